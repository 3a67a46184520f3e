# SPDX-License-Identifier: Apache-2.0
"""Poses and transforms as arrays, turned by scipy: what the tests judge the model's own tuples by."""

import numpy as np
from scipy.spatial.transform import Rotation

from tactile_resonance.simulation.ur5e.kinematics import Posture


def floats(values) -> tuple[float, ...]:
    """An array as the model takes it."""
    return tuple(np.asarray(values, dtype=float).tolist())


def matrix(transform) -> np.ndarray:
    """Homogeneous matrix (4, 4) of one of the model's transforms."""
    found = np.eye(4)
    found[:3, :3] = np.reshape(transform[0], (3, 3))
    found[:3, 3] = transform[1]
    return found


def transform(matrix):
    """Transform of the model for a homogeneous matrix (4, 4)."""
    return floats(matrix[:3, :3].ravel()), floats(matrix[:3, 3])


def matrix_from_pose(pose) -> np.ndarray:
    found = np.eye(4)
    found[:3, :3] = Rotation.from_rotvec(pose[3:]).as_matrix()
    found[:3, 3] = pose[:3]
    return found


def pose_from_matrix(matrix) -> np.ndarray:
    return np.concatenate([matrix[:3, 3], Rotation.from_matrix(matrix[:3, :3]).as_rotvec()])


def turn_between(start, end) -> np.ndarray:
    """Rotation vector (3,) in the base from one matrix to another."""
    return Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec()


def forward(q) -> np.ndarray:
    """The model's flange at joint angles, as a matrix (4, 4)."""
    return matrix(Posture(floats(q)).flange)
