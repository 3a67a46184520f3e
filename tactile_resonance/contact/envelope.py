# SPDX-License-Identifier: Apache-2.0
"""The safety envelope: what is measured must keep the limits, and so must what is commanded.

Every wrench that arrives is judged before it is used: number, overload, stuck, old. The envelope knows nothing
of the law or the state machine: it judges data and bounds velocities, and what it says wins. It is software on
an ordinary computer, not a certified safety function.
"""

from __future__ import annotations

import math
from bisect import bisect
from collections import deque
from typing import NamedTuple

from tactile_resonance.contact.goal import Breach, Cause
from tactile_resonance.contact.parameters import Limits
from tactile_resonance.contact.samples import ArmSample, WrenchSample
from tactile_resonance.contact.vectors import ZERO, Six, Vector, dot, turn_from_vector

RATE_WINDOW_NS = 10_000_000
RECENT, LONGEST_GAP_NS = 64, 200_000_000
"""So many forces are kept for the rate, none from before a longer gap [ns]."""


class ForceWatch:
    """The last wrenches, less their bias.

    Parameters
    ----------
    stuck_samples : int
        So many equal forces along z in a row are a stuck sensor, or one at the end of its range.
    mean_s : float
        Over which the force is averaged [s].

    Attributes
    ----------
    force_n : tuple of 3 floats
        Newest force at the tip, less the bias [N].
    peak_n : float
        Largest force along +z since the bias was set [N]; 0 before.
    """

    def __init__(self, stuck_samples: int, mean_s: float) -> None:
        self._stuck_samples = stuck_samples
        self._equal = 1
        self._last: tuple[int, float] | None = None  # time and force along z of the newest
        self._last_across, self._others_moved = (0.0, 0.0), False  # along x and y, while z was equal
        self._times_ns: deque[int] = deque(maxlen=RECENT)
        self._forces_n: deque[float] = deque(maxlen=RECENT)  # along z, at these times
        self._mean_ns = round(mean_s * 1e9)
        self._averaged: deque[tuple[int, float]] = deque()  # time and force along z
        self._sum_n, self._full = 0.0, False  # of these; whether they reach back far enough
        self._bias_n: Vector | None = None
        self.force_n: Vector = ZERO
        self.peak_n = 0.0

    @property
    def bias_n(self) -> Vector:
        """What is taken off [N]; zeros before the tare."""
        return ZERO if self._bias_n is None else self._bias_n

    def set_bias(self, bias_n: Vector) -> None:
        """Take what the sensor shows out of contact as 0; forget what came before."""
        self._bias_n = bias_n
        self._times_ns.clear()
        self._forces_n.clear()
        self._averaged.clear()
        self._sum_n, self._full = 0.0, False
        self.force_n = ZERO
        self.peak_n = 0.0

    def add(self, sample: WrenchSample, inertia_n: float = 0.0) -> Breach | None:
        """Take one wrench, oldest first; what is wrong with it is returned and it is not used.

        Parameters
        ----------
        sample : WrenchSample
        inertia_n : float
            Part of the force along z that is not of the contact [N].
        """
        time_ns, (x, y, z), _, overload = sample
        if overload:
            return Breach(Cause.FORCE_OVERLOAD, "the force sensor reports overload")
        if not math.isfinite(x + y + z):
            return Breach(Cause.FORCE_INVALID, f"force is not finite: {x}, {y}, {z} N")
        since_ns = 0
        if self._last is not None:
            last_ns, last_n = self._last
            since_ns = time_ns - last_ns
            if since_ns <= 0:
                text = f"time of forces does not ascend: {time_ns} after {last_ns} ns"
                return Breach(Cause.FORCE_INVALID, text)
            if z == last_n:
                self._equal += 1
                self._others_moved = self._others_moved or (x, y) != self._last_across
            else:
                self._equal, self._others_moved = 1, False
            if self._equal >= self._stuck_samples:
                self._last, self._last_across = (time_ns, z), (x, y)
                why = "the sensor is stuck"
                if self._others_moved:
                    why = "z is stuck, or its noise does not show (filter, coarse steps: stuck_samples)"
                text = f"{self._equal} equal forces in a row: {why}"
                return Breach(Cause.FORCE_STUCK, text)
        self._last, self._last_across = (time_ns, z), (x, y)
        z -= inertia_n
        if self._bias_n is not None:
            bias_x, bias_y, bias_z = self._bias_n
            x, y, z = x - bias_x, y - bias_y, z - bias_z
            if z > self.peak_n:
                self.peak_n = z
        self.force_n = (x, y, z)
        if since_ns > LONGEST_GAP_NS:
            self._times_ns.clear()
            self._forces_n.clear()
        self._times_ns.append(time_ns)
        self._forces_n.append(z)
        averaged, first_ns = self._averaged, time_ns - self._mean_ns
        averaged.append((time_ns, z))
        self._sum_n += z
        while averaged[0][0] <= first_ns:
            self._sum_n -= averaged.popleft()[1]
            self._full = True
        return None

    def age_s(self, now_ns: int) -> float:
        """Age of the newest wrench [s]; infinite before the first."""
        return math.inf if self._last is None else (now_ns - self._last[0]) * 1e-9

    @property
    def mean_n(self) -> float | None:
        """Mean force along z over the last `mean_s` [N]; None where less than that is there."""
        return self._sum_n / len(self._averaged) if self._full else None

    @property
    def newest_n(self) -> float:
        """Mean of the three newest forces along z [N]; of fewer where so many have not come."""
        forces = list(self._forces_n)[-3:]
        return sum(forces) / max(1, len(forces))

    @property
    def mean_count(self) -> int:
        """Of forces in `mean_n`."""
        return len(self._averaged)

    def rate_n_per_s(self) -> float | None:
        """Rise of the force along z over 10 ms [N/s], from means of three; None where too few."""
        times, forces = self._times_ns, self._forces_n
        if len(times) < 6:
            return None
        newest_ns = (times[-1] + times[-2] + times[-3]) / 3
        then = newest_ns - RATE_WINDOW_NS
        # the three samples nearest to 10 ms before, none of the newest: `first` is the oldest of them
        first = min(bisect(times, then), len(times) - 6)
        while first > 0 and abs(times[first - 1] - then) <= abs(times[first + 2] - then):
            first -= 1
        span = newest_ns - (times[first] + times[first + 1] + times[first + 2]) / 3
        if span < RATE_WINDOW_NS / 2:
            return None
        before = forces[first] + forces[first + 1] + forces[first + 2]
        return (forces[-1] + forces[-2] + forces[-3] - before) / 3 / (span * 1e-9)


