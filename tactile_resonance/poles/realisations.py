# SPDX-License-Identifier: Apache-2.0
"""Poles from all bins of the band of several records: other phases and a transient in each.

Several realisations of the phases tell stochastic nonlinear distortion from noise, and from errors of
the model: the best linear approximation is what they have in common (Pintelon & Schoukens, *System
Identification: A Frequency Domain Approach*, 2nd ed. (2012), chapter 4). Estimated are one A and B and
M numerators C of transients.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from tactile_resonance.poles.joint import ComplexArray, JointPlan, result_of
from tactile_resonance.poles.joint_fit import CHUNK, JointFit
from tactile_resonance.poles.joint_layout import IntArray, JointLayout
from tactile_resonance.poles.model_error import richer
from tactile_resonance.poles.realisations_fit import fit_realisations
from tactile_resonance.poles.result import PolesBatch


@dataclass(frozen=True, eq=False)
class PoleEstimator(JointPlan):
    """Poles from several records of one kind each; parameters are those of `JointLayout`.

    Of one period each there are no bins between harmonics: realisations then tell noise and
    distortion together, and `covariance` holds both. Input noise counts as none, or as
    `input_noise_ratio` of that of the output where given. `total_covariance` holds also what the
    poles of the realisations scatter by, see `realisations_spread`.

    Harmonics of the period that are not excited carry distortion and are not used. A single
    realisation cannot tell any of this, and is left to `JointPlan`.

    Examples
    --------
    >>> plan = PoleEstimator(50e3, 20000, 8, np.arange(4, 4001), (200.0, 300.0))
    >>> poles = plan(u, y)  # u, y: (..., M, 8, 20000)
    """

    def from_bins(self, u: ComplexArray, y: ComplexArray) -> PolesBatch:
        """Poles from the bins of the band of the DFTs of whole records.

        Parameters
        ----------
        u, y : (..., M, K) complex
            At ``bins``, of M realisations.

        Returns
        -------
        PolesBatch
            With the leading axes but the last one. Its `fit` holds the coefficients of the M
            transients one after the other, its `coefficient_covariance` those of A and B alone.
        """
        u, y = self._checked(u, y)
        if y.ndim < 2:
            raise ValueError(f"u, y: shape {y.shape}, expected (..., M, {self.bins.size})")
        *shape, records, size = y.shape
        if records == 1:
            return self._single.from_bins(u[..., 0, :], y[..., 0, :])
        flat_u, flat_y = (v.reshape(-1, records, size) for v in (u, y))
        chunk = max(1, CHUNK // records)
        starts = range(0, max(flat_u.shape[0], 1), chunk)
        parts = [
            fit_realisations(self, flat_u[k : k + chunk], flat_y[k : k + chunk]) for k in starts
        ]
        method = f"joint maximum likelihood of poles and transients, {records} realisations"
        return result_of(self, JointFit.joined(parts), tuple(shape), method, True)

    @cached_property
    def _single(self) -> JointPlan:
        return JointPlan(*self._arguments)

    @cached_property
    def richer(self) -> JointLayout | None:
        """With one mode more; None where the band holds too few lines for it."""
        arguments = list(self._arguments)
        arguments[5], arguments[6] = richer(self.structure), None
        try:
            return PoleEstimator(*arguments)
        except ValueError:
            return None

    @property
    def _arguments(self) -> tuple:
        return (
            self.sample_rate_hz,
            self.samples_per_period,
            self.periods,
            self.harmonics,
            self.band_hz,
            self.structure,
            self.transient_terms,
            self.input_noise_ratio,
            self.left_out,
        )

    def _between(self, bins: IntArray, excited: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        return np.asarray(~excited & (bins % self.periods != 0))
