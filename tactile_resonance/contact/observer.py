# SPDX-License-Identifier: Apache-2.0
"""From wrenches and heights to what is known: bias, touch, the model of the contact, held force.

The bias, the zero of the force source, is taken just before each approach, and refused where it cannot be
relied on. From one contact to the next it is a random walk that is seen while the tip is in air: between two
looks its variance grows with time; each look, a mean of forces in air, lowers it (the scalar Kalman filter of a
local level, one for each axis). What a look shows beyond both deviations is no walk.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.contact_filter import ContactFilter
from tactile_resonance.contact.envelope import ForceWatch
from tactile_resonance.contact.goal import Breach, Cause
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.samples import WrenchSample
from tactile_resonance.contact.vectors import vector

FEWEST = 20
"""Samples for a tare."""

STEPPED = 4.0
"""Deviations beyond which the zero has not walked, but stepped."""


class TareError(ValueError):
    """The zero cannot be relied on; the message says why."""


@dataclass(frozen=True)
class Zero:
    """What was known of the zero.

    Attributes
    ----------
    force_n : (3,) array
        Mean reading without contact, in the frame `tip`.
    std_n : (3,) array
        Of that mean, with the correlation of the samples.
    time_ns : int
        When, on the clock of the samples.
    """

    force_n: FloatArray
    std_n: FloatArray
    time_ns: int

    def with_look(self, look: Zero, walk_n_per_sqrt_s: float) -> Zero | None:
        """The zero after one more look at it; None where it has stepped.

        Parameters
        ----------
        look : Zero
            From forces in air alone.
        walk_n_per_sqrt_s : float
            Of the random walk [N/sqrt(s)].
        """
        passed_s = max(0.0, (look.time_ns - self.time_ns) * 1e-9)
        variance = self.std_n**2 + walk_n_per_sqrt_s**2 * passed_s
        seen = look.std_n**2
        off = look.force_n - self.force_n
        if np.any(off**2 > STEPPED**2 * (variance + seen)):
            return None
        total = variance + seen
        # an axis that shows one number and does not walk is known
        gain = np.divide(variance, total, out=np.ones_like(total), where=total > 0)
        return Zero(self.force_n + gain * off, np.sqrt(gain * seen), look.time_ns)


def tare(
    samples: Sequence[WrenchSample], parameters: ContactParameters, time_ns: int
) -> tuple[Zero, float]:
    """Zero from sound samples in air, refused beyond the limits that the parameters state for each axis.

    The standard deviation of the mean takes the correlation of neighbouring samples into account: a filter
    in the sensor makes it no smaller than it is.

    Returns
    -------
    zero : Zero
        At the time given [ns].
    noise_n : float
        Along the normal, of one sample about the line through all [N rms].

    Raises
    ------
    TareError
        Too few samples; noise, drift or offset beyond the limits, with the figures.
    """
    if len(samples) < FEWEST:
        raise TareError(f"tare: {len(samples)} samples, expected at least {FEWEST}")
    force = np.array([sample.force_n for sample in samples])  # (n, 3)
    t = np.array([sample.time_ns - samples[0].time_ns for sample in samples]) * 1e-9
    n = len(t)
    t = t - t.mean()
    mean = force.mean(axis=0)
    slope = t @ (force - mean) / (t @ t)
    residual = force - mean - t[:, None] * slope
    rms = np.sqrt((residual**2).sum(axis=0) / (n - 2))
    inflation = _inflation(residual)
    # mean and slope take more of noise whose neighbours are alike with them than of white noise
    left = np.maximum(n - 2 * inflation**2, n / 4)
    scatter = inflation * rms * np.sqrt((n - 2) / left)
    mean_std = scatter / math.sqrt(n)
    slope_std = scatter / math.sqrt(t @ t)
    figures = np.stack([mean, mean_std, rms, slope, slope_std], axis=1).tolist()
    for name, of_axis in zip("xyz", figures, strict=True):
        _check_zero(parameters, name, *of_axis)
    return Zero(mean, mean_std, time_ns), float(rms[2])


def _inflation(residual: FloatArray) -> FloatArray:
    """How much wider (3,) than for white noise the mean scatters, from neighbouring samples' correlation.

    For noise behind a first-order low-pass, sqrt((1 + r) / (1 - r)); the estimate of r is biased by about
    -(1 + 4 r) / n about a mean (Marriott and Pope, Biometrika 41, 1954), about a line by one -(1 + r) / n more.
    """
    n = len(residual)
    power = (residual**2).sum(axis=0)
    r = (residual[1:] * residual[:-1]).sum(axis=0) / np.where(power > 0, power, 1.0)
    r = np.clip(r + (2 + 5 * r) / n, 0.0, 0.999)
    return np.sqrt((1 + r) / (1 - r))


def _check_zero(
    p: ContactParameters,
    name: str,
    zero: float,
    std: float,
    rms: float,
    drift: float,
    drift_std: float,
) -> None:
    if rms > 1.5 * p.cell_noise_n:
        raise TareError(
            f"tare: noise of F{name} {rms * 1e3:.3g} mN rms, the source states "
            f"{p.cell_noise_n * 1e3:.3g} mN: does something touch or shake?"
        )
    # what is no more than noise is not called drift
    if abs(drift) - 3 * drift_std > p.tare_drift_n_per_s:
        raise TareError(
            f"tare: F{name} drifts by {drift * 1e3:.3g} +- {drift_std * 1e3:.2g} mN/s, accepted are "
            f"{p.tare_drift_n_per_s * 1e3:.3g} mN/s"
        )
    if std > p.tare_std_n:
        raise TareError(
            f"tare: zero of F{name} uncertain by {std * 1e3:.3g} mN, accepted are "
            f"{p.tare_std_n * 1e3:.3g} mN: take more samples"
        )
    if abs(zero) > p.tare_offset_n:
        raise TareError(
            f"tare: F{name} reads {zero * 1e3:.4g} mN without contact, accepted are up to "
            f"{p.tare_offset_n * 1e3:.4g} mN (tare_offset_n): does something press or pull?"
        )


class ArmModel:
    """Acceleration limit, dead time and lag of the arm along the normal, one period at a time.

    The law needs from it the way that is still to come; the estimator the acceleration, whose
    force on a tool-mounted cell is not one of contact.

    Attributes
    ----------
    set_speed_m_s : float
        Commanded to the arm, after the acceleration limit.
    speed_m_s, acceleration_m_s2 : float
        Of the tip, as far as the model knows.
    """

    def __init__(self, parameters: ContactParameters) -> None:
        self._period_s = period_s = parameters.period_s
        self._lag_s = lag_s = parameters.arm_lag_s
        self._line: deque[float] = deque([0.0] * max(1, round(parameters.arm_dead_time_s / period_s)))
        self._keep = math.exp(-period_s / lag_s) if lag_s > 0 else 0.0
        self.set_speed_m_s = 0.0
        self.speed_m_s = 0.0
        self.acceleration_m_s2 = 0.0

    def step(self, speed_m_s: float, acceleration_m_s2: float) -> None:
        """Advance one period, commanded to a speed under an acceleration limit."""
        most = acceleration_m_s2 * self._period_s
        self.set_speed_m_s += min(most, max(-most, speed_m_s - self.set_speed_m_s))
        self._line.append(self.set_speed_m_s)
        delayed = self._line.popleft()
        before = self.speed_m_s
        self.speed_m_s = delayed + self._keep * (before - delayed)
        self.acceleration_m_s2 = (self.speed_m_s - before) / self._period_s

    @property
    def pending_m(self) -> float:
        """Way that the arm goes on if its set speed became zero now [m]."""
        return sum(self._line) * self._period_s + self.speed_m_s * self._lag_s


class TouchDetector:
    """Tells a touch from noise: means over short and long windows against their deviation.

    Short windows see stiff tissue at once, long ones soft tissue at a fraction of the noise.
    """

    WINDOWS = (4, 12, 36)
    THRESHOLD = 5.0  # standard deviations: some 1e-7 false alarms per window

    def __init__(self, noise_n: float, tare_std_n: float) -> None:
        self._limits_n = [
            n * self.THRESHOLD * math.sqrt(noise_n**2 / n + tare_std_n**2) for n in self.WINDOWS
        ]  # of the sums
        self._sums_n = [0.0] * len(self.WINDOWS)
        self._recent: deque[float] = deque(maxlen=self.WINDOWS[-1] + 1)

    def add(self, force_n: float) -> bool:
        """Take one more force; return whether there is contact."""
        recent, sums = self._recent, self._sums_n
        recent.append(force_n)
        count, found = len(recent), False
        for k, n in enumerate(self.WINDOWS):
            sums[k] += force_n - recent[-n - 1] if count > n else force_n
            found = found or (count >= n and sums[k] > self._limits_n[k])
        return found


WINDOW_SAMPLES = 220
"""Forces kept for the first estimate of the contact: 440 ms at 500 Hz, 1.8 mm at 4 mm/s."""

LEAST_NOISE_N = 2e-5
"""The filter takes a force for no more certain than this [N]."""

QUIETEST_SHARE = 0.1
"""A sensor with less than this of the noise it states does not measure any more."""

LONGEST_GUESS_S = 0.02
"""So far beyond the newest state of the arm its height is continued [s]."""


class Observer:
    """Takes every force once, at the height at which it was measured.

    Attributes
    ----------
    parameters, limits : ContactParameters, Limits
        Of this contact.
    watch : ForceWatch
    arm_model : ArmModel
    model : ContactFilter or None
        From the touch on.
    taring : bool
        Whether forces are collected for a tare.
    sound : bool
        Whether no force of this contact was bad.
    touched_m : float or None
        Height of the surface as the first touch showed it.
    zero : Zero or None
        The bias, once there is one.
    noise_n, bias_std_n : float
        Of one force and of the bias, from the last tare [N].
    scatter_n : float
        Of white noise whose means scatter as much as those of the forces do [N]: more than `noise_n` where
        neighbouring forces are alike, as behind a filter.
    """

    def __init__(self, parameters: ContactParameters, limits: Limits) -> None:
        p = self.parameters = parameters
        self.limits = limits
        self.watch = ForceWatch(limits.stuck_samples, limits.lost_s)
        self.arm_model = ArmModel(p)
        self.model: ContactFilter | None = None
        self.taring = False
        self.sound = True
        self.touched_m: float | None = None
        self._unloaded: list[WrenchSample] = []
        self.zero: Zero | None = None
        self.noise_n = self.scatter_n = self.bias_std_n = 0.0
        self._heights: deque[tuple[int, float]] = deque(maxlen=50)  # time, height
        self._accelerations: deque[tuple[int, float]] = deque(maxlen=50)  # middle of period, m/s2
        self._carried_kg = p.carried_kg
        self._half_period_ns = round(0.5e9 * p.period_s)
        self._cell_lag_ns = round(1e9 * p.cell_lag_s)
        self._window: deque[tuple[float, float]] = deque(maxlen=WINDOW_SAMPLES)
        self._detector: TouchDetector | None = None
        self._model_ns = 0
        self._sum_n, self._count = 0.0, 0

    def begin_tare(self) -> None:
        """Collect forces for the bias from now on."""
        self.taring = True
        self._unloaded.clear()

    def end_tare(self, now_ns: int, before: Zero | None = None) -> Breach | None:
        """Take the bias and look for the touch from now on; what is wrong with it is returned.

        Parameters
        ----------
        now_ns : int
        before : Zero, optional
            What is known from the contact before: the forces are one more look at it. Then what does not
            agree with it, or leaves it too uncertain, is wrong too.
        """
        self.taring = False
        p = self.parameters
        try:
            look, noise = tare(self._unloaded, p, now_ns)
        except TareError as error:
            return Breach(Cause.TARE, str(error))
        if noise < QUIETEST_SHARE * p.cell_noise_n:
            text = f"tare: noise of {1e3 * noise:.2g} mN rms, the source states"
            return Breach(Cause.TARE, f"{text} {1e3 * p.cell_noise_n:g} mN: does it still measure?")
        zero: Zero | None = look
        if before is not None:
            zero = before.with_look(look, p.zero_walk_n_per_sqrt_s)
            if zero is not None and zero.std_n.max() > p.zero_std_n:
                zero = None
        if zero is None:
            return Breach(Cause.TARE, "tare: the zero is not known from the contact before")
        self.zero = zero
        self.watch.set_bias(vector(zero.force_n))
        self.noise_n = max(LEAST_NOISE_N, noise)
        self.bias_std_n = float(zero.std_n[2])
        self.scatter_n = max(self.noise_n, float(look.std_n[2]) * math.sqrt(len(self._unloaded)))
        self.seek_touch()
        return None

    def seek_touch(self) -> None:
        """Forget the contact and look for a touch."""
        self.model = self.touched_m = None
        self._window.clear()
        self._detector = TouchDetector(self.scatter_n, self.bias_std_n)

    def begin_mean(self) -> None:
        """Average the force from now on."""
        self._sum_n, self._count = 0.0, 0

    def mean_force(self) -> tuple[float, float] | None:
        """Mean force since `begin_mean` and its deviation from noise and tare [N]; None if none."""
        if self._count == 0:
            return None
        std = math.hypot(self.scatter_n / math.sqrt(self._count), self.bias_std_n)
        return self._sum_n / self._count, std

    def take(self, wrenches: Sequence[WrenchSample], arm_ns: int, height_m: float) -> Breach | None:
        """Take a state of the arm and the forces that came; stop at the first that is bad."""
        self._heights.append((arm_ns, height_m))
        carried_kg, inertia = self._carried_kg, 0.0
        if carried_kg > 0:
            middle = arm_ns - self._half_period_ns
            self._accelerations.append((middle, self.arm_model.acceleration_m_s2))
        watch, model, speed_m_s = self.watch, self.model, self.arm_model.speed_m_s
        for sample in wrenches:
            time_ns = sample[0]
            if carried_kg > 0:
                # a cell on the tool feels the contact less mass times acceleration
                then = time_ns - self._cell_lag_ns
                inertia = -carried_kg * _between(self._accelerations, then, 0.0)
            breach = watch.add(sample, inertia)
            if breach is not None:
                self.sound = False
                return breach
            if self.taring:
                self._unloaded.append(sample)
            elif self._detector is not None:
                force, height = watch.force_n[2], _between(self._heights, time_ns, speed_m_s)
                self._window.append((height, force))
                if model is not None:
                    model.follow((time_ns - self._model_ns) * 1e-9, height, force)
                    self._model_ns = time_ns
                    self._sum_n += force
                    self._count += 1
                elif self._detector.add(force):
                    model = self._touch(time_ns)
        return None

    def look_again(self) -> None:
        """Estimate the contact anew from all that was kept: what was detected may have been noise."""
        self._touch(self._model_ns)

    def _touch(self, time_ns: int) -> ContactFilter:
        heights, forces = zip(*self._window, strict=True)
        self.model = ContactFilter(
            heights,
            forces,
            noise_n=self.scatter_n,
            beam_n_per_m=self.parameters.beam_n_per_m,
            vibration_m=self.parameters.arm_vibration_m,
        )
        if self.touched_m is None:
            self.touched_m = self.model.surface_m
        self._model_ns = time_ns
        return self.model


def _between(history: deque[tuple[int, float]], time_ns: int, rate_per_s: float) -> float:
    """Value at a time, linear between those known; beyond the newest it goes on at a rate."""
    after: tuple[int, float] | None = None
    for before in reversed(history):
        then_ns, value = before
        if then_ns > time_ns:
            after = before
        elif after is None:
            return value + rate_per_s * min(LONGEST_GUESS_S, (time_ns - then_ns) * 1e-9)
        else:
            share = (time_ns - then_ns) / (after[0] - then_ns)
            return value + share * (after[1] - value)
    return history[0][1]
