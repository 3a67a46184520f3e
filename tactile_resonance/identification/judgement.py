# SPDX-License-Identifier: Apache-2.0
"""What a fit is worth: status, covariances, and the sentence that says so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.covariance import pole_quantities, real_covariance
from tactile_resonance.identification.lines_fit import LinesFit, LinesPlan
from tactile_resonance.identification.result import (
    STATUS_CODE,
    ComplexArray,
    FloatArray,
    Poles,
    PolesBatch,
    PolesStatus,
    natural_frequency_and_damping,
)
from tactile_resonance.identification.structure import ModelStructure
from tactile_resonance.identification.whiteness import SMOOTH_RESIDUAL

BoolArray = npt.NDArray[np.bool_]

# A cost that noise alone exceeds once in a thousand fits counts as model error.
MODEL_ERROR_PROBABILITY = 1e-3
# A mode that noise makes is taken for one this often.
NOISE_PASSES_FOR_A_MODE = 1e-4
# Beyond this the parameters have no figure left in double precision.
LARGEST_CONDITION_NUMBER = 1e12


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the statistics of a batch of fits rest on.

    Attributes
    ----------
    fit : LinesFit
    lines : (batch,) int
    enough : (batch,) bool
        Lines for the model.
    cost, expected_cost : (batch,) float
        NaN where the variance is unknown.
    suspect : (batch,) bool
        Whether the cost is beyond what noise explains.
    covariance, total_covariance : (batch, n, n) float
        Of the coefficients; NaN where it cannot be told.
    variance_model : (batch,) str
    level_known : bool
        Whether the variance is known otherwise than from the residuals.
    noise_variance : (batch, 2) float or None
        See `PolesBatch`.
    """

    fit: LinesFit
    lines: npt.NDArray[np.int64]
    enough: BoolArray
    cost: FloatArray
    expected_cost: FloatArray
    suspect: BoolArray
    covariance: FloatArray
    total_covariance: FloatArray
    variance_model: npt.NDArray[np.str_]
    level_known: bool
    noise_variance: FloatArray | None = None

    @classmethod
    def empty(cls, plan: LinesPlan, lines: npt.NDArray[np.int64]) -> Evidence:
        """Of a band with too few lines."""
        batch, n = lines.size, plan.structure.parameters
        nan = np.full(batch, np.nan)
        a, b, _ = plan.problem.sizes
        model = plan._model(np.full((batch, a + b), np.nan))
        no = np.zeros(batch, bool)
        residual = np.zeros((batch, 0), complex)
        matrix = np.full((batch, n, n), np.nan)
        fit = LinesFit(model, nan, matrix, nan, no, residual)
        return cls(fit, lines, no, nan, nan, no, matrix, matrix, np.full(batch, ""), True)

    def with_model_error(self, weighted: FloatArray) -> Evidence:
        """With the model error in the total covariance of the suspects.

        Parameters
        ----------
        weighted : (batch, n, n) float
            Covariance of the coefficients from the variance weighted with.
        """
        rows = self.suspect
        factor = model_error_factor(
            self.fit.residual[rows], self.cost[rows], self.expected_cost[rows]
        )
        total = self.total_covariance.copy()
        total[rows] = weighted[rows] * factor[:, None, None]
        return replace(self, total_covariance=total)


def model_error_factor(
    residual: ComplexArray, cost: FloatArray, expected_cost: FloatArray
) -> FloatArray:
    """(batch,) factor from the covariance of noise to that of noise and model error.

    The excess of the cost tells how large the errors are; their correlation from line to line, how
    many of them act together: errors that keep their sign over L lines disturb a coefficient as L
    times fewer lines of independent errors would.

    Parameters
    ----------
    residual : (batch, F) complex
        Weighted.
    cost, expected_cost : (batch,) float
    """
    ratio = np.fmax(cost / expected_cost, 1.0)  # 1 where the level itself is from the residuals
    return ratio * correlation_length(residual)


