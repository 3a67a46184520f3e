# SPDX-License-Identifier: Apache-2.0
"""From an FRF, or spectra, with covariance to poles with covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tactile_resonance.frf.result import FRF, FrfStatus
from tactile_resonance.identification.bins import BinData
from tactile_resonance.identification.covariance import modes_in_band
from tactile_resonance.identification.judgement import Evidence, assemble
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
    if frf.g.ndim != 1:
        raise ValueError(f"frf.g: shape {frf.g.shape}, expected (F,); identify_batch takes batches")
    batch = identify_batch(frf, band_hz, structure)
    notes = []
    left_out = frf.band(*batch.band_hz).g.size - int(batch.lines)
    if left_out:
        notes.append(f"{left_out} lines without a finite response left out")
    if frf.status is not FrfStatus.OK or frf.variance_noise is None:
        notes.append(frf.message)
    notes.append(_light_damping(frf, batch))
    return single(batch, notes=notes)


def _light_damping(frf: FRF, batch: PolesBatch) -> str:
    """Where the transient of a mode is too narrow for the local polynomials that removed it."""
    if "local polynomial" not in frf.method or frf.periods < 2 or frf.frequency_hz.size < 2:
        return ""
    bin_hz = float(np.diff(frf.frequency_hz).min()) / frf.periods
    half_width = batch.damping_ratio * batch.f0_hz / bin_hz
    if not np.any(half_width < FEWEST_BINS):
        return ""
    return (
        f"half the width of the mode is {np.nanmin(half_width):.1f} bins, less than {FEWEST_BINS}: "
        "unless the record began settled, what the local polynomial method leaves of the transient "
        "biases the poles"
    )


def identify_batch(
    frf: FRF, band_hz: tuple[float, float] | None = None, structure: ModelStructure | None = None
) -> PolesBatch:
    """As `identify_poles` for FRFs of many points on the same lines.

    Parameters
    ----------
    frf : FRF
        With (..., F) arrays.

    Returns
    -------
    PolesBatch
        With the leading axes of `frf`.
    """
    structure = structure or ModelStructure()
    band_hz = _band(frf.frequency_hz, band_hz)
    selected = frf.band(*band_hz)
    g = selected.g.reshape(-1, selected.frequency_hz.size)
    variance = _flat(selected.variance, g.shape)
    noise = _flat(selected.variance_noise, g.shape)
    usable = np.isfinite(g)
    if variance is not None:
        usable &= np.isfinite(variance)
    known: VarianceModel | None = None
    if variance is not None and selected.dof > 0 and bool(np.all((variance > 0) | ~usable)):
        gain = np.where(usable, np.abs(g) ** 2, 0.0)
        known = model_variance(np.where(usable, variance, np.nan), selected.dof, gain)
        if frf.variance_total is None and frf.periods > 1:
            # noise is from bins between lines: neighbours share them where periods are few
            bins = (frf.periods - 1) * frf.realisations
            known = replace(known, independent_dof=min(selected.dof, bins))
        weights = known.variance
    else:
        count = np.maximum(usable.sum(axis=-1, keepdims=True), 1)
        power = np.sum(np.abs(np.where(usable, g, 0)) ** 2, axis=-1, keepdims=True) / count
        power = np.where(power > 0, power, 1.0)
        weights = np.where(usable, power, np.inf)
    if not usable.all():
        g = np.where(usable, g, 0.0)
    total_known = selected.variance_total is not None
    return _identify(
        selected.frequency_hz,
        BinData(g, None, weights),
        known,
        usable,
        structure,
        band_hz,
        shape=frf.g.shape[:-1],
        method="weighted least squares",
        noise=noise if known is not None and total_known else None,
        total_known=total_known,
    )


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
        Average the covariance over the band where a test finds both variances flat.

    Returns
    -------
    PolesBatch

    References
    ----------
    Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
    section 12.3: sample maximum likelihood.
    """
    structure = structure or ModelStructure()
    if spectra.shape[-2] != 2 or covariance.shape[-3:-1] != (2, 2):
        raise ValueError(
            f"spectra, covariance: shapes {spectra.shape}, {covariance.shape}, "
            "expected (..., 2, F) and (..., 2, 2, F)"
        )
    band_hz = _band(frequency_hz, band_hz)
    inside = (frequency_hz >= band_hz[0]) & (frequency_hz <= band_hz[1])
    lines = int(inside.sum())
    shape = spectra.shape[:-2]
    z = spectra[..., inside].reshape(-1, 2, lines)
    c = np.broadcast_to(covariance, (*shape, 2, 2, covariance.shape[-1]))
    c = c[..., inside].reshape(-1, 2, 2, lines)
    usable = np.isfinite(z).all(axis=-2) & np.isfinite(c).all(axis=(-3, -2))
    usable &= c[:, 0, 0].real > 0
    z = np.where(usable[:, None], z, 0.0)
    c_yy = np.where(usable, c[:, 0, 0].real, np.inf)
    c_uu = np.where(usable, c[:, 1, 1].real, 0.0)
    c_yu = np.where(usable, c[:, 0, 1], 0.0)
    known = _pooled_kind(c_yy, c_uu, usable, dof, pooled)
    flat = known.kind == 0
    if flat.any():
        count = np.maximum(usable.sum(axis=-1, keepdims=True), 1)
        choose = flat[:, None] & usable
        finite = np.where(usable, c_yy, 0.0)
        c_yy = np.where(choose, finite.sum(axis=-1, keepdims=True) / count, c_yy)
        c_uu = np.where(choose, c_uu.sum(axis=-1, keepdims=True) / count, c_uu)
        c_yu = np.where(choose, c_yu.sum(axis=-1, keepdims=True) / count, c_yu)
    return _identify(
        frequency_hz[inside],
        BinData(z[:, 0], z[:, 1], c_yy, c_uu, c_yu),
        known,
        usable,
        structure,
        band_hz,
        shape=shape,
        method="sample maximum likelihood, errors in variables",
    )


