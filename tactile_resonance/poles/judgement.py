# SPDX-License-Identifier: Apache-2.0
"""What a batch of fits is worth: status and covariances."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tactile_resonance.poles.covariance import pole_quantities
from tactile_resonance.poles.lines_fit import LinesFit, LinesPlan
from tactile_resonance.poles.model_error import model_error_factor
from tactile_resonance.poles.result import (
    STATUS_CODE,
    FloatArray,
    PolesBatch,
    PolesStatus,
)
from tactile_resonance.poles.significance import significant_modes
from tactile_resonance.poles.structure import ModelStructure

BoolArray = npt.NDArray[np.bool_]

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
    level_known : bool or (batch,) bool
        Whether the variance is known otherwise than from the residuals.
    noise_variance : (batch, 2) float or None
        See `PolesBatch`.
    lacking : (batch, 3) float or None
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
    level_known: bool | BoolArray
    noise_variance: FloatArray | None = None
    lacking: FloatArray | None = None

    @classmethod
    def empty(cls, plan: LinesPlan, lines: npt.NDArray[np.int64]) -> Evidence:
        """Of a band with too few lines."""
        batch, n = lines.size, plan.structure.parameters
        nan = np.full(batch, np.nan)
        a, b, _ = plan.problem.sizes
        model = plan.model_of(np.full((batch, a + b), np.nan))
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
    significant = significant_modes(fit.model, quantities, covariance, evidence.lines)
    total_f0_damping = np.full_like(quantities["covariance"], np.nan)
    rows = np.flatnonzero(np.isfinite(total[:, 0, 0]))
    if rows.size:
        total_f0_damping[rows] = pole_quantities(
            fit.model if rows.size == total.shape[0] else fit.model.at((rows,)),
            band_hz,
            total[rows],
        )["covariance"]
    code = np.full(hopeless.shape, STATUS_CODE[PolesStatus.OK], np.uint8)
    with np.errstate(invalid="ignore"):
        # the gravest last, so that it stays
        for where, status in (
            (~np.asarray(evidence.level_known), PolesStatus.NO_COVARIANCE),
            (~np.isfinite(covariance[:, 0, 0]), PolesStatus.NO_COVARIANCE),
            (evidence.suspect, PolesStatus.MODEL_ERROR),
            ((significant & (poles.real >= 0)).any(axis=-1), PolesStatus.UNSTABLE_POLE),
            (~significant.any(axis=-1), PolesStatus.NO_RESONANCE),
            (~conditioned, PolesStatus.ILL_CONDITIONED),
            (~fit.converged, PolesStatus.NOT_CONVERGED),
            (~evidence.enough, PolesStatus.TOO_FEW_LINES),
        ):
            code[where] = STATUS_CODE[status]
    noise = evidence.noise_variance
    if noise is None:
        noise = np.full((code.size, 2), np.nan)
    lacking = evidence.lacking
    if lacking is None:
        lacking = np.full((code.size, 3), np.nan)

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
        significant=batch(significant),
        status_code=batch(code),
        noise_variance=batch(noise),
        lacking=batch(lacking),
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
