# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms and the six-number poses of Universal Robots, on tuples of floats.

In every cycle the controller works on some dozens of them. On so few numbers a numpy call costs more
than the arithmetic that it does, so that it is written out here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from operator import add, sub

Vector = tuple[float, float, float]
Six = tuple[float, ...]
"""Six numbers: of the joints, a pose, a twist, a wrench."""
Turn = tuple[float, float, float, float, float, float, float, float, float]
"""A rotation matrix, row by row."""
Transform = tuple[Turn, Vector]
"""Rotation of a frame and place of its origin [m], both as seen from another frame."""

ORIGIN: Vector = (0.0, 0.0, 0.0)
ZERO: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
NO_TURN: Turn = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
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


def rounded(place_m: Vector) -> list[float]:
    """Return a place to a tenth of a millimetre, for messages."""
    return [round(value, 4) for value in place_m]


def dot(a: Vector, b: Vector) -> float:
    """Return the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Return the vector product of two vectors."""
    ax, ay, az = a
    bx, by, bz = b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def rotated(turn: Turn, vector: Vector) -> Vector:
    """Return a vector turned by a rotation."""
    xx, yx, zx, xy, yy, zy, xz, yz, zz = turn
    x, y, z = vector
    return xx * x + yx * y + zx * z, xy * x + yy * y + zy * z, xz * x + yz * y + zz * z


def rotated_back(turn: Turn, vector: Vector) -> Vector:
    """Return a vector turned by the inverse of a rotation."""
    xx, yx, zx, xy, yy, zy, xz, yz, zz = turn
    x, y, z = vector
    return xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, zx * x + zy * y + zz * z


def transposed(turn: Turn) -> Turn:
    """Return the inverse of a rotation."""
    xx, yx, zx, xy, yy, zy, xz, yz, zz = turn
    return xx, xy, xz, yx, yy, yz, zx, zy, zz


def turn_product(a: Turn, b: Turn) -> Turn:
    """Return the rotation that first does `b`, then `a`."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = a
    b0, b1, b2, b3, b4, b5, b6, b7, b8 = b
    return (
        a0 * b0 + a1 * b3 + a2 * b6,
        a0 * b1 + a1 * b4 + a2 * b7,
        a0 * b2 + a1 * b5 + a2 * b8,
        a3 * b0 + a4 * b3 + a5 * b6,
        a3 * b1 + a4 * b4 + a5 * b7,
        a3 * b2 + a4 * b5 + a5 * b8,
        a6 * b0 + a7 * b3 + a8 * b6,
        a6 * b1 + a7 * b4 + a8 * b7,
        a6 * b2 + a7 * b5 + a8 * b8,
    )


def turn_from_vector(vector: Vector) -> Turn:
    """Return the rotation of a rotation vector [rad] (Rodrigues' formula)."""
    x, y, z = vector
    angle = math.hypot(x, y, z)
    if angle == 0.0:
        return NO_TURN
    # by half the angle: 1 - cos(angle) has no digits left where the angle is small
    half = math.sin(angle / 2) / angle
    a, b = 2 * half * math.cos(angle / 2), 2 * half * half
    bx, by, bz = b * x, b * y, b * z
    ax, ay, az = a * x, a * y, a * z
    bxy, byz, bzx = bx * y, by * z, bz * x
    bxx, byy, bzz = bx * x, by * y, bz * z
    return (
        1.0 - byy - bzz, bxy - az, bzx + ay,
        bxy + az, 1.0 - bzz - bxx, byz - ax,
        bzx - ay, byz + ax, 1.0 - bxx - byy,
    )  # fmt: skip


def vector_from_turn(turn: Turn) -> Vector:
    """Return the rotation vector [rad] of a rotation, of up to half a turn.

    By the quaternion, whose largest element comes first (Shepperd, J. Guidance and Control 1, 1978):
    no digits are lost at any angle. Of half a turn either direction of the axis is right.
    """
    xx, yx, zx, xy, yy, zy, xz, yz, zz = turn
    trace = xx + yy + zz
    if trace >= xx and trace >= yy and trace >= zz:
        x, y, z, w = yz - zy, zx - xz, xy - yx, 1.0 + trace
    elif xx >= yy and xx >= zz:
        x, y, z, w = 1.0 - trace + 2 * xx, xy + yx, xz + zx, yz - zy
    elif yy >= zz:
        x, y, z, w = xy + yx, 1.0 - trace + 2 * yy, yz + zy, zx - xz
    else:
        x, y, z, w = xz + zx, yz + zy, 1.0 - trace + 2 * zz, xy - yx
    sine = math.hypot(x, y, z)
    if sine == 0.0:
        return 0.0, 0.0, 0.0
    scale = 2 * math.atan2(sine, w) / sine if w >= 0.0 else -2 * math.atan2(sine, -w) / sine
    return scale * x, scale * y, scale * z


def transform_from_pose(pose: Iterable[float]) -> Transform:
    """Return the transform of a pose: place [m] and rotation vector [rad], six numbers."""
    x, y, z, rx, ry, rz = map(float, pose)
    return turn_from_vector((rx, ry, rz)), (x, y, z)


def pose_from_transform(transform: Transform) -> Six:
    """Return place [m] and rotation vector [rad] of a transform."""
    return *transform[1], *vector_from_turn(transform[0])


def product(a: Transform, b: Transform) -> Transform:
    """Return the transform of `b` as seen from the frame in which `a` is given."""
    turn, (x, y, z) = a
    dx, dy, dz = rotated(turn, b[1])
    return turn_product(turn, b[0]), (x + dx, y + dy, z + dz)


def inverse_transform(transform: Transform) -> Transform:
    """Return the inverse of a transform."""
    turn, place = transform
    x, y, z = rotated_back(turn, place)
    return transposed(turn), (-x, -y, -z)


def turned(transform: Transform, shift_m: Vector, turn_rad: Vector) -> Transform:
    """Return a transform shifted and then turned about its own origin, both in the base."""
    turn, (x, y, z) = transform
    place = (x + shift_m[0], y + shift_m[1], z + shift_m[2])
    return (turn_product(turn_from_vector(turn_rad), turn) if any(turn_rad) else turn), place


def turn_between(start: Transform, end: Transform) -> Vector:
    """Return the rotation vector in the base [rad] that turns one transform into another."""
    return vector_from_turn(turn_product(end[0], transposed(start[0])))


def moved_wrench(wrench: Six, to_frame: Transform) -> Six:
    """Return a wrench [N, N m] expressed at and in the frame that `to_frame` leads to.

    `to_frame` holds the frame in which the wrench is given, seen from the frame wanted.
    """
    turn, arm = to_frame
    fx, fy, fz, tx, ty, tz = wrench
    force = rotated(turn, (fx, fy, fz))
    x, y, z = rotated(turn, (tx, ty, tz))
    dx, dy, dz = cross(arm, force)
    return *force, x + dx, y + dy, z + dz
