# SPDX-License-Identifier: Apache-2.0
"""What the simulation knows over a surface: tissue, contact and one resonance at every position."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_resonance.fields import require
from tactile_resonance.simulation.bench import SimulatedBench
from tactile_resonance.simulation.modal import ComplexArray, FloatArray
from tactile_resonance.simulation.scene import PhantomScene


@dataclass(frozen=True, eq=False)
class TruthMap:
    """Exact small-signal truth at positions; NaN, or -1 for the region, where there is nothing.

    Attributes
    ----------
    position_m : (..., 2 or 3) array
    region_index : (...) int array
        Into the scene's regions.
    modulus_1s_pa : (...) array
        E(1 s) that the tip feels.
    pole_rad_s : (...) complex array
        Of the resonance asked for.
    contact_radius_m, indentation_m, force_n : (...) arrays
    """

    position_m: FloatArray
    region_index: NDArray[np.int64]
    modulus_1s_pa: FloatArray
    pole_rad_s: ComplexArray
    contact_radius_m: FloatArray
    indentation_m: FloatArray
    force_n: FloatArray

    @property
    def f0_hz(self) -> FloatArray:
        """Undamped natural frequency [Hz], shape (...)."""
        return np.abs(self.pole_rad_s) / (2 * np.pi)

    @property
    def damping_ratio(self) -> FloatArray:
        """Shape (...)."""
        return -self.pole_rad_s.real / np.abs(self.pole_rad_s)


def truth_map(
    bench: SimulatedBench,
    scene: PhantomScene,
    position_m: ArrayLike,
    *,
    near_hz: float = 250.0,
    hold_time_s: float = 1.0,
) -> TruthMap:
    """Return the truth at positions (..., 2 or 3) [m], at the scene's force.

    Parameters
    ----------
    bench, scene
    position_m : (..., 2 or 3) array
    near_hz : float
        The resonance whose natural frequency is nearest to this.
    hold_time_s : float
        As in `hertz_contact`.
    """
    position = np.asarray(position_m, dtype=float)
    index = scene.region_index(position)  # (...)
    modulus, radius, depth, force = (np.full(index.shape, np.nan) for _ in range(4))
    pole = np.full(index.shape, np.nan, dtype=complex)
    for at in np.ndindex(index.shape):
        tissue = scene.tissue_at(position[at])
        if tissue is None:
            continue
        coupled = bench.coupled(tissue, force_n=scene.force_n, hold_time_s=hold_time_s)
        contact = coupled.contact
        assert contact is not None
        modulus[at] = tissue.relaxation_modulus_1s_pa
        radius[at], depth[at] = contact.contact_radius_m, contact.indentation_m
        force[at] = contact.force_n
        pole[at] = coupled.mode_near(near_hz).pole_rad_s
    require(bool(np.any(index >= 0)), "position_m", position.shape, "a position on the phantoms")
    return TruthMap(position, index, modulus, pole, radius, depth, force)
