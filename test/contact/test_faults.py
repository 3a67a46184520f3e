# SPDX-License-Identifier: Apache-2.0
"""Every fault in every state ends with the tip at rest, in time, below the hard limit, and is named.

The times are those that docs/safety.md states.
"""

import copy
import functools
import sys
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.contact.goal import Cause, State
from tactile_resonance.contact.interfaces import ArmFault, ForceFault
from tactile_resonance.contact.parameters import Limits

sys.path.insert(0, str(Path(__file__).parent))
import contacts
from contacts import SOFT, contact, lower, started, stiffer

STATES = [s for s in State if s not in (State.IDLE, State.FAULT)]
HARD_N = Limits().hard_force_n
AT_REST_M_S = 3e-4


def set_fault(**faults):
    def inject(made):
        for name, value in faults.items():
            setattr(made.bench.cell.faults, name, value)

    return inject


def cell_error(fault):
    def inject(made):
        made.bench.cell.error = fault

    return inject


def arm(method, *arguments):
    return lambda made: getattr(made.bench.arm, method)(*arguments)


FORCE_FAULTS = {
    # name: (injection, rest within [s], accepted causes)
    "silent": (set_fault(silent=True), 0.08, {Cause.FORCE_STALE}),
    "stuck": (set_fault(stuck=True), 0.10, {Cause.FORCE_STUCK}),
    "no number": (set_fault(invalid=True), 0.07, {Cause.FORCE_INVALID}),
    "saturated": (set_fault(saturated=True), 0.07, {Cause.FORCE_PULL}),
    "link lost": (cell_error(ForceFault.LINK_LOST), 0.07, {Cause.FORCE_SOURCE}),
    "overload": (cell_error(ForceFault.OVERLOAD), 0.07, {Cause.FORCE_SOURCE}),
    "frames lost": (cell_error(ForceFault.INCOMPLETE), 0.07, {Cause.FORCE_SOURCE}),
    "step up": (set_fault(bias_step_n=-0.03), 0.09, {Cause.FORCE_ABORT, Cause.FORCE_RATE}),
    "step down": (set_fault(bias_step_n=0.03), 0.09, {Cause.FORCE_PULL, Cause.FORCE_RATE}),
}
"""The cell under the sample shows a press as a negative force, so that a step of -0.03 N is a press."""

ARM_FAULTS = {
    "frozen for 1 s": (arm("freeze", 1.0), 0.13, {Cause.ARM_LINK}),
    "frozen for 4 s": (arm("freeze", 4.0), 0.13, {Cause.ARM_LINK}),
    "link lost": (arm("break_link", ArmFault.LINK_LOST), 0.12, {Cause.ARM_LINK}),
    "client died": (arm("break_link", ArmFault.CLIENT_DIED), 0.12, {Cause.ARM_LINK}),
    "protective stop": (
        arm("halt", ArmFault.PROTECTIVE_STOP),
        0.07,
        {Cause.ARM_STOPPED, Cause.ARM_LINK},
    ),
    "emergency stop": (
        arm("halt", ArmFault.EMERGENCY_STOP),
        0.07,
        {Cause.ARM_STOPPED, Cause.ARM_LINK},
    ),
    "watchdog": (
        arm("halt", ArmFault.PROGRAM_STOPPED),
        0.07,
        {Cause.ARM_STOPPED, Cause.ARM_LINK},
    ),
}


def brought_to(state):
    """A contact in a state, for whoever asks a copy of the same one."""
    return copy.deepcopy(_brought_to(state))


@functools.cache
def _brought_to(state):
    made = started()
    if state is State.RETRACT:
        assert made.run_until(State.HOLD)
        made.controller.retract()
    assert made.run_until(state)
    made.run(0.01)
    return made


