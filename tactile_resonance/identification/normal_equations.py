# SPDX-License-Identifier: Apache-2.0
"""Steps from normal equations with unit columns, of one point or of many."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

FloatArray = npt.NDArray[np.float64]


def solve_scaled(
    normal: FloatArray, gradient: FloatArray, damping: FloatArray | float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """``(N + damping diag N)^-1 gradient`` (batch, n), and the gradient times it (batch,)."""
    n = normal.shape[-1]
    diagonal = normal.diagonal(axis1=-2, axis2=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(diagonal > 0, 1 / np.sqrt(diagonal), 1.0)
    scaled = normal * scale[..., :, None]
    scaled *= scale[..., None, :]
    # a trace of damping: an exactly singular matrix of one point must not stop the batch
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
    return np.asarray(step * scale, float), np.asarray(np.einsum("...i,...i->...", step, right))


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
    """``(N + damping diag N)^-1 gradient`` (n,) by Cholesky; NaN where N is not positive definite."""
    diagonal = normal.diagonal()
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = normal * scale * scale[:, None]
    scaled.flat[:: scale.size + 1] = 1 + 1e-15 + damping
    _, step, fault = lapack.dposv(scaled, gradient * scale)
    return step * scale if fault == 0 else np.full(scale.size, np.nan)
