# SPDX-License-Identifier: Apache-2.0
"""The service force_over, exact or with a reason and never waited for; and which poles tell a touch."""

import math
import os
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from rclpy.executors import SingleThreadedExecutor
from spinning import spin_until
from std_srvs.srv import Trigger
from tactile_resonance.srv import ForceOver

from tactile_resonance import msg
from tactile_resonance.contact.goal import State
from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.contact.loop import Cycle
from tactile_resonance.contact.samples import ArmSample, WrenchSample
from tactile_resonance.nodes import contact_topics
from tactile_resonance.nodes.contact_topics import ForceService, TouchFromPoles
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import time_message
from tactile_resonance.nodes.running import initialised
from tactile_resonance.processes import free_domain_id
from tactile_resonance.recording.messages import time_from_message

MS = 1_000_000
BEGAN_NS = 3_600_000 * MS  # of a loop's clock that has run for an hour
AHEAD_NS = 1_700_000_000 * 10**9  # ROS time less the loop's
BIAS_N, ZERO_STD_N, SLOPE_N_S = 0.3, 4e-5, 0.02


class Contact(ManagedNode):
    """What contact_node makes of it, without a robot."""

    def __init__(self):
        super().__init__("contact_node", ())
        self.clock = SimpleNamespace(ros_ns=lambda t: t + AHEAD_NS, own_ns=lambda t: t - AHEAD_NS)
        self.ticks = 0

    def configure(self):
        self.forces = ForceService(self, 1000.0, 2e-3, lambda: self.clock, "base")
        self.every(0.005, self._tick)
        self.serve(Trigger, "other", lambda request, response: response)

    def _tick(self):
        self.ticks += 1

    def run(self, until_ms, state=State.HOLD, began_ms=0, fault=None, silent_ms=(0, 0)):
        """Let the loop see a force that rises from 0 at the beginning, less what the cell left out."""
        for tick in range(began_ms, until_ms, 2):
            wrenches = [
                WrenchSample(
                    BEGAN_NS + ms * MS, (9.0, -9.0, BIAS_N + SLOPE_N_S * ms * 1e-3), (0.0,) * 3
                )
                for ms in (tick + 1, tick + 2)
                if not silent_ms[0] < ms < silent_ms[1]
            ]
            time_ns = BEGAN_NS + (tick + 2) * MS
            arm = ArmSample(time_ns, 0.0, (0.1, 0.2, 1e-4 * tick), (0.0, 0.0, 0.5), (0.0,) * 6)
            zero = (0.0, 0.0, BIAS_N), ZERO_STD_N
            self.forces.take(Cycle(time_ns, arm, wrenches, state, *zero, fault))


@pytest.fixture
def served(monkeypatch):
    """The node, a client's question, and something that spins until a condition holds."""
    monkeypatch.setattr(contact_topics, "WAIT_S", 60.0)
    with initialised(domain_id=free_domain_id(os.environ)):
        node, executor = Contact(), SingleThreadedExecutor()
        node.trigger_configure()
        node.trigger_activate()
        executor.add_node(node)
        client = node.create_client(ForceOver, "force_over")
        other = node.create_client(Trigger, "other")

        def wait(holds):
            assert spin_until(executor, holds)

        def ask(start_ms, end_ms):
            start_ns, end_ns = (BEGAN_NS + AHEAD_NS + ms * MS for ms in (start_ms, end_ms))
            request = ForceOver.Request(start=time_message(start_ns), end=time_message(end_ns))
            return client.call_async(request)

        def answer(start_ms, end_ms):
            asked = ask(start_ms, end_ms)
            wait(asked.done)
            return asked.result()

        wait(lambda: client.service_is_ready() and other.service_is_ready())
        yield SimpleNamespace(node=node, ask=ask, answer=answer, wait=wait, other=other)
        node.destroy_node()


