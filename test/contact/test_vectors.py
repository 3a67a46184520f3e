# SPDX-License-Identifier: Apache-2.0
"""Vectors and rotations as tuples, against numpy and scipy; their special cases in closed form."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tactile_resonance.contact.samples import Pose
from tactile_resonance.contact.vectors import (
    NO_TURN,
    ZERO,
    cross,
    difference,
    dot,
    quaternion_from_vector,
    rotated,
    rotated_back,
    scaled,
    six,
    transposed,
    turn_from_quaternion,
    turn_from_vector,
    turn_product,
    vector,
    vector_from_turn,
)

number = st.floats(-10, 10)
vectors = st.tuples(number, number, number)
AXES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, -0.8, 0], [1, 2, -3], [-1, 1e-3, 1e-8]])
AXES = AXES / np.linalg.norm(AXES, axis=1)[:, None]


def matrix(turn):
    return np.reshape(turn, (3, 3))


def close(got, want, atol=1e-14):
    np.testing.assert_allclose(got, want, rtol=0, atol=atol * max(1.0, np.abs(want).max()))


@settings(deadline=None)
@given(vectors, vectors, number)
def test_sums_and_products_of_vectors_are_those_of_numpy(a, b, factor):
    close(dot(a, b), np.dot(a, b))
    close(cross(a, b), np.cross(a, b))
    close(difference(a, b), np.subtract(a, b))
    close(scaled(factor, a), factor * np.array(a))


def test_arrays_become_tuples_of_floats():
    for made in (vector(np.arange(3)), six(np.arange(6, dtype=np.float32))):
        assert made == tuple(range(len(made)))
        assert {type(value) for value in made} == {float}
    with pytest.raises(ValueError, match="unpack"):
        vector([1.0, 2.0])


@settings(max_examples=200, deadline=None)
@given(vectors, vectors, vectors)
def test_rotations_are_those_of_scipy(rotation, other, a):
    turn, first = turn_from_vector(rotation), turn_from_vector(other)
    close(matrix(turn), Rotation.from_rotvec(rotation).as_matrix())
    close(rotated(turn, a), matrix(turn) @ a)
    close(rotated_back(turn, a), matrix(turn).T @ a)
    close(matrix(transposed(turn)), matrix(turn).T)
    close(matrix(turn_product(turn, first)), matrix(turn) @ matrix(first))


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize(
    "angle",
    [1e-300, 1e-160, 1e-12, 1e-8, 1e-4, 0.3, 1.5, 2.0, 3.0, math.pi - 1e-4, math.pi - 1e-8],
)
def test_rotation_vector_comes_back_at_every_angle(axis, angle):
    rotation = vector(angle * axis)
    back = vector_from_turn(turn_from_vector(rotation))
    # no digits lost: relative to the angle, be it ever so small
    np.testing.assert_allclose(back, rotation, rtol=0, atol=1e-15 * angle)


@pytest.mark.parametrize("axis", AXES)
def test_half_a_turn_comes_back_about_either_direction_of_its_axis(axis):
    back = np.array(vector_from_turn(turn_from_vector(vector(math.pi * axis))))
    assert np.linalg.norm(back) == pytest.approx(math.pi, rel=1e-15)
    close(abs(back @ axis), math.pi)


@pytest.mark.parametrize("axis", AXES)
def test_more_than_half_a_turn_comes_back_the_short_way_round(axis):
    back = vector_from_turn(turn_from_vector(vector(4.0 * axis)))
    close(back, (4.0 - 2 * math.pi) * axis)


def test_no_rotation_is_exact():
    assert turn_from_vector(ZERO) == NO_TURN
    assert vector_from_turn(NO_TURN) == ZERO


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_no_rotation_and_no_error(value):
    turn = turn_from_vector((0.1, value, 0.2))
    assert np.isnan(turn).all()
    assert np.isnan(vector_from_turn(turn)).all()
    assert np.isnan(rotated(turn, (1.0, 2.0, 3.0))).all()


@pytest.mark.parametrize("diagonal", [(1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
def test_half_turns_about_the_axes_are_exact(diagonal):
    turn = tuple(np.diag(diagonal).astype(float).ravel().tolist())
    close(vector_from_turn(turn), math.pi * (np.array(diagonal) > 0))


@settings(max_examples=200, deadline=None)
@given(vectors, vectors)
def test_turn_from_one_orientation_to_another_is_that_of_scipy(start, end):
    between = turn_product(turn_from_vector(end), transposed(turn_from_vector(start)))
    want = Rotation.from_rotvec(end) * Rotation.from_rotvec(start).inv()
    close(Rotation.from_rotvec(vector_from_turn(between)).as_matrix(), want.as_matrix(), 1e-13)


@settings(max_examples=200, deadline=None)
@given(vectors, st.floats(-10, 10), st.floats(1e-3, 1e3))
def test_quaternions_are_those_of_scipy_whatever_their_length_and_sign(axis, w, length):
    quaternion = np.array([*axis, w])
    norm = np.linalg.norm(quaternion)
    if norm < 1e-100:
        return
    quaternion = length * quaternion / norm
    want = Rotation.from_quat(quaternion).as_matrix()
    close(matrix(turn_from_quaternion(*quaternion.tolist())), want)
    close(matrix(turn_from_quaternion(*(-quaternion).tolist())), want)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("angle", [0.0, 1e-160, 1e-8, 0.3, math.pi, 4.0, 2 * math.pi, 7.0])
def test_quaternion_of_a_rotation_vector_is_of_length_one_and_comes_back(axis, angle):
    rotation = vector(angle * axis)
    quaternion = quaternion_from_vector(rotation)
    assert math.hypot(*quaternion) == pytest.approx(1.0, rel=1e-15)
    close(Rotation.from_quat(quaternion).as_matrix(), Rotation.from_rotvec(rotation).as_matrix())
    close(turn_from_quaternion(*quaternion), turn_from_vector(rotation))


@settings(deadline=None)
@given(vectors)
def test_turn_of_a_pose_is_its_rotation(rotation):
    pose = Pose(np.zeros(3), np.array(rotation))
    close(matrix(pose.turn), pose.rotation.as_matrix())
    close(matrix(pose.turn), Rotation.from_rotvec(rotation).as_matrix())
