# SPDX-License-Identifier: Apache-2.0
"""Where each realisation alone puts the poles: a nonlinear resonator is another system in each.

Its departures are not independent from line to line, so what lines scatter by says too little of
them; what the realisations' poles scatter by does. That scatter has few degrees of freedom: ellipses
are widened by the quantile of Student's distribution that belongs to them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy import special

from tactile_resonance._typing import BoolArray, FloatArray, IntArray
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.likelihood import invert, moments
from tactile_resonance.poles.model import real_rows
from tactile_resonance.poles.model_error import MODEL_ERROR_PROBABILITY
from tactile_resonance.poles.result import natural_frequency_and_damping_jacobian

if TYPE_CHECKING:
    from tactile_resonance.poles.joint import JointPlan


# Scatter that chance makes more often says nothing; the rarer it is, the more it counts. A test that is
# passed or not would pass differences of the size of the noise, and ellipses would hold 80 to 90 %.
CHANCE = 0.5
# Fewer cannot show whether one is off, or all differ.
FEWEST_RECORDS = 4
# Share of errors (f0, damping) within the ellipse.
INSIDE = 0.95


@dataclass(frozen=True, eq=False)
class Spread:
    """Departures of each realisation, one step from what all share.

    Attributes
    ----------
    step : (batch, s) float
        Mean departure of the shared coefficients.
    departure : (batch, M, places, 2) float
        Of (f0_hz, damping_ratio); NaN where there is no mode.
    expected : (batch, M, places, 2) float
        Its variance, if lines scattered independently.
    dof : (batch,) float
        Real degrees of freedom of what that rests on.
    turn : (batch, places, 2, a) float
        Derivative of (f0_hz, damping_ratio) by the coefficients of A.
    """

    step: FloatArray
    departure: FloatArray
    expected: FloatArray
    dof: FloatArray
    turn: FloatArray

    @classmethod
    def of(
        cls,
        plan: JointPlan,
        data: BinData,
        theta: FloatArray,
        inner: FloatArray,
        dof: FloatArray,
    ) -> Spread:
        """Departures from a fit.

        Parameters
        ----------
        plan : JointPlan
        data : BinData
            With the variances that it was weighted with.
        theta : (batch, M, n) float
            The fit.
        inner : (batch, M, n, n) float
            Covariance of the gradient of each realisation, twice, if lines scattered independently.
        dof : (batch,) float
            Complex degrees of freedom of that.
        """
        a, b, _ = plan.problem.sizes
        batch, records, n = theta.shape
        _, gradient, normal = moments(plan.problem.tables, data, theta)
        inverse = invert(normal.sum(axis=2).reshape(-1, n, n))[0]
        step = -(inverse @ gradient.reshape(-1, n, 1))[:, : a + b, 0]
        inverse = inverse[:, :a]  # (batch M, a, n)
        covariance = 0.5 * inverse @ inner.reshape(-1, n, n) @ inverse.swapaxes(-1, -2)
        step = step.reshape(batch, records, a + b)
        covariance = covariance.reshape(batch, records, a, a)
        poles = plan.poles_in_band(theta[:, 0])
        _, sensitivity = plan.model_of(theta[:, 0]).residues_and_sensitivity(poles)  # (batch, places, a)
        turn = natural_frequency_and_damping_jacobian(poles) @ real_rows(sensitivity)
        departure = np.einsum("bpia,bma->bmpi", turn, step[..., :a])
        expected = np.einsum("bpia,bmac,bpic->bmpi", turn, covariance, turn)
        return cls(step.mean(axis=1), departure, expected, 2 * dof, turn)

    @property
    def records(self) -> int:
        """M."""
        return self.departure.shape[1]

    @property
    def information(self) -> FloatArray:
        """(batch, M, places, 2) share of each realisation in the information of all."""
        information = 1 / self.expected
        return np.asarray(information / information.sum(axis=1, keepdims=True))

    @property
    def ratio(self) -> FloatArray:
        """(batch, places, 2) scatter over what independent lines explain."""
        rest = self._rest(self.information)
        return np.asarray(np.sum(rest**2 / self.expected, axis=1) / (self.records - 1))

    @property
    def known(self) -> BoolArray:
        """(batch,) whether each realisation alone determines a pole."""
        return np.asarray(np.isfinite(self.ratio).any(axis=(1, 2)))

    @property
    def chance(self) -> FloatArray:
        """(batch,) how often one system scatters as much, in f0 or damping of any mode; NaN: not known."""
        p = special.fdtrc(self.records - 1, self.dof[:, None, None], self.ratio)
        p = np.where(np.isfinite(p), p, np.inf).min(axis=(1, 2), initial=np.inf)
        known = self.known & np.isfinite(p)
        return np.where(known, 1 - (1 - np.where(known, p, 1.0)) ** (2 * self.ratio.shape[1]), np.nan)

    @property
    def weight(self) -> FloatArray:
        """(batch,) from 0, where chance explains the scatter, to 1."""
        return np.nan_to_num(np.clip(1 - self.chance / CHANCE, 0.0, 1.0))

    def variance_of_mean(self, alike: BoolArray) -> FloatArray:
        """(batch, places, 2) of (f0_hz, damping_ratio), for an ellipse as of many degrees of freedom.

        Widened so that it holds both errors in 95 %, also where they are fully correlated:
        ``2 t^2 / chi^2`` of M - 1 and of two degrees of freedom.

        Parameters
        ----------
        alike : (batch,) bool
            Whether realisations count alike in the mean, not by their information.
        """
        share = np.where(alike[:, None, None, None], 1 / self.records, self.information)
        of_mean = np.sum((share * self._rest(share)) ** 2, axis=1)
        quantile = special.stdtrit(self.records - 1, (1 + INSIDE) / 2)
        wider = 2 * quantile**2 / special.chdtri(2, 1 - INSIDE)
        return np.asarray(wider * self.records / (self.records - 1) * of_mean)

    def of_poles(self, covariance: FloatArray) -> FloatArray:
        """(batch, places, 2) variances of (f0_hz, damping_ratio) from a covariance (batch, s, s)."""
        a = self.turn.shape[-1]
        return np.asarray(
            np.einsum("bpia,bac,bpic->bpi", self.turn, covariance[:, :a, :a], self.turn)
        )

    def remarks(self) -> tuple[BoolArray, npt.NDArray[np.object_]]:
        """(batch,) where one realisation contradicts the others, and a note for people."""
        surely = self.chance < MODEL_ERROR_PROBABILITY
        if not surely.any():
            return surely, np.full(surely.size, "", object)
        odd, away = self._odd_one()
        size = np.sqrt(np.nan_to_num(self.ratio).max(axis=(1, 2), initial=0.0))
        remarks = np.full(size.size, "", object)
        for k in np.flatnonzero(surely):
            remarks[k] = (
                f"poles of {self.records} realisations scatter {size[k]:.1f} times as much as noise and "
                "distortion of independent lines make them: each is another system"
            )
            if odd[k] >= 0:
                remarks[k] = (
                    f"realisation {odd[k] + 1} departs from the other {self.records - 1}, which agree, by "
                    f"{away[k]:.1f} deviations"
                )
        return surely & (odd >= 0), remarks

    def _rest(self, share: FloatArray) -> FloatArray:
        """(batch, M, places, 2) departures from their mean."""
        mean = np.sum(share * self.departure, axis=1, keepdims=True)
        return np.asarray(self.departure - mean)

    def _odd_one(self) -> tuple[IntArray, FloatArray]:
        """(batch,) the realisation that departs from all others, which agree, or -1; by how many deviations."""
        batch, records = self.departure.shape[:2]
        odd, size = np.full(batch, -1), np.zeros(batch)
        if records < FEWEST_RECORDS:
            return odd, size
        limit = -special.ndtri(MODEL_ERROR_PROBABILITY / (4 * records))
        for m in range(records):
            rest = np.arange(records) != m
            others = replace(
                self, departure=self.departure[:, rest], expected=self.expected[:, rest]
            )
            mean = np.sum(others.information * others.departure, axis=1)
            spread = self.expected[:, m] + 1 / np.sum(1 / others.expected, axis=1)
            away = np.abs(self.departure[:, m] - mean) / np.sqrt(spread)
            away = np.nan_to_num(away).max(axis=(1, 2), initial=0.0)
            here = (away > limit) & (away > size) & (others.weight == 0)
            odd[here], size[here] = m, away[here]
        return odd, size
