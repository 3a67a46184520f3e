# SPDX-License-Identifier: Apache-2.0
"""The loop of a contact when something is wrong with it: the arm comes to rest, nobody waits for ever."""

import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.clock import WallClock
from tactile_resonance.contact.goal import State
from tactile_resonance.contact.interfaces import ArmFault
from tactile_resonance.contact.loop import MOST_STOPS
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.samples import Pose
from tactile_resonance.nodes import contact_thread
from tactile_resonance.nodes.contact_thread import ContactThread

sys.path.insert(0, str(Path(__file__).parents[1] / "contact"))
from contacts import QUICK, contact

HANGS_S = 20.0
"""What takes longer has hung, on whatever machine."""


class Rig:
    """A `ContactThread` on the bench in virtual time, whose arm and listener may be made faulty.

    Attributes
    ----------
    stops, states : int
        Stops and requests for the state that the arm has had.
    unheard : int
        So many of the next stops are lost on their way.
    on_the_way : callable
        Called in the loop's thread in each cycle of the approach in which the tip moves.
    """

    waits_for = ""
    tip_in_tool = Pose.at_origin()

    def __init__(self, clock=None, told_s=0.0):
        made = contact()
        self.bench, self.goal, self._arm = made.bench, made.goal, made.bench.arm
        self.clock = clock or self.bench
        self.stops = self.states = self.unheard = 0
        self.on_the_way = lambda: None
        self.closed, self.failed = False, threading.Event()
        self.connecting, self.connect_now = threading.Event(), threading.Event()
        self.connect_now.set()
        self.states_while_connecting = 0
        self.thread = ContactThread(
            self, self.bench.cell, QUICK, Limits(), None, self._listen, self.failed.set, told_s
        )

    def begin(self):
        self.thread.start(self.goal, QUICK, Limits())

    def until(self, state):
        deadline = time.monotonic() + HANGS_S
        while self.thread.controller.state is not state:
            assert time.monotonic() < deadline, self.thread.controller.state
            time.sleep(1e-4)

    def defect(self, unheard=0):
        self.stops, self.unheard = 0, unheard
        raise RuntimeError("a defect")

    def _listen(self, cycle):
        if cycle.state is State.APPROACH and self.speed_m_s > 3e-3:
            self.on_the_way()

    @property
    def speed_m_s(self):
        return np.linalg.norm(self.bench.motion.twist[:3])

    # NodeArm

    def led_clock(self, cell, while_waiting):
        return None

    def connect(self):
        self.connecting.set()
        assert self.connect_now.wait(HANGS_S)
        self._arm.repair()
        self._arm.connect()
        self.connecting.clear()

    def state(self):
        self.states += 1
        self.states_while_connecting += self.connecting.is_set()
        return self._arm.state()

    def speed(self, twist, acceleration_m_s2):
        self._arm.speed(twist, acceleration_m_s2)

    def stop(self, deceleration_m_s2):
        self.stops += 1
        if self.stops > self.unheard:
            self._arm.stop(deceleration_m_s2)

    def close(self):
        self.closed = True
        self._arm.close()


def within_reason(work):
    """Result of work that must not hang."""
    results = []
    thread = threading.Thread(target=lambda: results.append(work()), daemon=True)
    thread.start()
    thread.join(HANGS_S)
    assert results, "it hangs"
    return results[0]


@pytest.mark.parametrize("unheard", [0, 1, 7])
def test_after_a_defect_of_the_loop_the_arm_is_stopped_until_it_stands(unheard):
    rig = Rig()
    rig.on_the_way = lambda: rig.defect(unheard)
    rig.begin()
    assert rig.failed.wait(HANGS_S)
    assert "a defect" in str(rig.thread.error)
    assert rig.stops == unheard + 1
    assert rig.speed_m_s < 5e-4
    assert rig.thread.moves == ""
    assert not rig.closed
    assert within_reason(rig.thread.close)


def test_an_arm_that_is_never_seen_to_stand_is_told_and_its_link_closed():
    rig = Rig()
    rig.on_the_way = lambda: rig.defect(10**6)
    rig.begin()
    assert rig.failed.wait(HANGS_S)
    assert rig.thread.moves == "it still moves"
    assert rig.stops == MOST_STOPS
    assert rig.closed


def test_a_link_that_is_gone_is_not_tried_for_long():
    rig = Rig()

    def lose():
        rig._arm.break_link(ArmFault.CLIENT_DIED)
        rig.defect()

    rig.on_the_way = lose
    rig.begin()
    assert rig.failed.wait(HANGS_S)
    assert "client_died" in rig.thread.moves
    assert rig.stops == 1
    assert rig.closed


def test_a_loop_that_hangs_is_given_up_and_its_arm_closed(monkeypatch):
    monkeypatch.setattr(contact_thread, "RETRACT_WITHIN_S", 0.3)
    monkeypatch.setattr(contact_thread, "END_WITHIN_S", 0.3)
    rig, on, hangs = Rig(), threading.Event(), threading.Event()
    rig.on_the_way = lambda: hangs.set() or on.wait()
    rig.begin()
    assert hangs.wait(HANGS_S)
    assert not within_reason(rig.thread.close)
    assert rig.closed
    moved = rig.stops, rig.thread.loop.cycles
    on.set()  # it comes back: it moves nothing any more
    rig.thread._thread.join(HANGS_S)
    assert not rig.thread._thread.is_alive()
    assert rig.thread.loop.cycles == moved[1]
    assert rig.speed_m_s == pytest.approx(0, abs=5e-3)


def test_a_goal_begins_at_once_however_seldom_an_idle_loop_looks(monkeypatch):
    monkeypatch.setattr(contact_thread, "MOST_IDLE_PERIODS", 10**8)
    rig = Rig(WallClock(), told_s=2e5)
    loop = rig.thread.loop
    deadline = time.monotonic() + HANGS_S
    while loop.left_s < 1e5:  # after its first cycle
        assert time.monotonic() < deadline
        time.sleep(1e-4)
    rig.begin()
    rig.until(State.FAULT)  # the states of an arm on another clock are of another time
    assert within_reason(rig.thread.close)


def test_a_loop_that_is_ended_in_contact_draws_back_and_leaves_the_arm_at_rest():
    rig = Rig()
    rig.begin()
    rig.until(State.HOLD)
    assert within_reason(rig.thread.close)
    assert rig.thread.controller.state is State.IDLE
    assert rig.speed_m_s < 5e-4
    assert not rig.closed


def test_requests_are_taken_while_the_program_of_the_arm_is_started_again():
    rig = Rig()
    rig.on_the_way = lambda: rig._arm.halt(ArmFault.PROGRAM_STOPPED)
    rig.begin()
    rig.until(State.FAULT)
    rig.on_the_way = lambda: None
    rig.connect_now.clear()
    ready = threading.Thread(target=rig.thread.make_ready, daemon=True)
    ready.start()
    assert rig.connecting.wait(HANGS_S)
    within_reason(lambda: rig.thread.retract() or True)
    with pytest.raises(ValueError, match="accepted in idle"):
        rig.thread.configure(ContactParameters(), Limits())
    assert rig.thread.alive
    time.sleep(0.1)  # a loop that went on would run hundreds of cycles
    assert rig.states_while_connecting == 0, "the arm is the other thread's"
    rig.connect_now.set()
    ready.join(HANGS_S)
    rig.thread.retract()
    rig.until(State.IDLE)
    assert within_reason(rig.thread.close)
