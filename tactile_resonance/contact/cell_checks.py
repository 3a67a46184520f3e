# SPDX-License-Identifier: Apache-2.0
"""Whether a force source serves a force; what its wrenches show of the health of its sensor, one by one."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from tactile_resonance.contact.interfaces import ForceError, ForceFault, ForceInfo
from tactile_resonance.contact.vectors import Six
from tactile_resonance.fields import Checked, Range

REFERENCE_RATE_HZ = 500.0
"""The control loop's. White noise of another rate is compared by its density."""
NOISE_SHARE = 0.10
"""Noise of one sample at the reference rate, per force asked for: 1 mN rms at 1 cN."""
RESOLUTION_SHARE = 0.03
"""Smallest step, per force asked for: 0.3 mN at 1 cN."""
SLOWEST_HZ = 200.0
"""Two samples within the 10 ms after which force data are too old."""
RANGE_FACTOR = 5.0
"""Range, per force asked for: the hard stop of contact control must be measurable."""


def require_fit(info: ForceInfo, force_n: float) -> None:
    """Refuse a source that cannot serve a force.

    The limits are those with which the contact controller was simulated: with three times the noise the
    95 % quantile of its overshoot goes from 8 to 17 % (docs/force_sensors.md).

    Parameters
    ----------
    info : ForceInfo
    force_n : float
        Contact force asked for [N].

    Raises
    ------
    ValueError
        With every reason and its figures.
    """
    if not 0 < force_n < math.inf:
        raise ValueError(f"force_n: {force_n!r}, expected a force above 0")
    noise_n = info.noise_rms_n * (REFERENCE_RATE_HZ / info.rate_hz) ** 0.5
    most_noise_n, most_step_n = NOISE_SHARE * force_n, RESOLUTION_SHARE * force_n
    slack = 1 + 1e-9
    judged = (
        (
            noise_n <= most_noise_n * slack,
            f"its noise is {noise_n * 1e3:.3g} mN rms (at {REFERENCE_RATE_HZ:g} Hz), at most "
            f"{most_noise_n * 1e3:.3g} mN serve",
        ),
        (
            info.resolution_n <= most_step_n * slack,
            f"its smallest step is {info.resolution_n * 1e3:.3g} mN, at most "
            f"{most_step_n * 1e3:.3g} mN serve",
        ),
        (
            info.rate_hz >= SLOWEST_HZ,
            f"it gives {info.rate_hz:g} Hz, at least {SLOWEST_HZ:g} Hz serve",
        ),
        (
            info.range_n >= RANGE_FACTOR * force_n,
            f"its range is {info.range_n * 1e3:.4g} mN, at least "
            f"{RANGE_FACTOR * force_n * 1e3:.3g} mN serve",
        ),
    )
    reasons = "; ".join(text for good, text in judged if not good)
    if reasons:
        raise ValueError(f"force source {info.name} cannot control {force_n * 1e3:.3g} mN: {reasons}")


FALSE_ALARM = 1e-12
"""Accepted probability that noise alone repeats a sample so often that it is called stuck."""
LOST_WITHIN = 100


@dataclass(frozen=True)
class CellLimits(Checked):
    """When a sensor is called faulty.

    Attributes
    ----------
    silent_s : float
        Nothing has come for so long.
    stuck_samples : int or None
        So many samples on end are equal on all axes; None: as many as noise does not explain.
    jump_n : float
        Largest step of a force between samples that a contact makes.
    overload_samples : int
        So many samples on end are beyond the range.
    lost_tolerated : int
        Wrenches lost among the last hundred.
    """

    silent_s: Annotated[float, Range(math.ulp(0.0), 1.0, "above 0 to 1 s")] = 0.010
    stuck_samples: Annotated[int, Range(2, math.inf, "2 or more")] | None = None
    jump_n: Annotated[float, Range(math.ulp(0.0), math.inf, "a number above 0")] = math.inf
    overload_samples: Annotated[int, Range(1, math.inf, "1 or more")] = 3
    lost_tolerated: Annotated[int, Range(0, LOST_WITHIN - 1)] = 3


