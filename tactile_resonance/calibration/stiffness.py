# SPDX-License-Identifier: Apache-2.0
"""The complex stiffness of a contact, of few parameters and yet of finitely many poles."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class ContactStiffness:
    """``k(s) = K + sum_j K_j s tau_j / (1 + s tau_j) + c s + m s^2``; leading axes (...) are a stack.

    Attributes
    ----------
    elastic_n_per_m : (...) float
        K.
    relaxing_n_per_m, times_s : (..., J) float
        K_j, 0 or above, and tau_j.
    viscous_ns_per_m, mass_kg : (...) float
        c and m.
    """

    elastic_n_per_m: FloatArray | float = 0.0
    relaxing_n_per_m: FloatArray = field(default_factory=lambda: np.zeros(0))
    times_s: FloatArray = field(default_factory=lambda: np.ones(0))
    viscous_ns_per_m: FloatArray | float = 0.0
    mass_kg: FloatArray | float = 0.0

    def at(self, s: npt.ArrayLike) -> ComplexArray:
        """(..., S) k at s (..., S) [rad/s]."""
        s = np.asarray(s, complex)
        x = s[..., None] * self.times_s[..., None, :]
        relaxing = (self.relaxing_n_per_m[..., None, :] * x / (1 + x)).sum(axis=-1)
        k, c, m = (
            np.asarray(value)[..., None]
            for value in (self.elastic_n_per_m, self.viscous_ns_per_m, self.mass_kg)
        )
        return np.asarray(k + relaxing + c * s + m * s**2)

    def slope(self, s: npt.ArrayLike) -> ComplexArray:
        """(..., S) derivative of k by s."""
        s = np.asarray(s, complex)
        tau = self.times_s[..., None, :]
        relaxing = self.relaxing_n_per_m[..., None, :] * tau / (1 + s[..., None] * tau) ** 2
        c, m = (np.asarray(x)[..., None] for x in (self.viscous_ns_per_m, self.mass_kg))
        return np.asarray(relaxing.sum(axis=-1) + c + 2 * m * s)


AIR = ContactStiffness()
