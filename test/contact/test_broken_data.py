# SPDX-License-Identifier: Apache-2.0
"""Stamps of the future, poses that are not finite, commands that are lost or refused."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.contact.goal import Cause, State
from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.contact.loop import ContactLoop
from tactile_resonance.contact.parameters import Limits
from tactile_resonance.simulation.cell.transducer import CellParameters

sys.path.insert(0, str(Path(__file__).parent))
from contacts import FORCE_N, SOFT, contact, lower, started, stiffer
from disturbed import broken_promises, disturbed


def brought_to(state, **options):
    rig = disturbed(SOFT, **options)
    rig.loop.start(rig.goal)
    if state is State.RETRACT:
        assert rig.run_until(State.HOLD)
        rig.controller.retract()
    assert rig.run_until(state)
    rig.run(0.01)
    return rig


STATES = [s for s in State if s not in (State.IDLE, State.FAULT)]
NAN = math.nan
NO_POSES = {
    "place": {"position_m": (NAN, NAN, NAN)},
    "turn": {"rotation_rad": (NAN, NAN, NAN)},
    "endless turn": {"rotation_rad": (math.inf, 0.0, 0.0)},
    "speed": {"velocity": (0.0, 0.0, NAN, 0.0, 0.0, 0.0)},
    "endless speed": {"velocity": (math.inf, -math.inf, 0.0, 0.0, 0.0, 0.0)},
}


@pytest.mark.parametrize(
    ("name", "state"),
    [("turn", s) for s in STATES] + [(n, State.HOLD) for n in NO_POSES if n != "turn"],
)
def test_arm_whose_pose_is_not_finite_is_stopped_and_named(name, state):
    rig = brought_to(state)
    rig.arm.change = lambda sample: sample._replace(**NO_POSES[name])
    rig.run(0.3)
    assert rig.controller.state is State.FAULT
    assert rig.controller.result.message
    if state is not State.RETRACT:
        assert rig.controller.result.cause is Cause.ARM_INVALID
    assert np.abs(rig.twists[-1]).max() < 3e-4
    rig.arm.change = lambda sample: sample
    rig.controller.retract()
    assert rig.run_until(State.IDLE)
    rig.run(0.1)
    assert broken_promises(rig) == []


@pytest.mark.parametrize("state", [State.APPROACH, State.HOLD])
@pytest.mark.parametrize("device", ["arm", "force"])
def test_data_of_the_future_do_not_pass_for_fresh_ones(state, device):
    # a second ahead of the clock a sensor could be silent for a second unseen
    rig = brought_to(state)
    getattr(rig, device).late_ns = -(10**9)
    rig.run(0.02)
    result = rig.controller.result
    assert rig.controller.state is State.FAULT
    assert result.cause is {"arm": Cause.ARM_STALE, "force": Cause.FORCE_STALE}[device]
    assert "ahead of the clock" in result.message


def test_stop_that_is_lost_as_a_contact_ends_is_told_until_it_has_worked():
    # asked to draw back high above the standoff there is nothing to do but to stop
    rig = disturbed(SOFT, start_m=0.05)
    rig.loop.start(rig.goal)
    rig.run(0.3)
    assert rig.controller.state is State.TRAVEL
    assert np.linalg.norm(rig.twists[-1][:3]) > 0.02
    rig.arm.deaf = True  # a link that drops commands for shorter than its watchdog waits
    rig.controller.retract()
    rig.run(0.03)
    assert rig.controller.state is State.IDLE
    rig.arm.deaf = False
    rig.run(0.3)
    assert np.abs(rig.twists[-1]).max() < 1e-5
    assert broken_promises(rig) == []


def test_retraction_that_cannot_be_done_now_is_not_done_much_later():
    rig = brought_to(State.HOLD)
    rig.bench.arm.halt(ArmFault.PROTECTIVE_STOP)
    rig.run(0.1)
    rig.controller.retract()
    assert not rig.controller.settled
    rig.run(1.2)
    assert rig.controller.settled
    rig.bench.arm.repair()
    rig.bench.arm.connect()
    place = rig.heights_m[-1]
    rig.run(0.5)
    assert rig.heights_m[-1] == pytest.approx(place, abs=1e-5)
    assert rig.controller.state is State.FAULT
    # told anew it is
    rig.controller.retract()
    assert rig.run_until(State.IDLE)
    assert rig.controller.result.cause is Cause.ARM_STOPPED


def test_command_that_the_driver_refuses_ends_the_contact_with_its_reason():
    made = started()
    assert made.run_until(State.APPROACH)
    hears = made.bench.arm.speed

    def speed(twist, acceleration_m_s2):
        raise ValueError("speed: 0.3, the configuration allows 0.25")

    made.bench.arm.speed = speed
    made.run(0.2)
    assert made.controller.result.cause is Cause.ARM_LINK
    assert "the configuration allows 0.25" in made.controller.result.message
    assert abs(made.speed_m_s[-1]) < 1e-5
    made.bench.arm.speed = hears
    assert made.loop.retract().retracted


def test_forces_are_reported_while_no_state_of_the_arm_comes():
    """A supervisor may have to act on them."""
    made, told = contact(SOFT), []
    made.loop = ContactLoop(
        made.bench.arm, made.bench.cell, made.bench, made.controller, told.append
    )
    made.loop.make(made.goal)
    made.loop.run_while(lambda: True, 0.2)
    sees = made.bench.arm.state

    def state():
        raise ArmError(ArmFault.COMMAND_REFUSED, "no answer to a command")

    made.bench.arm.state = state
    del told[:]
    made.loop.run_while(lambda: True, 0.02)
    made.bench.arm.state = sees
    assert {cycle.arm for cycle in told} == {None}
    forces = [wrench.force_n[2] for cycle in told for wrench in cycle.wrenches]
    assert len(forces) >= 10
    # the arm has been stopped and stands, so force and zero stay as they were
    zero_n = told[0].bias_n[2]
    assert np.mean(forces) - zero_n == pytest.approx(FORCE_N, rel=0.2)


def test_tissue_that_rises_while_the_zero_is_taken_is_met_by_a_stop():
    # at 4 mm/s for up to half a second, as breathing does
    made = contact(stiffer(SOFT, 4.0), height_m=2.1e-3, start_m=2.2e-3)
    made.bench.on_step.append(
        lambda: lower(made.bench, -8e-6) if made.controller.state is State.TARE else None
    )
    made.loop.make(made.goal)
    result = made.controller.result
    assert result.cause is Cause.SURFACE_EARLY
    assert "before its zero was known" in result.message
    assert max(made.force_n) < 2.5 * FORCE_N


def test_noise_of_a_coarse_sensor_is_no_touch_on_the_way_down():
    parameters = replace(contact().controller.parameters, cell_noise_n=0.02, tare_std_n=0.01)
    coarse = replace(CellParameters.from_yaml(), force_noise_rms_n=0.02)
    limits = Limits(pull_force_n=0.5)
    made = contact(start_m=4.5e-3, parameters=parameters, limits=limits, cell_parameters=coarse)
    made.loop.start(made.goal)
    assert made.run_until(State.APPROACH, 5.0), made.controller.result


def test_estimate_that_errs_does_not_lead_deeper_than_search_and_depth_allow():
    rig = brought_to(State.HOLD, limits=Limits(depth_m=1.5e-3))
    # a force that stays whatever the depth, and an estimate by which the touch lies ever deeper
    model = rig.controller._observer.model
    lowest_m = -rig.controller.parameters.search_m - rig.controller.limits.depth_m
    lower(rig.bench, 0.02)
    rig.force.change = lambda s: s._replace(force_n=(*s.force_n[:2], s.force_n[2] + 4e-3))

    def sink():
        model.surface_m, model._ln_c = rig.heights_m[-1] + 1e-4, math.log(800.0)
        model.surface_speed_m_s = 0.0

    rig.bench.on_step.append(sink)
    rig.run_until(State.FAULT, 7.0)
    assert rig.controller.result.cause is Cause.DEPTH
    rig.run(0.2)
    assert min(rig.heights_m) > lowest_m - 3e-4


def test_two_thirds_of_the_abort_force_may_be_asked_for():
    made = contact(force_n=0.02)
    made.loop.start(made.goal)
    assert made.controller.state is State.TRAVEL
