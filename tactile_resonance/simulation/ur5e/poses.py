# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms and the six-number poses of Universal Robots, on tuples of floats."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from operator import add, sub

from tactile_resonance.contact.vectors import (
    NO_TURN,
    Turn,
    Vector,
    added,
    dot,
    rotated_back,
    transposed,
    turn_from_vector,
    turn_product,
    vector_from_turn,
)

Six = tuple[float, ...]
"""Six numbers: of the joints, a pose, a twist, a wrench."""
Transform = tuple[Turn, Vector]
"""Rotation of a frame and place of its origin [m], both as seen from another frame."""

ORIGIN: Vector = (0.0, 0.0, 0.0)
ZERO: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
IDENTITY: Transform = (NO_TURN, ORIGIN)


def largest(values: Sequence[float]) -> float:
    """Return the largest magnitude among numbers."""
    return max(max(values), -min(values))


def total(a: Six, b: Six) -> Six:
    """Return the sum of two tuples, number by number."""
    return tuple(map(add, a, b))


def difference(a: Six, b: Six) -> Six:
    """Return a tuple less another, number by number."""
    return tuple(map(sub, a, b))


def beside(vector: Vector, axis: Vector) -> Vector:
    """Return what of a vector is perpendicular to an axis of length 1."""
    along = dot(vector, axis)
    return vector[0] - axis[0] * along, vector[1] - axis[1] * along, vector[2] - axis[2] * along


def rounded(place_m: Vector) -> list[float]:
    """Return a place to a tenth of a millimetre, for messages."""
    return [round(value, 4) for value in place_m]


def transform_from_pose(pose: Iterable[float]) -> Transform:
    """Return the transform of a pose: place [m] and rotation vector [rad], six numbers."""
    x, y, z, rx, ry, rz = map(float, pose)
    return turn_from_vector((rx, ry, rz)), (x, y, z)


def pose_from_transform(transform: Transform) -> Six:
    """Return place [m] and rotation vector [rad] of a transform."""
    return *transform[1], *vector_from_turn(transform[0])


def inverse_transform(transform: Transform) -> Transform:
    """Return the inverse of a transform."""
    turn, place = transform
    x, y, z = rotated_back(turn, place)
    return transposed(turn), (-x, -y, -z)


def turned(transform: Transform, shift_m: Vector, turn_rad: Vector) -> Transform:
    """Return a transform shifted and then turned about its own origin, both in the base."""
    turn, place = transform
    turn = turn_product(turn_from_vector(turn_rad), turn) if any(turn_rad) else turn
    return turn, added(place, shift_m)


def turn_between(start: Transform, end: Transform) -> Vector:
    """Return the rotation vector in the base [rad] that turns one transform into another."""
    return vector_from_turn(turn_product(end[0], transposed(start[0])))
