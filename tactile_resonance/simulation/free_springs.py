# SPDX-License-Identifier: Apache-2.0
"""Recovery of a dented viscoelastic surface: springs let go at different times, then unloaded."""

from __future__ import annotations

from math import exp
from operator import mul

import numpy as np

from tactile_resonance.simulation.tissue import FloatArray

Values = list[float]  # one per Prony term: its share E_j v_j of the line load
Node = tuple[float, float, FloatArray]  # x, time when it was let go, modal state then


class FreeSprings:
    """Springs of a Prony series without load: ``E0 u = sum E_j z_j``, ``tau_j z_j' = u - z_j``.

    While it touches, a spring bears ``Einf u + sum E_j v_j`` with ``v_j = u - z_j``.

    Parameters
    ----------
    moduli_pa, times_s : (terms,) arrays
        E_j above 0 [Pa] and tau_j [s].
    glassy_pa : float
        ``E0 = Einf + sum E_j`` [Pa].

    Notes
    -----
    The same rank-one change of ``diag(1 / tau)`` as in the creep compliance; its eigenvectors
    make every free spring a sum of decays, so none needs to be stepped.
    """

    def __init__(self, moduli_pa: FloatArray, times_s: FloatArray, glassy_pa: float) -> None:
        root = np.sqrt(moduli_pa / times_s)
        rates, vectors = np.linalg.eigh(np.diag(1 / times_s) - np.outer(root, root) / glassy_pa)
        weights = np.sqrt(moduli_pa * times_s)
        self._moduli, self._decay_rates = moduli_pa, (-rates).tolist()
        self._into = vectors.T * weights  # (modes, terms): modal state of z
        displacement = vectors.T @ root / glassy_pa  # (modes,)
        loads = moduli_pa[:, None] * (displacement - vectors / weights[:, None])  # (terms, modes)
        self._out = np.vstack([displacement, loads]).tolist()

    def let_go(self, u: float, values: Values) -> FloatArray:
        """Return the modal state of a spring at displacement u [m] that has just been let go."""
        return (self._into @ (u - np.array(values) / self._moduli)).tolist()

    def at(self, node: Node, time: float) -> tuple[float, Values]:
        """Return u of a free spring [m], and what its terms would bear if it were held there."""
        _, since, state = node
        elapsed = time - since
        now = [y * exp(elapsed * rate) for y, rate in zip(state, self._decay_rates, strict=True)]
        values = [sum(map(mul, row, now)) for row in self._out]
        return values.pop(0), values
