# SPDX-License-Identifier: Apache-2.0
"""The housing of the sensor stays clear of a flat surface: goals are refused, approaches end."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.goal import Cause
from tactile_resonance.contact.loop import ContactLoop
from tactile_resonance.contact.machine import ContactController
from tactile_resonance.contact.parameters import Limits
from tactile_resonance.contact.samples import Pose
from tactile_resonance.contact.vectors import vector

sys.path.insert(0, str(Path(__file__).parent))
from contacts import QUICK, contact

UP = (0.0, 0.0, 1.0)
FLAT = TipGeometry(beam_tilt_rad=0.08)  # the housing 1.6 mm above the surface at the touch


def with_tip(tip, limits=None, **options):
    made = contact(limits=limits, **options)
    limits = Limits() if limits is None else limits
    made.controller = ContactController(QUICK, limits, tip)
    bench = made.bench
    made.loop = ContactLoop(bench.arm, bench.cell, bench, made.controller)
    return made


def rows(rotation):
    """A rotation as the core has it: the matrix in a tuple, row by row."""
    return tuple(rotation.as_matrix().ravel().tolist())


@pytest.mark.parametrize("angle", [0.0, 0.03, -0.05])
def test_height_of_the_housing_is_that_of_its_lowest_point_drawn_in_the_plane(angle):
    tip = TipGeometry()
    turn = Rotation.from_rotvec([0.0, angle, 0.0])
    # in the tip's x-z plane: ball at the origin, clamp at -L cos, L sin, housing straight below it
    x, z = -0.064 * np.cos(0.17), 0.064 * np.sin(0.17) - 6e-3
    lowered = np.cos(angle) * z - np.sin(angle) * x
    assert tip.housing_height(rows(turn), UP, -1e-3) == pytest.approx(
        2.5e-3 - 1e-3 + lowered, abs=1e-12
    )
    # tip and plane turned together see the same
    both = Rotation.from_rotvec([0.3, -0.2, 0.5])
    same = tip.housing_height(rows(both * turn), vector(both.apply(UP)), -1e-3)
    assert same == pytest.approx(2.5e-3 - 1e-3 + lowered, abs=1e-12)


def test_worst_height_is_the_least_over_all_turns_of_that_angle():
    tip, rng = TipGeometry(), np.random.default_rng(1)
    worst = tip.worst_height(4e-3, 0.05)
    axes = rng.standard_normal((2000, 3))
    turns = Rotation.from_rotvec(0.05 * axes / np.linalg.norm(axes, axis=1)[:, None])
    heights = [tip.housing_height(rows(turn), UP, -4e-3) for turn in turns]
    assert worst <= min(heights)
    assert min(heights) - worst < 0.1e-3
    # the default sensor at the default limits: a sixth of a millimetre
    assert worst == pytest.approx(0.17e-3, abs=0.02e-3)


def test_goal_at_which_the_housing_would_touch_is_refused():
    made = with_tip(FLAT)
    with pytest.raises(ValueError, match="the housing is -4.* mm above the surface"):
        made.loop.start(made.goal)
    # less depth and a better held orientation make it possible
    made = with_tip(FLAT, limits=Limits(depth_m=1e-3, misalignment_rad=0.005))
    made.loop.start(made.goal)


def test_tip_that_dips_its_housing_in_the_approach_is_stopped():
    limits = Limits(depth_m=1e-3, misalignment_rad=0.2, clearance_m=0.0)
    # admitted with a housing that is high; then it turns out to reach lower
    made = with_tip(replace(FLAT, housing_below_m=0.0, beam_tilt_rad=0.3), limits=limits)
    made.loop.start(made.goal)
    assert made.run_until(made.controller.state.APPROACH)
    made.controller._free._path.tip = FLAT
    reported = made.bench.motion.reported
    dipped = Rotation.from_rotvec([0.0, -0.1, 0.0]) * reported.rotation
    made.bench.motion.reported = Pose(reported.position_m, dipped.as_rotvec())
    made.run_until(made.controller.state.IDLE, 3.0)
    assert made.controller.result.cause is Cause.HOUSING
    assert "mm above the surface" in made.controller.result.message
    assert max(made.force_n) == 0


def test_tip_that_begins_far_below_the_plane_of_its_goal_is_lifted_to_it():
    # 30 mm below it, as over a lower step: the housing is below that plane and above nothing
    made = with_tip(TipGeometry(), height_m=-0.5, start_m=-0.03)
    made.loop.start(made.goal)
    assert made.run_until(made.controller.state.TARE), made.controller.result
