# SPDX-License-Identifier: Apache-2.0
"""What a contact that ended means for the point."""

from itertools import count
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from geometry_msgs.msg import PoseStamped

from tactile_resonance import msg
from tactile_resonance.contact.goal import Cause, HoldMode
from tactile_resonance.nodes.messages import time_message
from tactile_resonance.nodes.tip_contact import UNKNOWN, TipContact
from tactile_resonance.scan.failures import PointDisturbed, ScanEnded
from tactile_resonance.scan.point_outcome import StateTimes

NOT_OF_THE_POINT = (
    "force_stale",
    "force_source",
    "force_invalid",
    "arm_stale",
    "arm_link",
    "cancelled",
    "busy",
    "stopped",
)
OF_THE_POINT = ("refused", "force_hard", "force_abort", "force_overload", "surface_missing", "tilt")


@pytest.mark.parametrize("cause", [*NOT_OF_THE_POINT, *OF_THE_POINT])
def test_a_point_comes_again_where_the_cause_says_nothing_of_it(cause):
    known = {member.value for member in Cause}
    if cause not in known:
        pytest.fail(f"{cause}: expected one of {sorted(known)}")
    tip = TipContact.__new__(TipContact)
    tip.stopped = False
    failure = tip.failure(msg.ContactState(cause=cause, message="told"))
    assert isinstance(failure, PointDisturbed) == (cause in NOT_OF_THE_POINT)
    assert cause in str(failure)
    assert "told" in str(failure)


def test_a_contact_is_as_old_as_its_first_touch(monkeypatch):
    """It took 0.3 s until the force was reached, at 5 s; that it is still held is said again and again."""
    tip = TipContact.__new__(TipContact)
    tip._state, tip._held_ns, tip.stopped, tip._instance = UNKNOWN, 0, False, 0
    tip._times, tip._low = StateTimes(), False

    def make(goal, check):
        for state, seconds in (("settle", 4.9), ("hold", 5.0), ("hold", 5.04), ("hold", 5.08)):
            message = msg.ContactState(state=state)
            message.header.stamp = time_message(round(seconds * 1e9))
            tip._on_state(message)
        return SimpleNamespace(contact_s=0.3)

    monkeypatch.setattr(tip, "_make", make)
    tip.hold(PoseStamped(), 0.01, HoldMode.FORCE, lambda: None)
    assert tip.touched_ns == 4_700_000_000
    assert tip.spent_s["press_s"] == pytest.approx(0.1)
    assert tip.spent_s["hold_s"] == pytest.approx(0.08)


def drawn_back(monkeypatch, seen=("approach", "hold", "retract"), refused="", **state):
    """What `retract` comes to where contact_node then reports this state, after those seen."""
    tip = TipContact.__new__(TipContact)
    tip._times = StateTimes()
    for k, each in enumerate(seen):
        tip._times.take(each, 10**9 * (k + 1))
    tip.touching, tip.touched_ns, tip._end_if_hung = True, 1, lambda: None
    tip._time = SimpleNamespace(go=lambda: None)

    def ask():
        tip._state = msg.ContactState(**state)
        return refused

    monkeypatch.setattr(tip, "_ask_to_retract", ask)
    monkeypatch.setattr("tactile_resonance.nodes.tip_contact.ASK_AGAIN_S", 0.05)
    return tip.retract(1.0)


def test_a_tip_that_is_held_ends_the_scan_with_the_reason(monkeypatch):
    with pytest.raises(ScanEnded, match="the tip is held: a hook pulls"):
        drawn_back(monkeypatch, state="fault", cause="held", message="a hook pulls")


def test_a_tip_that_is_not_drawn_back_ends_the_scan_with_what_keeps_it(monkeypatch):
    monkeypatch.setattr("time.monotonic", count(0.0, 0.3).__next__)
    for refused, told in (("arm: protective stop", ""), ("", "tip tilted by 0.9 rad")):
        with pytest.raises(ScanEnded, match=f"not drawn back within 1 s: {refused or told}$"):
            drawn_back(monkeypatch, refused=refused, state="fault", message=told)


@pytest.mark.parametrize(("moved_n", "told_n"), [(-2e-3, -2e-3), (0.0, 0.0), (float("nan"), 0.0)])
def test_a_tip_that_is_free_tells_how_far_its_zero_moved(monkeypatch, moved_n, told_n):
    assert drawn_back(monkeypatch, state="idle", zero_moved_n=moved_n) == told_n


@pytest.mark.parametrize("state", ["approach", "hold", "retract"])
def test_a_reference_in_air_is_disturbed_where_another_client_moves_the_tip(state):
    tip = TipContact.__new__(TipContact)
    tip.touching, tip.stopped = False, False
    for free in ("", "idle", "fault"):
        tip._state = msg.ContactState(state=free)
        tip.check()
    tip._state = msg.ContactState(state=state)
    with pytest.raises(PointDisturbed, match=f"contact: {state}: asked for by another client") as caught:
        tip.check()
    assert caught.value.kind == "busy"


def test_the_zero_of_the_contact_before_is_not_that_of_a_goal_that_was_refused(monkeypatch):
    assert drawn_back(monkeypatch, ("idle",), state="idle", zero_moved_n=-2e-3) == 0.0
