# SPDX-License-Identifier: Apache-2.0
"""Kinematics of a UR5e: forward, Jacobian, and the inverse in closed form.

Denavit-Hartenberg parameters: Universal Robots, "Parameters for calculations of kinematics and
dynamics" (article 45257), table UR5e. Real arms carry a calibration of their own, tenths of a
millimetre away from these nominal figures.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

# Figures of the table; joints 1 to 6. Lengths in m, twists alpha in units of a quarter turn.
D1, A2, A3, D4, D5, D6 = 0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996
DH_A_M = np.array([0.0, A2, A3, 0.0, 0.0, 0.0])
DH_D_M = np.array([D1, 0.0, 0.0, D4, D5, D6])
DH_ALPHA_QUARTERS = np.array([1, 0, 0, 1, -1, 0])

# cos and sin of the twists, exact
_COS_ALPHA = 1.0 - np.abs(DH_ALPHA_QUARTERS)
_SIN_ALPHA = DH_ALPHA_QUARTERS.astype(float)

# By how much a cosine may pass 1 from rounding alone: a joint at the edge of its reach.
_EDGE = 1e-9


def link_frames(q: FloatArray) -> FloatArray:
    """Return the transforms of base and links in the base, shape (7, 4, 4).

    Parameters
    ----------
    q : (6,) array
        Joint angles [rad].

    Returns
    -------
    (7, 4, 4) array
        The base itself, then links 1 to 6; the last one is the tool flange.
    """
    cosine, sine = np.cos(q), np.sin(q)
    step = np.zeros((6, 4, 4))
    step[:, 0, 0] = cosine
    step[:, 0, 1] = -sine * _COS_ALPHA
    step[:, 0, 2] = sine * _SIN_ALPHA
    step[:, 0, 3] = DH_A_M * cosine
    step[:, 1, 0] = sine
    step[:, 1, 1] = cosine * _COS_ALPHA
    step[:, 1, 2] = -cosine * _SIN_ALPHA
    step[:, 1, 3] = DH_A_M * sine
    step[:, 2, 1] = _SIN_ALPHA
    step[:, 2, 2] = _COS_ALPHA
    step[:, 2, 3] = DH_D_M
    step[:, 3, 3] = 1.0
    frames = np.empty((7, 4, 4))
    frames[0] = np.eye(4)
    for joint in range(6):
        frames[joint + 1] = frames[joint] @ step[joint]
    return frames


def forward(q: FloatArray) -> FloatArray:
    """Return the transform of the tool flange in the base, shape (4, 4)."""
    return link_frames(q)[-1]


def jacobian(frames: FloatArray, point_m: FloatArray) -> FloatArray:
    """Return the geometric Jacobian of a point carried by the flange, shape (6, 6).

    Parameters
    ----------
    frames : (7, 4, 4) array
        As `link_frames` returns them.
    point_m : (3,) array
        The point in the base [m].

    Returns
    -------
    (6, 6) array
        Maps joint speeds [rad/s] to velocity [m/s] and angular velocity [rad/s] in the base.
    """
    axis = frames[:6, :3, 2].T  # (3, joint)
    x, y, z = point_m[:, None] - frames[:6, :3, 3].T  # each (joint,)
    columns = np.empty((6, 6))
    columns[0] = axis[1] * z - axis[2] * y
    columns[1] = axis[2] * x - axis[0] * z
    columns[2] = axis[0] * y - axis[1] * x
    columns[3:] = axis
    return columns


def inverse(flange: FloatArray, wrist_angle_rad: float = 0.0) -> list[tuple[float, ...]]:
    """Return every set of joint angles that brings the flange to a pose, each in (-pi, pi].

    Closed form: joint 1 from the wrist's centre, joints 5 and 6 from the flange's attitude, then a
    planar arm of two links (joints 2, 3) and the angle left for joint 4.

    Parameters
    ----------
    flange : (4, 4) array
        Transform of the flange in the base.
    wrist_angle_rad : float
        Angle of joint 6 where axes 4 and 6 are parallel and only a sum of angles is determined.

    Returns
    -------
    list of 6-tuples
        At most eight; empty out of reach.
    """
    (xx, yx, zx, px), (xy, yy, zy, py), (xz, yz, zz, pz) = flange[:3].tolist()
    # centre of the wrist, on joint 6's axis, D6 before the flange
    wx, wy, wz = px - D6 * zx, py - D6 * zy, pz - D6 * zz
    sideways = _cosine(D4, math.hypot(wx, wy))
    if sideways is None:
        return []
    solutions = []
    for sign1 in (1.0, -1.0):
        q1 = math.atan2(wy, wx) + sign1 * math.acos(sideways) + math.pi / 2
        s1, c1 = math.sin(q1), math.cos(q1)
        bend = _cosine(px * s1 - py * c1 - D4, D6)
        if bend is None:
            continue
        # flange's x and y against axis 2; both vanish where axes 4 and 6 are parallel
        along_x, along_y = xx * s1 - xy * c1, yx * s1 - yy * c1
        for sign5 in (1.0, -1.0):
            # the arc cosine alone would lose half of the digits near 0 and half a turn
            q5 = sign5 * math.atan2(math.hypot(along_x, along_y), bend)
            s5, c5 = math.sin(q5), math.cos(q5)
            parallel = abs(s5) < _EDGE
            q6 = wrist_angle_rad if parallel else math.atan2(-along_y / s5, along_x / s5)
            s6, c6 = math.sin(q6), math.cos(q6)
            # z and x axes of link 4 in the base
            z4x, z4y, z4z = -s6 * xx - c6 * yx, -s6 * xy - c6 * yy, -s6 * xz - c6 * yz
            fx, fy, fz = c5 * c6, -c5 * s6, -s5
            x4x, x4y = fx * xx + fy * yx + fz * zx, fx * xy + fy * yy + fz * zy
            x4z = fx * xz + fy * yz + fz * zz
            q234 = math.atan2(x4z, x4x * c1 + x4y * s1)
            # end of the two-link arm in the plane of x1 and the vertical
            reach = (wx - D5 * z4x) * c1 + (wy - D5 * z4y) * s1
            height = wz - D5 * z4z - D1
            squares = reach * reach + height * height
            elbow = _cosine(squares - A2 * A2 - A3 * A3, 2 * A2 * A3)
            if elbow is None:
                continue
            for sign3 in (1.0, -1.0):
                q3 = sign3 * math.acos(elbow)
                q2 = math.atan2(height, reach)
                q2 -= math.atan2(A3 * math.sin(q3), A2 + A3 * math.cos(q3))
                joints = (q1, q2, q3, q234 - q2 - q3, q5, q6)
                solutions.append(tuple(math.remainder(angle, math.tau) for angle in joints))
    return solutions


def nearest_inverse(
    flange: FloatArray, q_near: FloatArray, joint_range_rad: float = math.tau
) -> FloatArray | None:
    """Return the joint angles for a pose that are nearest to given ones, shape (6,).

    Parameters
    ----------
    flange : (4, 4) array
        Transform of the flange in the base.
    q_near : (6,) array
        Joint angles [rad]; whole turns are added to the solutions to come close to them.
    joint_range_rad : float
        Largest angle of a joint to either side [rad].

    Returns
    -------
    (6,) array or None
        None where the pose is out of reach.
    """
    near = q_near.tolist()
    best, best_distance = None, math.inf
    for solution in inverse(flange, near[5]):
        joints, distance = [], 0.0
        for angle, wanted in zip(solution, near, strict=True):
            closest = wanted + math.remainder(angle - wanted, math.tau)
            if abs(closest) > joint_range_rad:
                closest -= math.copysign(math.tau, closest)
            joints.append(closest)
            distance += abs(closest - wanted)
        if distance < best_distance:
            best, best_distance = joints, distance
    return None if best is None else np.array(best)


def _cosine(numerator: float, denominator: float) -> float | None:
    """Return a ratio as a cosine, clipped where rounding alone passes 1; None out of reach."""
    if abs(numerator) > abs(denominator) * (1 + _EDGE) or denominator == 0.0:
        return None
    return max(-1.0, min(1.0, numerator / denominator))
