# SPDX-License-Identifier: Apache-2.0
"""Normal equations whose matrix is a block arrow: coefficients all records share, and those of each.

The transients of M records couple through the shared coefficients alone, so each is eliminated by
itself (Schur complement) and the cost of a step grows as M, not as its cube (Golub & Van Loan, *Matrix
Computations*, 4th ed. (2013), section 3.2.11). Blocks come as the normal matrices of each record by
itself, (batch, M, n, n), of which the first `shared` rows and columns add up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.covariance import invert_normal
from tactile_resonance.identification.normal_equations import solve_positive, solve_scaled

FloatArray = npt.NDArray[np.float64]


def solve_arrow(
    normal: FloatArray, gradient: FloatArray, shared: int, damping: FloatArray | float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """``(N + damping diag N)^-1 gradient`` and the gradient times it.

    Parameters
    ----------
    normal : (batch, M, n, n) float
    gradient : (batch, M, n) float
    shared : int
    damping : (batch,) float or float

    Returns
    -------
    step : (batch, M, n) float
        Its first `shared` entries are alike in all records; NaN where a block is not positive.
    decrement : (batch,) float
    """
    batch, records, n = gradient.shape
    each = np.broadcast_to(np.asarray(damping, float), batch)
    coupling, solved, schur, right = _eliminated(normal, gradient, shared, each)
    common = solve_scaled(schur, right)[0]  # (batch, shared)
    step = np.empty((batch, records, n))
    step[..., :shared] = common[:, None]
    step[..., shared:] = solved - (coupling @ common[:, None, :, None])[..., 0]
    decrement = np.einsum("bmi,bmi->b", step, gradient)
    return step, decrement


def _eliminated(
    normal: FloatArray, gradient: FloatArray, shared: int, damping: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """``D^-1 F`` (batch, M, own, shared), ``D^-1 g`` (batch, M, own), Schur complement and its right side.

    D is the block of a record's own coefficients, F its coupling to the shared ones.
    """
    batch, records, n, _ = normal.shape
    own = normal[..., shared:, shared:].reshape(-1, n - shared, n - shared)
    f = normal[..., shared:, :shared]  # (batch, M, own, shared)
    right = np.concatenate([f, gradient[..., shared:, None]], axis=-1)
    trace = 1e-15 + np.repeat(damping, records)
    solution, good = solve_positive(own, right.reshape(-1, n - shared, shared + 1), trace)
    solution[~good] = np.nan
    solution = solution.reshape(batch, records, n - shared, shared + 1)
    coupling, solved = solution[..., :-1], solution[..., -1]
    top = normal[..., :shared, :shared].sum(axis=1)  # (batch, shared, shared)
    index = np.arange(shared)
    top[:, index, index] *= 1 + damping[:, None]
    schur = top - np.einsum("bmci,bmcj->bij", f, coupling)
    total = gradient[..., :shared].sum(axis=1) - np.einsum("bmci,bmc->bi", f, solved)
    return coupling, solved, schur, total


@dataclass(frozen=True, eq=False)
class ArrowInverse:
    """Inverse of block-arrow matrices.

    Attributes
    ----------
    shared : (batch, s, s) float
        Its block of the shared coefficients.
    marginal : (batch, M, n, n) float
        Its block of the shared coefficients and those of one record.
    projection : (batch, M, s, n) float
        What the gradient of a record moves the shared coefficients by: their step is the sum.
    condition : (batch,) float
        As of `covariance.invert_normal` for the whole matrix.
    """

    shared: FloatArray
    marginal: FloatArray
    projection: FloatArray
    condition: FloatArray

    @classmethod
    def of(cls, normal: FloatArray, shared: int) -> ArrowInverse:
        """Inverse of blocks (batch, M, n, n); NaN where a matrix is singular or not finite."""
        batch, records, n, _ = normal.shape
        zero = np.zeros(batch)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            coupling, _, schur, _ = _eliminated(normal, np.zeros((batch, records, n)), shared, zero)
            inverse, _ = invert_normal(schur)
            own, _ = invert_normal(
                normal[..., shared:, shared:].reshape(-1, n - shared, n - shared)
            )
            own = own.reshape(batch, records, n - shared, n - shared)
            cross = -coupling @ inverse[:, None]  # (batch, M, own, shared)
            spread = -cross @ coupling.swapaxes(-1, -2)
            marginal = np.empty((batch, records, n, n))
            marginal[..., :shared, :shared] = inverse[:, None]
            marginal[..., shared:, :shared] = cross
            marginal[..., :shared, shared:] = cross.swapaxes(-1, -2)
            marginal[..., shared:, shared:] = own + spread
            projection = np.concatenate(
                [
                    np.broadcast_to(inverse[:, None], (batch, records, shared, shared)),
                    cross.swapaxes(-1, -2),
                ],
                axis=-1,
            )
            condition = _condition(normal, marginal, coupling, inverse, spread, shared)
        return cls(inverse, marginal, projection, condition)

    def leverage(self, normal: FloatArray) -> FloatArray:
        """(batch,) real coefficients that go to the bins of normal matrices (batch, M, n, n)."""
        return np.einsum("bmij,bmji->b", self.marginal, normal)

    def sandwich(self, normal: FloatArray) -> FloatArray:
        """(batch, s, s) of the shared coefficients where gradients have these covariances (batch, M, n, n)."""
        return np.einsum("bmik,bmkl,bmjl->bij", self.projection, normal, self.projection)


def _condition(
    normal: FloatArray,
    marginal: FloatArray,
    coupling: FloatArray,
    inverse: FloatArray,
    spread: FloatArray,
    shared: int,
) -> FloatArray:
    """(batch,) root of the Frobenius condition number with unit diagonal.

    Blocks of the inverse between two records are ``coupling inverse coupling'``; their squares are
    summed without making them.
    """
    diagonal = np.diagonal(normal, axis1=-2, axis2=-1).copy()  # (batch, M, n)
    diagonal[..., :shared] = diagonal[..., :shared].sum(axis=1, keepdims=True)
    size = np.sqrt(diagonal)
    scaled = normal / size[..., :, None] / size[..., None, :]
    top = scaled[..., :shared, :shared].sum(axis=1)
    forward = np.sum(top**2, axis=(-2, -1)) + np.sum(
        2 * np.sum(scaled[..., shared:, :shared] ** 2, axis=(-2, -1))
        + np.sum(scaled[..., shared:, shared:] ** 2, axis=(-2, -1)),
        axis=-1,
    )
    back = marginal * size[..., :, None] * size[..., None, :]
    first, own = size[:, 0, :shared], size[..., shared:]
    of_one = np.sum((spread * own[..., :, None] * own[..., None, :]) ** 2, axis=(-2, -1))
    weighted = coupling * own[..., None] / first[:, None, None, :]
    gram = np.einsum("bmci,bmcj->bij", weighted, weighted)
    scaled_inverse = inverse * first[:, :, None] * first[:, None, :]
    product = gram @ scaled_inverse
    between = np.einsum("bij,bji->b", product, product) - of_one.sum(axis=-1)
    backward = (
        np.sum(back[:, 0, :shared, :shared] ** 2, axis=(-2, -1))
        + between
        + np.sum(
            2 * np.sum(back[..., shared:, :shared] ** 2, axis=(-2, -1))
            + np.sum(back[..., shared:, shared:] ** 2, axis=(-2, -1)),
            axis=-1,
        )
    )
    found = (forward * backward) ** 0.25
    return np.where(np.isfinite(found), found, np.inf)
