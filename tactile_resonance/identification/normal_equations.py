# SPDX-License-Identifier: Apache-2.0
"""Steps from normal equations with unit columns, of one point or of many."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

FloatArray = npt.NDArray[np.float64]


# From so many points on elimination in all of them at once is faster than one call each.
MANY = 32


def solve_scaled(
    normal: FloatArray, gradient: FloatArray, damping: FloatArray | float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """``(N + damping diag N)^-1 gradient`` (batch, n), and the gradient times it (batch,)."""
    batch, n = gradient.shape
    if batch >= MANY:
        # a trace of damping: an exactly singular matrix of one point must not stop the batch
        trace = 1e-15 + np.asarray(damping)
        step, good = solve_positive(normal, gradient[..., None], trace)
        step = step[..., 0]
        if not good.all():
            rest = np.broadcast_to(damping, batch)[~good]
            step[~good] = _solve_any(normal[~good], gradient[~good], rest)
    else:
        step = _solve_any(normal, gradient, damping)
    return step, np.einsum("bi,bi->b", step, gradient)


def solve_positive(
    matrices: FloatArray, right: FloatArray, damping: FloatArray | float = 0.0
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Solutions (batch, n, r) of positive definite systems, and (batch,) which matrices are that.

    By elimination without pivoting: its rounding is that of Cholesky's method, whatever the scales of
    the unknowns. All points of the batch take each step together.

    Parameters
    ----------
    matrices : (batch, n, n) float
    right : (batch, n, r) float
    damping : (batch,) float or float
        Added to the matrices, times their diagonals.
    """
    batch, n = matrices.shape[:2]
    work = np.empty((n, n + right.shape[-1], batch))
    work[:, :n] = np.moveaxis(matrices, 0, -1)
    work[:, n:] = np.moveaxis(right, 0, -1)
    pivots = work.reshape(-1, batch)[: n * work.shape[1] : work.shape[1] + 1]  # (n, batch), a view
    pivots *= 1 + np.asarray(damping)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for j in range(n - 1):
            factor = work[j + 1 :, j] / pivots[j]
            work[j + 1 :, j + 1 :] -= factor[:, None] * work[j, j + 1 :]
        solution = work[:, n:]
        for j in range(n - 1, -1, -1):
            if j + 1 < n:
                solution[j] -= np.einsum("ib,irb->rb", work[j, j + 1 : n], solution[j + 1 :])
            solution[j] /= pivots[j]
    return np.ascontiguousarray(np.moveaxis(solution, -1, 0)), np.asarray((pivots > 0).all(axis=0))


def _solve_any(normal: FloatArray, gradient: FloatArray, damping: FloatArray | float) -> FloatArray:
    """Steps (batch, n) point by point, for any symmetric matrix; NaN where it is not finite."""
    n = normal.shape[-1]
    diagonal = normal.diagonal(axis1=-2, axis2=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(diagonal > 0, 1 / np.sqrt(diagonal), 1.0)
    scaled = normal * scale[..., :, None]
    scaled *= scale[..., None, :]
    flat = scaled.reshape(*scaled.shape[:-2], n * n)
    flat[..., :: n + 1] = 1 + 1e-15 + np.asarray(damping)[..., None]
    # finite as a whole only where every entry is
    bad = ~np.isfinite(flat.sum(axis=-1))
    if bad.any():
        scaled[bad] = np.eye(n)
    right = gradient * scale
    try:
        step = np.linalg.solve(scaled, right[..., None])[..., 0]
    except np.linalg.LinAlgError:
        step = (np.linalg.pinv(scaled) @ right[..., None])[..., 0]
    step[bad] = np.nan
    return np.asarray(step * scale, float)


def step_and_decrement(
    normal: FloatArray, gradient: FloatArray, damping: float = 0.0
) -> tuple[FloatArray, float]:
    """As `solve_scaled`, for one point (n, n), (n,)."""
    step = solve_one(normal, gradient, damping)
    decrement = float(gradient @ step)
    if np.isfinite(decrement):
        return step, decrement
    steps, decrements = solve_scaled(normal[None], gradient[None], np.array([damping]))
    return steps[0], float(decrements[0])


def solve_one(normal: FloatArray, gradient: FloatArray, damping: float = 0.0) -> FloatArray:
    """``(N + damping diag N)^-1 gradient`` (n,) by Cholesky; NaN where N is not positive definite.

    The rounding of Cholesky's method is that of the matrix with unit diagonal as it is (van der
    Sluis 1969).
    """
    damped = normal.copy()
    damped.flat[:: gradient.size + 1] *= 1 + 1e-15 + damping
    _, step, fault = lapack.dposv(damped, gradient, overwrite_a=True)
    return step if fault == 0 else np.full(gradient.size, np.nan)
