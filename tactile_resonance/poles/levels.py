# SPDX-License-Identifier: Apache-2.0
"""Levels of noise and distortion that a fit to records shows, and whether its cost contradicts the model.

An error of the model is an error of the response: turned by the phase of the input it is the same in
every realisation. Noise and stochastic nonlinear distortion differ (Pintelon & Schoukens, *System
Identification: A Frequency Domain Approach*, 2nd ed. (2012), section 4.3). So of M residuals on a
line one combination may hold model error, and the M - 1 others give the variance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.joint_noise import BINS_PER_BAND
from tactile_resonance.poles.likelihood import Solution, invert
from tactile_resonance.poles.model_error import MODEL_ERROR_PROBABILITY
from tactile_resonance.poles.noise_level import (
    Pieces,
    is_rare,
    log_linear,
    model_variance,
    moments_of_ratio,
    student_variance,
    two_channels,
)

if TYPE_CHECKING:
    from tactile_resonance.poles.joint import JointPlan


# Noise alone looks like distortion this often; it is then weighted as such, at next to no loss.
DISTORTION_PROBABILITY = 1e-2
# Degrees of freedom that a variance known from a piece of the band alone should have, and the fewest.
PIECE_DOF = 24
FEWEST_PIECE_DOF = 8
# Pieces that are wanted before their degrees of freedom are.
WANTED_PIECES = 5


@dataclass(frozen=True, eq=False)
class Level:
    """Noise level of points of one record, in units of the variances weighted with.

    Attributes
    ----------
    scale : (batch,) float
        Level that covariances are of.
    cost, expected, suspect, noise
        See `judgement.Judged`.
    correction : (batch,) float
        Factor of the covariance for a level that is not known exactly.
    """

    scale: FloatArray
    cost: FloatArray
    expected: FloatArray
    suspect: BoolArray
    noise: FloatArray
    correction: FloatArray

    @classmethod
    def of(
        cls,
        plan: JointPlan,
        solution: Solution,
        noise: FloatArray,
        by_piece: BoolArray,
    ) -> Level:
        """Level of a fit.

        Without bins between harmonics it is from the residuals, and a model error hides in it unless they
        are smooth. With such bins these give the level, and the excited ones whether the model holds.

        Parameters
        ----------
        plan : JointPlan
        solution : Solution
        noise : (batch, 2) float
            Mean variances of Y and U weighted with.
        by_piece : (batch,) bool
            Where the variances are from each of the pieces of the band alone.
        """
        batch, _, n = solution.theta.shape
        lines, others = plan.excited_at.size, plan.others_at.size
        if others == 0:
            dof = np.full(batch, max(lines - n / 2, 0.5))
            scale, nothing = solution.cost / dof, np.full(batch, np.nan)
            no = np.zeros(batch, bool)
            return cls(scale, nothing, nothing, no, noise * scale[:, None], student_variance(dof))
        used = solution.leverage[:, 0]
        dof_o = others - used / 2
        dof_e = lines - (n - used) / 2
        dof = dof_e + dof_o
        level = solution.part_cost[:, 0] / dof_o
        cost = solution.part_cost[:, 1] / level
        expected = dof_e * dof_o / (dof_o - 1)
        suspect = is_rare(cost / dof_e, dof_e, dof_o, MODEL_ERROR_PROBABILITY)
        correction = student_variance(dof)
        if by_piece.any():
            mean, std = moments_of_ratio(BINS_PER_BAND)  # weights are from few bins
            limit = dof_e * mean - np.sqrt(dof_e) * std * special.ndtri(MODEL_ERROR_PROBABILITY)
            expected = np.where(by_piece, expected * mean, expected)
            suspect = np.where(by_piece, cost > limit, suspect)
            correction = np.where(by_piece, BINS_PER_BAND / (BINS_PER_BAND - 2), correction)
        scale = np.where(suspect, level, solution.part_cost.sum(axis=-1) / dof)
        return cls(scale, cost, expected, suspect, noise * level[:, None], correction)


def line_pieces(lines: int, dof: int) -> Pieces:
    """Pieces of lines with a sample variance of `dof` degrees of freedom each."""
    size = min(-(-PIECE_DOF // dof), max(1, lines // WANTED_PIECES))
    return Pieces.of(lines, max(size, -(-FEWEST_PIECE_DOF // dof)), dof)


def smooth_variance(
    sample: FloatArray, gain: FloatArray, pieces: Pieces
) -> tuple[FloatArray, IntArray]:
    """Variance on each line from sample variances, and its kind as index into `KINDS`.

    Flat on both channels unless a test says otherwise, then sloped, then piece by piece.

    Parameters
    ----------
    sample : (batch, K) float
    gain : (batch, K) float
        ``|G|^2``.
    pieces : Pieces
    """
    kind = model_variance(pieces.means(sample), pieces.dof, pieces.means(gain)).kind
    variance = two_channels(sample, gain)
    sloped, each = kind == 1, kind == 2
    if sloped.any():  # with noise of both channels, whose sum follows the resonance
        curve = log_linear(sample[sloped])
        more = two_channels(sample[sloped] / curve, gain[sloped])
        variance[sloped] = curve * more
    if each.any():
        variance[each] = pieces.means(sample[each])[:, pieces.of_bin]
    return variance, kind


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
        """Levels of a fit.

        Parameters
        ----------
        plan : JointPlan
        solution : Solution
        u : (batch, M, K_e) complex
            Input on excited lines.
        variance : (batch, K_e) float
            That these were weighted with.
        pieces : Pieces
        by_piece : (batch,) bool
            Where that variance is from each of the pieces alone.
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
            # sums over pieces of F(2 lines, 2 nu): as a chi-square of the same mean and variance
            spread = (pieces.size + nu - 1) / (lines * (nu - 2))
            of_pieces = special.chdtrc(2 / spread, 2 / spread * cost / expected)
            chance = np.where(by_piece, of_pieces, chance)
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

    def _residual_level(self, suspect: BoolArray) -> tuple[FloatArray, FloatArray]:
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
        level, dof = self._residual_level(suspect)
        if np.isnan(self.between_dof).all():
            return level, dof
        both = self.between_dof + dof
        pooled = (self.between * self.between_dof + level * dof) / both
        apart = self.distorted()
        return np.where(apart, self.between, pooled), np.where(apart, self.between_dof, both)

    def covariances(
        self, solution: Solution, shared: int, suspect: BoolArray, noise_normal: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Covariances (batch, s, s) of the shared coefficients, from noise and in total.

        Parameters
        ----------
        solution : Solution
        shared : int
            How many coefficients realisations share.
        suspect : (batch,) bool
            Where the model is in error.
        noise_normal : (batch, M, n, n) float or None
            Covariance of the gradient on excited lines from their noise alone; None where that is
            all they were weighted with.
        """
        level, dof = self._residual_level(suspect)
        between, between_dof = self.noise_level(suspect)
        with np.errstate(divide="ignore", invalid="ignore"):
            nu = self.piece_dof
            pieces = np.where(nu > 2, nu / (nu - 2), 1.0)
            first, last = solution.normal[:, :, 0], solution.normal[:, :, 1]
            noise = solution.marginal[:, 0, :shared, :shared]
            if np.isnan(self.between_dof).all():
                both = 0.5 * (level * student_variance(dof) * pieces)[:, None, None]
                return both * noise, both * noise
            if noise_normal is not None:
                between, between_dof = self.between, self.between_dof
                noise = solution.sandwich(first + noise_normal, shared)
            more = level / between
            if noise_normal is None:  # there is no less than the noise
                more = np.maximum(more, 1.0)
            total = solution.sandwich(first + last * more[:, None, None, None], shared)
            scale = 0.5 * between * pieces
            total_dof = np.where(more == 1, between_dof, dof)
            return (
                noise * (scale * student_variance(between_dof))[:, None, None],
                total * (scale * student_variance(total_dof))[:, None, None],
            )


def _taken_by_transients(plan: JointPlan, solution: Solution, variance: FloatArray) -> FloatArray:
    """(batch, K_e) real coefficients of all transients that go to each excited line.

    Leverages with A and B as they are. A transient is large where the response is, and takes most
    there.
    """
    a, b, own = plan.problem.sizes
    of_a, _, basis = plan.problem.driven_bases
    size = plan.problem.split(solution.theta[:, 0])[0] @ of_a.T
    blocks = solution.normal[..., a + b :, a + b :].sum(axis=2)
    inverse = invert(blocks.reshape(-1, own, own))[0].reshape(blocks.shape).sum(axis=1)
    products = np.real(basis.conj()[:, :, None] * basis[:, None, :]).reshape(-1, own * own)
    return (inverse.reshape(-1, own * own) @ products.T) / (
        variance * (size.real**2 + size.imag**2)
    )
