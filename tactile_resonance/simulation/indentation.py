# SPDX-License-Identifier: Apache-2.0
"""Quasi-static indentation of viscoelastic tissue by a rigid sphere (Lee & Radok 1960)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance.simulation.fields import require
from tactile_resonance.simulation.tissue import FloatArray, Tissue


def indentation_force(
    tissue: Tissue,
    time_s: ArrayLike,
    depth_m: ArrayLike,
    *,
    tip_radius_m: float,
    poisson_ratio: float,
) -> FloatArray:
    """Return the force [N] while a rigid sphere is pressed in and held, shape (T,).

    ``F(t) = 4 sqrt(R) / (3 (1 - nu^2)) integral E(t - t') d(depth^(3/2))``, valid while the contact
    does not shrink. Exact for ``depth^(3/2)`` linear between the given times.

    Parameters
    ----------
    tissue : Tissue
    time_s : (T,) array
        Strictly ascending times [s]; the tissue is relaxed before the first.
    depth_m : (T,) array
        Indentation [m], 0 or above and never falling.
    tip_radius_m, poisson_ratio : float

    Raises
    ------
    ValueError
        If times do not ascend or the depth falls or is negative.
    """
    time, depth = np.asarray(time_s, dtype=float), np.asarray(depth_m, dtype=float)
    shapes = time.ndim == 1 and time.size > 0 and depth.shape == time.shape
    require(shapes, "depth_m", depth.shape, f"the shape of time_s, {time.shape}, one axis")
    require(bool(np.all(np.diff(time) > 0)), "time_s", time, "strictly ascending times")
    loading = bool(depth[0] >= 0) and bool(np.all(np.diff(depth) >= 0))
    require(loading, "depth_m", depth, "0 or above and never falling (loading only)")
    measure = depth**1.5
    tau = np.asarray(tissue.prony_times_s, dtype=float)
    memory = np.full(tau.size, measure[0])  # integral exp(-(t - t')/tau_j) d(depth^1.5)
    stress = np.empty(time.size)
    stress[0] = tissue.instantaneous_modulus_pa * measure[0]
    for n in range(1, time.size):
        step = time[n] - time[n - 1]
        rate = (measure[n] - measure[n - 1]) / step
        memory = memory * np.exp(-step / tau) - rate * tau * np.expm1(-step / tau)
        stress[n] = tissue.equilibrium_modulus_pa * measure[n] + tissue.prony_moduli_pa @ memory
    return 4 * np.sqrt(tip_radius_m) / (3 * (1 - poisson_ratio**2)) * stress
