# SPDX-License-Identifier: Apache-2.0
"""Homogeneous transforms and the six-number poses of Universal Robots."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tactile_resonance.simulation.plant import cross

FloatArray = NDArray[np.float64]


def matrix_from_pose(pose: FloatArray | Sequence[float]) -> FloatArray:
    """Return the transform (4, 4) of a pose: position [m] and rotation vector [rad], shape (6,)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(pose[3:]).as_matrix()
    matrix[:3, 3] = pose[:3]
    return matrix


def pose_from_matrix(matrix: FloatArray) -> FloatArray:
    """Return position and rotation vector (6,) of a transform (4, 4)."""
    rotation = Rotation.from_matrix(matrix[:3, :3]).as_rotvec()
    return np.concatenate([matrix[:3, 3], rotation])


def inverse_transform(matrix: FloatArray) -> FloatArray:
    """Return the inverse of a rigid transform (4, 4)."""
    inverse = np.eye(4)
    inverse[:3, :3] = matrix[:3, :3].T
    inverse[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return inverse


def turned(matrix: FloatArray, shift_m: FloatArray, turn_rad: FloatArray) -> FloatArray:
    """Return a transform (4, 4) shifted and then turned about its own origin, both in the base."""
    moved = matrix.copy()
    moved[:3, 3] += shift_m
    if turn_rad.any():
        moved[:3, :3] = Rotation.from_rotvec(turn_rad).as_matrix() @ matrix[:3, :3]
    return moved


def turn_between(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the rotation vector (3,) in the base [rad] that turns one transform into another."""
    return Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec()


def moved_wrench(wrench: FloatArray, to_frame: FloatArray) -> FloatArray:
    """Return a wrench (6,) [N, N m] expressed at and in the frame that `to_frame` (4, 4) leads to.

    `to_frame` holds the frame in which the wrench is given, seen from the frame wanted.
    """
    rotation, arm = to_frame[:3, :3], to_frame[:3, 3]
    force = rotation @ wrench[:3]
    return np.concatenate([force, rotation @ wrench[3:] + cross(arm, force)])
