# SPDX-License-Identifier: Apache-2.0
"""Kinematics of a UR5e in closed form: where the links are, how they move, and the inverse of both.

Denavit-Hartenberg parameters: Universal Robots, "Parameters for calculations of kinematics and
dynamics" (article 45257), table UR5e. Real arms carry a calibration of their own, tenths of a
millimetre away from these nominal figures.

Axes 2, 3 and 4 are parallel, so that joints 2 to 4 move the wrist in the plane of x and z of frame 1
("outwards" and "up") as an arm of two links; axes 5 and 6 meet in the wrist's centre.

A simulated robot does this several times a cycle, so it is compiled (numba, which looks at the date of this
file alone: whatever is compiled for it is in here). So are the two steps of an arm's state in each cycle:
`follow`, joints that lag behind their target, and `feel`, what the sensor at the flange measures.
"""

from __future__ import annotations

import math

from numba import boolean, float64, njit, void
from numba.types import UniTuple

from tactile_resonance.contact.vectors import IDENTITY, Numbers, Transform, Vector, cross

# Figures of the table. Lengths in m; the twists alpha are 90, 0, 0, 90, -90 and 0 degrees.
D1, A2, A3, D4, D5, D6 = 0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996

# Of a joint, by the UR5e data sheet: largest angle to either side, 360 degrees; largest speed, 180 degrees/s.
JOINT_RANGE_RAD, JOINT_SPEED_RAD_S = math.tau, math.pi

# By how much a cosine may pass 1 from rounding alone: a joint at the edge of its reach.
_EDGE = 1e-9

_3, _6, _9, _12 = (UniTuple(float64, n) for n in (3, 6, 9, 12))
_ROWS = float64[:, ::1]


