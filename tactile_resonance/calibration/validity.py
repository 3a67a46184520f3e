# SPDX-License-Identifier: Apache-2.0
"""Whether a calibrated sensor is still as it was, from its poles in air.

Warmer or colder, all modes of a beam move by one common relative factor, for its modulus and length change as a
whole. A crack, a clamp that loosens, glue or dirt at the tip move each mode differently, or their damping.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from scipy import special

from tactile_resonance._typing import FloatArray
from tactile_resonance.calibration.model import AIR, Calibration
from tactile_resonance.fields import require
from tactile_resonance.poles.result import natural_frequency_and_damping

SIGNIFICANT = 1e-4
"""Probability of a deviation by chance below which it counts."""
LEAST_SHIFT, LEAST_DAMPING = 2e-4, 5e-5
"""Relative shift of a frequency, and change of a damping ratio, below which none counts however significant."""
MOST_SHIFT = 0.01
"""Relative shift that a temperature may cause: of a PZT bimorph some 50 K."""


class SensorState(str, Enum):
    """What became of a calibrated sensor."""

    AS_CALIBRATED = "as calibrated"
    TEMPERATURE = "all modes shifted alike: temperature"
    SHIFTED = "one mode shifted: temperature or damage, one mode does not tell"
    CHANGED = "changed"
    UNKNOWN = "unknown"


@dataclass(frozen=True, eq=False)
class Validity:
    """A sensor against its calibration.

    Attributes
    ----------
    state : SensorState
    shift, shift_std : float
        Common relative shift of the frequencies in air; NaN where unknown.
    message : str
        With the figures of each mode that was measured.
    """

    state: SensorState
    shift: float
    shift_std: float
    message: str

    @property
    def usable(self) -> bool:
        """Whether the calibration may be used, where the shift is taken along."""
        return self.state in (SensorState.AS_CALIBRATED, SensorState.TEMPERATURE)


def poles_in_air(calibration: Calibration) -> tuple[FloatArray, FloatArray]:
    """(n, 2) f0 [Hz] and damping ratio of all modes in air, and their covariance (n, 2, 2)."""
    stack, correlation = calibration.one_moved_each()
    poles, own = stack.poles(AIR), calibration.model.poles(AIR)  # (free, N), (N,)
    own = own[own.imag > 0]
    own = own[np.argsort(np.abs(own))]
    near = np.argmin(np.abs(poles[:, None, :] - own[:, None]), axis=-1)
    moved = np.take_along_axis(poles[:, None, :], near[..., None], axis=-1)[..., 0]  # (free, n)
    values, of_moved = (
        np.stack(natural_frequency_and_damping(each), axis=-1) for each in (own, moved)
    )
    slope = of_moved - values  # (free, n, 2), per deviation
    return values, np.einsum("ina,ij,jnb->nab", slope, correlation, slope)


def check_in_air(
    calibration: Calibration,
    estimates: Sequence[FloatArray],
    covariances: Sequence[FloatArray],
) -> Validity:
    """Compare measured poles in air with those of the calibration.

    Parameters
    ----------
    calibration : Calibration
    estimates : sequence of (2,) float
        f0 [Hz] and damping ratio of one mode or more.
    covariances : sequence of (2, 2) float
        NaN where unknown.
    """
    expected, own = poles_in_air(calibration)
    measured = np.asarray(estimates, float).reshape(-1, 2)
    noise = np.asarray(covariances, float).reshape(-1, 2, 2)
    known = np.isfinite(measured).all(axis=1) & np.isfinite(noise).all(axis=(1, 2))
    if not known.any():
        text = "no poles in air with a covariance"
        return Validity(SensorState.UNKNOWN, np.nan, np.nan, text)
    measured, noise = measured[known], noise[known]
    mode = np.argmin(np.abs(np.log(measured[:, :1] / expected[:, 0])), axis=1)
    at, covariance = expected[mode], own[mode] + noise
    shifts = measured[:, 0] / at[:, 0] - 1
    shift_var = covariance[:, 0, 0] / at[:, 0] ** 2 + (LEAST_SHIFT / 4) ** 2
    changes = measured[:, 1] - at[:, 1]
    damping_var = covariance[:, 1, 1] + (LEAST_DAMPING / 4) ** 2
    weight = 1 / shift_var
    shift, shift_std = float(weight @ shifts / weight.sum()), float(weight.sum() ** -0.5)
    apart = float(np.sum((shifts - shift) ** 2 * weight))
    damped = changes**2 / damping_var  # (k,)
    unlike = mode.size > 1 and special.chdtrc(mode.size - 1, apart) < SIGNIFICANT
    # materials damp a little more when warm: only what is large counts as damage
    large = np.abs(changes) > np.maximum(LEAST_DAMPING, 0.1 * at[:, 1])
    damaged = bool(np.any(large & (special.chdtrc(1, damped) < SIGNIFICANT / mode.size)))
    moved = special.chdtrc(1, (shift / shift_std) ** 2) < SIGNIFICANT and abs(shift) > LEAST_SHIFT
    figures = "; ".join(
        f"mode {k + 1} at {f:.2f} Hz: {1e2 * s:+.3f} %, damping {c:+.2g}"
        for k, f, s, c in zip(mode, at[:, 0], shifts, changes, strict=True)
    )
    blind = special.chdtrc(1, (MOST_SHIFT / shift_std) ** 2) >= SIGNIFICANT
    if unlike or damaged or (moved and abs(shift) > MOST_SHIFT):
        state = SensorState.CHANGED
    elif blind:  # not even a shift that means damage would show
        text = f"poles in air too uncertain: frequencies to {1e2 * shift_std:.2g} % ({figures})"
        return Validity(SensorState.UNKNOWN, shift, shift_std, text)
    elif moved:
        # where the others may as well have stayed, it may be the one that moved most
        each = weight * shifts**2
        others = special.chdtrc(max(1, mode.size - 1), each.sum() - each.max())
        alike = mode.size > 1 and others < SIGNIFICANT
        state = SensorState.TEMPERATURE if alike else SensorState.SHIFTED
        if mode.size > 1 and not alike:
            figures += "; whether the others shifted alike is too uncertain"
    else:
        state = SensorState.AS_CALIBRATED
    return Validity(state, shift, shift_std, f"{state.value} ({figures})")


def as_of_today(calibration: Calibration, found: Validity) -> Calibration:
    """The calibration with the shift taken along where there is one.

    That of one mode, which may be damage, makes all frequencies uncertain by as much as it is.

    Raises
    ------
    ValueError
        If the sensor changed otherwise.
    """
    accepted = "a sensor as calibrated, or warmer: calibrate it again"
    require(found.state is not SensorState.CHANGED, "calibration", found.message, accepted)
    if found.state is SensorState.TEMPERATURE:
        return at_shift(calibration, found.shift, found.shift_std)
    if found.state is SensorState.SHIFTED:
        return at_shift(calibration, found.shift, abs(found.shift))
    return calibration


def at_shift(calibration: Calibration, shift: float, shift_std: float) -> Calibration:
    """The calibration of a sensor all of whose modes moved by a relative shift, uncertain to a deviation.

    A modulus that changes by twice the shift changes the piezoelectric coupling as well, by about as much and
    in a direction that is not known: a common factor of the couplings is that uncertain.
    """
    model, n = calibration.model, calibration.model.modes
    moved = replace(model, natural_rad_s=model.natural_rad_s * (1 + shift))
    covariance = calibration.covariance.copy()
    covariance[:n, :n] += shift_std**2 * np.outer(model.natural_rad_s, model.natural_rad_s)
    coupled = slice(2 * n, 3 * n)
    covariance[coupled, coupled] += (2 * shift) ** 2 * np.outer(
        model.coupling_rad_s, model.coupling_rad_s
    )
    return replace(calibration, model=moved, covariance=covariance)
