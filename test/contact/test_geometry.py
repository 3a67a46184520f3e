# SPDX-License-Identifier: Apache-2.0
"""The twists of a contact: where they lead from any pose, in closed form."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tactile_resonance.contact.geometry import (
    ARRIVED_M,
    ARRIVING_S,
    RIGHTING_S,
    TipGeometry,
    TipPath,
    touch_pose,
)
from tactile_resonance.contact.goal import ContactGoal
from tactile_resonance.contact.parameters import ContactParameters
from tactile_resonance.contact.samples import ArmSample
from tactile_resonance.contact.vectors import vector

GOAL = ContactGoal(touch_pose([0.1, -0.2, 0.3], [0.2, -0.1, 1.0], [1, 1, 0], 2.5e-3), 0.01)
TOUCH, P = GOAL.touch, ContactParameters()
NORMAL = TOUCH.rotation.as_matrix()[:, 2]
STILL = (0.0,) * 6

small = st.floats(-0.02, 0.02)
ways = st.tuples(small, small, small)
turns = st.tuples(*[st.floats(-1.5, 1.5)] * 3)


def at(way_m, turn_rad=(0.0, 0.0, 0.0)):
    """The arm off the touch by a way, and by a turn that it would have to make."""
    turned = Rotation.from_rotvec(turn_rad).inv() * TOUCH.rotation
    return ArmSample(0, 0.0, vector(TOUCH.position_m + way_m), vector(turned.as_rotvec()), STILL)


@settings(max_examples=50, deadline=None)
@given(ways, turns, st.floats(-0.005, 0.005))
def test_along_the_normal_place_and_orientation_are_put_right_meanwhile(way, turn, speed):
    path = TipPath(GOAL)
    for arm, left in ((at(way, turn), turn), (at(way), (0, 0, 0)), (at(way, turn), turn)):
        twist = np.array(path.along_normal(arm, speed))
        beside = np.array(way) - (NORMAL @ way) * NORMAL
        np.testing.assert_allclose(twist[:3], speed * NORMAL - beside / RIGHTING_S, atol=1e-14)
        np.testing.assert_allclose(twist[3:], np.array(left) / RIGHTING_S, atol=1e-13)
        np.testing.assert_allclose(path.turn_rad(arm), left, atol=1e-14)
        assert path.off_rad(arm) == pytest.approx(np.linalg.norm(left), abs=1e-14)
        assert path.height_m(arm) == pytest.approx(NORMAL @ way, abs=1e-15)


def test_same_orientation_is_no_turn_at_all():
    arm = ArmSample(0, 0.0, (0.0, 0.0, 0.0), vector(TOUCH.rotation_rad), STILL)
    assert TipPath(GOAL).turn_rad(arm) == (0.0, 0.0, 0.0)


@settings(deadline=None)
@given(ways)
def test_lift_is_straight_up_and_ends_at_the_standoff(way):
    twist = np.array(TipPath(GOAL).lift(at(way), P))
    speed = float(NORMAL @ twist[:3])
    np.testing.assert_allclose(twist, [*(speed * NORMAL), 0, 0, 0], atol=1e-15)
    left = max(0.0, P.standoff_m - NORMAL @ way)
    assert speed == pytest.approx(
        max(1e-4, min(P.retract_speed_m_s, np.sqrt(P.acceleration_m_s2 * left), left / ARRIVING_S))
    )


def test_travel_goes_straight_to_the_standoff_and_turns_what_is_left():
    arm = at((0.01, 0.02, 0.03), (0.0, 0.02, 0.0))
    twist = np.array(TipPath(GOAL).travel(arm, P))
    way = TOUCH.position_m + P.standoff_m * NORMAL - arm.position_m
    np.testing.assert_allclose(
        twist[:3], P.travel_speed_m_s * way / np.linalg.norm(way), rtol=1e-12
    )
    np.testing.assert_allclose(twist[3:], [0, 0.02 / RIGHTING_S, 0], atol=1e-13)


def test_arrived_is_near_and_turned():
    path, above = TipPath(GOAL), P.standoff_m * NORMAL
    assert path.arrived(at(above + 0.9 * ARRIVED_M * NORMAL), P.standoff_m)
    assert not path.arrived(at(above + [0, 1.1 * ARRIVED_M, 0]), P.standoff_m)
    assert not path.arrived(at(above, (0.0, 0.0, 3e-3)), P.standoff_m)


@settings(deadline=None)
@given(turns)
def test_housing_is_seen_where_the_tip_is_turned_to(turn):
    tip = TipGeometry()
    path, arm = TipPath(GOAL, tip), at((0.0, 0.0, 0.0), turn)
    lower_edge = arm.tip.rotation.apply(
        [-0.064 * np.cos(0.17), 0.0, 0.064 * np.sin(0.17) - tip.housing_below_m]
    )
    want = tip.ball_radius_m + 1e-3 + NORMAL @ lower_edge
    assert path.housing_m(arm, 1e-3) == pytest.approx(want, abs=1e-14)
    assert TipPath(GOAL).housing_m(arm, 1e-3) is None
