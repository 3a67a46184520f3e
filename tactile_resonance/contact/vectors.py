# SPDX-License-Identifier: Apache-2.0
"""Arithmetic on vectors, rotations, rigid transforms and other tuples of floats.

The control loop, and a simulated robot, do this in every period. On three numbers a numpy call costs ten to a
hundred times as much as the arithmetic that it does, so that it is written out here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from operator import add, sub

Vector = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]
"""Force and torque, or velocity and angular velocity."""
Numbers = tuple[float, ...]
"""Of the joints, a pose, a twist, a wrench."""
Turn = tuple[float, float, float, float, float, float, float, float, float]
"""A rotation matrix, row by row."""
Transform = tuple[Turn, Vector]
"""Rotation of a frame and place of its origin [m], both as seen from another frame."""

ZERO: Vector = (0.0, 0.0, 0.0)
ZEROS: Numbers = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
NO_TURN: Turn = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
IDENTITY: Transform = (NO_TURN, ZERO)
TURN_LEVER_M = 0.1
"""Turns a limit of acceleration [m/s2] into one of rotation [rad/s2]."""
_NAN = math.nan
_UNKNOWN: Turn = (_NAN, _NAN, _NAN, _NAN, _NAN, _NAN, _NAN, _NAN, _NAN)


def vector(values: Iterable[float]) -> Vector:
    """Return three numbers, of an array or whatever, as floats in a tuple."""
    x, y, z = map(float, values)
    return x, y, z


def six(values: Iterable[float]) -> Six:
    """Return six numbers, of an array or whatever, as floats in a tuple."""
    a, b, c, d, e, f = map(float, values)
    return a, b, c, d, e, f


def dot(a: Vector, b: Vector) -> float:
    """Return the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Return the vector product of two vectors."""
    ax, ay, az = a
    bx, by, bz = b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def added(a: Vector, b: Vector) -> Vector:
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def difference(a: Vector, b: Vector) -> Vector:
    """Return `a` less `b`."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def scaled(factor: float, a: Vector) -> Vector:
    """Return a vector times a number."""
    return factor * a[0], factor * a[1], factor * a[2]


def nearer(twist: Six, wanted: Six, step: float) -> Six:
    """Return a twist nearer to what is wanted, by a change of velocity of `step` [m/s] at most."""
    change = [b - a for a, b in zip(twist, wanted, strict=True)]
    largest = max(math.hypot(*change[:3]), TURN_LEVER_M * math.hypot(*change[3:]))
    if largest <= step:
        return wanted
    share = step / largest
    return six(a + share * d for a, d in zip(twist, change, strict=True))


def rotated(turn: Turn, a: Vector) -> Vector:
    """Return a vector turned by a rotation."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = turn
    x, y, z = a
    return xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, zx * x + zy * y + zz * z


def rotated_back(turn: Turn, a: Vector) -> Vector:
    """Return a vector turned by the inverse of a rotation."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = turn
    x, y, z = a
    return xx * x + yx * y + zx * z, xy * x + yy * y + zy * z, xz * x + yz * y + zz * z


def transposed(turn: Turn) -> Turn:
    """Return the inverse of a rotation."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = turn
    return xx, yx, zx, xy, yy, zy, xz, yz, zz


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


@lru_cache(maxsize=2)  # loop, path and housing ask for the same one in each period
def turn_from_vector(rotation_rad: Vector) -> Turn:
    """Return the rotation of a rotation vector [rad] (Rodrigues' formula); NaN where that is not finite."""
    x, y, z = rotation_rad
    angle = math.hypot(x, y, z)
    if angle == 0.0:
        return NO_TURN
    if not angle < math.inf:
        return _UNKNOWN
    # 1 - cos(angle) by half the angle: the difference has no digits left where the angle is small
    half = math.sin(angle / 2) / angle
    sine, versine = 2 * half * math.cos(angle / 2), 2 * half * half
    sx, sy, sz = sine * x, sine * y, sine * z
    vx, vy, vz = versine * x, versine * y, versine * z
    return (
        1.0 - vy * y - vz * z,
        vx * y - sz,
        vx * z + sy,
        vx * y + sz,
        1.0 - vx * x - vz * z,
        vy * z - sx,
        vx * z - sy,
        vy * z + sx,
        1.0 - vx * x - vy * y,
    )


def vector_from_turn(turn: Turn) -> Vector:
    """Return the rotation vector [rad] of a rotation, of up to half a turn.

    By the quaternion, whose largest element comes first (Shepperd, J. Guidance and Control 1, 1978),
    so that no digits are lost at any angle. Of half a turn either direction of the axis is right.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = turn
    trace = xx + yy + zz
    largest = max(trace, xx, yy, zz)
    # four times the product of the quaternion with its largest element
    if largest == trace:
        x, y, z, w = zy - yz, xz - zx, yx - xy, 1.0 + trace
    elif largest == xx:
        x, y, z, w = 1.0 - trace + 2 * xx, xy + yx, xz + zx, zy - yz
    elif largest == yy:
        x, y, z, w = xy + yx, 1.0 - trace + 2 * yy, yz + zy, xz - zx
    else:
        x, y, z, w = xz + zx, yz + zy, 1.0 - trace + 2 * zz, yx - xy
    sine = math.hypot(x, y, z)
    if sine == 0.0:
        return ZERO
    scale = 2 * math.atan2(sine, w) / sine if w >= 0.0 else -2 * math.atan2(sine, -w) / sine
    return scale * x, scale * y, scale * z


def turn_from_quaternion(x: float, y: float, z: float, w: float) -> Turn:
    """Return the rotation of a quaternion of any length but 0."""
    length = math.hypot(x, y, z, w)
    sine = math.hypot(x, y, z)
    if sine == 0.0:
        return NO_TURN
    angle = 2 * math.atan2(sine / length, w / length)
    return turn_from_vector(scaled(angle / sine, (x, y, z)))


def quaternion_from_vector(rotation_rad: Vector) -> tuple[float, float, float, float]:
    """Return the unit quaternion (x, y, z, w) of a rotation vector [rad]."""
    x, y, z = rotation_rad
    angle = math.hypot(x, y, z)
    half = 0.5 if angle == 0.0 else math.sin(angle / 2) / angle
    return half * x, half * y, half * z, math.cos(angle / 2)


def largest(values: Sequence[float]) -> float:
    """Return the largest magnitude among numbers."""
    return max(max(values), -min(values))


def plus(a: Numbers, b: Numbers) -> Numbers:
    """Return the sum of two tuples, number by number."""
    return tuple(map(add, a, b))


def minus(a: Numbers, b: Numbers) -> Numbers:
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


def pose_from_transform(transform: Transform) -> Numbers:
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