@njit(_12(_9, _3, _9, _3), cache=True)
def _product(a, a_m, b, b_m):
    """See `product`."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = a
    b0, b1, b2, b3, b4, b5, b6, b7, b8 = b
    (x, y, z), (bx, by, bz) = a_m, b_m
    return (
        a0 * b0 + a1 * b3 + a2 * b6, a0 * b1 + a1 * b4 + a2 * b7, a0 * b2 + a1 * b5 + a2 * b8,
        a3 * b0 + a4 * b3 + a5 * b6, a3 * b1 + a4 * b4 + a5 * b7, a3 * b2 + a4 * b5 + a5 * b8,
        a6 * b0 + a7 * b3 + a8 * b6, a6 * b1 + a7 * b4 + a8 * b7, a6 * b2 + a7 * b5 + a8 * b8,
        x + (a0 * bx + a1 * by + a2 * bz),
        y + (a3 * bx + a4 * by + a5 * bz),
        z + (a6 * bx + a7 * by + a8 * bz),
    )  # fmt: skip


def product(a: Transform, b: Transform) -> Transform:
    """Return the transform of `b` as seen from the frame in which `a` is given."""
    numbers = _product(*a, *b)
    return numbers[:9], numbers[9:]


@njit(UniTuple(float64, 24)(_6), cache=True)
def _posture(q):
    """Return the flange in the base, turn (9) and place (3), and the numbers (12) of `Posture`."""
    q1, q2, q3, q4, q5, q6 = q
    q23 = q2 + q3
    q234 = q23 + q4
    s1, c1 = math.sin(q1), math.cos(q1)
    s234, c234 = math.sin(q234), math.cos(q234)
    s5, c5 = math.sin(q5), math.cos(q5)
    s6, c6 = math.sin(q6), math.cos(q6)
    # ends of links 2 and 3, and the wrist's centre: outwards and up from axis 2
    r2, h2 = A2 * math.cos(q2), A2 * math.sin(q2)
    r3, h3 = r2 + A3 * math.cos(q23), h2 + A3 * math.sin(q23)
    r4, h4 = r3 + D5 * s234, h3 - D5 * c234
    wx, wy, wz = r4 * c1 + D4 * s1, r4 * s1 - D4 * c1, D1 + h4
    # axes of frames 4 and 5; y of frame 4 is axis 2: (s1, -c1, 0)
    z4x, z4y, z4z = s234 * c1, s234 * s1, -c234
    x4x, x4y, x4z = c234 * c1, c234 * s1, s234
    x5x, x5y, x5z = c5 * x4x + s5 * s1, c5 * x4y - s5 * c1, c5 * x4z
    z5x, z5y, z5z = c5 * s1 - s5 * x4x, -c5 * c1 - s5 * x4y, -s5 * x4z
    return (
        c6 * x5x - s6 * z4x, -s6 * x5x - c6 * z4x, z5x,
        c6 * x5y - s6 * z4y, -s6 * x5y - c6 * z4y, z5y,
        c6 * x5z - s6 * z4z, -s6 * x5z - c6 * z4z, z5z,
        wx + D6 * z5x, wy + D6 * z5y, wz + D6 * z5z,
        s1, c1, s234, c234, s5, c5, r2, h2, r3, h3, r4, h4,
    )  # fmt: skip


@njit(_6(_12, _3, _6), cache=True)
def _twist(numbers, point_m, qd):
    """See `Posture.twist`."""
    s1, c1, s234, c234, s5, c5, r2, h2, r3, h3, r4, h4 = numbers
    qd1, qd2, qd3, qd4, qd5, qd6 = qd
    bending = qd2 + qd3 + qd4
    outwards = bending * (h3 - h4) - qd2 * h3 - qd3 * (h3 - h2)
    up = bending * (r4 - r3) + qd2 * r3 + qd3 * (r3 - r2)
    # angular velocity along x of frame 4 and along axis 2
    along, across = -s5 * qd6, bending + c5 * qd6
    ox = c1 * (c234 * along + s234 * qd5) + s1 * across
    oy = s1 * (c234 * along + s234 * qd5) - c1 * across
    oz = s234 * along - c234 * qd5 + qd1
    wx, wy, wz = r4 * c1 + D4 * s1, r4 * s1 - D4 * c1, D1 + h4
    x, y, z = point_m[0] - wx, point_m[1] - wy, point_m[2] - wz
    return (
        oy * z - oz * y + outwards * c1 - qd1 * wy,
        oz * x - ox * z + outwards * s1 + qd1 * wx,
        ox * y - oy * x + up,
        *(ox, oy, oz),
    )


@njit(_6(_12, _3, _6), cache=True)
def _speeds(numbers, point_m, twist):
    """Return the joint speeds [rad/s] of a twist of a point, the inverse of `_twist`; NaN at a singularity."""
    s1, c1, s234, c234, s5, c5, r2, h2, r3, h3, r4, h4 = numbers
    vx, vy, vz, ox, oy, oz = twist
    # A2 A3 sin(q3): 0 where the elbow is stretched; r4: where the wrist is above the shoulder
    elbow = r2 * h3 - h2 * r3
    if s5 == 0.0 or r4 == 0.0 or elbow == 0.0:
        nan = math.nan
        return nan, nan, nan, nan, nan, nan
    wx, wy, wz = r4 * c1 + D4 * s1, r4 * s1 - D4 * c1, D1 + h4
    px, py, pz = wx - point_m[0], wy - point_m[1], wz - point_m[2]
    # velocity of the wrist's centre
    x, y, z = oy * pz - oz * py + vx, oz * px - ox * pz + vy, ox * py - oy * px + vz
    qd1 = (c1 * y - s1 * x) / r4
    outwards = c1 * x + s1 * y - qd1 * D4
    oz -= qd1
    level = c1 * ox + s1 * oy
    qd5 = s234 * level - c234 * oz
    qd6 = -(c234 * level + s234 * oz) / s5
    bending = s1 * ox - c1 * oy - c5 * qd6
    outwards -= bending * (h3 - h4)
    up = z - bending * (r4 - r3)
    qd2 = (outwards * (r3 - r2) + up * (h3 - h2)) / elbow
    qd3 = -(outwards * r3 + up * h3) / elbow
    return qd1, qd2, qd3, bending - qd2 - qd3, qd5, qd6


class Posture:
    """The arm at one set of joint angles.

    Parameters
    ----------
    q : tuple of 6 float
        Joint angles [rad].

    Attributes
    ----------
    q : tuple of 6 float
        Joint angles [rad].
    flange : Transform
        Tool flange in the base.
    """

    __slots__ = ("_numbers", "_tools", "flange", "q")

    def __init__(self, q: Numbers) -> None:
        self.q = q
        numbers = _posture(q)
        self.flange: Transform = numbers[:9], numbers[9:12]
        self._numbers = numbers[12:]
        self._tools: list[tuple[Transform, Transform]] = [(IDENTITY, self.flange)]

    def tool(self, tcp: Transform) -> Transform:
        """Return a frame that the flange carries, in the base; each, known by identity, is computed once."""
        for known, tool in self._tools:
            if known is tcp:
                return tool
        tool = product(self.flange, tcp)
        self._tools.append((tcp, tool))
        return tool

    def twist(self, point_m: Vector, qd: Numbers) -> Numbers:
        """Return the velocity [m/s] of a point that the flange carries and its angular velocity [rad/s].

        Parameters
        ----------
        point_m : Vector
            The point in the base [m].
        qd : 6 floats
            Speeds of the joints [rad/s].
        """
        return _twist(self._numbers, point_m, qd)

    def torques(self, point_m: Vector, wrench: Numbers) -> Numbers:
        """Return the torques [N m] of the joints that a wrench [N, N m] at a point in the base exerts."""
        s1, c1, s234, c234, s5, c5, r2, h2, r3, h3, r4, h4 = self._numbers
        fx, fy, fz, mx, my, mz = wrench
        wx, wy, wz = r4 * c1 + D4 * s1, r4 * s1 - D4 * c1, D1 + h4
        x, y, z = cross((point_m[0] - wx, point_m[1] - wy, point_m[2] - wz), (fx, fy, fz))
        mx, my, mz = mx + x, my + y, mz + z  # about the wrist's centre
        outwards, level, across = c1 * fx + s1 * fy, c1 * mx + s1 * my, s1 * mx - c1 * my
        return (
            mz + wx * fy - wy * fx,
            across + r4 * fz - h4 * outwards,
            across + (r4 - r2) * fz - (h4 - h2) * outwards,
            across + (r4 - r3) * fz - (h4 - h3) * outwards,
            s234 * level - c234 * mz,
            c5 * across - s5 * (c234 * level + s234 * mz),
        )


@njit
def _cosine(numerator, denominator):
    """Return a ratio as a cosine, clipped where rounding alone passes 1; NaN out of reach."""
    if abs(numerator) > abs(denominator) * (1 + _EDGE) or denominator == 0.0:
        return math.nan
    return max(-1.0, min(1.0, numerator / denominator))


@njit
def _within_a_turn(angle):
    """Return an angle in [-pi, pi], whole turns taken off."""
    return angle - math.tau * math.floor(angle / math.tau + 0.5)


@njit(_6(_9, _3, float64, float64, float64, float64), cache=True)
def _solution(turn, place_m, shoulder, wrist, elbow, wrist_angle_rad):
    """Return the joint angles for a place of the flange with given signs, each in [-pi, pi]; NaN out of reach.

    Closed form: joint 1 from the wrist's centre, joints 5 and 6 from the flange's attitude, then a
    planar arm of two links (joints 2, 3) and the angle left for joint 4.
    """
    xx, yx, zx, xy, yy, zy, xz, yz, zz = turn
    px, py, pz = place_m
    # centre of the wrist, on joint 6's axis, D6 before the flange
    wx, wy, wz = px - D6 * zx, py - D6 * zy, pz - D6 * zz
    sideways = _cosine(D4, math.sqrt(wx * wx + wy * wy))
    q1 = math.atan2(wy, wx) + shoulder * math.acos(sideways) + math.pi / 2
    s1, c1 = math.sin(q1), math.cos(q1)
    bend = _cosine(px * s1 - py * c1 - D4, D6)
    # flange's x and y against axis 2; both vanish where axes 4 and 6 are parallel
    along_x, along_y = xx * s1 - xy * c1, yx * s1 - yy * c1
    # the arc cosine alone would lose half of the digits near 0 and half a turn
    q5 = wrist * math.atan2(math.sqrt(along_x * along_x + along_y * along_y), bend)
    s5, c5 = math.sin(q5), math.cos(q5)
    q6 = wrist_angle_rad if abs(s5) < _EDGE else math.atan2(-along_y / s5, along_x / s5)
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
    stretch = _cosine(reach * reach + height * height - A2 * A2 - A3 * A3, 2 * A2 * A3)
    q3 = elbow * math.acos(stretch)
    q2 = math.atan2(height, reach) - math.atan2(A3 * math.sin(q3), A2 + A3 * math.cos(q3))
    q4 = _within_a_turn(q234 - q2 - q3)
    return _within_a_turn(q1), _within_a_turn(q2), q3, q4, q5, _within_a_turn(q6)


@njit
def _closest(angle, wanted):
    """Return an angle with the whole turns added that bring it close to another."""
    closest = wanted + _within_a_turn(angle - wanted)
    if abs(closest) > JOINT_RANGE_RAD:
        closest -= math.copysign(math.tau, closest)
    return closest


@njit(UniTuple(float64, 7)(_9, _3, _6), cache=True)
def _nearest(turn, place_m, near):
    """Return of all solutions, with whole turns added, that nearest to given angles; last how far it is."""
    best = (near[0], near[1], near[2], near[3], near[4], near[5], math.inf)
    for number in range(8):
        shoulder = -1.0 if number & 4 else 1.0
        wrist = -1.0 if number & 2 else 1.0
        elbow = -1.0 if number & 1 else 1.0
        q = _solution(turn, place_m, shoulder, wrist, elbow, near[5])
        a, b, c = _closest(q[0], near[0]), _closest(q[1], near[1]), _closest(q[2], near[2])
        d, e, f = _closest(q[3], near[3]), _closest(q[4], near[4]), _closest(q[5], near[5])
        way = abs(a - near[0]) + abs(b - near[1]) + abs(c - near[2])
        way = way + abs(d - near[3]) + abs(e - near[4]) + abs(f - near[5])
        if way < best[6]:
            best = (a, b, c, d, e, f, way)
    return best


def nearest_inverse(flange: Transform, near: Numbers) -> Numbers | None:
    """Return the joint angles for a place of the flange that are nearest to given ones.

    Parameters
    ----------
    flange : Transform
        The flange in the base.
    near : 6 floats
        Joint angles [rad]; whole turns are added to the solutions to come close to them.

    Returns
    -------
    6 floats or None
        None where the place is out of reach.
    """
    *joints, way = _nearest(*flange, near)
    return tuple(joints) if way < math.inf else None


@njit(UniTuple(float64, 13)(_9, _3, _6, _6, _9, _3, _9, _3), cache=True)
def motion_to(turn, place_m, twist, near, tcp, tcp_m, back, back_m):
    """Return the motion of the joints that brings a TCP to a place with a twist, as numbers.

    Parameters
    ----------
    turn, place_m : 9 floats, 3 floats
        Of the TCP in the base.
    twist : 6 floats
        Its velocity [m/s] and angular velocity [rad/s] in the base.
    near : 6 floats
        See `nearest_inverse`.
    tcp, tcp_m, back, back_m : 9 floats, 3 floats, twice
        The TCP in the flange, and the flange in it.

    Returns
    -------
    13 floats
        Joint angles [rad] (6), joint speeds [rad/s] (6), NaN at a singularity; how far the angles are from
        `near` [rad], infinite out of reach.
    """
    flange = _product(turn, place_m, back, back_m)
    found = _nearest(flange[:9], flange[9:], near)
    numbers = _posture(found[:6])
    point_m = _product(numbers[:9], numbers[9:12], tcp, tcp_m)[9:]
    return found[:6] + _speeds(numbers[12:], point_m, twist) + found[6:]


@njit
def _turned(turn, x, y, z):
    """Return a turn that is turned further by a rotation vector in the base (Rodrigues' formula)."""
    angle = math.sqrt(x * x + y * y + z * z)
    if angle == 0.0:
        return turn
    # 1 - cos(angle) by half the angle: the difference has no digits left where the angle is small
    half = math.sin(angle / 2) / angle
    sine, versine = 2 * half * math.cos(angle / 2), 2 * half * half
    sx, sy, sz, vx, vy, vz = sine * x, sine * y, sine * z, versine * x, versine * y, versine * z
    further = (
        1.0 - vy * y - vz * z, vx * y - sz, vx * z + sy,
        vx * y + sz, 1.0 - vx * x - vz * z, vy * z - sx,
        vx * z - sy, vy * z + sx, 1.0 - vx * x - vy * y,
    )  # fmt: skip
    nowhere = (0.0, 0.0, 0.0)
    return _product(further, nowhere, turn, nowhere)[:9]


@njit(
    UniTuple(float64, 15)(*[_6] * 3, *[float64] * 2, boolean, *[_9, _3] * 2),
    cache=True,
)
def motion_towards(q, qd, goal, most, period_s, straight, tcp, tcp_m, back, back_m):
    """Return the motion of the joints that brings the twist of a TCP nearer to a goal in a period.

    Parameters
    ----------
    q, qd : 6 floats
        Of the joints at its beginning [rad], [rad/s].
    goal : 6 floats
        Velocity [m/s] and angular velocity [rad/s] in the base.
    most, period_s : float
        Largest change of the velocity [m/s], numerically that of the angular velocity too; the period.
    straight : bool
        Moving and turning end together, so that the path is kept.
    tcp, tcp_m, back, back_m
        See `motion_to`.

    Returns
    -------
    15 floats
        As of `motion_to`; whether the goal is reached; whether no joint passes its range or its speed, on the
        way and at its end.
    """
    numbers = _posture(q)
    tool = _product(numbers[:9], numbers[9:12], tcp, tcp_m)
    vx, vy, vz, ox, oy, oz = _twist(numbers[12:], tool[9:], qd)
    x, y, z, rx, ry, rz = goal
    moving = math.sqrt((x - vx) * (x - vx) + (y - vy) * (y - vy) + (z - vz) * (z - vz))
    turning = math.sqrt((rx - ox) * (rx - ox) + (ry - oy) * (ry - oy) + (rz - oz) * (rz - oz))
    reached = moving <= most and turning <= most
    if not reached:
        longest = max(moving, turning)
        move = most / max(longest if straight else moving, most)
        turn = most / max(longest if straight else turning, most)
        x, y, z = vx + (x - vx) * move, vy + (y - vy) * move, vz + (z - vz) * move
        rx, ry, rz = ox + (rx - ox) * turn, oy + (ry - oy) * turn, oz + (rz - oz) * turn
    mean_s = period_s / 2
    turned = _turned(tool[:9], (ox + rx) * mean_s, (oy + ry) * mean_s, (oz + rz) * mean_s)
    px, py, pz = tool[9:]
    place = (px + (vx + x) * mean_s, py + (vy + y) * mean_s, pz + (vz + z) * mean_s)
    twist = (x, y, z, rx, ry, rz)
    found = motion_to(turned, place, twist, q, tcp, tcp_m, back, back_m)
    within = True
    for k in range(6):
        on_the_way, then = (found[k] - q[k]) / period_s, found[6 + k]
        within = within and abs(found[k]) <= JOINT_RANGE_RAD
        within = within and max(abs(on_the_way), abs(then)) <= JOINT_SPEED_RAD_S
    return found + (1.0 if reached else 0.0, 1.0 if within else 0.0)


FLANGE, TOOL, TOUCH, SEEN, SPEEDS, TWIST, WRENCHES, TCP, TIP, MASSES, FALL, ARM_ROWS = range(12)
"""Rows of an arm's state, 12 numbers each, and how many there are: turn and place of the flange, the TCP, and
the tip where it trembles; joint angles and the wrench on the TCP; joint speeds in this cycle and in the one
before; twist of the TCP, and the wrench that is taken for zero; wrench on the flange as measured, and without
payload.

What is set: TCP and tip in the flange; masses [kg] with their centres of gravity, of the tool, of the payload
that is compensated, and of what of that an external sensor does not feel; acceleration of free fall, place of
that sensor in the flange, and what it measures there."""


@njit(void(_ROWS, float64[::1]), cache=True)
def behind(lag, how):
    """Let axes follow their set points for a period, exactly for those that run linearly over it.

    Parameters
    ----------
    lag : (4 + n, axes) array
        Where the axes are, the set points that reached them last, and those on their way, oldest first; the
        last is that of the end of the period.
    how : (3,) array
        Share of a period by which the dead time is longer than n of them; decay and slope of the lag.
    """
    fraction, decay, slope = how
    for k in range(lag.shape[1]):
        value, before, now = lag[0, k], lag[1, k], lag[3, k]
        if fraction > 0.0:
            now = now + fraction * (lag[2, k] - now)
        lag[1, k] = now
        lag[0, k] = now + decay * (value - before) - slope * (now - before)
        for row in range(2, len(lag) - 1):
            lag[row, k] = lag[row + 1, k]


@njit
def _write(row, numbers):
    """Write numbers into a row."""
    for k in range(len(numbers)):
        row[k] = numbers[k]


@njit
def _three(row, first):
    """Return three numbers of a row."""
    return row[first], row[first + 1], row[first + 2]


@njit
def _six(row, first):
    """Return six numbers of a row."""
    return _three(row, first) + _three(row, first + 3)


@njit
def _carried(arm, frame, inside):
    """Write where a frame of the flange is in the base."""
    for k in range(3):
        a, b, c = arm[FLANGE, 3 * k], arm[FLANGE, 3 * k + 1], arm[FLANGE, 3 * k + 2]
        for n in range(3):
            x, y, z = arm[inside, n], arm[inside, 3 + n], arm[inside, 6 + n]
            arm[frame, 3 * k + n] = a * x + b * y + c * z
        place = a * arm[inside, 9] + b * arm[inside, 10] + c * arm[inside, 11]
        arm[frame, 9 + k] = arm[FLANGE, 9 + k] + place


@njit(void(_ROWS, _ROWS, float64[::1], _6, _3, float64, boolean), cache=True)
def follow(arm, lag, how, target, tremble_m, period_s, powered):
    """Let the joints follow their target for a period; without power the brakes hold them where they are.

    Parameters
    ----------
    arm : (ARM_ROWS, 12) array
        Changed, but for the wrenches and what is set.
    lag, how
        See `behind`.
    target : 6 floats
        Angles of the joints at its end [rad].
    tremble_m : 3 floats
        Displacement of the tip in the base.
    period_s : float
    powered : bool
    """
    if powered:
        _write(lag[len(lag) - 1], target)
        behind(lag, how)
    moving = False
    for k in range(6):
        arm[SPEEDS, 6 + k] = arm[SPEEDS, k] if powered else 0.0
        arm[SPEEDS, k] = (lag[0, k] - arm[SEEN, k]) / period_s
        arm[SEEN, k] = lag[0, k]
        moving = moving or arm[SPEEDS, k] != 0.0
    numbers = _posture(_six(arm[SEEN], 0))
    _write(arm[FLANGE], numbers[:12])
    _carried(arm, TOOL, TCP)
    _carried(arm, TOUCH, TIP)
    for k in range(3):
        arm[TOUCH, 9 + k] += tremble_m[k]
    for k in range(6):
        arm[TWIST, k] = 0.0
    if moving:
        _write(arm[TWIST], _twist(numbers[12:], _three(arm[TOOL], 9), _six(arm[SPEEDS], 0)))


@njit
def _in_flange(flange, vector):
    """Return a vector of the base as the flange sees it."""
    x, y, z = vector
    return (
        flange[0] * x + flange[3] * y + flange[6] * z,
        flange[1] * x + flange[4] * y + flange[7] * z,
        flange[2] * x + flange[5] * y + flange[8] * z,
    )


@njit
def _at_origin(place_m, force, torque):
    """Return as a wrench about the origin what acts at a place."""
    (x, y, z), (fx, fy, fz), (mx, my, mz) = place_m, force, torque
    return fx, fy, fz, mx + (y * fz - z * fy), my + (z * fx - x * fz), mz + (x * fy - y * fx)


@njit
def _weight(masses, first, down):
    """Return the weight of a mass as a wrench on the flange."""
    kg = masses[first]
    force = (down[0] * kg, down[1] * kg, down[2] * kg)
    return _at_origin(_three(masses, first + 1), force, (0.0, 0.0, 0.0))


@njit(float64(_ROWS, _6, _3, _3, boolean), cache=True)
def feel(arm, error, force, torque, replaced):
    """Measure the wrench on the flange; return the force on the TCP without payload and zero [N].

    Parameters
    ----------
    arm : (ARM_ROWS, 12) array
        Its wrenches are changed.
    error : 6 floats
        Of the sensor, in the flange [N], [N m].
    force, torque : 3 floats
        On the tip, in the base [N], [N m].
    replaced : bool
        Whether an external sensor's wrench is taken in place of the measured one.
    """
    flange, fall = arm[FLANGE], arm[FALL]
    down = _in_flange(flange, _three(fall, 0))
    tool, payload = _weight(arm[MASSES], 0, down), _weight(arm[MASSES], 4, down)
    own = _weight(arm[MASSES], 8, down)
    pressed = _at_origin(_three(arm[TIP], 9), _in_flange(flange, force), _in_flange(flange, torque))
    told = _at_origin(_three(fall, 3), _three(fall, 6), _three(fall, 9))
    for k in range(6):
        measured = tool[k] + pressed[k] + error[k]
        arm[WRENCHES, k] = measured
        arm[WRENCHES, 6 + k] = (told[k] if replaced else measured) - (payload[k] - own[k])
    (x, y, z), free, zero = _three(arm[TCP], 9), _six(arm[WRENCHES], 6), _six(arm[TWIST], 6)
    fx, fy, fz = free[0] - zero[0], free[1] - zero[1], free[2] - zero[2]
    mx = free[3] - zero[3] + (fy * z - fz * y)
    my = free[4] - zero[4] + (fz * x - fx * z)
    mz = free[5] - zero[5] + (fx * y - fy * x)
    for k in range(3):
        a, b, c = flange[3 * k], flange[3 * k + 1], flange[3 * k + 2]
        arm[SEEN, 6 + k] = a * fx + b * fy + c * fz
        arm[SEEN, 9 + k] = a * mx + b * my + c * mz
    return math.sqrt(fx * fx + fy * fy + fz * fz)