def correlation_length(residual: ComplexArray) -> FloatArray:
    """(batch,) ``1 + 2 sum rho`` over the correlations of residuals (batch, F).

    Sokal's automatic window: the sum ends at the lag that exceeds five times itself.
    """
    lines = residual.shape[-1]
    padded = np.fft.fft(residual, 2 * lines, axis=-1)
    correlation = np.fft.ifft(np.abs(padded) ** 2, axis=-1).real[:, :lines]
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = correlation / correlation[:, :1]
    length = 2 * np.cumsum(np.nan_to_num(rho), axis=-1) - 1  # (batch, F)
    enough = np.arange(lines) >= 5 * length
    window = np.where(enough.any(axis=-1), np.argmax(enough, axis=-1), lines - 1)
    return np.maximum(np.take_along_axis(length, window[:, None], axis=-1)[:, 0], 1.0)


def difference_of_halves(even_rad_s: ComplexArray, odd_rad_s: ComplexArray) -> FloatArray:
    """Outer product of what even and odd lines differ by in (f0_hz, damping_ratio).

    What one wild line does shows in no residual of its neighbours; it does between halves of the
    lines.

    Parameters
    ----------
    even_rad_s, odd_rad_s : (..., places) complex
        Poles found from either half; NaN where a half does not have the mode.

    Returns
    -------
    (..., places, 2, 2) float
    """
    even, odd = (
        np.stack(natural_frequency_and_damping(p), axis=-1) for p in (even_rad_s, odd_rad_s)
    )
    difference = even - odd  # (..., places, 2)
    return np.asarray(difference[..., :, None] * difference[..., None, :])


def difference_of_models(poles_rad_s: ComplexArray, richer_rad_s: ComplexArray) -> FloatArray:
    """Outer product of what a model with one mode more moves each pole by in (f0_hz, damping_ratio).

    Two modes nearer to each other than their widths are fitted by one between them so well that
    residuals tell little of how far it is from either.

    Parameters
    ----------
    poles_rad_s : (..., places) complex
    richer_rad_s : (..., more places) complex
        NaN where there is no mode; the nearest one counts.

    Returns
    -------
    (..., places, 2, 2) float
        0 where the richer model has no mode.
    """
    distance = np.abs(richer_rad_s[..., None, :] - poles_rad_s[..., None])  # (..., places, more)
    nearest = np.argmin(np.where(np.isfinite(distance), distance, np.inf), axis=-1)
    other = np.take_along_axis(richer_rad_s, nearest, axis=-1)
    return np.nan_to_num(difference_of_halves(poles_rad_s, other))


def richer(structure: ModelStructure) -> ModelStructure:
    """One mode more, as many residual terms."""
    return replace(
        structure, order=structure.order + 2, numerator_order=structure.numerator_order + 2
    )


