# SPDX-License-Identifier: Apache-2.0
"""Transforms on tuples against matrices of numpy."""

import sys
from pathlib import Path

import numpy as np

from tactile_resonance.contact.vectors import (
    inverse_transform,
    pose_from_transform,
    transform_from_pose,
    turn_between,
    turned,
)
from tactile_resonance.simulation.ur5e.kinematics import product

sys.path.insert(0, str(Path(__file__).parent))
import matrices
from matrices import floats, matrix, matrix_from_pose, transform


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
