# SPDX-License-Identifier: Apache-2.0
"""From an FRF, or spectra, with covariance to poles with covariance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tactile_resonance.frf.result import FRF, FrfStatus
from tactile_resonance.identification.bins import BinData
from tactile_resonance.identification.covariance import modes_in_band
from tactile_resonance.identification.inputs import checked_band, checked_frf, checked_spectra
from tactile_resonance.identification.judgement import Evidence, assemble
from tactile_resonance.identification.lines_compiled import fit_compiled
from tactile_resonance.identification.lines_fit import LinesFit, LinesPlan
from tactile_resonance.identification.model_error import (
    MODEL_ERROR_PROBABILITY,
    difference_of_halves,
    difference_of_models,
    richer,
)
from tactile_resonance.identification.noise_level import KINDS, VarianceModel, model_variance
from tactile_resonance.identification.result import (
    ComplexArray,
    FloatArray,
    Poles,
    PolesBatch,
)
from tactile_resonance.identification.single_point import single
from tactile_resonance.identification.structure import ModelStructure
from tactile_resonance.identification.whiteness import are_smooth

# Half the width of a mode, in bins, from which a polynomial of order 2 follows its transient at 40 dB.
FEWEST_BINS = 16
# Degrees of freedom that stand for a covariance known exactly.
EXACT = 10**6
# Of the input's noise seen at the output.
LEAST_OUTPUT_NOISE = 1e-12
# Mean square of the residuals over that of the data, below which they are rounding.
ROUNDED = 1e-22


def identify_poles(
    frf: FRF, band_hz: tuple[float, float] | None = None, structure: ModelStructure | None = None
) -> Poles:
    """Poles of a rational model fitted to the lines of a band.

    Parameters
    ----------
    frf : FRF
        With (F,) arrays. Lines whose response or variance is not finite are left out, and said so.
    band_hz : (low, high), optional
        All lines when absent.
    structure : ModelStructure, optional
        One mode and six residual terms when absent.

    Returns
    -------
    Poles
        Always; the status says what it is worth.

    Notes
    -----
    Lines are weighted with the largest variance known (total, else noise), pooled over the band
    where a test allows it. Where both are known, ``covariance`` propagates the noise through these
    weights and ``total_covariance`` the total; where only realisations are at hand, noise cannot be
    told from distortion and both fields hold both. Where the cost exceeds what the variance
    explains, ``total_covariance`` holds the model error too; see `model_error.model_error_factor`.
    """
    if np.ndim(frf.g) != 1:
        raise ValueError(
            f"frf.g: shape {np.shape(frf.g)}, expected (F,); identify_batch takes batches"
        )
    frf = checked_frf(frf)
    batch = identify_batch(frf, band_hz, structure)
    notes = []
    left_out = frf.band(*batch.band_hz).g.size - int(batch.lines)
    if left_out:
        notes.append(f"{left_out} lines without a finite response, or a variance above 0, left out")
    if frf.status is not FrfStatus.OK or frf.variance_noise is None:
        notes.append(frf.message)
    poles = single(batch, notes=notes)
    message = "; ".join(filter(None, [poles.message, _light_damping(frf, poles)]))
    return replace(poles, message=message)


def _light_damping(frf: FRF, poles: Poles) -> str:
    """Where the transient of a mode is too narrow for the local polynomials that removed it."""
    if "local polynomial" not in frf.method or frf.periods < 2 or frf.frequency_hz.size < 2:
        return ""
    bin_hz = float(np.diff(frf.frequency_hz).min()) / frf.periods
    half_width = np.abs(poles.damping_ratio) * poles.f0_hz / bin_hz
    if not np.any(half_width < FEWEST_BINS):
        return ""
    return (
        f"half the width of the mode is {half_width.min():.1f} bins, less than {FEWEST_BINS}: "
        "unless the record began settled, what the local polynomial method leaves of the transient "
        "biases the poles"
    )


@np.errstate(all="ignore")  # what exceeds double precision shows in the status
def identify_batch(
    frf: FRF,
    band_hz: tuple[float, float] | None = None,
    structure: ModelStructure | None = None,
    *,
    compiled: bool = False,
) -> PolesBatch:
    """As `identify_poles` for FRFs of many points on the same lines.

    Parameters
    ----------
    frf : FRF
        With (..., F) arrays; a variance (F,) is that of all points. Lines whose variance is not
        above 0 are left out; a point without any variance above 0 is fitted as one without
        variance.
    compiled : bool
        One mode through numba (extra ``compiled``): the same answers in less time.

    Returns
    -------
    PolesBatch
        With the leading axes of `frf`.

    Raises
    ------
    ImportError
        If `compiled`, without numba.
    ValueError
        If shapes, lines or band are none: names the field, its value, and what is accepted.
    """
    structure = structure or ModelStructure()
    frf = checked_frf(frf)
    band_hz = checked_band(frf.frequency_hz, band_hz)
    selected = frf.band(*band_hz)
    shape = frf.g.shape[:-1]
    flat_shape = math.prod(shape), selected.frequency_hz.size
    g = selected.g.reshape(flat_shape)
    usable = np.isfinite(g)
    level_known = np.full(flat_shape[0], selected.variance is not None and selected.dof > 0)
    variance = np.ones(flat_shape)
    if selected.variance is not None and selected.dof > 0:
        variance = selected.variance.reshape(flat_shape)
        weighted = usable & (variance > 0) & (variance < np.inf)
        if not weighted.all():
            level_known = np.asarray((usable & (variance > 0)).any(axis=-1))
            variance = np.where(level_known[:, None], variance, 1.0)
            usable = np.where(level_known[:, None], weighted, usable)
    if not usable.all():
        g = np.where(usable, g, 0.0)
        variance = np.where(usable, variance, np.nan)
    known = model_variance(variance, max(selected.dof, 1), g.real**2 + g.imag**2)
    weights = known.variance
    if not level_known.all():
        power = np.where(usable, _power(g, usable), np.inf)
        weights = np.where(level_known[:, None], weights, power)
    if frf.variance_total is None and frf.periods > 1:
        # noise is from bins between lines: neighbours share them where periods are few
        bins = (frf.periods - 1) * frf.realisations
        known = replace(known, independent_dof=min(selected.dof, bins))
    total_known = selected.variance_total is not None
    noise = selected.variance_noise
    return _identify(
        selected.frequency_hz,
        BinData(g, None, weights),
        known,
        usable,
        structure,
        band_hz,
        shape=shape,
        method="weighted least squares",
        level_known=level_known,
        noise=noise.reshape(flat_shape) if noise is not None and total_known else None,
        total_known=total_known,
        compiled=compiled,
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
        As for `identify_poles`.
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
    """
    structure = structure or ModelStructure()
    frequency_hz, spectra, covariance = checked_spectra(frequency_hz, spectra, covariance, dof)
    band_hz = checked_band(frequency_hz, band_hz)
    inside = (frequency_hz >= band_hz[0]) & (frequency_hz <= band_hz[1])
    lines = int(inside.sum())
    shape = spectra.shape[:-2]
    points = math.prod(shape)
    z = spectra[..., inside].reshape(points, 2, lines)
    c = covariance[..., inside].reshape(points, 2, 2, lines)
    usable = np.isfinite(z).all(axis=-2) & np.isfinite(c).all(axis=(-3, -2))
    noise_y, noise_u = (usable & (c[:, k, k].real > 0) for k in (0, 1))
    level_known = np.asarray((noise_y | noise_u).any(axis=-1))
    # lines of one channel without variance, beside others with one, are none of the noise's making
    usable &= noise_y | ~noise_y.any(axis=-1, keepdims=True)
    usable &= noise_u | ~noise_u.any(axis=-1, keepdims=True)
    z = np.where(usable[:, None], z, 0.0)
    c_yy, c_uu = (np.where(usable, c[:, k, k].real, 0.0) for k in (0, 1))
    c_yu = np.where(usable, c[:, 0, 1], 0.0)
    model_y, model_u = (_channel(x, usable, dof, pooled) for x in (c_yy, c_uu))
    known = replace(
        model_y,
        lines=usable.sum(axis=-1),
        dof=dof if dof > 0 else EXACT,
        kind=np.maximum(model_y.kind, model_u.kind),
    )
    together = known.kind[:, None] < 2
    smooth_y, smooth_u = (np.where(usable, m.variance, 0.0) for m in (model_y, model_u))
    both = np.sqrt(smooth_y * smooth_u)
    correlation = (c_yu / _or_one(both)).sum(axis=-1, keepdims=True)
    correlation /= np.maximum(known.lines[:, None], np.abs(correlation))  # 1 at most
    c_yu = np.where(together, correlation * both, c_yu)
    c_yy, c_uu = (np.where(together, *pair) for pair in ((smooth_y, c_yy), (smooth_u, c_uu)))
    power_y, power_u = (_power(x, usable) for x in (z[:, 0], z[:, 1]))
    # all the noise may be in the input, but weights of start values are from the output's
    c_yy = np.maximum(c_yy, LEAST_OUTPUT_NOISE * c_uu * power_y / power_u)
    c_yy = np.where(level_known[:, None], c_yy, power_y)
    return _identify(
        frequency_hz[inside],
        BinData(z[:, 0], z[:, 1], np.where(usable, c_yy, np.inf), c_uu, c_yu),
        known,
        usable,
        structure,
        band_hz,
        shape=shape,
        method="sample maximum likelihood, errors in variables",
        level_known=level_known,
    )