def assemble(
    evidence: Evidence,
    structure: ModelStructure,
    band_hz: tuple[float, float],
    shape: tuple[int, ...],
    method: str,
) -> PolesBatch:
    """The result of a batch.

    Parameters
    ----------
    shape : tuple of int
        Leading axes, of as many points as the batch has.
    """
    fit = evidence.fit
    conditioned = fit.condition_number < LARGEST_CONDITION_NUMBER
    # a model that the lines do not determine has no poles worth a number
    undetermined = ~(evidence.enough & conditioned)
    hopeless = undetermined | ~fit.converged
    covariance, total = evidence.covariance, evidence.total_covariance
    if hopeless.any():
        covariance, total = covariance.copy(), total.copy()
        covariance[hopeless] = total[hopeless] = np.nan
    quantities = pole_quantities(fit.model, band_hz, covariance)
    if undetermined.any():
        for name in ("poles_rad_s", "f0_hz", "damping_ratio", "residues"):
            quantities[name][undetermined] = np.nan
    poles = quantities["poles_rad_s"]
    total_f0_damping = np.full_like(quantities["covariance"], np.nan)
    rows = np.flatnonzero(np.isfinite(total).any(axis=(-2, -1)))
    if rows.size:
        total_f0_damping[rows] = pole_quantities(
            fit.model if rows.size == total.shape[0] else _rows(fit.model, rows),
            band_hz,
            total[rows],
        )["covariance"]
    code = np.full(hopeless.shape, STATUS_CODE[PolesStatus.OK], np.uint8)
    with np.errstate(invalid="ignore"):
        # the gravest last, so that it stays
        for where, status in (
            (not evidence.level_known, PolesStatus.NO_COVARIANCE),
            (evidence.suspect, PolesStatus.MODEL_ERROR),
            ((poles.real >= 0).any(axis=-1), PolesStatus.UNSTABLE_POLE),
            (~np.isfinite(poles).any(axis=-1), PolesStatus.NO_RESONANCE),
            (~conditioned, PolesStatus.ILL_CONDITIONED),
            (~fit.converged, PolesStatus.NOT_CONVERGED),
            (~evidence.enough, PolesStatus.TOO_FEW_LINES),
        ):
            code[where] = STATUS_CODE[status]
    noise = evidence.noise_variance
    if noise is None:
        noise = np.full((code.size, 2), np.nan)

    def batch(array: npt.NDArray) -> npt.NDArray:
        return array.reshape((*shape, *array.shape[1:]))

    model = fit.model
    delay = model.delay_s
    return PolesBatch(
        **{name: batch(values) for name, values in quantities.items()},
        total_covariance=batch(total_f0_damping),
        coefficient_covariance=batch(covariance),
        cost=batch(evidence.cost),
        expected_cost=batch(evidence.expected_cost),
        condition_number=batch(fit.condition_number),
        residual=batch(fit.residual),
        lines=batch(evidence.lines),
        status_code=batch(code),
        noise_variance=batch(noise),
        fit=replace(
            model,
            denominator=batch(model.denominator),
            numerator=batch(model.numerator),
            transient=batch(model.transient) if model.transient.ndim > 1 else model.transient,
            delay_s=batch(np.asarray(delay)) if np.ndim(delay) else delay,
        ),
        structure=structure,
        band_hz=band_hz,
        variance_model=batch(evidence.variance_model),
        method=method,
    )


def single(batch: PolesBatch, index: tuple[int, ...] = (), notes: Sequence[str] = ()) -> Poles:
    """One point of a batch, with the zeros and the sentence a batch leaves out.

    Parameters
    ----------
    batch : PolesBatch
    index : tuple of int
        Into its leading axes.
    notes : sequence of str
        Added to the message.
    """
    model = batch.fit.at(index)
    status = batch.status(index)
    there = np.isfinite(batch.poles_rad_s[index])
    poles = batch.poles_rad_s[index][there]
    coefficients = batch.coefficient_covariance[index]
    n = batch.structure.order
    zeros = np.empty(0, complex)
    if status is not PolesStatus.TOO_FEW_LINES and np.isfinite(model.numerator).all():
        zeros = model.zeros_rad_s()
    known = bool(np.isfinite(coefficients).all()) and poles.size > 0
    residue = zero = None
    if known:
        with np.errstate(all="ignore"):
            residue = real_covariance(model.residue_sensitivity(poles), coefficients)
            m = model.numerator.size
            zero = real_covariance(
                model.zero_sensitivity(zeros), coefficients[n : n + m, n : n + m]
            )

    found = poles
    if known and residue is not None:
        real = _significant(batch.residues[index][there], residue, int(batch.lines[index]))
        there[there] = real
        poles, residue = poles[real], residue[real]
        if not real.any():
            status, residue = PolesStatus.NO_RESONANCE, None
            notes = [
                f"what the fit took for a mode at {abs(pole) / (2 * np.pi):.4g} Hz is no more than "
                "noise makes"
                for pole in found
            ] + list(notes)

    if status is PolesStatus.OK and poles.size and not known:
        status = PolesStatus.NO_COVARIANCE
        notes = [
            "the variance of each line has too few degrees of freedom to tell the uncertainty: "
            "record more periods or realisations",
            *notes,
        ]

    def optional(array: FloatArray) -> FloatArray | None:
        values = array[index][there]
        return values if values.size and np.isfinite(values).all() else None

    message = "; ".join(filter(None, [_sentence(batch, index, status), *notes]))
    return Poles(
        poles_rad_s=poles,
        f0_hz=batch.f0_hz[index][there],
        damping_ratio=batch.damping_ratio[index][there],
        residues=batch.residues[index][there],
        covariance=optional(batch.covariance),
        total_covariance=optional(batch.total_covariance),
        pole_covariance=optional(batch.pole_covariance),
        residue_covariance=residue,
        zeros_rad_s=zeros,
        zero_covariance=zero,
        structure=batch.structure,
        band_hz=batch.band_hz,
        lines=int(batch.lines[index]),
        cost=float(batch.cost[index]),
        expected_cost=float(batch.expected_cost[index]),
        whiteness=float(batch.whiteness[index]),
        condition_number=float(batch.condition_number[index]),
        variance_model=str(batch.variance_model[index]),
        fit=None if status is PolesStatus.TOO_FEW_LINES else model,
        method=batch.method,
        status=status,
        message=message,
    )


