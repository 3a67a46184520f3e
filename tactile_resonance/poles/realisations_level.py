# SPDX-License-Identifier: Apache-2.0
"""Levels of noise and distortion of several realisations, and what contradicts the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_resonance.poles.fit import RecordsInverse, Solution
from tactile_resonance.poles.joint_fit import student_variance
from tactile_resonance.poles.joint_layout import JointLayout
from tactile_resonance.poles.likelihood import invert
from tactile_resonance.poles.model_error import MODEL_ERROR_PROBABILITY
from tactile_resonance.poles.noise_level import f_quantile
from tactile_resonance.poles.scatter import Pieces, Scatter

BoolArray = npt.NDArray[np.bool_]
FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

# Noise alone looks like distortion this often; it is then weighted as such, at next to no loss.
DISTORTION_PROBABILITY = 1e-2


@dataclass(frozen=True, eq=False)
class Levels:
    """Variances of a batch in units of those weighted with.

    Attributes
    ----------
    scatter : Scatter
    inverse : RecordsInverse
    normal : (batch, M, 2, n, n) float
        Of undriven and driven bins.
    between : (batch,) float
        From the bins between harmonics: noise; NaN where there are none.
    between_dof : (batch,) float
        Complex degrees of freedom of it.
    excited : (batch,) float
        From what realisations differ by on excited lines: noise and distortion.
    excited_dof, common_dof : (batch,) float
    cost, expected, limit : (batch,) float
        Of what realisations have in common, over `excited`: as found, expected, and exceeded by
        chance once in a thousand times.
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

    scatter: Scatter
    inverse: RecordsInverse
    normal: FloatArray
    between: FloatArray
    between_dof: FloatArray
    excited: FloatArray
    excited_dof: FloatArray
    common_dof: FloatArray
    cost: FloatArray
    expected: FloatArray
    limit: FloatArray
    line_variance: FloatArray
    piece_dof: FloatArray

    @classmethod
    def of(
        cls,
        layout: JointLayout,
        solution: Solution,
        u: ComplexArray,
        variance: FloatArray,
        pieces: Pieces,
        by_piece: BoolArray,
    ) -> Levels:
        """Levels of a fit.

        Parameters
        ----------
        layout : JointLayout
        solution : Solution
        u : (batch, M, K_e) complex
            Input on excited lines.
        variance : (batch, K_e) float
            That these were weighted with.
        pieces : Pieces
        by_piece : (batch,) bool
            Where that variance is from each of the pieces alone.
        """
        a, b, _ = layout.problem.sizes
        shared = a + b
        batch, records, lines = solution.residual.shape
        scatter = Scatter.of(solution.residual, u)
        inverse = RecordsInverse.of(solution.normal.sum(axis=2), shared)
        used = inverse.leverage(solution.normal[:, :, 1])
        # what the transients take from a line: of each a part 1/M of what all have in common
        taken = _taken_by_transients(layout, solution, variance)
        line_dof = (records - 1) * np.maximum(1 - taken / (2 * records), 0.05)
        excited_dof = np.maximum(line_dof.sum(axis=-1), 0.5)
        common_dof = np.maximum(records * lines - used / 2 - excited_dof, 0.5)
        excited = scatter.differing_cost / excited_dof
        between = between_dof = np.full(batch, np.nan)
        if layout.other_bins.size > 0:
            used_between = inverse.leverage(solution.normal[:, :, 0])
            between_dof = records * layout.other_bins.size - used_between / 2
            between = solution.part_cost[:, 0] / between_dof
        cost = scatter.common_cost / excited
        nu = np.where(by_piece, float(pieces.dof), excited_dof)
        expected = common_dof * np.where(nu > 1, nu / (nu - 1), np.nan)
        limit = common_dof * f_quantile(
            1 - MODEL_ERROR_PROBABILITY, 2 * common_dof, 2 * excited_dof
        )
        if by_piece.any():
            # sums over pieces of F(2 lines, 2 nu): as a chi-square of the same mean and variance
            spread = (pieces.lines + nu - 1) / (lines * (nu - 2))
            scaled = f_quantile(1 - MODEL_ERROR_PROBABILITY, 2 / spread, np.full(batch, 1e12))
            limit = np.where(by_piece, expected * scaled, limit)
        return cls(
            scatter,
            inverse,
            solution.normal,
            between,
            between_dof,
            excited,
            excited_dof,
            common_dof,
            cost,
            expected,
            limit,
            scatter.line_cost / line_dof,
            np.where(by_piece, float(pieces.dof), 0.0),
        )

    def distorted(self, chance: float = DISTORTION_PROBABILITY) -> BoolArray:
        """(batch,) whether realisations differ by more than the noise between harmonics explains."""
        limit = f_quantile(1 - chance, 2 * self.excited_dof, 2 * self.between_dof)
        return np.asarray(self.excited > limit * self.between)

    def _residual_level(self, suspect: BoolArray) -> tuple[FloatArray, FloatArray]:
        """(batch,) level of the excited lines and its degrees of freedom.

        With what realisations have in common, where that is no model error.
        """
        alone = suspect | (self.piece_dof > 0)
        dof = self.excited_dof + np.where(alone, 0.0, self.common_dof)
        cost = self.excited * self.excited_dof + np.where(alone, 0.0, self.scatter.common_cost)
        return cost / dof, dof

    def noise_level(self, suspect: BoolArray) -> FloatArray:
        """(batch,) of the noise; without bins between harmonics of noise and distortion."""
        return self._noise_level(suspect)[0]

    def _noise_level(self, suspect: BoolArray) -> tuple[FloatArray, FloatArray]:
        level, dof = self._residual_level(suspect)
        if np.isnan(self.between_dof).all():
            return level, dof
        both = self.between_dof + dof
        pooled = (self.between * self.between_dof + level * dof) / both
        apart = self.distorted()
        return np.where(apart, self.between, pooled), np.where(apart, self.between_dof, both)

    def covariances(
        self, suspect: BoolArray, noise_normal: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Covariances (batch, s, s) of the shared coefficients, from noise and in total.

        Parameters
        ----------
        suspect : (batch,) bool
            Where the model is in error.
        noise_normal : (batch, M, n, n) float or None
            Covariance of the gradient on excited lines from their noise alone; None where that is
            all they were weighted with.
        """
        level, dof = self._residual_level(suspect)
        between, between_dof = self._noise_level(suspect)
        with np.errstate(divide="ignore", invalid="ignore"):
            nu = self.piece_dof
            pieces = np.where(nu > 2, nu / (nu - 2), 1.0)
            last = self.normal[:, :, 1]
            if np.isnan(self.between_dof).all():
                both = 0.5 * (level * student_variance(dof) * pieces)[:, None, None]
                return both * self.inverse.shared, both * self.inverse.shared
            first = self.normal[:, :, 0]
            noise = self.inverse.shared
            if noise_normal is not None:
                between = self.between
                between_dof = self.between_dof
                noise = self.inverse.sandwich(first + noise_normal)
            more = level / between
            if noise_normal is None:  # there is no less than the noise
                more = np.maximum(more, 1.0)
            total = self.inverse.sandwich(first + last * more[:, None, None, None])
            scale = 0.5 * between * pieces
            total_dof = np.where(more == 1, between_dof, dof)
            return (
                noise * (scale * student_variance(between_dof))[:, None, None],
                total * (scale * student_variance(total_dof))[:, None, None],
            )


def _taken_by_transients(
    layout: JointLayout, solution: Solution, variance: FloatArray
) -> FloatArray:
    """(batch, K_e) real coefficients of all transients that go to each excited line.

    Leverages with A and B as they are. A transient is large where the response is, and takes most
    there.
    """
    a, b, own = layout.problem.sizes
    problem = layout.problem
    driven = slice(problem.undriven, None)
    alpha, _, _ = layout.problem.split(solution.theta[:, 0])
    size = alpha @ problem.denominator[driven].T
    basis = problem.transient[driven]
    blocks = solution.normal[..., a + b :, a + b :].sum(axis=2)
    inverse = invert(blocks.reshape(-1, own, own))[0].reshape(blocks.shape).sum(axis=1)
    products = np.real(basis.conj()[:, :, None] * basis[:, None, :]).reshape(-1, own * own)
    return (inverse.reshape(-1, own * own) @ products.T) / (
        variance * (size.real**2 + size.imag**2)
    )