def test_mean_over_a_block_is_exact_and_its_place_that_of_the_middle(served):
    served.node.run(1000)
    told = served.answer(100, 420)
    assert told.reason == ""
    assert told.coverage == 1.0
    assert told.force_n == pytest.approx(SLOPE_N_S * 0.26, rel=1e-12)
    # eight batches of a ramp, whose means are a straight line of 8 values over 0.28 s; and the zero
    batches = [SLOPE_N_S * 0.04 * n for n in range(8)]
    variance = sum((b - sum(batches) / 8) ** 2 for b in batches) / 7 / 8
    assert told.force_std_n == pytest.approx(math.sqrt(variance + ZERO_STD_N**2), rel=1e-9)
    # a ramp, in sixteen means over 20 ms
    assert told.force_rms_n == pytest.approx(SLOPE_N_S * 0.32 / math.sqrt(12), rel=2e-2)
    assert told.force_max_n - told.force_min_n == pytest.approx(SLOPE_N_S * 0.3, rel=1e-2)
    pose = told.tip_pose
    assert pose.header.frame_id == "base"
    assert time_from_message(pose.header.stamp) == BEGAN_NS + AHEAD_NS + 260 * MS
    place, turn = pose.pose.position, pose.pose.orientation
    assert (place.x, place.y) == (0.1, 0.2)
    assert place.z == pytest.approx(
        1e-4 * (260 - 2), rel=1e-9
    )  # a period's state is told at its end
    assert (turn.z, turn.w) == pytest.approx((math.sin(0.25), math.cos(0.25)))


@pytest.mark.parametrize(("silent_ms", "share"), [((200, 250), 0.83333), ((200, 270), 0.76667)])
def test_a_block_of_which_too_little_was_heard_has_no_force_but_a_reason(served, silent_ms, share):
    served.node.run(1000, silent_ms=silent_ms)
    told = served.answer(100, 400)
    assert told.coverage == pytest.approx(share, abs=1e-5)
    if share < 0.8:
        assert math.isnan(told.force_n)
        assert math.isnan(told.force_std_n)
        assert math.isnan(told.force_rms_n + told.force_min_n + told.force_max_n)
        assert told.reason == "forces cover 76.7 % of the block, at least 80 % are accepted"
    else:
        assert told.reason == ""
        # where nothing was heard nothing is made up: the mean of what was
        assert told.force_n == pytest.approx(
            SLOPE_N_S * (0.1 * 0.15 + 0.15 * 0.325) / 0.25, rel=1e-9
        )
    assert told.tip_pose.header.frame_id == "base"


@pytest.mark.parametrize(
    ("state", "fault"),
    [(State.TRAVEL, None), (State.TARE, None), (State.HOLD, ArmError(ArmFault.STALE, "too old"))],
)
def test_forces_without_a_zero_or_in_a_fault_do_not_count(served, state, fault):
    served.node.run(500, state, fault=fault)
    served.node.run(1000, began_ms=500)
    told = served.answer(100, 400)
    assert math.isnan(told.force_n)
    assert told.reason.startswith("forces cover 0 % of the block")
    assert served.answer(600, 900).force_n == pytest.approx(SLOPE_N_S * 0.75, rel=1e-12)


def test_a_block_that_is_not_over_is_waited_for_and_nothing_else_waits(served):
    served.node.run(200)
    asked = [served.ask(100, 300), served.ask(100, 400)]
    served.wait(lambda: sum(t.name == "force_over" for t in threading.enumerate()) == 2)
    ticks = served.node.ticks
    served.wait(lambda: served.node.ticks > ticks + 5)
    other = served.other.call_async(Trigger.Request())
    served.wait(other.done)
    assert not any(future.done() for future in asked)
    served.node.run(310, began_ms=200)
    served.wait(asked[0].done)
    assert asked[0].result().force_n == pytest.approx(SLOPE_N_S * 0.2, rel=1e-12)
    assert not asked[1].done()
    served.node.run(410, began_ms=310)
    served.wait(asked[1].done)
    assert asked[1].result().force_n == pytest.approx(SLOPE_N_S * 0.25, rel=1e-12)


def test_a_loop_that_stands_is_not_waited_for_for_long(served, monkeypatch):
    monkeypatch.setattr(contact_topics, "WAIT_S", 0.2)
    served.node.run(200)
    begun_s, asked = time.monotonic(), served.ask(100, 300)
    served.wait(asked.done)
    assert time.monotonic() - begun_s >= 0.2
    assert math.isnan(asked.result().force_n)
    assert asked.result().reason == "the block ends 100.0 ms in the future"


def test_without_a_contact_there_is_no_force_and_nothing_to_wait_for(served):
    served.node.run(200, State.IDLE)
    told = served.answer(100, 300)  # would wait for ever
    assert math.isnan(told.force_n)
    assert told.reason == "no contact was under way"
    assert served.answer(300, 300).reason == "the interval is empty"
    served.node.clock = None
    assert served.answer(100, 300).reason == "contact_node is not active"


