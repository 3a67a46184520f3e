# SPDX-License-Identifier: Apache-2.0
"""Linear viscoelastic tissue: a generalised Maxwell solid (Prony series)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_resonance.fields import require

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Tissue:
    """A tissue or phantom material, ``E(t) = Einf + sum_j E_j exp(-t / tau_j)``.

    Attributes
    ----------
    name : str
        Key in the tissue library.
    relaxation_modulus_1s_pa : float
        E(t = 1 s) [Pa]; it fixes Einf.
    prony_times_s, prony_ratios : tuple of float
        tau_j [s], distinct, and ``E_j / E(1 s)``.
    label : str
        For people.
    gelatine_percent : float or None
        Concentration [% w/w] where the material is gelatine.
    """

    name: str
    relaxation_modulus_1s_pa: float
    prony_times_s: tuple[float, ...]
    prony_ratios: tuple[float, ...]
    label: str = ""
    gelatine_percent: float | None = None

    def __post_init__(self) -> None:
        modulus, times, ratios = (
            self.relaxation_modulus_1s_pa, self.prony_times_s, self.prony_ratios,
        )  # fmt: skip
        require(0 < modulus < np.inf, "relaxation_modulus_1s_pa", modulus, "a number above 0")
        distinct = len(set(times)) == len(times) and all(0 < t < np.inf for t in times)
        require(distinct, "prony_times_s", times, "distinct numbers above 0")
        good = len(ratios) == len(times) and all(0 <= r < np.inf for r in ratios)
        require(good, "prony_ratios", ratios, f"{len(times)} numbers, 0 or above")
        share = np.asarray(ratios) @ np.exp(-1 / np.asarray(times))
        require(bool(share < 1), "prony_ratios", ratios, "ratios that leave Einf above 0")

    @property
    def prony_moduli_pa(self) -> FloatArray:
        """E_j [Pa], shape (terms,)."""
        return self.relaxation_modulus_1s_pa * np.asarray(self.prony_ratios, dtype=float)

    @property
    def equilibrium_modulus_pa(self) -> float:
        """Einf [Pa], from ``E(1 s) = Einf + sum E_j exp(-1 s / tau_j)``."""
        left = np.exp(-1 / np.asarray(self.prony_times_s, dtype=float))
        return float(self.relaxation_modulus_1s_pa - self.prony_moduli_pa @ left)

    @property
    def instantaneous_modulus_pa(self) -> float:
        """E(0) [Pa]."""
        return float(self.equilibrium_modulus_pa + self.prony_moduli_pa.sum())

    def relaxation_modulus(self, time_s: ArrayLike) -> FloatArray:
        """Return E(t) [Pa], of the shape of `time_s` (0 or above)."""
        time = np.asarray(time_s, dtype=float)[..., None]  # (..., 1)
        decay = np.exp(-time / np.asarray(self.prony_times_s, dtype=float))  # (..., terms)
        return np.asarray(self.equilibrium_modulus_pa + decay @ self.prony_moduli_pa)

    def complex_modulus(self, s_rad_s: ArrayLike) -> ComplexArray:
        """Return ``E*(s) = Einf + sum E_j s tau_j / (1 + s tau_j)`` [Pa] at complex s [rad/s]."""
        s = np.asarray(s_rad_s, dtype=complex)[..., None] * np.asarray(self.prony_times_s)
        return np.asarray(self.equilibrium_modulus_pa + (s / (1 + s)) @ self.prony_moduli_pa)

    def creep_compliance(self, time_s: ArrayLike) -> FloatArray:
        """Return the creep compliance J(t) [1/Pa], of the shape of `time_s` (0 or above).

        Exact inverse of the Prony series: ``s J(s) = 1 / E*(s)``, whose poles are the eigenvalues
        of a symmetric rank-one change of ``diag(1 / tau)``.
        """
        time = np.asarray(time_s, dtype=float)[..., None]
        rate = 1 / np.asarray(self.prony_times_s, dtype=float)
        glassy = self.instantaneous_modulus_pa
        root = np.sqrt(self.prony_moduli_pa * rate)
        retardation, vectors = np.linalg.eigh(np.diag(rate) - np.outer(root, root) / glassy)
        weight = (vectors.T @ root) ** 2 / glassy**2 / retardation
        return np.asarray(1 / glassy - np.expm1(-time * retardation) @ weight)
