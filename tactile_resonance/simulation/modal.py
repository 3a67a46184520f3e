# SPDX-License-Identifier: Apache-2.0
"""A linear system as a sum over its poles, ``G(s) = direct + sum r_k / (s - p_k)``.

Every state is one number that decays by itself, so any instant is reached without the instants
before it. The polynomial form of the same system is useless in floating point at this order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class PoleResidueModel:
    """A real, stable, strictly diagonalisable single-input single-output system.

    Attributes
    ----------
    poles_rad_s : (K,) array
        Poles with imaginary part 0 or above [rad/s]; conjugates are implied.
    residues_rad_s : (K,) array
        Their residues [V/V rad/s].
    direct : float
        Direct term [V/V].

    Notes
    -----
    State ``z_k' = p_k z_k + r_k u``; output ``direct u + sum weight_k Re z_k``, weight 2 for a
    complex pole (it stands for the pair), 1 for a real one.
    """

    poles_rad_s: ComplexArray
    residues_rad_s: ComplexArray
    direct: float

    @property
    def weights(self) -> FloatArray:
        """How often each listed pole counts, shape (K,): 2 for a complex pole, 1 for a real one."""
        return np.where(self.poles_rad_s.imag > 0, 2.0, 1.0)

    def without_direct_term(self) -> PoleResidueModel:
        """Return the strictly proper part."""
        return PoleResidueModel(self.poles_rad_s, self.residues_rad_s, 0.0)

    def frequency_response(self, frequency_hz: ArrayLike) -> ComplexArray:
        """Return G(j 2 pi f), of the shape of `frequency_hz`."""
        upper, lower = self.resolvents(frequency_hz)
        weighted = self.residues_rad_s * self.weights / 2
        return np.asarray(self.direct + upper @ weighted + lower @ np.conj(weighted))

    def resolvents(self, frequency_hz: ArrayLike) -> tuple[ComplexArray, ComplexArray]:
        """Return ``1 / (s - p)`` and ``1 / (s - conj p)`` at s = j 2 pi f, both (..., K)."""
        s = 2j * np.pi * np.asarray(frequency_hz, dtype=float)[..., None]  # (..., 1)
        return 1 / (s - self.poles_rad_s), 1 / (s - np.conj(self.poles_rad_s))
