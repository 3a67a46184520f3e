# SPDX-License-Identifier: Apache-2.0
"""Transforms on tuples against scipy and numpy, at the angles where formulas lose digits."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_resonance.simulation.robot.poses import (
    inverse_transform,
    pose_from_transform,
    product,
    transform_from_pose,
    turn_between,
    turn_from_vector,
    turned,
    vector_from_turn,
)

sys.path.insert(0, str(Path(__file__).parent))
import matrices
from matrices import floats, matrix, matrix_from_pose, transform

ANGLES = (0.0, 5e-324, 1e-200, 1e-12, 1e-6, 0.3, np.pi / 2, np.pi - 1e-6, np.pi - 1e-12, np.pi)


@pytest.fixture(scope="module")
def axes() -> np.ndarray:
    """Directions: all 26 along edges and diagonals of a cube, and others."""
    grid = np.array(np.meshgrid(*[(-1, 0, 1)] * 3)).reshape(3, -1).T
    some = np.random.default_rng(4).standard_normal((20, 3))
    every = np.concatenate([grid[np.any(grid, axis=1)], some])
    return every / np.linalg.norm(every, axis=1)[:, None]


@pytest.mark.parametrize("angle", ANGLES)
def test_rotation_vectors_and_rotations_are_those_of_scipy(axes, angle):
    for axis in axes:
        turn = turn_from_vector(floats(axis * angle))
        rotation = np.reshape(turn, (3, 3))
        wanted = Rotation.from_rotvec(axis * angle).as_matrix()
        np.testing.assert_allclose(rotation, wanted, atol=2e-15)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=2e-15)
        back = np.array(vector_from_turn(turn))
        if angle > np.pi - 1e-9:  # half a turn either way is the same
            back *= np.sign(back @ axis)
        np.testing.assert_allclose(back, axis * angle, rtol=1e-12, atol=3e-15)


def test_small_angles_keep_their_digits():
    for size in (1e-150, 1e-30, 1e-12, 1e-8, 1e-4):
        vector = size * np.array([0.6, -0.48, 0.64])
        back = vector_from_turn(turn_from_vector(floats(vector)))
        np.testing.assert_allclose(back, vector, rtol=1e-12)


def test_half_turns_in_exact_numbers():
    for axis in range(3):
        diagonal = -np.ones(3)
        diagonal[axis] = 1.0
        wanted = np.pi * np.eye(3)[axis]
        np.testing.assert_array_equal(vector_from_turn(floats(np.diag(diagonal).ravel())), wanted)


def test_products_inverses_and_turns_are_those_of_matrices():
    rng = np.random.default_rng(5)
    for _ in range(50):
        one, two = rng.standard_normal((2, 6))
        a, b = transform_from_pose(one), transform_from_pose(two)
        first, second = matrix_from_pose(one), matrix_from_pose(two)
        np.testing.assert_allclose(matrix(product(a, b)), first @ second, atol=1e-14)
        np.testing.assert_allclose(matrix(inverse_transform(a)), np.linalg.inv(first), atol=1e-14)
        np.testing.assert_allclose(
            turn_between(a, b), matrices.turn_between(first, second), atol=1e-13
        )
        moved = matrix_from_pose([*(one[:3] + two[:3]), *np.zeros(3)])
        moved[:3, :3] = second[:3, :3] @ first[:3, :3]
        np.testing.assert_allclose(
            matrix(turned(a, floats(two[:3]), floats(two[3:]))), moved, atol=1e-14
        )
        np.testing.assert_allclose(pose_from_transform(transform(first)), one, atol=1e-13)
