# SPDX-License-Identifier: Apache-2.0
"""Whether the local polynomials behind an FRF followed the transient of the mode that was found in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import special

from tactile_resonance._typing import FloatArray
from tactile_resonance.frf.result import FRF
from tactile_resonance.poles.modes import in_any_direction
from tactile_resonance.poles.result import Poles, PolesStatus

# Half the width of a mode, in bins, from which a polynomial of order 2 follows its transient at 40 dB.
FEWEST_BINS = 16
# A record without a transient is suspected once in ten thousand times.
FALSE_ALARM = 1e-4
FEWEST_NEAR = 3
# Deviation in bins of a mode narrower than one, beside what the variance shows: a transient that is left
# changes its shape, by .28 bins of half width at most.
UNRESOLVED = 0.25


def with_transient_judged(frf: FRF, poles: Poles) -> Poles:
    """The poles; status MODEL_ERROR where a transient is left in the FRF they are from.

    Parameters
    ----------
    frf : FRF
        With (F,) arrays.
    poles : Poles
        Of it.

    Notes
    -----
    What a polynomial leaves of a transient ``c / (s - p)`` on the bins between harmonics counts as
    noise of the output, and is largest beside the mode. So the variance of the output given the input
    (``C_YY - |C_YU|^2 / C_UU``, which noise of the generator does not enter) of the lines within half
    the mode's width, three at least and a quarter of the band at most, is compared with that of the
    farther half of the band by an F-test. It needs `FRF.sensor_variance_given_actuator`, hence one
    realisation; without, half widths below `FEWEST_BINS` are mentioned.

    Monte Carlo, 30 records a cell of a mode at 250 Hz in 200-300 Hz, lines 2.5 Hz apart, order 2, 2 to 8
    periods, damping ratio .005 to .1, 20 to 80 dB: from rest, mean square errors of f0 over the
    Cramer-Rao bound were

    ========  ==========  =======  =======  =======  =======
    periods   half width  20 dB    40 dB    60 dB    80 dB
    ========  ==========  =======  =======  =======  =======
    2         1 bin       2e2      1e4      3e5      9e6
    2         4 bins      9        3e2      2e3      8e3
    2         10 bins     1.6      11       65       2e2
    2         20 bins     1.2      1.2      6        11
    4         8 bins      1.0      4.5      36       5e2
    8         4 bins      2.6      44       2e2      1e3
    8         16 bins     1.0      1.0      3.3      22
    ========  ==========  =======  =======  =======  =======

    The stated ellipses held the truth in 97 % or more, for what is left raises the variance too: such
    poles are not wrong, but of next to no precision. Of half widths below a bin that is so with
    `UNRESOLVED`; without, damping ratios were off by up to 16 deviations. In steady state the ratio was
    .5 to 2 throughout. The test found every cell with a ratio above 3, and none in steady state.
    """
    if "local polynomial" not in frf.method or frf.periods < 2 or poles.f0_hz.size == 0:
        return poles
    left = max(_beside(frf, poles, k) for k in range(poles.f0_hz.size))
    if left > 0:
        note = (
            f"beside the mode the output's variance is {left:.3g} times that of the other lines: the "
            "local polynomials do not follow its transient, and the poles have little precision; use "
            "the joint method, more periods, or drop the first"
        )
        judged = poles.status in (PolesStatus.OK, PolesStatus.NO_COVARIANCE)
        total = poles.covariance if poles.total_covariance is None else poles.total_covariance
        if total is not None:
            std = np.where(_half_width(frf, poles) < 1, UNRESOLVED * 2 * np.pi * _bin_hz(frf), 0.0)
            total = total + in_any_direction(std, poles.poles_rad_s)
        poles = replace(
            poles,
            status=PolesStatus.MODEL_ERROR if judged else poles.status,
            total_covariance=total,
        )
    else:
        note = _light_damping(frf, poles)
    return poles.noting(note)


def _beside(frf: FRF, poles: Poles, mode: int) -> float:
    """How much larger the variance beside a mode is than elsewhere; 0 where chance may make it."""
    band = frf.band(*poles.band_hz)
    variance = band.sensor_variance_given_actuator
    if variance is None or band.noise_dof < 2:
        return 0.0
    distance = np.abs(band.frequency_hz - poles.f0_hz[mode])
    order = np.argsort(distance)
    half_width = abs(poles.damping_ratio[mode]) * poles.f0_hz[mode]
    near = int(np.clip(np.sum(distance <= half_width), FEWEST_NEAR, max(order.size // 4, 1)))
    far = order[order.size // 2 :]
    # neighbouring lines share the bins between them
    dof = min(band.noise_dof - 1, (band.periods - 1) * band.realisations)
    mean = float(variance[far].mean()) if far.size else 0.0
    if not mean > 0:
        return 0.0
    ratio = float(variance[order[:near]].mean()) / mean
    alarm = FALSE_ALARM / poles.f0_hz.size
    return ratio if ratio > special.fdtri(2 * near * dof, 2 * far.size * dof, 1 - alarm) else 0.0


def _light_damping(frf: FRF, poles: Poles) -> str:
    """Where the transient of a mode is too narrow for the local polynomials that removed it."""
    if frf.frequency_hz.size < 2:
        return ""
    half_width = _half_width(frf, poles)
    if not np.any(half_width < FEWEST_BINS):
        return ""
    return (
        f"half the width of the mode is {half_width.min():.1f} bins, less than {FEWEST_BINS}: "
        "unless the record began settled, what the local polynomial method leaves of the transient "
        "biases the poles"
    )


def _half_width(frf: FRF, poles: Poles) -> FloatArray:
    """(n,) of the modes, in bins of the record."""
    return np.asarray(np.abs(poles.damping_ratio) * poles.f0_hz / _bin_hz(frf))


def _bin_hz(frf: FRF) -> float:
    """One over the duration of the record."""
    return float(np.diff(frf.frequency_hz).min()) / frf.periods
