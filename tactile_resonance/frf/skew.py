# SPDX-License-Identifier: Apache-2.0
"""Delay between the channels: measured by a loop-back, corrected, or only suspected."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import special

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.frf.estimate import frf_of_realisations
from tactile_resonance.frf.faults import Fault, FaultKind
from tactile_resonance.frf.result import FRF
from tactile_resonance.frf.spectra import Spectrum, averaged_spectra, stacked_spectra


@dataclass(frozen=True)
class ChannelSkew:
    """Result of a loop-back measurement, both channels on the same signal.

    Attributes
    ----------
    delay_s : float
        Delay of the sensor channel behind the actuator channel [s].
    delay_std_s : float
        Its standard deviation, from the scatter of the phases about a straight line [s]; of few lines widened
        so that 1.96 of it hold the delay in 95 %, as Student's distribution says.
    gain : float
        Ratio of the channels, sensor over actuator; negative where one inverts.
    residual_rad : float
        Largest phase left after the correction [rad]: more than noise means that the channels do
        not differ by a mere delay (filters that do not match).
    """

    delay_s: float
    delay_std_s: float
    gain: float
    residual_rad: float


def skew_from_loopback(
    u: npt.NDArray[np.floating],
    y: npt.NDArray[np.floating],
    *,
    sample_rate_hz: float,
    harmonics: npt.ArrayLike,
) -> ChannelSkew:
    """Delay between channels that are both connected to the generator.

    Parameters
    ----------
    u, y : (P, N) float
        Actuator and sensor channel [V], steady state.
    sample_rate_hz : float
    harmonics : (F,) int
        Excited lines, at least three; the delay is unique up to one over their smallest spacing.

    Raises
    ------
    ValueError
        For fewer than three lines, or channels that do not see the same signal.
    """
    spectra = stacked_spectra([averaged_spectra(Spectrum.of(u, y), harmonics)])
    frf = frf_of_realisations(spectra, sample_rate_hz=sample_rate_hz)
    f = frf.frequency_hz
    if f.size < 3:
        raise ValueError(f"harmonics: {f.size} lines, expected at least 3 to fit a delay")
    delay, intercept, residual, std = linear_phase(f, frf.g)
    largest = float(np.max(np.abs(residual)))
    if largest > 0.5:
        raise ValueError(
            f"u, y: phase between the channels is {largest:.2f} rad off a straight line, expected "
            "a loop-back: both channels on the same signal"
        )
    std *= special.stdtrit(f.size - 2, 0.975) / special.ndtri(0.975)
    sign = np.sign(np.cos(intercept))
    # the line need not pass through zero: what it has there no delay takes out
    left = np.angle(correct_skew(frf, float(delay)).g * sign)
    gain = float(np.mean(np.abs(frf.g)) * sign)
    return ChannelSkew(float(delay), float(std), gain, float(np.max(np.abs(left))))


def correct_skew(frf: FRF, delay_s: float) -> FRF:
    """The FRF as it were without the delay of the sensor channel; variances are the same.

    Parameters
    ----------
    frf : FRF
    delay_s : float
        Delay of the sensor channel behind the actuator channel [s], e.g. `ChannelSkew.delay_s`.
    """
    if not np.isfinite(delay_s):
        raise ValueError(f"delay_s: {delay_s}, expected a finite delay in seconds")
    return replace(frf, g=frf.g * np.exp(2j * np.pi * frf.frequency_hz * delay_s))


def suspected_skew(frf: FRF) -> Fault | None:
    """A phase over the upper half of the lines that a delay explains, nothing more.

    A sensor whose response is flat above its mode, as a piezoelectric bimorph with feed-through
    is, has no phase there; a straight phase through zero (or pi) then hints at a skew. A real
    delay in the system looks the same: only a loop-back distinguishes them.
    """
    upper = frf.frequency_hz >= frf.frequency_hz[-1] / 2
    f, g = frf.frequency_hz[upper], frf.g[upper]
    if f.size < 8 or g.ndim != 1:
        return None
    delay, intercept, residual, std = linear_phase(f, g)
    turned = abs(2 * np.pi * delay * f[-1])
    # against what it turns over the lines: near a mode it turns too, but along no straight line
    turned_over_lines = abs(2 * np.pi * delay * (f[-1] - f[0]))
    # and within what phases of noise, pi / sqrt(3) about any line, are far above
    straight = np.sqrt(np.mean(residual**2)) < min(0.05 * max(turned_over_lines, 0.1), 0.3)
    through_origin = abs(np.sin(intercept)) < 0.1 * max(turned, 1.0)
    if turned < 0.05 or not straight or not through_origin or abs(delay) < 5 * std:
        return None
    text = (
        f"The phase looks like a delay of {delay * 1e6:.3g} us between the channels: measure it "
        "with a loop-back"
    )
    return Fault(FaultKind.CHANNEL_SKEW, "both", abs(float(delay)), False, text)


def linear_phase(
    f: FloatArray, g: ComplexArray
) -> tuple[np.floating, np.floating, FloatArray, np.floating]:
    """Delay, phase at zero frequency, residual phases (F,), and standard deviation of the delay."""
    # delay from line to line first, so that the rest needs no unwrapping
    step = np.diff(f)
    closest = step < 1.5 * step.min()
    advance = np.sum(g[1:][closest] * g[:-1][closest].conj())
    coarse = -np.angle(advance) / (2 * np.pi * step[closest].mean())
    turned = g * np.exp(2j * np.pi * f * coarse)
    phase = np.unwrap(np.angle(turned))
    slope, intercept = np.polyfit(f, phase, 1)
    residual = phase - (slope * f + intercept)
    spread = np.sum((f - f.mean()) ** 2)
    std = np.sqrt(np.sum(residual**2) / max(f.size - 2, 1) / spread) / (2 * np.pi)
    return coarse - slope / (2 * np.pi), intercept, residual, std