def _channel(
    variance: FloatArray, usable: npt.NDArray[np.bool_], dof: int, pooled: bool
) -> VarianceModel:
    """Of one channel: pooled over the band where a test allows it; exact ones line by line."""
    lines = usable.sum(axis=-1)
    if dof <= 0 or not pooled:
        return VarianceModel(variance, lines, max(dof, 1), np.full(lines.shape, 2))
    model = model_variance(np.where(usable, variance, np.nan), dof)
    # a channel without noise is as flat as any
    noisy = np.asarray((variance > 0).any(axis=-1))[:, None]
    return replace(model, variance=np.where(noisy, model.variance, 0.0))


def _power(values: ComplexArray, usable: npt.NDArray[np.bool_]) -> FloatArray:
    """(batch, 1) mean square of the usable lines; 1 where there is none above 0."""
    power = np.where(usable, values.real**2 + values.imag**2, 0.0).sum(axis=-1, keepdims=True)
    return _or_one(power / np.maximum(usable.sum(axis=-1, keepdims=True), 1))


def _or_one(values: FloatArray) -> FloatArray:
    return np.where(values > 0, values, 1.0)


def _identify(
    frequency_hz: FloatArray,
    data: BinData,
    known: VarianceModel,
    usable: npt.NDArray[np.bool_],
    structure: ModelStructure,
    band_hz: tuple[float, float],
    *,
    shape: tuple[int, ...],
    method: str,
    level_known: npt.NDArray[np.bool_],
    noise: FloatArray | None = None,
    total_known: bool = False,
    compiled: bool = False,
) -> PolesBatch:
    lines = usable.sum(axis=-1)
    batch = lines.size
    parameters = structure.parameters
    enough = lines >= structure.fewest_lines
    if frequency_hz.size < structure.fewest_lines or batch == 0:
        # bases need points: any will do, nothing is fitted
        places = max(structure.order, structure.numerator_order) + 1
        nothing = LinesPlan.on_lines(np.linspace(1.0, 2.0, places), structure)
        return assemble(Evidence.empty(nothing, lines), structure, band_hz, shape, method)
    plan = LinesPlan.on_lines(frequency_hz, structure)
    fit = fit_compiled(plan, data) if compiled else plan.fit(data)
    weighted = fit.covariance * known.information_correction[:, None, None]
    covariance = weighted if noise is None else _propagated(plan, fit, data, noise)
    cost, expected = fit.cost, known.expected_cost(parameters)
    suspect = level_known & (cost > known.cost_quantile(parameters, 1 - MODEL_ERROR_PROBABILITY))
    suspect |= are_smooth(fit.residual, parameters)
    unknown_total = np.full_like(weighted, np.nan)
    total = weighted if total_known else unknown_total
    kind = np.array(KINDS)[known.kind]
    if not level_known.all():
        # the residuals are all there is: they hold noise, distortion and model error together
        level = fit.cost / np.maximum(lines - parameters / 2, 0.5)
        weighted = _where(level_known, weighted, fit.covariance * level[:, None, None])
        covariance = _where(level_known, covariance, unknown_total)
        total = _where(level_known, total, weighted)
        # what rounding leaves of exact data says nothing
        suspect &= level_known | (level > ROUNDED)
        cost, expected = (np.where(level_known, x, np.nan) for x in (cost, expected))
        kind = np.where(level_known, kind, "unknown")
    evidence = Evidence(
        fit, lines, enough, cost, expected, suspect, covariance, total, kind, level_known
    )
    if suspect.any():
        evidence = evidence.with_model_error(weighted)
    result = assemble(evidence, structure, band_hz, shape, method)
    if suspect.any():
        systematic = _systematic(plan, fit, data, usable, np.flatnonzero(suspect), band_hz)
        total = result.total_covariance.reshape((batch, *systematic.shape[1:]))
        total[suspect] += systematic
    return result


