# SPDX-License-Identifier: Apache-2.0
"""A whole test of indentation at once: force and contact radius for given times and depths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance.fields import require
from tactile_resonance.simulation.indenter import Indenter
from tactile_resonance.simulation.tissue import FloatArray, Tissue

AT_ONCE_S = 1e-9  # in which the first depth is reached: glassy, as no Prony term is that fast


@dataclass(frozen=True, eq=False)
class Indentation:
    """Time [s], depth [m], force [N] and contact radius [m] of a test, (T,) arrays each."""

    time_s: FloatArray
    depth_m: FloatArray
    force_n: FloatArray
    contact_radius_m: FloatArray


def indent(
    tissue: Tissue,
    time_s: ArrayLike,
    depth_m: ArrayLike,
    *,
    tip_radius_m: float,
    poisson_ratio: float,
    adhesion_j_per_m2: float = 0.0,
) -> Indentation:
    """Return what a rigid sphere feels on its way in, while it is held, and out again.

    Parameters
    ----------
    tissue : Tissue
        At rest before the first time, at which the first depth is put on at once.
    time_s : (T,) array
        Strictly ascending times [s].
    depth_m : (T,) array
        Depth of the lowest point below the undisturbed surface [m]; straight in between.
    tip_radius_m, poisson_ratio, adhesion_j_per_m2 : float
        As in `Indenter`.

    Raises
    ------
    ValueError
        If times do not ascend, or shapes differ.
    """
    time, depth = np.asarray(time_s, dtype=float), np.asarray(depth_m, dtype=float)
    shapes = time.ndim == 1 and time.size > 0 and depth.shape == time.shape
    require(shapes, "depth_m", depth.shape, f"the shape of time_s, {time.shape}, one axis")
    require(bool(np.all(np.diff(time) > 0)), "time_s", time, "strictly ascending times")
    require(bool(np.all(np.isfinite(depth))), "depth_m", depth, "finite numbers")
    tip = Indenter(
        tissue,
        tip_radius_m=tip_radius_m,
        poisson_ratio=poisson_ratio,
        adhesion_j_per_m2=adhesion_j_per_m2,
    )
    steps = np.diff(time, prepend=time[0] - 1.0)
    steps[0] = AT_ONCE_S
    rows = []
    for x, dt in zip(depth.tolist(), steps.tolist(), strict=True):
        force = tip.step(x, dt)
        rows.append((force, tip.contact_radius_m))
    force_n, radius_m = np.array(rows).T
    return Indentation(time, depth, force_n, radius_m)