def _pooled_kind(
    c_yy: FloatArray, c_uu: FloatArray, usable: npt.NDArray[np.bool_], dof: int, pooled: bool
) -> VarianceModel:
    """Flat where both variances pass the test (exact ones count as many periods), else per line."""
    lines = usable.sum(axis=-1)
    exact = dof <= 0
    kind = np.full(c_yy.shape[0], 2)
    if pooled and not exact:
        for variance in (c_yy, c_uu):
            if np.any(variance[usable] > 0):
                kind = np.minimum(kind, 2 - 2 * (model_variance(variance, dof).kind == 0))
                kind = np.where(model_variance(variance, dof).kind == 0, kind, 3)
        kind = np.where(kind == 0, 0, 2)
    return VarianceModel(c_yy, lines, 10**6 if exact else dof, kind)


def _identify(
    frequency_hz: FloatArray,
    data: BinData,
    known: VarianceModel | None,
    usable: npt.NDArray[np.bool_],
    structure: ModelStructure,
    band_hz: tuple[float, float],
    *,
    shape: tuple[int, ...],
    method: str,
    noise: FloatArray | None = None,
    total_known: bool = False,
) -> PolesBatch:
    lines = usable.sum(axis=-1)
    batch = lines.size
    parameters = structure.parameters
    enough = lines >= structure.fewest_lines
    places = max(frequency_hz.size, structure.order + 1, structure.numerator_order + 1)
    if frequency_hz.size < structure.fewest_lines:
        # bases need points: any will do, nothing is fitted
        frequency_hz = np.linspace(band_hz[0], max(band_hz[1], band_hz[0] + 1.0), places)
        return assemble(
            Evidence.empty(LinesPlan.on_lines(frequency_hz, structure), lines),
            structure,
            band_hz,
            shape,
            method,
        )
    plan = LinesPlan.on_lines(frequency_hz, structure)
    fit = plan.fit(data)
    free = np.maximum(lines - parameters / 2, 0.5)
    nan = np.full(batch, np.nan)
    if known is None:
        # the residuals are all there is: they hold noise, distortion and model error together
        scale = fit.cost / free
        nothing = np.full_like(fit.covariance, np.nan)
        evidence = Evidence(
            fit, lines, enough, nan, nan, np.zeros(batch, bool), nothing,
            fit.covariance * scale[:, None, None], np.full(batch, "unknown"), False,
        )  # fmt: skip
        return assemble(evidence, structure, band_hz, shape, method)
    weighted = fit.covariance * known.information_correction[:, None, None]
    covariance = weighted
    if noise is not None:
        covariance = _propagated(plan, fit, data, noise)
    expected = known.expected_cost(parameters)
    with np.errstate(invalid="ignore"):
        suspect = fit.cost > known.cost_quantile(parameters, 1 - MODEL_ERROR_PROBABILITY)
        suspect |= are_smooth(fit.residual, parameters)
    total = weighted if total_known else np.full_like(weighted, np.nan)
    evidence = Evidence(
        fit, lines, enough, fit.cost, expected, suspect, covariance, total,
        np.array(KINDS)[known.kind], True,
    )  # fmt: skip
    if suspect.any():
        evidence = evidence.with_model_error(weighted)
    result = assemble(evidence, structure, band_hz, shape, method)
    if suspect.any():
        systematic = _systematic(plan, fit, data, usable, np.flatnonzero(suspect), band_hz)
        total = result.total_covariance.reshape((batch, *systematic.shape[1:]))
        total[suspect] += systematic
    return result


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
        poles.append(modes_in_band(plan.fit(half).model.poles_rad_s(), band_hz))
    systematic = difference_of_halves(*poles)
    structure = richer(plan.structure)
    if usable[rows].sum(axis=-1).min() > structure.fewest_lines:
        model = LinesPlan.on_lines(plan.frequency_hz, structure).fit(part).model
        systematic = systematic + difference_of_models(
            modes_in_band(fit.model.poles_rad_s()[rows], band_hz),
            modes_in_band(model.poles_rad_s(), band_hz),
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


def _band(frequency_hz: FloatArray, band_hz: tuple[float, float] | None) -> tuple[float, float]:
    if band_hz is None:
        return float(frequency_hz[0]), float(frequency_hz[-1])
    return float(band_hz[0]), float(band_hz[1])


def _flat(array: FloatArray | None, shape: tuple[int, ...]) -> FloatArray | None:
    return None if array is None else array.reshape(shape)