def inwards(made, since):
    return -np.minimum(0, made.speed_m_s[since:])


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("name", FORCE_FAULTS)
def test_fault_of_the_force_stops_the_tip_and_draws_it_back(name, state):
    inject, rest_s, causes = FORCE_FAULTS[name]
    made = brought_to(state)
    before = made.controller.state
    inject(made)
    at = len(made.force_n)
    made.run_until(State.IDLE, 6.0)
    result = made.controller.result
    assert max(made.force_n) < HARD_N
    if before is State.RETRACT:  # by position alone, or feeling its way
        assert result.retracted
        return
    if before in (State.TRAVEL, State.TARE) and name.startswith("step"):
        # before the tare a step is part of the zero, or makes it refused
        assert result is None or result.cause in {Cause.TARE, Cause.SURFACE_EARLY, Cause.NONE}
        return
    if before in (State.TRAVEL, State.TARE) and name == "saturated":
        causes = {*causes, Cause.SURFACE_EARLY, Cause.TARE, Cause.FORCE_STUCK}
        rest_s = 1.0  # while at rest anyway
    assert result.cause in causes, result.message
    assert result.message
    after = inwards(made, at + round(rest_s / 0.002))
    assert after.size == 0 or after.max() < AT_REST_M_S
    assert result.retracted
    assert made.controller.state is State.IDLE


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("name", ARM_FAULTS)
def test_fault_of_the_arm_stops_the_tip_where_it_is(name, state):
    inject, rest_s, causes = ARM_FAULTS[name]
    made = brought_to(state)
    inject(made)
    at = len(made.force_n)
    made.run(0.3)
    result = made.controller.result
    assert max(made.force_n) < HARD_N
    assert made.controller.state is State.FAULT
    if state is not State.RETRACT:
        assert result.cause in causes, result.message
    assert not result.retracted
    assert np.abs(made.speed_m_s[at + round(rest_s / 0.002) :]).max() < AT_REST_M_S
    # after the repair the tip moves only when it is told to
    made.bench.arm.repair()
    made.bench.arm.connect()
    made.bench.cell.start()
    place = made.bench.motion.reported.position_m
    made.run(0.1)
    np.testing.assert_allclose(made.bench.motion.reported.position_m, place, atol=1e-6)
    assert made.loop.retract().retracted


@pytest.mark.parametrize("state", [State.APPROACH, State.CONTACT, State.SETTLE, State.HOLD])
def test_frozen_for_20_ms_is_survived_or_named(state):
    made = brought_to(state)
    made.bench.arm.freeze(0.02)
    made.run(1.0)
    assert max(made.force_n) < 1.6 * contacts.FORCE_N
    result = made.controller.result
    assert made.controller.state is State.HOLD or result.cause in {Cause.ARM_LINK, Cause.ARM_STALE}


def test_flipped_sign_is_found_before_the_abort_force():
    made = contact()
    made.bench.cell.faults.flipped = True
    result = made.loop.make(made.goal)
    assert result.cause is Cause.FORCE_PULL
    assert max(made.force_n) < Limits().abort_force_n


def test_one_frame_of_many_pairs_lost_is_survived():
    made = contact()
    made.bench.cell.faults.lose_second_every = 3
    assert made.loop.make(made.goal).reached
    made.run(1.0)
    assert np.mean(made.force_n[-500:]) == pytest.approx(contacts.FORCE_N, rel=0.05)


def test_small_step_in_hold_moves_the_force_no_further_than_the_step():
    made = brought_to(State.HOLD)
    made.bench.cell.faults.bias_step_n = -3e-3
    made.run(1.0)
    assert abs(made.force_n[-1] - contacts.FORCE_N) < 4.5e-3


def test_missing_surface_ends_the_search_at_its_depth():
    made = contact(height_m=-0.02)
    result = made.loop.make(made.goal)
    made.run(0.3)
    assert result.cause is Cause.SURFACE_MISSING
    lowest = -contacts.QUICK.search_m
    assert made.bench.motion.reported.position_m[2] > contacts.RADIUS_M + lowest - 2e-4


@pytest.mark.parametrize("tissue", [SOFT, stiffer(SOFT, 8.0)])
def test_surface_5_mm_early_is_met_slowly_enough(tissue):
    # on the way down to the standoff, before any tare
    made = contact(tissue, height_m=5e-3, start_m=0.02)
    result = made.loop.make(made.goal)
    made.run(0.5)
    assert result.cause in {Cause.SURFACE_EARLY, Cause.FORCE_RATE}
    assert max(made.force_n) < HARD_N


@pytest.mark.parametrize("state", [State.CONTACT, State.SETTLE, State.HOLD])
def test_tissue_that_is_taken_away_is_noticed(state):
    made = brought_to(state)
    lower(made.bench, 0.01)
    at = len(made.force_n)
    made.run_until(State.IDLE, 2.5)
    result = made.controller.result
    assert result.cause in {
        Cause.CONTACT_LOST,
        Cause.SURFACE_MISSING,
        Cause.FORCE_RATE,
        Cause.DEPTH,
    }
    assert result.retracted
    assert max(made.force_n[at:]) < 1.2 * contacts.FORCE_N