WALL_TIME_S = 0.1
"""Towards a wall of the workspace the tip goes no faster than this brings it there [s]."""

ANSWER_S, BRAKING_M_S2 = 0.03, 0.2
"""The arm answers this late [s] and is trusted to slow down this hard [m/s2] before it is near."""

ROUNDING = 1e-12
"""A part of a velocity this much smaller than all of it is rounding."""

SPEED_MARGIN = 1.5
"""A measured speed may exceed a limit by this factor: vibration and noise of the encoders."""


class Place(NamedTuple):
    """Where the tip is with respect to the surface.

    Attributes
    ----------
    normal : tuple of 3 floats
        Out of the tissue, in the base.
    height_m : float
        Above the expected first touch, along the normal [m].
    depth_m : float or None
        Past the first touch [m]; None where not in contact.
    misalignment_rad : float
        Between the tip's orientation and its goal's.
    housing_m : float or None
        Height of the housing above the surface [m]; None where it is not watched.
    """

    normal: Vector
    height_m: float
    depth_m: float | None
    misalignment_rad: float
    housing_m: float | None = None


class Envelope:
    """Limits, applied."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self._least_upright = math.cos(limits.tilt_rad)
        reach_m = WALL_TIME_S * limits.free_speed_m_s
        # where no speed that is allowed is too much for the walls
        self._amid_low_m = tuple(low + reach_m for low in limits.workspace.low_m)
        self._amid_high_m = tuple(high - reach_m for high in limits.workspace.high_m)

    def judge_arm(self, now_ns: int, arm: ArmSample | None) -> Breach | None:
        """Whether the arm's data are fresh and good and it is where it may be."""
        limits = self.limits
        if arm is None:
            return Breach(Cause.ARM_STALE, "no state of the arm has come")
        age = (now_ns - arm.time_ns) * 1e-9
        if abs(age) > limits.arm_age_s:  # one of the future would seem fresh for long
            text = f"state of the arm is {_age(age)}, limit {1e3 * limits.arm_age_s:g} ms"
            return Breach(Cause.ARM_STALE, text)
        if not arm.moving_allowed:
            return Breach(Cause.ARM_STOPPED, f"the arm may not move: {arm.message}")
        if not is_finite(arm):
            return Breach(Cause.ARM_INVALID, "pose or velocity of the arm is not finite")
        box = limits.workspace
        if not inside(arm.position_m, box.low_m, box.high_m):
            x, y, z = arm.position_m
            text = f"tip at {x:.4f}, {y:.4f}, {z:.4f} m, workspace {box.low_m} to {box.high_m} m"
            return Breach(Cause.WORKSPACE, text)
        upright = turn_from_vector(arm.rotation_rad)[8]  # +z of the tip against the vertical
        if upright < self._least_upright:
            tilt = math.acos(max(-1.0, upright))
            return Breach(
                Cause.TILT, f"tip tilted by {tilt:.3f} rad, limit {limits.tilt_rad:g} rad"
            )
        return None

    def judge_motion(self, arm: ArmSample, place: Place) -> Breach | None:
        """Speed, alignment and depth near the surface and in it; the housing anywhere."""
        limits = self.limits
        if place.depth_m is not None and place.depth_m > limits.depth_m:
            text = f"{1e3 * place.depth_m:.2f} mm past the first touch, limit {1e3 * limits.depth_m:g} mm"
            return Breach(Cause.DEPTH, text)
        if place.depth_m is not None or place.height_m < limits.near_m:
            inwards = -dot(place.normal, arm.velocity[:3])
            if inwards > SPEED_MARGIN * limits.near_speed_m_s:
                text = f"{1e3 * inwards:.1f} mm/s towards the surface near it"
                return Breach(Cause.SPEED, f"{text}, limit {1e3 * limits.near_speed_m_s:g} mm/s")
            if place.misalignment_rad > limits.misalignment_rad:
                text = f"tip {place.misalignment_rad:.3f} rad off its orientation near the surface"
                return Breach(Cause.MISALIGNED, f"{text}, limit {limits.misalignment_rad:g} rad")
        if place.housing_m is not None and place.housing_m < limits.clearance_m:
            text = f"housing {1e3 * place.housing_m:.2f} mm above the surface"
            return Breach(Cause.HOUSING, f"{text}, limit {1e3 * limits.clearance_m:g} mm")
        return None

    def judge_force(self, now_ns: int, watch: ForceWatch) -> Breach | None:
        """Age, size, direction and rate of the force; only after a tare."""
        limits = self.limits
        stale = self.judge_force_age(now_ns, watch)
        if stale is not None:
            return stale
        x, y, z = watch.force_n
        if z > limits.hard_force_n:
            text = f"{1e3 * z:.1f} mN on the tip, beyond the hard limit"
            return Breach(Cause.FORCE_HARD, f"{text} of {1e3 * limits.hard_force_n:g} mN")
        if z > limits.abort_force_n:
            text = f"{1e3 * z:.1f} mN on the tip, limit {1e3 * limits.abort_force_n:g} mN"
            return Breach(Cause.FORCE_ABORT, text)
        newest_n = watch.newest_n  # the noise of one force may be a quarter of this limit
        if newest_n < -limits.pull_force_n:
            text = f"{1e3 * newest_n:.1f} mN against the pressing direction"
            return Breach(Cause.FORCE_PULL, f"{text}, limit {1e3 * limits.pull_force_n:g} mN")
        lateral = math.hypot(x, y)
        if lateral > limits.lateral_force_n:
            text = f"{1e3 * lateral:.1f} mN along the surface"
            return Breach(Cause.FORCE_LATERAL, f"{text}, limit {1e3 * limits.lateral_force_n:g} mN")
        rate = watch.rate_n_per_s()
        if rate is not None and abs(rate) > limits.force_rate_n_per_s:
            text = f"force changes by {rate:.2f} N/s, limit {limits.force_rate_n_per_s:g} N/s"
            return Breach(Cause.FORCE_RATE, text)
        return None

    def judge_force_age(self, now_ns: int, watch: ForceWatch) -> Breach | None:
        """Whether forces still come."""
        age, limit = watch.age_s(now_ns), self.limits.force_age_s
        if abs(age) > limit:
            text = "no force has come" if age == math.inf else f"newest force is {_age(age)}"
            return Breach(Cause.FORCE_STALE, f"{text}, limit {1e3 * limit:g} ms")
        return None

    def bound(self, twist: Six, position_m: Vector, place: Place) -> Six:
        """Return the twist [m/s, rad/s] with every part that breaks a limit taken back.

        What is not finite stops the tip. Speeds shrink, they do not turn round; in contact the parts
        along the surface and into it shrink apart.
        """
        limits = self.limits
        if not math.isfinite(sum(twist)):
            return *ZERO, *ZERO
        x, y, z, turn_x, turn_y, turn_z = twist
        nx, ny, nz = place.normal
        across = nx * x + ny * y + nz * z
        if place.depth_m is not None:
            x, y, z = x - across * nx, y - across * ny, z - across * nz
            share = _shrink(math.hypot(x, y, z), limits.lateral_speed_m_s)
            if across < 0:
                across = max(across, -limits.contact_speed_m_s)
                if place.depth_m >= limits.depth_m:
                    across = 0.0
            x, y, z = share * x + across * nx, share * y + across * ny, share * z + across * nz
            across = nx * x + ny * y + nz * z
        speed, most = math.hypot(x, y, z), limits.free_speed_m_s
        if across < -ROUNDING * speed:
            # further up just so fast that it can slow down before it is near
            room = max(0.0, place.height_m - limits.near_m + ANSWER_S * across)
            most = min(most, math.sqrt(limits.near_speed_m_s**2 + 2 * BRAKING_M_S2 * room))
        share = _shrink(speed, most)
        x, y, z = share * x, share * y, share * z
        if not inside(position_m, self._amid_low_m, self._amid_high_m):
            x, y, z = self._before_walls((x, y, z), position_m)
        share = _shrink(math.hypot(turn_x, turn_y, turn_z), limits.angular_speed_rad_s)
        return x, y, z, share * turn_x, share * turn_y, share * turn_z

    def _before_walls(self, velocity_m_s: Vector, position_m: Vector) -> Vector:
        """The whole velocity shrinks before a wall, so that no other limit is broken by it."""
        box, (x, y, z) = self.limits.workspace, velocity_m_s
        velocity = [x, y, z]
        for axis in (0, 1, 2):
            speed, place_m = velocity[axis], position_m[axis]
            room = box.high_m[axis] - place_m if speed > 0 else place_m - box.low_m[axis]
            room = max(0.0, room) / WALL_TIME_S
            if abs(speed) > room:
                if abs(speed) <= ROUNDING * math.hypot(*velocity):
                    velocity[axis] = 0.0  # along the wall: it stops nothing
                else:
                    velocity = [room / abs(speed) * part for part in velocity]
        x, y, z = velocity
        return x, y, z


def _age(age_s: float) -> str:
    return f"{1e3 * age_s:.0f} ms old" if age_s > 0 else f"{-1e3 * age_s:.0f} ms ahead of the clock"


def inside(place_m: Vector, low_m: tuple[float, ...], high_m: tuple[float, ...]) -> bool:
    """Whether a place is in a box, its walls included."""
    (x, y, z), (low_x, low_y, low_z), (high_x, high_y, high_z) = place_m, low_m, high_m
    return low_x <= x <= high_x and low_y <= y <= high_y and low_z <= z <= high_z


def is_finite(arm: ArmSample) -> bool:
    """Whether pose and velocity of an arm are finite."""
    return math.isfinite(sum(arm.position_m) + sum(arm.rotation_rad) + sum(arm.velocity))


def _shrink(length: float, most: float) -> float:
    """Factor that brings a length down to the most that is allowed, 1 where it is within."""
    return 1.0 if length <= most else most / length
