# SPDX-License-Identifier: Apache-2.0
"""A generalised Maxwell solid: a Prony series; with one term the standard linear solid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance._typing import ComplexArray, FloatArray


@dataclass(frozen=True, eq=False)
class Prony:
    """``E(t) = Einf + sum_j E_j exp(-t / tau_j)``.

    Attributes
    ----------
    equilibrium_pa : float
        Einf [Pa], 0 or above.
    moduli_pa, times_s : (terms,) arrays
        E_j [Pa], 0 or above, and tau_j [s], above 0.
    """

    equilibrium_pa: float
    moduli_pa: FloatArray
    times_s: FloatArray

    @property
    def instantaneous_pa(self) -> float:
        """E(0) [Pa]."""
        return float(self.equilibrium_pa + self.moduli_pa.sum())

    def relaxation_modulus(self, time_s: ArrayLike) -> FloatArray:
        """Return E(t) [Pa], of the shape of `time_s` (0 or above)."""
        time = np.asarray(time_s, dtype=float)[..., None]  # (..., 1)
        return np.asarray(self.equilibrium_pa + np.exp(-time / self.times_s) @ self.moduli_pa)

    def complex_modulus(self, s_rad_s: ArrayLike) -> ComplexArray:
        """Return ``E*(s) = Einf + sum E_j s tau_j / (1 + s tau_j)`` [Pa] at complex s [rad/s]."""
        s = np.asarray(s_rad_s, dtype=complex)[..., None] * self.times_s
        return np.asarray(self.equilibrium_pa + (s / (1 + s)) @ self.moduli_pa)

    def creep_compliance(self, time_s: ArrayLike) -> FloatArray:
        """Return the creep compliance J(t) [1/Pa], of the shape of `time_s` (0 or above).

        Exact inverse of the Prony series: ``s J(s) = 1 / E*(s)``, whose poles are the eigenvalues
        of a symmetric rank-one change of ``diag(1 / tau)``. Needs Einf above 0.
        """
        time = np.asarray(time_s, dtype=float)[..., None]
        rate, glassy = 1 / self.times_s, self.instantaneous_pa
        root = np.sqrt(self.moduli_pa * rate)
        retardation, vectors = np.linalg.eigh(np.diag(rate) - np.outer(root, root) / glassy)
        weight = (vectors.T @ root) ** 2 / glassy**2 / retardation
        return np.asarray(1 / glassy - np.expm1(-time * retardation) @ weight)
