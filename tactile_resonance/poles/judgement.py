# SPDX-License-Identifier: Apache-2.0
"""What a batch of fits is worth: status and covariances; one point of it for people, with a sentence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.model_error import SMOOTH_RESIDUAL, model_error_factor
from tactile_resonance.poles.modes import (
    beside_others,
    fall_of_noise,
    pole_quantities,
    propagated,
    second_order,
    significant_modes,
)
from tactile_resonance.poles.noise_level import KINDS
from tactile_resonance.poles.result import STATUS_CODE, Poles, PolesBatch, PolesStatus
from tactile_resonance.poles.tables import FitPlan

Plan = TypeVar("Plan", bound=FitPlan)

# Squares of this number cancel in the variance of a residue. Beyond it rounding leaves nothing of that
# variance, and a mode cannot be distinguished from noise.
LARGEST_CONDITION_NUMBER = 6.7e7
# Of the variance of a delay by what is not known of other coefficients: beyond it, its deviation means little.
MOST_INFLATION = 100.0
# Of `Judged.kind`.
NAMES = np.array([*KINDS, "unknown", ""])
# Fields that a `PolesBatch` takes as they are.
AS_JUDGED = (
    *("lines", "condition_number", "residual", "cost"),
    *("expected_cost", "noise_variance", "lacking"),
)


@dataclass(frozen=True, eq=False)
class Judged:
    """Fits of points and what the statistics say of them.

    Attributes
    ----------
    theta : (batch, n) float
        Coefficients [A without its last, B, C]; of several records the C of each.
    lines : (batch,) int
        That were used; 0 where a bin of a record is not finite.
    condition_number : (batch,) float
    converged : (batch,) bool
    residual : (batch, F) complex
        Weighted, on the (excited) lines; 0 on those left out.
    cost, expected_cost : (batch,) float
        Of these lines; NaN where the level is from the residuals themselves.
    suspect : (batch,) bool
        Whether cost, smoothness of the residuals or what the model lacks contradict the model.
    covariance : (batch, p, p) float
        Of the coefficients from noise, of several records of those they share; NaN where noise cannot be
        distinguished from all else.
    total : same shape or None
        From noise and distortion; NaN where nothing but noise is known, None where that is so of all.
    kind : (batch,) int
        Index into `NAMES`, what the variance was taken for.
    level_known : (batch,) bool
        Whether the variance is known otherwise than from the residuals.
    noise_variance : (batch, 2) float
        Variance of a bin of Y and of U; NaN where the data brought their own.
    systematic : (batch, places, 2, 2) float
        What a model error moves (f0_hz, damping_ratio) by, as an outer product, and what else adds to the
        total covariance; 0 where nothing does.
    lacking : (batch, 3) float
        See `PolesBatch`.
    doubt : (batch,) object
        What counts in the covariances of a point, but not for which of its modes are significant: (n, n) of
        the coefficients, of which the first p belong to `covariance`; None: nothing. See `lacking.Lack`.
    remark : (batch,) object
        A further note for people; empty: none.
    """

    theta: FloatArray
    lines: IntArray
    condition_number: FloatArray
    converged: BoolArray
    residual: ComplexArray
    cost: FloatArray
    expected_cost: FloatArray
    suspect: BoolArray
    covariance: FloatArray
    total: FloatArray | None
    kind: IntArray
    level_known: BoolArray
    noise_variance: FloatArray
    systematic: FloatArray
    lacking: FloatArray
    doubt: npt.NDArray[np.object_]
    remark: npt.NDArray[np.object_]

    @classmethod
    def of(cls, plan: FitPlan, lines: IntArray, **values: Any) -> Judged:
        """With a known level of noise, and nothing found or to remark, of what no value is given for."""
        batch, parameters, places = lines.size, plan.structure.parameters, plan.structure.order // 2
        nothing: dict[str, tuple[tuple[int, ...], complex]] = {
            "theta": ((batch, parameters), np.nan),
            "condition_number": ((batch,), np.nan),
            "converged": ((batch,), False),
            "residual": ((batch, 0), 0j),
            "cost": ((batch,), np.nan),
            "expected_cost": ((batch,), np.nan),
            "suspect": ((batch,), False),
            "covariance": ((batch, parameters, parameters), np.nan),
            "kind": ((batch,), -1),
            "level_known": ((batch,), True),
            "noise_variance": ((batch, 2), np.nan),
            "systematic": ((batch, places, 2, 2), 0.0),
            "lacking": ((batch, 3), np.nan),
        }
        for name in nothing.keys() - values.keys():
            values[name] = np.full(*nothing[name])
        values.setdefault("total", None)
        values.setdefault("doubt", np.full(batch, None, object))
        values.setdefault("remark", np.full(batch, "", object))
        return cls(lines=lines, **values)

    def put(self, rows: IntArray, others: Judged) -> None:
        """Write other points in place of some."""
        for f in fields(self):
            if getattr(self, f.name) is not None:
                getattr(self, f.name)[rows] = getattr(others, f.name)

    def total_with_model_error(self) -> tuple[IntArray, FloatArray]:
        """Points of which more than noise is known, and their total covariances, with the model error."""
        if self.total is None:
            rows = np.flatnonzero(self.suspect)
            total = self.covariance[rows]
        else:
            rows, total = np.arange(self.lines.size), self.total
            if self.suspect.any():
                known = np.isfinite(total) | ~self.suspect[:, None, None]
                total = np.where(known, total, self.covariance)
        if self.suspect.any():
            wrong = self.suspect[rows]
            args = (self.residual[rows][wrong], self.cost[rows][wrong], self.expected_cost[rows][wrong])
            total = total.copy()
            total[wrong] *= model_error_factor(*args)[:, None, None]
        return rows, total


def assemble(
    plan: Plan,
    judged: Judged,
    shape: tuple[int, ...],
    method: str,
    costs: Callable[[Plan, IntArray], FloatArray],
) -> PolesBatch:
    """The result of a batch.

    Parameters
    ----------
    plan : FitPlan
        Of the coefficients.
    judged : Judged
    shape : tuple of int
        Leading axes, of as many points as the batch has.
    method : str
    costs : callable
        Costs (rows,) of some points fitted by another plan, with one mode less; see `_needed`.
    """
    structure, band_hz, model = plan.structure, plan.band_hz, plan.model_of(judged.theta)
    enough = judged.lines >= structure.fewest_lines
    conditioned = judged.condition_number < LARGEST_CONDITION_NUMBER
    # a model that the lines do not determine has no poles worth a number
    undetermined = ~(enough & conditioned)
    hopeless = undetermined | ~judged.converged
    covariance = judged.covariance
    if hopeless.any():
        covariance = covariance.copy()
        covariance[hopeless] = np.nan
    quantities, sensitivity = pole_quantities(model, band_hz, covariance)
    quantities["total_covariance"] = np.full_like(quantities["covariance"], np.nan)
    rows, total = judged.total_with_model_error()
    if rows.size:
        in_f0 = propagated(quantities["poles_rad_s"][rows], sensitivity[rows], total)[1]
        in_f0[hopeless[rows]] = np.nan
        quantities["total_covariance"][rows] = in_f0 + judged.systematic[rows]
    lost = judged.level_known & ~hopeless & _lost_to_rounding(quantities["covariance"])
    if lost.any():
        conditioned &= ~lost
        undetermined |= lost
        covariance = covariance.copy()
        for matrix in (covariance, quantities["covariance"], quantities["total_covariance"]):
            matrix[lost] = np.nan
    if undetermined.any():
        for name in ("poles_rad_s", "f0_hz", "damping_ratio", "residues"):
            quantities[name][undetermined] = np.nan
    poles = quantities["poles_rad_s"]
    tested, dof = covariance, np.array(np.inf)
    if judged.total is not None and not judged.level_known.all():
        of_residuals = ~judged.level_known & ~hopeless
        tested = np.where(of_residuals[:, None, None], judged.total, covariance)
        free = np.maximum(judged.lines - tested.shape[-1] / 2, 1)
        dof = np.where(of_residuals, free, np.inf)
    significant, distance = significant_modes(model, quantities, tested, judged.lines, dof)
    in_doubt = [k for k, matrix in enumerate(judged.doubt) if matrix is not None]
    if in_doubt:
        covariance = covariance.copy()
        p = covariance.shape[-1]
        doubt = np.stack([matrix[:p, :p] for matrix in judged.doubt[in_doubt]])
        covariance[in_doubt] += doubt
        of_poles, in_f0 = propagated(quantities["poles_rad_s"][in_doubt], sensitivity[in_doubt], doubt)
        for name, more in (("pole_covariance", of_poles), ("covariance", in_f0), ("total_covariance", in_f0)):
            quantities[name][in_doubt] += more
    if poles.shape[-1] > 2:
        significant &= ~_sum_of_hidden(poles, significant)
    if (less := plan.poorer) is not None:
        certain = judged.level_known & ~undetermined & ~hopeless & ~judged.suspect
        asked = beside_others(poles, significant) & certain[:, None]
        significant |= _needed(judged, structure.parameters, asked, partial(costs, less))
    remark, notes = judged.remark.copy(), [_without_lost_totals(quantities, significant)]
    if poles.shape[-1] > 1:
        notes.append(_widen(quantities, second_order(poles, significant, distance)))
    for k, note in (item for of_points in notes for item in of_points.items()):
        remark[k] = "; ".join(filter(None, [remark[k], note]))
    code = np.full(hopeless.shape, STATUS_CODE[PolesStatus.OK], np.uint8)
    with np.errstate(invalid="ignore"):
        # the gravest last, so that it stays
        for where, status in (
            (~judged.level_known, PolesStatus.NO_COVARIANCE),
            (~np.isfinite(covariance[:, 0, 0]), PolesStatus.NO_COVARIANCE),
            (judged.suspect, PolesStatus.MODEL_ERROR),
            ((significant & (poles.real >= 0)).any(axis=-1), PolesStatus.UNSTABLE_POLE),
            (~significant.any(axis=-1), PolesStatus.NO_RESONANCE),
            (~conditioned, PolesStatus.ILL_CONDITIONED),
            (~judged.converged, PolesStatus.NOT_CONVERGED),
            (~enough, PolesStatus.TOO_FEW_LINES),
        ):
            code[where] = STATUS_CODE[status]

    def batch(array: npt.NDArray) -> npt.NDArray:
        # of one point an index takes half the time of a new shape
        return array.reshape((*shape, *array.shape[1:])) if shape else array[0, ...]

    delay = model.delay_s
    return PolesBatch(
        **{name: batch(values) for name, values in quantities.items()},
        coefficient_covariance=batch(covariance),
        **{name: batch(getattr(judged, name)) for name in AS_JUDGED},
        significant=batch(significant),
        status_code=batch(code),
        fit=replace(
            model,
            denominator=batch(model.denominator),
            numerator=batch(model.numerator),
            transient=batch(model.transient),
            delay_s=batch(np.asarray(delay)) if np.ndim(delay) else delay,
        ),
        structure=structure,
        band_hz=band_hz,
        variance_model=batch(NAMES[judged.kind]),
        method=method,
        remark=batch(remark),
    )


def _lost_to_rounding(covariance: FloatArray) -> BoolArray:
    """(batch,) where a variance of a mode's covariance (batch, k, 2, 2) is not above 0.

    A mode beside its own zero leaves the normal matrix all but singular.
    """
    return np.asarray(((covariance[..., 0, 0] <= 0) | (covariance[..., 1, 1] <= 0)).any(axis=-1))


def _needed(
    judged: Judged,
    parameters: int,
    beside: BoolArray,
    costs_with_less: Callable[[IntArray], FloatArray],
) -> BoolArray:
    """(batch, k) modes `beside` others whose residue noise could make, but without which the fit is worse.

    Two modes nearer than their widths share what the lines say of them, so that the residue of one may be
    uncertain, and only a fit without it tells; see `modes.fall_of_noise`.
    """
    rows = np.flatnonzero(beside.any(axis=-1))
    if rows.size:
        lines, expected = judged.lines[rows], judged.expected_cost[rows]
        level = np.maximum(expected / (lines - parameters / 2), 1)
        fall = costs_with_less(rows) - judged.cost[rows]
        beside[rows] &= (fall > level * fall_of_noise(lines))[:, None]
    return beside


def _without_lost_totals(quantities: dict[str, npt.NDArray], significant: BoolArray) -> dict[int, str]:
    """Total covariances (batch, k, 2, 2) that rounding has made negative become NaN; notes of points."""
    total = quantities["total_covariance"]
    lost = (np.diagonal(total, axis1=-2, axis2=-1) <= 0).any(axis=-1)
    if not lost.any():
        return {}
    total[lost] = np.nan
    note = "the total covariance is lost to rounding: a smaller order has one"
    return dict.fromkeys(np.flatnonzero((lost & significant).any(axis=-1)).tolist(), note)


def _widen(quantities: dict[str, npt.NDArray], more: FloatArray) -> dict[int, str]:
    """Add more (batch, k, 2, 2) to the total covariance; notes of the points where it is."""
    wide, notes = more[..., 0, 0] > 0, dict[int, str]()
    total, covariance = quantities["total_covariance"], quantities["covariance"]
    total[wide] = np.where(np.isfinite(total), total, covariance)[wide] + more[wide]
    for k in np.flatnonzero(wide.any(axis=-1)).tolist():
        f0_hz = " and ".join(f"{f0:.4g}" for f0 in quantities["f0_hz"][k][wide[k]])
        notes[k] = (
            f"the modes at {f0_hz} Hz are nearer than their widths, and how they share the response is "
            "uncertain: rely on the total covariance"
        )
    return notes


def _sum_of_hidden(poles: ComplexArray, significant: BoolArray) -> BoolArray:
    """(batch, k) wide modes across two others or more of which none is significant alone.

    Noise hides each of these, but not their sum, which a mode as wide as all of them stands for.
    """
    apart = np.abs(poles.imag[:, :, None] - poles.imag[:, None, :])
    across = (apart < np.abs(poles.real)[:, :, None]) & ~np.eye(poles.shape[-1], dtype=bool)
    some = (across & significant[:, None, :]).any(axis=-1)
    return np.asarray((across.sum(axis=-1) > 1) & ~some)


def single(batch: PolesBatch, index: tuple[int, ...] = (), notes: Sequence[str] = ()) -> Poles:
    """One point of a batch, with the sentence a batch leaves out.

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
    real = batch.significant[index][there]
    left_out = [
        f"what the fit took for a mode at {abs(pole) / (2 * np.pi):.4g} Hz is no more than "
        "noise makes"
        for pole in poles[~real]
    ]
    there[there] = real
    terms = batch.structure.numerator_order - batch.structure.order + 1
    from_what = f"{terms} residual terms" if terms > 1 else "the numerator"
    not_told = f"the delay is not told from {from_what}: its own value and deviation mean little"
    untold = batch.structure.delay and there.any() and (terms > 1 or _inflation(coefficients) > MOST_INFLATION)
    of_delay = [not_told] if untold else []
    notes = [*left_out, *of_delay, *notes]

    def optional(array: FloatArray) -> FloatArray | None:
        values = array[index][there]
        return values if values.size and np.isfinite(values).all() else None

    said = [_sentence(batch, index, status), *notes, str(batch.remark[index])]
    message = "; ".join(filter(None, said))
    return Poles(
        poles_rad_s=poles[real],
        f0_hz=batch.f0_hz[index][there],
        damping_ratio=batch.damping_ratio[index][there],
        residues=batch.residues[index][there],
        covariance=optional(batch.covariance),
        total_covariance=optional(batch.total_covariance),
        pole_covariance=optional(batch.pole_covariance),
        coefficient_covariance=coefficients if np.isfinite(coefficients).all() else None,
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


def _inflation(covariance: FloatArray) -> float:
    """Variance of the last coefficient over what it would be if the others (n, n) were known; NaN: unknown."""
    if not np.isfinite(covariance).all():
        return float("nan")
    std = np.sqrt(np.diagonal(covariance))
    return float(np.linalg.pinv(covariance / np.outer(std, std), hermitian=True)[-1, -1])


def _sentence(batch: PolesBatch, index: tuple[int, ...], status: PolesStatus) -> str:
    if status is PolesStatus.OK:
        return ""
    low_hz, high_hz = batch.band_hz
    structure = batch.structure
    sentences = {
        PolesStatus.TOO_FEW_LINES: f"{int(batch.lines[index])} lines with finite values in "
        f"{low_hz:g}-{high_hz:g} Hz, "
        f"{structure.parameters} parameters need at least {structure.fewest_lines}",
        PolesStatus.NOT_CONVERGED: "the iterations found no minimum",
        PolesStatus.ILL_CONDITIONED: f"condition number {batch.condition_number[index]:.2g}: the "
        "lines do not determine the model",
        PolesStatus.NO_RESONANCE: f"no complex pole pair in {low_hz:g}-{high_hz:g} Hz",
        PolesStatus.UNSTABLE_POLE: "a pole in the right half plane: the sensor is passive, so the "
        "model is wrong",
        PolesStatus.NO_COVARIANCE: _without_covariance(batch, index),
        PolesStatus.MODEL_ERROR: f"{_contradiction(batch, index)}: the model leaves something out"
        + (", rely on the total covariance" if _has_total(batch, index) else ""),
    }
    return sentences.get(status, "")


def _has_total(batch: PolesBatch, index: tuple[int, ...]) -> bool:
    return bool(np.isfinite(batch.total_covariance[index]).any())


def _without_covariance(batch: PolesBatch, index: tuple[int, ...]) -> str:
    """Why there is none."""
    if np.isfinite(batch.cost[index]):
        if _has_total(batch, index):
            return "no line has a finite variance of the noise alone: the total covariance is known"
        return (
            "the variance of each line has too few degrees of freedom to estimate the uncertainty: "
            "record more periods or realisations"
        )
    if not _has_total(batch, index):
        return (
            "the fit leaves too few degrees of freedom to estimate the noise: take a wider band, more "
            "periods or a smaller order"
        )
    return (
        "the variance is not known independently of the fit: a model error would not show unless it "
        "is smooth"
    )


def _contradiction(batch: PolesBatch, index: tuple[int, ...]) -> str:
    """What noise alone would not make."""
    found = []
    chi_square, parameters, f0_hz = batch.lacking[index]
    if np.isfinite(chi_square):
        what = (
            f"one mode more near {f0_hz:.4g} Hz fits"
            if np.isfinite(f0_hz)
            else ("two residual terms more fit")
        )
        found.append(f"{what} better: chi-square {chi_square:.0f} for {parameters:.0f} parameters")
    if batch.cost[index] > batch.expected_cost[index]:
        found.append(
            f"cost {batch.cost[index]:.4g} where the variance explains "
            f"{batch.expected_cost[index]:.4g}"
        )
    if batch.whiteness[index] > SMOOTH_RESIDUAL:
        found.append(
            f"residuals smooth over the lines (whiteness {batch.whiteness[index]:.1f} where "
            f"noise makes {SMOOTH_RESIDUAL} at most)"
        )
    return ", ".join(found) or "realisations contradict each other"