@pytest.mark.parametrize("lost_s", [0.02, 0.3])
def test_lost_contact_is_told_by_the_mean_over_the_time_asked_for(lost_s):
    made = started(limits=Limits(lost_s=lost_s, depth_m=6e-3, force_rate_n_per_s=10.0))
    assert made.run_until(State.HOLD)
    made.run(0.5)
    lower(made.bench, 0.01)
    at = len(made.force_n)
    assert made.run_until(State.FAULT, 1.0)
    assert made.controller.result.cause is Cause.CONTACT_LOST
    # 10 mN until the tissue was gone: the mean is below 2 mN after four fifths of its time
    assert (len(made.force_n) - at) * 0.002 == pytest.approx(0.8 * lost_s, rel=0.2, abs=6e-3)


@pytest.mark.parametrize("seed", range(10))
def test_tissue_ten_times_stiffer_than_the_stiffest_stays_below_the_hard_limit(seed):
    # 400 kPa under 2.5 mm: 370 N/m at 1 cN
    made = contact(stiffer(SOFT, 400 / 8.8), seed=seed)
    result = made.loop.make(made.goal)
    made.run(0.5)
    # taken off at once and faster than it came, the force stays below what the abort is set to
    assert max(made.force_n) < Limits().abort_force_n
    if result.cause is not Cause.NONE:
        assert result.cause in {Cause.FORCE_RATE, Cause.FORCE_ABORT}


@pytest.mark.parametrize("seed", range(3))
def test_force_that_goes_on_after_the_contact_was_given_up_is_told(seed):
    # 4 MPa: before the tip has turned round the force is four times that at which it was given up
    made = contact(stiffer(SOFT, 4000 / 8.8), seed=seed)
    assert made.loop.make(made.goal).cause in {Cause.FORCE_RATE, Cause.FORCE_ABORT}
    assert made.run_until(State.IDLE, 5.0)
    noise_n = made.bench.cell.info.noise_rms_n
    assert max(made.force_n) > 2 * Limits().hard_force_n
    result = made.controller.result
    assert abs(result.peak_force_n - max(made.force_n)) < 5 * noise_n
    assert result.cause is Cause.FORCE_HARD
    assert f"{1e3 * result.peak_force_n:.1f} mN on the tip, beyond the hard limit" in result.message


def test_arm_that_turns_on_the_spot_is_not_taken_to_stand():
    made = contact()
    arm = made.bench.arm
    arm.speed([0, 0, 0, 0, 0, 0.3], 2.0)
    made.bench.wait_until(300_000_000)
    stop, stops = arm.stop, []
    arm.stop = lambda a: stop(a) if len(stops) > 3 else stops.append(a)  # the first ones are lost
    assert made.loop.bring_to_rest() == ""
    assert len(stops) > 3
    assert max(map(abs, arm.state().velocity)) < 1e-2


@pytest.mark.parametrize(
    "fault", [ArmFault.REGISTERS_IN_USE, ArmFault.NOT_REMOTE, ArmFault.PROGRAM_NOT_STARTED]
)
def test_arm_that_does_not_start_is_named_and_nothing_moves(fault):
    made = contact()
    made.bench.arm.break_link(fault)
    result = made.loop.make(made.goal)
    made.run(0.2)
    assert result.cause is Cause.ARM_LINK
    assert fault.value in result.message
    assert np.abs(made.speed_m_s).max() == 0


@pytest.mark.parametrize("state", [State.APPROACH, State.CONTACT, State.SETTLE])
@pytest.mark.parametrize(
    "inject", [set_fault(stuck=True), set_fault(silent=True), ARM_FAULTS["link lost"][0]]
)
def test_on_stiff_tissue_the_way_to_rest_costs_little_force(inject, state):
    made = started(stiffer(SOFT, 40 / 8.8), seed=3)
    assert made.run_until(state)
    if state is State.APPROACH:  # a few samples before the touch
        touch_m = contacts.RADIUS_M + 1e-3
        position = made.bench.motion
        made.loop.run_while(lambda: position.reported.position_m[2] > touch_m + 2e-5)
    inject(made)
    made.run(0.3)
    assert max(made.force_n) < 2.0 * contacts.FORCE_N
