# SPDX-License-Identifier: Apache-2.0
"""From an FRF, or spectra, with covariance to poles with covariance."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import special

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.fields import band, number, require, require_kind
from tactile_resonance.frf.result import FRF, FrfStatus
from tactile_resonance.poles.judgement import Judged, assemble
from tactile_resonance.poles.lacking import FEWEST_OF_A_LINE, Lack
from tactile_resonance.poles.lines import (
    LinesPlan,
    WeightedLines,
    lines_of_frf,
    lines_of_spectra,
)
from tactile_resonance.poles.noise_level import (
    KINDS,
    MODEL_ERROR_PROBABILITY,
    ROUNDED,
    not_counted,
    student_variance,
)
from tactile_resonance.poles.result import Poles, PolesBatch, PolesStatus, single
from tactile_resonance.poles.significance import are_smooth, in_any_direction, systematic_of
from tactile_resonance.poles.structure import ModelStructure, checked_structure
from tactile_resonance.poles.tones import poles_of_lines_without_tones

# Of a covariance that is Hermitian and positive semidefinite but for rounding to single precision.
ROUNDING = 1e-5
# Half the width of a mode, in bins, from which a polynomial of order 2 follows its transient at 40 dB.
FEWEST_BINS = 16
# A record without a transient is suspected once in ten thousand times.
TRANSIENT_FALSE_ALARM = 1e-4
FEWEST_NEAR = 3
# Deviation in bins of a mode of less than so many, beside what the variance shows: a transient that is left
# changes its shape, by .28 bins of half width at most.
NARROW, UNRESOLVED = 2.0, 0.25


def identify_frf(
    frf: FRF, band_hz: tuple[float, float] | None = None, structure: ModelStructure | None = None
) -> Poles:
    """Poles of a rational model fitted to the lines of a band.

    Parameters
    ----------
    frf : FRF
        With (F,) arrays. Lines whose response or variance is not finite, or that hold a tone, are left
        out, and said so.
    band_hz : (low, high), optional
        All lines when absent.
    structure : ModelStructure, optional
        One mode and six residual terms when absent.

    Returns
    -------
    Poles
        Always; the status says what it is worth, also where the FRF still holds a transient, see
        `with_transient_judged`.

    Notes
    -----
    Lines are weighted with the largest variance known (total, else noise), pooled over the band
    where a test allows it. Where both are known, ``covariance`` propagates the noise through these
    weights and ``total_covariance`` the total; where only realisations are at hand, noise cannot be
    distinguished from distortion and both fields hold both. Where the cost exceeds what the variance
    explains, ``total_covariance`` holds the model error too; see `significance.model_error_factor`.
    """
    if np.ndim(frf.g) != 1:
        raise ValueError(
            f"frf.g: shape {np.shape(frf.g)}, expected (F,); identify_batch takes batches"
        )
    frf = _checked_frf(frf)
    selected = frf.band(*_checked_band(frf.frequency_hz, band_hz))
    batch, tones = poles_of_lines_without_tones(
        lambda lines: identify_batch(lines, band_hz, structure), selected
    )
    notes = [tone.text("left out") for tone in tones]
    left_out = selected.g.size - int(batch.lines) - len(tones)
    if left_out:
        notes.append(f"{left_out} lines without a finite response, or a variance above 0, left out")
    if frf.status is not FrfStatus.OK or frf.variance_noise is None:
        notes.append(frf.message)
    return with_transient_judged(frf, single(batch, notes=notes))


@np.errstate(all="ignore")  # what exceeds double precision shows in the status
def identify_batch(
    frf: FRF,
    band_hz: tuple[float, float] | None = None,
    structure: ModelStructure | None = None,
) -> PolesBatch:
    """As `identify_frf` for FRFs of many points on the same lines.

    Parameters
    ----------
    frf : FRF
        With (..., F) arrays; a variance (F,) is that of all points. Lines whose variance is not
        above 0 are left out; a point without any variance above 0 is fitted as one without
        variance.

    Returns
    -------
    PolesBatch
        With the leading axes of `frf`.

    Raises
    ------
    ValueError
        If shapes, lines or band are none: names the field, its value, and what is accepted.

    Examples
    --------
    Two points on the same lines, with the variance of their errors, means over eight periods:

    >>> import numpy as np
    >>> frequency_hz = np.arange(200.0, 300.1, 2.5)
    >>> s, w0 = 2j * np.pi * frequency_hz, 2 * np.pi * np.array([[250.0], [251.0]])
    >>> g = 0.04 * w0**2 / (s**2 + 0.04 * w0 * s + w0**2)
    >>> noise = np.random.default_rng(0).standard_normal((2, *g.shape))
    >>> g = g + 1e-3 * (noise[0] + 1j * noise[1]) / np.sqrt(2)
    >>> frf = tr.FRF(frequency_hz, g, variance_noise=np.full(g.shape, 1e-6), noise_dof=7)
    >>> batch = tr.identify_batch(frf)
    >>> batch.f0_hz.round(2).tolist()
    [[250.0], [251.0]]
    """
    structure = checked_structure(structure)
    frf = _checked_frf(frf)
    band_hz = _checked_band(frf.frequency_hz, band_hz)
    selected = frf.band(*band_hz)
    return _identify(
        selected.frequency_hz,
        lines_of_frf(selected),
        structure,
        band_hz,
        frf.g.shape[:-1],
        "weighted least squares",
    )


@np.errstate(all="ignore")
def identify_spectra(
    frequency_hz: FloatArray,
    spectra: ComplexArray,
    covariance: ComplexArray,
    dof: int,
    band_hz: tuple[float, float] | None = None,
    structure: ModelStructure | None = None,
    *,
    pooled: bool = True,
) -> PolesBatch:
    """Poles from input and output spectra with their noise covariance: errors in variables.

    Parameters
    ----------
    frequency_hz : (F,) float
    spectra : (..., 2, F) complex
        Mean spectra, row order [Y; U].
    covariance : (..., 2, 2, F) complex
        Noise covariance of these means.
    dof : int
        Complex degrees of freedom of the covariance; 0 where it is exact.
    band_hz, structure
        As for `identify_frf`.
    pooled : bool
        Take both variances, and the correlation, from the whole band where a test finds each flat
        or sloped. A line on which one channel has no variance, where others have one, is left out.

    Returns
    -------
    PolesBatch

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted.

    References
    ----------
    Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
    section 12.3: sample maximum likelihood.

    Examples
    --------
    Noise of the same size on both spectra, whose level is known exactly:

    >>> import numpy as np
    >>> frequency_hz = np.arange(200.0, 300.1, 2.5)
    >>> s, w0 = 2j * np.pi * frequency_hz, 2 * np.pi * 250
    >>> g = 0.04 * w0**2 / (s**2 + 0.04 * w0 * s + w0**2)
    >>> spectra = np.stack([g, np.ones_like(g)])  # rows Y and U
    >>> noise = np.random.default_rng(0).standard_normal((2, *spectra.shape))
    >>> spectra = spectra + 1e-3 * (noise[0] + 1j * noise[1]) / np.sqrt(2)
    >>> covariance = np.zeros((2, 2, s.size))
    >>> covariance[0, 0] = covariance[1, 1] = 1e-6
    >>> batch = tr.identify_spectra(frequency_hz, spectra, covariance, 0, (200.0, 300.0))
    >>> print(f"{batch.f0_hz[0]:.2f} Hz", batch.covariance.shape)
    250.00 Hz (1, 2, 2)
    """
    structure = checked_structure(structure)
    frequency_hz, spectra, covariance = _checked_spectra(frequency_hz, spectra, covariance, dof)
    band_hz = _checked_band(frequency_hz, band_hz)
    inside = (frequency_hz >= band_hz[0]) & (frequency_hz <= band_hz[1])
    return _identify(
        frequency_hz[inside],
        lines_of_spectra(spectra[..., inside], covariance[..., inside], dof, pooled),
        structure,
        band_hz,
        spectra.shape[:-2],
        "sample maximum likelihood, errors in variables",
    )


def _identify(
    frequency_hz: FloatArray,
    lines: WeightedLines,
    structure: ModelStructure,
    band_hz: tuple[float, float],
    shape: tuple[int, ...],
    method: str,
) -> PolesBatch:
    data, used = lines.data, lines.known.lines
    if frequency_hz.size < structure.fewest_lines or used.size == 0:
        # bases need points: any will do, nothing is fitted
        places = max(structure.order, structure.numerator_order) + 1
        plan = LinesPlan.on_lines(np.linspace(1.0, 2.0, places), structure, band_hz)
        judged = Judged.of(plan, np.minimum(used, structure.fewest_lines - 1))
    else:
        plan, judged = _judged(LinesPlan.on_lines(frequency_hz, structure, band_hz), lines, used)
    return assemble(
        plan, judged, shape, method, lambda less, rows: less.fit(data.rows(rows))[1].cost
    )


def _judged(
    plan: LinesPlan, lines: WeightedLines, used: IntArray
) -> tuple[LinesPlan, Judged]:
    """What fits to lines are worth, of which so many are used (batch,), and the plan of the coefficients."""
    parameters, known, level_known = plan.structure.parameters, lines.known, lines.level_known
    of_fit, fit = plan.fit(lines.data)
    residual = fit.residual[:, 0]
    plain = 0.5 * fit.marginal[:, 0]  # where the variance of each line is the one weighted with
    cost, expected = fit.cost, known.expected_cost(parameters)
    chance = known.chance(cost, parameters)
    suspect = level_known & (chance < MODEL_ERROR_PROBABILITY)
    wider = known.information_correction * lines.noise_at_modes(of_fit, fit)
    wider = wider * not_counted(np.where(suspect, np.nan, chance), cost / expected)
    covariance = plain * wider[:, None, None]
    total = covariance if lines.total_known else None
    if lines.noise is not None:
        covariance = of_fit.propagated(fit, lines.data, lines.noise)
    suspect |= are_smooth(residual, parameters)
    asked = fit.converged & (suspect | (used.size == 1)) & (not plan.structure.delay)
    asked &= (known.kind < 2) | (known.dof >= FEWEST_OF_A_LINE)
    lack = Lack.of(of_fit, lines.data, fit, asked, np.where(level_known, 1.0, 0.0))
    suspect |= np.isfinite(lack.found[:, 0])
    kind = known.kind
    if not level_known.all():
        # the residuals are all there is: they hold noise, distortion and model error together
        dof = np.maximum(used - parameters / 2, 0.5)
        level = fit.cost / dof
        known_here, unknown = level_known[:, None, None], np.full_like(covariance, np.nan)
        covariance = np.where(known_here, covariance, unknown)
        from_residuals = plain * (level * student_variance(dof))[:, None, None]
        total = np.where(known_here, unknown if total is None else total, from_residuals)
        # what rounding leaves of exact data says nothing
        noisy = level_known | (level > ROUNDED)
        suspect, lack = suspect & noisy, lack.only_where(noisy)
        cost, expected = (np.where(level_known, x, np.nan) for x in (cost, expected))
        kind = np.where(level_known, kind, len(KINDS))
    lack = lack.only_where(~suspect)
    judged = Judged.of(
        plan,
        used,
        theta=fit.theta[:, 0],
        condition_number=fit.condition,
        converged=fit.converged,
        residual=residual,
        cost=cost,
        expected_cost=expected,
        suspect=suspect,
        covariance=covariance,
        total=total,
        kind=kind,
        level_known=level_known,
        systematic=systematic_of(plan, lines.data, fit.theta, suspect, of_fit),
        lacking=np.where(suspect[:, None], lack.found, np.nan),
        doubt=lack.doubt,
        remark=lack.remarks,
    )
    return of_fit, judged


def with_transient_judged(frf: FRF, poles: Poles) -> Poles:
    """The poles; status MODEL_ERROR where a transient is left in the FRF they are from, or it has that status.

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
    farther half of the band by an F-test. It needs `FRF.sensor_variance_given_actuator`, hence two
    periods; of one period, realisations show a transient by what they differ by (status MODEL_ERROR of the
    FRF, see `frf.estimate`). Where none is detected half widths below `FEWEST_BINS` are mentioned.

    Monte Carlo, 30 records a cell of a mode at 250 Hz in 200-300 Hz, lines 2.5 Hz apart, order 2, 2 to 8
    periods, damping ratio .005 to .1, 20 to 80 dB: from rest, mean square errors of f0 over the Cramer-Rao
    bound grow from 1.2 (20 and 40 dB) and 11 (80 dB) at half widths of 20 bins to 2e2, 1e4 and 9e6 at one
    bin (two periods; with eight 1.0, 1.0 and 22 at 16 bins). The stated ellipses held the truth in 97 % or
    more, for what is left raises the variance too: such poles are not wrong, but of next to no precision.
    Of half widths below a bin that is so with `UNRESOLVED`; without, damping ratios were off by up to 16
    deviations. In steady state the ratio was .5 to 2 throughout. The test found every cell with a ratio
    above 3, and none in steady state.
    """
    if frf.status is FrfStatus.MODEL_ERROR:
        return _doubted(frf, poles)
    if "local polynomial" not in frf.method or frf.periods < 2 or poles.f0_hz.size == 0:
        return poles
    left = max(_beside(frf, poles, k) for k in range(poles.f0_hz.size))
    half_width, note = _half_width(frf, poles), ""
    if left > 0:
        note = (
            f"beside the mode the output's variance is {left:.3g} times that of the other lines: the "
            "local polynomials do not follow its transient, and the poles have little precision; use "
            "the joint method, more periods, or drop the first"
        )
        poles = _doubted(frf, poles)
    elif np.any(half_width < FEWEST_BINS):
        note = (
            f"half the width of the mode is {half_width.min():.1f} bins, less than {FEWEST_BINS}: "
            "unless the record began settled, what the local polynomial method leaves of the transient "
            "biases the poles"
        )
    return poles.noting(note)


def _doubted(frf: FRF, poles: Poles) -> Poles:
    """With status MODEL_ERROR unless it is worse, and what a narrow mode is off by in the total covariance."""
    judged = poles.status in (PolesStatus.OK, PolesStatus.NO_COVARIANCE)
    total = poles.covariance if poles.total_covariance is None else poles.total_covariance
    if total is not None:
        std = np.where(_half_width(frf, poles) < NARROW, UNRESOLVED * 2 * np.pi * _bin_hz(frf), 0.0)
        total = total + in_any_direction(std, poles.poles_rad_s)
    return replace(
        poles,
        status=PolesStatus.MODEL_ERROR if judged else poles.status,
        total_covariance=total,
    )


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
    alarm = TRANSIENT_FALSE_ALARM / poles.f0_hz.size
    return ratio if ratio > special.fdtri(2 * near * dof, 2 * far.size * dof, 1 - alarm) else 0.0


def _half_width(frf: FRF, poles: Poles) -> FloatArray:
    """(n,) of the modes, in bins of the record."""
    return np.asarray(np.abs(poles.damping_ratio) * poles.f0_hz / _bin_hz(frf))


def _bin_hz(frf: FRF) -> float:
    """One over the duration of the record."""
    return float(np.diff(frf.frequency_hz).min()) / frf.periods


def _checked_frf(frf: FRF) -> FRF:
    """The FRF with arrays of double precision, its variances in the shape of its response."""
    require_kind(frf, "frf", FRF)
    g = _numbers(frf.g, "frf.g", complex)
    frequency_hz = _checked_lines(frf.frequency_hz, "frf.frequency_hz")
    if g.shape[-1:] != frequency_hz.shape:
        raise ValueError(
            f"frf.g: shape {g.shape}, expected (..., {frequency_hz.size}), one for each line"
        )
    variances: dict[str, Any] = {}
    for name, dof_name in (("variance_noise", "noise_dof"), ("variance_total", "total_dof")):
        variance = variances[name] = getattr(frf, name)
        if variance is None:
            continue
        values = _numbers(variance, f"frf.{name}", float)
        if np.any(values < 0) and not np.any(values > 0):  # single lines are left out
            raise ValueError(f"frf.{name}: {np.nanmin(values):g}, expected variances above 0")
        try:
            variances[name] = np.broadcast_to(values, g.shape)
        except ValueError:
            raise ValueError(
                f"frf.{name}: shape {values.shape}, expected that of g, {g.shape}"
            ) from None
        _check_dof(getattr(frf, dof_name), f"frf.{dof_name}")
    return replace(frf, frequency_hz=frequency_hz, g=g, **variances)


def _checked_spectra(
    frequency_hz: npt.ArrayLike, spectra: npt.ArrayLike, covariance: npt.ArrayLike, dof: int
) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """Lines (F,), spectra (..., 2, F) and covariance (..., 2, 2, F) of double precision."""
    lines_hz = _checked_lines(frequency_hz, "frequency_hz")
    z, c = _numbers(spectra, "spectra", complex), _numbers(covariance, "covariance", complex)
    lines = lines_hz.size
    if z.shape[-2:] != (2, lines) or c.shape[-3:] != (2, 2, lines):
        raise ValueError(
            f"spectra, covariance: shapes {z.shape}, {c.shape}, "
            f"expected (..., 2, {lines}) and (..., 2, 2, {lines}), one for each line"
        )
    _check_dof(dof, "dof")
    y, u, yu, uy = (c[..., i, j, :] for i, j in ((0, 0), (1, 1), (0, 1), (1, 0)))
    with np.errstate(over="ignore", invalid="ignore"):
        product = np.sqrt(np.abs(y.real)) * np.sqrt(np.abs(u.real))
        real = np.abs(y.imag) <= ROUNDING * np.abs(y)
        real &= np.abs(u.imag) <= ROUNDING * np.abs(u)
        alike = np.abs(yu - uy.conj()) <= ROUNDING * product
        definite = (y.real >= 0) & (u.real >= 0) & (np.abs(yu) <= (1 + ROUNDING) * product)
    # lines of NaN are left out later
    wrong = np.isfinite(c).all(axis=(-3, -2)) & ~(real & alike & definite)
    if wrong.any():
        *_, line = np.argwhere(wrong)[0]
        matrix = c[tuple(np.argwhere(wrong)[0][:-1])][..., line].tolist()
        raise ValueError(
            f"covariance: {matrix} at {lines_hz[line]:g} Hz, expected a Hermitian matrix, "
            "[[E|dY|^2, E dY conj(dU)], [E dU conj(dY), E|dU|^2]], without negative variances"
        )
    try:
        c = np.broadcast_to(c, (*z.shape[:-2], 2, 2, lines))
    except ValueError:
        raise ValueError(
            f"covariance: shape {c.shape}, expected {(*z.shape[:-2], 2, 2, lines)} as spectra"
        ) from None
    return lines_hz, z, c


def _checked_lines(frequency_hz: npt.ArrayLike, name: str) -> FloatArray:
    """(F,) float, ascending from 0 or above; ``ValueError`` naming the first line that is not."""
    lines_hz = _numbers(frequency_hz, name, float)
    if lines_hz.ndim != 1:
        raise ValueError(f"{name}: shape {lines_hz.shape}, expected (F,)")
    good = np.isfinite(lines_hz) & (lines_hz >= 0)
    good[1:] &= lines_hz[1:] > lines_hz[:-1]
    if not good.all():
        k = int(np.argmin(good))
        before = f" after {lines_hz[k - 1]:g}" if k else ""
        raise ValueError(f"{name}: {lines_hz[k]:g} Hz{before}, expected 0 or above, ascending")
    return lines_hz


def _checked_band(
    frequency_hz: FloatArray, band_hz: tuple[float, float] | None
) -> tuple[float, float]:
    """(low, high): all lines where nothing is asked for."""
    if band_hz is None:
        lines_hz = frequency_hz if frequency_hz.size else np.full(1, np.nan)
        return float(lines_hz[0]), float(lines_hz[-1])
    return band(band_hz)


def _numbers(values: npt.ArrayLike, name: str, kind: type) -> npt.NDArray:
    """Array of a kind; ``ValueError`` naming the field where the values are no array of numbers."""
    real = kind is float
    try:
        array = np.asarray(values)
        require(not real or array.dtype.kind in "biuf", name, array.dtype, "an array of real numbers")
        return np.asarray(array, kind)
    except (TypeError, ValueError):
        require(False, name, values, f"an array of {'real ' if real else ''}numbers")
        raise


def _check_dof(dof: float, name: str) -> None:
    require(number(dof, name) >= 0, name, dof, "a number of degrees of freedom, 0 or above")
