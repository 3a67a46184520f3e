# SPDX-License-Identifier: Apache-2.0
"""What a batch of fits is worth: status and covariances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.model import pole_quantities, propagated
from tactile_resonance.poles.noise_level import KINDS
from tactile_resonance.poles.result import STATUS_CODE, PolesBatch, PolesStatus
from tactile_resonance.poles.significance import (
    beside_others,
    fall_of_noise,
    model_error_factor,
    second_order,
    significant_modes,
)
from tactile_resonance.poles.tables import FitPlan

Plan = TypeVar("Plan", bound=FitPlan)

# Squares of this number cancel in the variance of a residue. Beyond it rounding leaves nothing of that
# variance, and a mode cannot be distinguished from noise.
LARGEST_CONDITION_NUMBER = 6.7e7
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
        nothing: dict[str, tuple[Any, ...]] = {  # shape, value, kind
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
            "doubt": ((batch,), None, object),
            "remark": ((batch,), "", object),
        }
        for name in nothing.keys() - values.keys():
            values[name] = np.full(*nothing[name])
        values.setdefault("total", None)
        return cls(lines=lines, **values)

    def put(self, rows: IntArray, others: Judged) -> None:
        """Write other points in place of some."""
        for f in fields(self):
            if getattr(self, f.name) is not None:
                getattr(self, f.name)[rows] = getattr(others, f.name)

    def total_with_model_error(self) -> tuple[IntArray, FloatArray]:
        """Points of which more than noise is known, and their total covariances, with the model error."""
        if self.total is None:
            rows = self.suspect.nonzero()[0]
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
    quantities["total_covariance"] = np.full(quantities["covariance"].shape, np.nan)
    rows, total = judged.total_with_model_error()
    if rows.size:
        in_f0 = propagated(quantities["poles_rad_s"][rows], sensitivity[rows], total)[1]
        in_f0[hopeless[rows]] = np.nan
        quantities["total_covariance"][rows] = in_f0 + judged.systematic[rows]
    lost = judged.level_known & ~hopeless & _lost_to_rounding(quantities["covariance"]).any(axis=-1)
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
    # the gravest last, so that it stays
    for where, status in (
        (~(judged.level_known & np.isfinite(covariance[:, 0, 0])), PolesStatus.NO_COVARIANCE),
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

    return PolesBatch(
        **{name: batch(values) for name, values in quantities.items()},
        coefficient_covariance=batch(covariance),
        **{name: batch(getattr(judged, name)) for name in AS_JUDGED},
        significant=batch(significant),
        status_code=batch(code),
        fit=plan.model_of(batch(judged.theta)),
        structure=structure,
        band_hz=band_hz,
        variance_model=batch(NAMES[judged.kind]),
        method=method,
        remark=batch(remark),
    )


def _lost_to_rounding(covariance: FloatArray) -> BoolArray:
    """(batch, k) where a variance of a mode's covariance (batch, k, 2, 2) is not above 0.

    A mode beside its own zero leaves the normal matrix all but singular.
    """
    return np.asarray((covariance[..., 0, 0] <= 0) | (covariance[..., 1, 1] <= 0))


def _needed(
    judged: Judged,
    parameters: int,
    beside: BoolArray,
    costs_with_less: Callable[[IntArray], FloatArray],
) -> BoolArray:
    """(batch, k) modes `beside` others whose residue noise could make, but without which the fit is worse.

    Two modes nearer than their widths share what the lines say of them, so that the residue of one may be
    uncertain, and only a fit without it tells; see `significance.fall_of_noise`.
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
    lost = _lost_to_rounding(total)
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