def _where(rows: npt.NDArray[np.bool_], those: FloatArray, others: FloatArray) -> FloatArray:
    """(batch, n, n) matrices of some points, and of the others."""
    return np.where(rows[:, None, None], those, others)


@np.errstate(over="ignore", invalid="ignore")
def _systematic(
    plan: LinesPlan,
    fit: LinesFit,
    data: BinData,
    usable: npt.NDArray[np.bool_],
    rows: npt.NDArray[np.int64],
    band_hz: tuple[float, float],
) -> FloatArray:
    """(rows, places, 2, 2) what halves of the lines, and one mode more, make of the poles."""
    poles = []
    part = data.rows(rows)
    for parity in (0, 1):
        left_out = np.arange(usable.shape[1]) % 2 == parity
        half = replace(part, variance_y=np.where(left_out, np.inf, part.variance_y))
        poles.append(modes_in_band(plan.compared(half), band_hz))
    systematic = difference_of_halves(*poles)
    structure = richer(plan.structure)
    if usable[rows].sum(axis=-1).min() > structure.fewest_lines:
        found = LinesPlan.on_lines(plan.frequency_hz, structure).compared(part)
        systematic = systematic + difference_of_models(
            modes_in_band(fit.model.poles_rad_s()[rows], band_hz), modes_in_band(found, band_hz)
        )
    return systematic


def _propagated(plan: LinesPlan, fit: LinesFit, data: BinData, noise: FloatArray) -> FloatArray:
    """Covariance (batch, n, n) from a variance (batch, F) other than the one weighted with."""
    with np.errstate(divide="ignore", invalid="ignore"):
        finite = np.isfinite(data.variance_y)
        changed = BinData(data.y, None, np.where(finite, data.variance_y**2 / noise, np.inf))
    inner = plan.weighted_normal(changed, plan.theta(fit.model))
    n = inner.shape[-1]
    inverse = 2 * fit.covariance[:, :n, :n]
    return 0.5 * inverse @ inner @ inverse
