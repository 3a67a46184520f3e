# SPDX-License-Identifier: Apache-2.0
"""The zero of a force source, taken just before each approach, and refused where it cannot be relied on.

From one contact to the next it is a random walk that is seen while the tip is in air: between two looks its
variance grows with time; each look, a mean of forces in air, lowers it (the scalar Kalman filter of a local
level, one for each axis). What a look shows beyond both deviations is no walk.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.parameters import ContactParameters
from tactile_resonance.contact.samples import WrenchSample

FEWEST = 20


class TareError(ValueError):
    """The zero cannot be relied on; the message says why."""


STEPPED = 4.0
"""Deviations beyond which the zero has not walked, but stepped."""


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
        gain = variance / (variance + seen)
        return Zero(self.force_n + gain * off, np.sqrt(gain * seen), look.time_ns)


def tare(
    samples: Sequence[WrenchSample], parameters: ContactParameters, time_ns: int
) -> tuple[Zero, float]:
    """Zero from samples without contact, refused beyond the limits that the parameters state for each axis.

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
        Too few samples or an overload; noise, drift or offset beyond the limits, with the figures.
    """
    if len(samples) < FEWEST:
        raise TareError(f"tare: {len(samples)} samples, expected at least {FEWEST}")
    if any(sample.overload for sample in samples):
        raise TareError("tare: the sensor is overloaded")
    force = np.array([sample.force_n for sample in samples])  # (n, 3)
    if not np.all(np.isfinite(force)):
        raise TareError("tare: a sample is not finite")
    stamps = np.array([sample.time_ns for sample in samples], dtype=np.int64)
    middle_ns = int(stamps[0]) + int(stamps[-1] - stamps[0]) // 2
    t = (stamps - middle_ns) * 1e-9
    if not np.any(t > t[0]):
        raise TareError("tare: all samples have one time stamp")
    n = len(t)
    t = t - t.mean()
    mean = force.mean(axis=0)
    slope = t @ (force - mean) / (t @ t)
    residual = force - mean - t[:, None] * slope
    rms = np.sqrt((residual**2).sum(axis=0) / (n - 2))
    inflation = _inflation(residual)
    mean_std = inflation * rms / math.sqrt(n)
    slope_std = inflation * rms / math.sqrt(t @ t)
    figures = np.stack([mean, mean_std, rms, slope, slope_std], axis=1).tolist()
    for name, of_axis in zip("xyz", figures, strict=True):
        _check(parameters, name, *of_axis)
    return Zero(mean, mean_std, time_ns), float(rms[2])


def _inflation(residual: FloatArray) -> FloatArray:
    """How much wider (3,) than for white noise the mean scatters, from neighbouring samples' correlation.

    For noise behind a first-order low-pass, sqrt((1 + r) / (1 - r)); the estimate of r is biased by about
    -(1 + 4 r) / n (Marriott and Pope, Biometrika 41, 1954).
    """
    n = len(residual)
    power = (residual**2).sum(axis=0)
    r = (residual[1:] * residual[:-1]).sum(axis=0) / np.where(power > 0, power, 1.0)
    r = np.clip(r + (1 + 4 * r) / n, 0.0, 0.999)
    return np.sqrt((1 + r) / (1 - r))


def _check(
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