SECOND_NS = 10**9
UP_NS = 1000 * SECOND_NS
AIR, GELATINE = (246.60, 0.0119), (249.0, 0.020)
STD = np.array([0.01, 5e-5])


def poles(pole, middle_ns, *, final=True, covariance=True):
    damped = 2 * np.pi * pole[0]
    message = msg.Poles(
        final=final,
        f0_hz=[pole[0]],
        damping_ratio=[pole[1]],
        real_rad_s=[-pole[1] * damped],
        imag_rad_s=[damped],
        residue_real=[0.0],
        residue_imag=[1.0],
        order=2,
        numerator_order=2,
    )
    if covariance:
        message.covariance = np.diag(STD**2).ravel().tolist()
    message.header.stamp = time_message(int(middle_ns))
    return message


class Hearing:
    """A `TouchFromPoles` with a clock set by the test."""

    def __init__(self, references=8):
        self.told, self.now_ns = 0, UP_NS + 2 * SECOND_NS
        self.rng = np.random.default_rng(2)
        self.touch = TouchFromPoles(1e-6, UP_NS)
        for _ in range(references):
            self.hear(AIR, State.IDLE)

    def hear(self, pole, state, length_s=0.8, passed=False, **fields):
        """Let a measurement of so long go by, unless it has passed, and hear of it at its end."""
        self.now_ns += 0 if passed else round(length_s * SECOND_NS)
        self.touch.moved(state, self.now_ns)
        pole = np.array(pole) + STD * self.rng.standard_normal(2)
        middle_ns = self.now_ns - length_s * SECOND_NS / 2
        touched = self.touch.hear(poles(pole, middle_ns, **fields), state, self.now_ns)
        self.told += touched
        return touched

    def stay(self, state, seconds):
        for _ in range(round(seconds / 0.1)):
            self.now_ns += SECOND_NS // 10
            self.touch.moved(state, self.now_ns)


def test_poles_that_change_in_an_approach_tell_the_touch():
    listener = Hearing()
    listener.stay(State.APPROACH, 0.5)
    for _ in range(5):
        assert not listener.hear(AIR, State.APPROACH)
    assert listener.hear(GELATINE, State.APPROACH)
    assert listener.told == 1


def test_without_eight_measurements_in_air_nothing_is_told():
    listener = Hearing(references=7)
    # what it holds is part of what the next poles of the same measurement say again
    listener.hear(AIR, State.IDLE, final=False)
    assert not listener.hear(GELATINE, State.APPROACH)
    assert listener.told == 0


def test_measurement_that_began_in_contact_is_no_reference_and_no_touch():
    listener = Hearing()
    listener.stay(State.HOLD, 1.0)
    listener.stay(State.RETRACT, 0.3)
    listener.stay(State.IDLE, 0.3)
    # half of it in the tissue: no reference, however far off
    listener.hear(GELATINE, State.IDLE, length_s=1.2, passed=True)
    # seen live: taken wholly after the contact, and yet of the contact
    listener.stay(State.IDLE, 0.2)
    listener.hear(GELATINE, State.IDLE, length_s=0.4, passed=True)
    listener.stay(State.HOLD, 1.0)
    listener.stay(State.TRAVEL, 0.2)
    listener.stay(State.APPROACH, 0.2)
    # it began in the last contact
    assert not listener.hear(GELATINE, State.APPROACH, passed=True)
    listener.stay(State.APPROACH, 0.5)
    assert not listener.hear(AIR, State.APPROACH)
    assert listener.hear(GELATINE, State.APPROACH)


def test_measurement_that_began_before_all_that_is_known_is_no_reference():
    listener = Hearing(references=0)
    # whether the tip was in air then nobody can tell
    listener.hear(AIR, State.IDLE, length_s=1.5, passed=True)
    for _ in range(7):
        listener.hear(AIR, State.IDLE)
    listener.stay(State.APPROACH, 1.5)
    assert not listener.hear(GELATINE, State.APPROACH)
    assert listener.told == 0


def test_poles_without_covariance_are_said_to_be_of_no_use():
    with pytest.raises(ValueError, match="covariance: unknown"):
        Hearing().hear(AIR, State.APPROACH, covariance=False)
