# SPDX-License-Identifier: Apache-2.0
"""Levels of noise and distortion that a fit to realisations shows, and whether these contradict the model.

An error of the model is an error of the response: turned by the phase of the input it is the same in
every realisation. Noise and stochastic nonlinear distortion differ (Pintelon & Schoukens, *System
Identification: A Frequency Domain Approach*, 2nd ed. (2012), section 4.3). So of M residuals on a
line one combination may hold model error, and the M - 1 others give the variance.

A nonlinear resonator is another system in each realisation. Its departures are not independent from line to
line, so what lines scatter by says too little of them; what the poles of each realisation alone scatter by
does. That scatter has few degrees of freedom: ellipses are widened by the quantile of Student's distribution
that belongs to them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy import special

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.likelihood import Solution, half_inverse, moments, sandwich
from tactile_resonance.poles.model import real_rows
from tactile_resonance.poles.noise_level import (
    CHANCE,
    MODEL_ERROR_PROBABILITY,
    Pieces,
    chance_of_pieces,
)
from tactile_resonance.poles.result import natural_frequency_and_damping_jacobian

if TYPE_CHECKING:
    from tactile_resonance.poles.joint import JointPlan


# Noise alone looks like distortion this often; it is then weighted as such, at next to no loss.
DISTORTION_PROBABILITY = 1e-2
# Fewer cannot show whether one is off, or all differ.
FEWEST_RECORDS = 4
# Share of errors (f0, damping) within the ellipse.
INSIDE = 0.95


@dataclass(frozen=True, eq=False)
class Levels:
    """Variances of a batch in units of those weighted with.

    Attributes
    ----------
    common : (batch, K_e) complex
        What weighted residuals of realisations have in common, with the variance of one residual; 0 on lines
        without input.
    between : (batch,) float
        From the bins between harmonics: noise; NaN where there are none.
    between_dof : (batch,) float
        Complex degrees of freedom of it.
    excited : (batch,) float
        From what realisations differ by on excited lines: noise and distortion.
    excited_dof, common_dof : (batch,) float
    cost, expected : (batch,) float
        Of what realisations have in common, over `excited`: as found, and expected.
    contradicts : (batch,) bool
        Whether chance exceeds this cost less than once in a thousand times.
    line_variance : (batch, K_e) float
        Sample variances of lines, M - 1 degrees of freedom each.
    piece_dof : (batch,) float
        Of the variances weighted with where they are those of pieces of the band; 0 elsewhere.

    Notes
    -----
    A level from nu complex degrees of freedom makes errors over their stated deviation Student
    distributed with 2 nu real ones: their covariance is ``nu / (nu - 1)`` times the plain one. Costs
    over a level are F distributed. Weights from pieces of nu degrees of freedom each cost
    information too: ``nu / (nu - 2)``, see `noise_level.VarianceModel.information_correction`.
    """

    common: ComplexArray
    between: FloatArray
    between_dof: FloatArray
    excited: FloatArray
    excited_dof: FloatArray
    common_dof: FloatArray
    cost: FloatArray
    expected: FloatArray
    contradicts: BoolArray
    line_variance: FloatArray
    piece_dof: FloatArray

    @classmethod
    def of(
        cls,
        plan: JointPlan,
        solution: Solution,
        u: ComplexArray,
        variance: FloatArray,
        pieces: Pieces,
        by_piece: BoolArray,
    ) -> Levels:
        """Levels of a fit to excited lines of inputs u (batch, M, K_e), weighted with `variance` (batch, K_e).

        Where `by_piece` (batch,) that is from each of the pieces alone.
        """
        batch, records, lines = solution.residual.shape
        size = np.abs(u)
        with np.errstate(divide="ignore", invalid="ignore"):
            whole = np.sqrt(np.sum(size**2, axis=1, keepdims=True))
            direction = np.where(whole > 0, size / whole, 0.0)
        common = np.einsum("bmk,bmk->bk", direction, solution.residual)
        rest = solution.residual - direction * common[:, None]
        differing = np.sum(rest.real**2 + rest.imag**2, axis=1)  # M - 1 degrees of freedom a line
        common_cost = np.sum(common.real**2 + common.imag**2, axis=-1)
        used_between, used = solution.leverage.T
        # what the transients take from a line: of each a part 1/M of what all have in common
        taken = _taken_by_transients(plan, solution, variance)
        line_dof = (records - 1) * np.maximum(1 - taken / (2 * records), 0.05)
        excited_dof = np.maximum(line_dof.sum(axis=-1), 0.5)
        common_dof = np.maximum(records * lines - used / 2 - excited_dof, 0.5)
        excited = differing.sum(axis=-1) / excited_dof
        between = between_dof = np.full(batch, np.nan)
        if plan.others_at.size > 0:
            between_dof = records * plan.others_at.size - used_between / 2
            between = solution.part_cost[:, 0] / between_dof
        cost = common_cost / excited
        nu = np.where(by_piece, float(pieces.dof), excited_dof)
        expected = common_dof * np.where(nu > 1, nu / (nu - 1), np.nan)
        ratio = cost / common_dof
        chance = special.fdtrc(2 * common_dof, 2 * excited_dof, ratio)
        if by_piece.any():
            chance = np.where(by_piece, chance_of_pieces(cost / expected, lines, pieces.size, nu), chance)
        return cls(
            common,
            between,
            between_dof,
            excited,
            excited_dof,
            common_dof,
            cost,
            expected,
            chance < MODEL_ERROR_PROBABILITY,
            differing / line_dof,
            np.where(by_piece, float(pieces.dof), 0.0),
        )

    def distorted(self) -> BoolArray:
        """(batch,) whether realisations differ by more than the noise between harmonics explains."""
        chance = special.fdtrc(2 * self.excited_dof, 2 * self.between_dof, self.excited / self.between)
        return np.asarray(chance < DISTORTION_PROBABILITY)

    def residual_level(self, suspect: BoolArray) -> tuple[FloatArray, FloatArray]:
        """(batch,) level of the excited lines and its degrees of freedom.

        With what realisations have in common, where that is no model error.
        """
        alone = suspect | (self.piece_dof > 0)
        dof = self.excited_dof + np.where(alone, 0.0, self.common_dof)
        common_cost = np.sum(self.common.real**2 + self.common.imag**2, axis=-1)
        cost = self.excited * self.excited_dof + np.where(alone, 0.0, common_cost)
        return cost / dof, dof

    def noise_level(self, suspect: BoolArray) -> tuple[FloatArray, FloatArray]:
        """(batch,) of the noise, and its dof; without bins between harmonics of noise and distortion."""
        level, dof = self.residual_level(suspect)
        if np.isnan(self.between_dof).all():
            return level, dof
        both = self.between_dof + dof
        pooled = (self.between * self.between_dof + level * dof) / both
        apart = self.distorted()
        return np.where(apart, self.between, pooled), np.where(apart, self.between_dof, both)


def _taken_by_transients(plan: JointPlan, solution: Solution, variance: FloatArray) -> FloatArray:
    """(batch, K_e) real coefficients of all transients that go to each excited line.

    Leverages with A and B as they are. A transient is large where the response is, and takes most
    there.
    """
    a, b, own = plan.problem.sizes
    of_a, _, basis = plan.problem.driven_bases
    size = plan.problem.split(solution.theta[:, 0])[0] @ of_a.T
    blocks = solution.normal[..., a + b :, a + b :].sum(axis=2)
    half = half_inverse(blocks.reshape(-1, own, own)).reshape(blocks.shape)
    inverse = (half.swapaxes(-1, -2) @ half).sum(axis=1)
    products = np.real(basis.conj()[:, :, None] * basis[:, None, :]).reshape(-1, own * own)
    return (inverse.reshape(-1, own * own) @ products.T) / (
        variance * (size.real**2 + size.imag**2)
    )


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
        """Departures from a fit theta (batch, M, n) to data with the variances that it was weighted with.

        `inner` (batch, M, n, n) is twice the covariance of the gradient of each realisation, if lines scattered
        independently, with complex `dof` (batch,).
        """
        a, b, _ = plan.problem.sizes
        batch, records, n = theta.shape
        _, gradient, normal = moments(plan.problem.tables, data, theta)
        half = half_inverse(normal.sum(axis=2).reshape(-1, n, n))
        step = -(half.swapaxes(-1, -2) @ (half @ gradient.reshape(-1, n, 1)))[:, : a + b, 0]
        covariance = 0.5 * sandwich(half, inner.reshape(-1, n, n))[:, :a, :a]
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
        p = np.fmin.reduce(p, axis=(1, 2), initial=np.nan)
        return np.asarray(1 - (1 - p) ** (2 * self.ratio.shape[1]))

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