def repeat_probability(noise_rms_n: float, resolution_n: float) -> float:
    """Probability that two readings of white noise fall on one count, at the worst place between counts."""
    if noise_rms_n <= 0:
        return 1.0
    if resolution_n <= 0:
        return 0.0
    step = resolution_n / noise_rms_n
    edges = (np.arange(-math.ceil(8 / step) - 1, math.ceil(8 / step) + 2) + 0.5) * step
    cumulative = [0.5 * math.erfc(-edge / math.sqrt(2)) for edge in edges]
    return float(np.sum(np.diff(cumulative) ** 2))


def samples_until_stuck(info: ForceInfo) -> int | None:
    """So many equal samples noise does not explain; None where it explains a second of them.

    From the three axes of force, white noise; never below ten samples, since sensors filter.
    """
    chance = repeat_probability(info.noise_rms_n, info.resolution_n) ** 3
    if chance >= 1:
        return None
    pairs = 1.0 if chance <= 0 else math.log(FALSE_ALARM) / math.log(chance)
    samples = max(10, 1 + math.ceil(pairs))
    return samples if samples <= info.rate_hz else None


class CellChecks:
    """The checks of one stream.

    Parameters
    ----------
    info : ForceInfo
    range_nm : float
        Largest torque of the sensor [N m].
    limits : CellLimits
    """

    def __init__(self, info: ForceInfo, range_nm: float, limits: CellLimits) -> None:
        self._limits = limits
        self._range_n, self._range_nm = info.range_n, range_nm
        self._stuck_at = limits.stuck_samples or samples_until_stuck(info) or math.inf
        self.restart()

    def restart(self) -> None:
        """Forget what was seen."""
        self._last: Six | None = None
        self._equal = self._over = 0
        self._recent: deque[bool] = deque(maxlen=LOST_WITHIN)

    def lost(self) -> None:
        """One wrench did not arrive whole. Raises `ForceError` where that comes too often."""
        self._recent.append(True)
        if sum(self._recent) > self._limits.lost_tolerated:
            raise ForceError(
                ForceFault.INCOMPLETE,
                f"{sum(self._recent)} of the last {len(self._recent)} wrenches lost, "
                f"accepted are {self._limits.lost_tolerated}",
            )

    def check(self, wrench: Six, overload: bool = False) -> bool:
        """Look at the next wrench of the sensor.

        Returns
        -------
        bool
            Whether a channel is beyond its range.

        Raises
        ------
        ForceError
            Invalid, overload, stuck or jump.
        """
        self._recent.append(False)
        if not math.isfinite(sum(wrench)):
            axis = next(k for k, value in enumerate(wrench) if not math.isfinite(value))
            raise ForceError(ForceFault.INVALID, f"{_AXES[axis]} is not finite: {wrench[axis]}")
        # written out: this is done for every wrench
        (fx, fy, fz, tx, ty, tz), most_n, most_nm = wrench, self._range_n, self._range_nm
        good = -most_n <= fx <= most_n and -most_n <= fy <= most_n and -most_n <= fz <= most_n
        good = good and -most_nm <= tx <= most_nm and -most_nm <= ty <= most_nm
        over = overload or not (good and -most_nm <= tz <= most_nm)
        self._over = self._over + 1 if over else 0
        if over and self._over >= self._limits.overload_samples:
            ranges = (*[most_n] * 3, *[most_nm] * 3)
            shares = [abs(value) / most for value, most in zip(wrench, ranges, strict=True)]
            axis = shares.index(max(shares))
            seen = f"{_AXES[axis]} is {wrench[axis]:.4g}, range {ranges[axis]:.4g}"
            seen = seen if shares[axis] > 1 else "as the sensor reports"
            raise ForceError(ForceFault.OVERLOAD, f"{self._over} samples beyond the range; {seen}")
        last, self._last = self._last, wrench
        if last is None:
            return over
        self._equal = self._equal + 1 if wrench == last else 0
        if self._equal + 1 >= self._stuck_at:
            raise ForceError(ForceFault.STUCK, f"{self._equal + 1} samples are equal on all axes")
        largest = max(abs(fx - last[0]), abs(fy - last[1]), abs(fz - last[2]))
        if largest > self._limits.jump_n and not over:
            raise ForceError(
                ForceFault.JUMP,
                f"a step of {largest * 1e3:.4g} mN between two samples, "
                f"at most {self._limits.jump_n * 1e3:.4g} mN are from a contact",
            )
        return over


_AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