def _significant(
    residues: ComplexArray, covariance: FloatArray, lines: int
) -> npt.NDArray[np.bool_]:
    """(n,) modes whose residue noise alone would not make.

    A fit to noise finds the line or bin that stands out most: the residue's Mahalanobis distance from
    zero, chi-square with two degrees of freedom, is the largest of about as many as there are lines
    (Bonferroni). Where it cannot be computed the mode is kept.
    """
    limit = -2 * np.log(NOISE_PASSES_FOR_A_MODE / max(lines, 1))
    kept = np.ones(residues.size, bool)
    for k, (residue, matrix) in enumerate(zip(residues, covariance, strict=True)):
        vector = np.array([residue.real, residue.imag])
        try:
            distance = vector @ np.linalg.solve(matrix, vector)
        except np.linalg.LinAlgError:
            continue
        kept[k] = not distance < limit
    return kept


def _sentence(batch: PolesBatch, index: tuple[int, ...], status: PolesStatus) -> str:
    low_hz, high_hz = batch.band_hz
    structure = batch.structure
    sentences = {
        PolesStatus.TOO_FEW_LINES: f"{int(batch.lines[index])} lines in {low_hz:g}-{high_hz:g} Hz, "
        f"{structure.parameters} parameters need at least {structure.fewest_lines}",
        PolesStatus.NOT_CONVERGED: "the iterations found no minimum",
        PolesStatus.ILL_CONDITIONED: f"condition number {batch.condition_number[index]:.2g}: the "
        "lines do not determine the model",
        PolesStatus.NO_RESONANCE: f"no complex pole pair in {low_hz:g}-{high_hz:g} Hz",
        PolesStatus.UNSTABLE_POLE: "a pole in the right half plane: the sensor is passive, so the "
        "model is wrong",
        PolesStatus.NO_COVARIANCE: "the variance is not known independently of the fit: a model "
        "error would not show",
        PolesStatus.MODEL_ERROR: f"{_contradiction(batch, index)}: the model leaves something out, "
        "rely on the total covariance",
    }
    return sentences.get(status, "")


def _contradiction(batch: PolesBatch, index: tuple[int, ...]) -> str:
    """What noise alone would not make."""
    found = []
    if np.isfinite(batch.cost[index]):
        found.append(
            f"cost {batch.cost[index]:.4g} where the variance explains "
            f"{batch.expected_cost[index]:.4g}"
        )
    if batch.whiteness[index] > SMOOTH_RESIDUAL:
        found.append(
            f"residuals of neighbouring lines alike (whiteness {batch.whiteness[index]:.1f} where "
            f"noise makes {SMOOTH_RESIDUAL} at most)"
        )
    return ", ".join(found)


def _rows(model, rows):
    delay = model.delay_s
    return replace(
        model,
        denominator=model.denominator[rows],
        numerator=model.numerator[rows],
        transient=model.transient[rows] if model.transient.ndim > 1 else model.transient,
        delay_s=np.asarray(delay)[rows] if np.ndim(delay) else delay,
    )
