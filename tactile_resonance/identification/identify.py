# SPDX-License-Identifier: Apache-2.0
"""From an FRF with covariance to poles with covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tactile_resonance.frf.result import FRF, FrfStatus
from tactile_resonance.identification.covariance import (
    ParameterCovariance,
    f0_damping_covariance,
    pole_covariance,
)
from tactile_resonance.identification.noise_level import VarianceModel, model_variance
from tactile_resonance.identification.rational_fit import RationalFit, fit_rational
from tactile_resonance.identification.result import (
    ComplexArray,
    FloatArray,
    Poles,
    PolesStatus,
    natural_frequency_and_damping,
)
from tactile_resonance.identification.structure import ModelStructure

# A cost that noise alone exceeds once in a thousand fits counts as model error.
MODEL_ERROR_PROBABILITY = 1e-3
# Beyond this the parameters have no figure left in double precision.
LARGEST_CONDITION_NUMBER = 1e12
# A mode this fraction of the band outside of it is still one that the lines show.
BAND_MARGIN = 0.1


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
    Lines are weighted with the largest variance known (total, else noise), pooled over the band where a
    test allows it. Where both are known, ``covariance`` propagates the noise through these weights and
    ``total_covariance`` the total; where only realisations are at hand, noise cannot be told from
    distortion and both fields hold both. Where the cost exceeds what the variance explains,
    ``total_covariance`` is enlarged by the ratio of the cost to its expectation.
    """
    structure = structure or ModelStructure()
    if band_hz is None:
        band_hz = (float(frf.frequency_hz[0]), float(frf.frequency_hz[-1]))
    selected = frf.band(*band_hz)
    variance = selected.variance
    usable = np.isfinite(selected.g)
    if variance is not None:
        usable &= np.isfinite(variance)
    lines = int(usable.sum())
    nothing = Poles(
        structure=structure, band_hz=band_hz, lines=lines, method="weighted least squares"
    )
    if lines < structure.fewest_lines:
        return replace(
            nothing,
            status=PolesStatus.TOO_FEW_LINES,
            message=f"{lines} lines in {band_hz[0]:g}-{band_hz[1]:g} Hz, "
            f"{structure.parameters} parameters need at least {structure.fewest_lines}",
        )
    g = selected.g[usable]
    model = None
    if variance is not None and selected.dof > 0 and np.all(variance[usable] > 0):
        model = model_variance(variance[usable], selected.dof)
        std = np.sqrt(model.variance)
    else:
        std = np.full(lines, np.sqrt(np.mean(np.abs(g) ** 2)))  # alike for all lines
    fit = fit_rational(selected.frequency_hz[usable], g, std, structure)
    parameters = ParameterCovariance.of(fit)
    poles = modes_in_band(fit.poles_rad_s(), band_hz)
    f0_hz, damping_ratio = natural_frequency_and_damping(poles)
    noise_ratio = None
    if model is not None and selected.variance_noise is not None:
        noise_ratio = selected.variance_noise[usable] / model.variance
    result = replace(
        nothing,
        poles_rad_s=poles,
        f0_hz=f0_hz,
        damping_ratio=damping_ratio,
        residues=fit.residues(poles),
        cost=fit.cost if model else float("nan"),
        expected_cost=model.expected_cost(lines, structure.parameters) if model else float("nan"),
        condition_number=parameters.condition_number,
        variance_model=model.kind if model else "unknown",
        fit=fit,
    )
    result = _judge(result, fit, model)
    result = _with_covariances(
        result, fit, parameters, model, noise_ratio, selected.variance_total is not None
    )
    notes = [result.message]
    if lines < usable.size:
        notes.append(f"{usable.size - lines} lines without a finite response left out")
    if frf.status is not FrfStatus.OK or selected.variance_noise is None:
        notes.append(frf.message)
    return replace(result, message="; ".join(filter(None, notes)))


def modes_in_band(poles_rad_s: ComplexArray, band_hz: tuple[float, float]) -> ComplexArray:
    """Of each complex pair near the band the pole above the real axis, by natural frequency."""
    margin = BAND_MARGIN * (band_hz[1] - band_hz[0])
    f0_hz, _ = natural_frequency_and_damping(poles_rad_s)
    inside = (
        (poles_rad_s.imag > 0) & (f0_hz >= band_hz[0] - margin) & (f0_hz <= band_hz[1] + margin)
    )
    return poles_rad_s[inside][np.argsort(f0_hz[inside])]


def _judge(result: Poles, fit: RationalFit, model: VarianceModel | None) -> Poles:
    """Status and its sentence: the first that applies, the gravest first."""
    low_hz, high_hz = result.band_hz
    checks = [
        (
            not fit.converged,
            PolesStatus.NOT_CONVERGED,
            f"no minimum found in {fit.iterations} iterations",
        ),
        (
            not result.condition_number < LARGEST_CONDITION_NUMBER,
            PolesStatus.ILL_CONDITIONED,
            f"condition number {result.condition_number:.2g}: the lines do not determine the model",
        ),
        (
            result.poles_rad_s.size == 0,
            PolesStatus.NO_RESONANCE,
            f"no complex pole pair in {low_hz:g}-{high_hz:g} Hz",
        ),
        (
            bool(np.any(result.poles_rad_s.real >= 0)),
            PolesStatus.UNSTABLE_POLE,
            "a pole in the right half plane: the sensor is passive, so the model is wrong",
        ),
        (
            model is None,
            PolesStatus.NO_COVARIANCE,
            "the variance of the response is unknown: lines weighted alike",
        ),
        (
            model is not None
            and result.cost
            > model.cost_quantile(
                result.lines, result.structure.parameters, 1 - MODEL_ERROR_PROBABILITY
            ),
            PolesStatus.MODEL_ERROR,
            f"cost {result.cost:.4g} where the variance explains {result.expected_cost:.4g}: the model "
            "leaves something out, rely on the total covariance",
        ),
    ]
    for applies, status, message in checks:
        if applies:
            return replace(result, status=status, message=message)
    return replace(result, status=PolesStatus.OK)


def _with_covariances(
    result: Poles,
    fit: RationalFit,
    parameters: ParameterCovariance,
    model: VarianceModel | None,
    noise_ratio: FloatArray | None,
    total_known: bool,
) -> Poles:
    """Fill in the covariances that can be told; see the notes of `identify_poles`."""
    if result.poles_rad_s.size == 0 or result.status in (
        PolesStatus.NOT_CONVERGED,
        PolesStatus.ILL_CONDITIONED,
    ):
        return result
    if model is None:
        # the residuals are all there is: they hold noise, distortion and model error together
        free = result.lines - result.structure.parameters / 2
        scaled = parameters.from_weights() * (fit.cost / free)
        total = pole_covariance(fit, result.poles_rad_s, scaled)
        return replace(result, total_covariance=f0_damping_covariance(result.poles_rad_s, total))
    correction = model.information_correction
    weighted = pole_covariance(fit, result.poles_rad_s, parameters.from_weights()) * correction
    noise = weighted
    if total_known and noise_ratio is not None:
        noise = pole_covariance(fit, result.poles_rad_s, parameters.from_variance(noise_ratio))
    total = weighted if total_known else None
    if result.status is PolesStatus.MODEL_ERROR:
        total = weighted * (result.cost / result.expected_cost)
    return replace(
        result,
        pole_covariance=noise,
        covariance=f0_damping_covariance(result.poles_rad_s, noise),
        total_covariance=None
        if total is None
        else f0_damping_covariance(result.poles_rad_s, total),
    )
