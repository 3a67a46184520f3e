# SPDX-License-Identifier: Apache-2.0
"""Recovery of a dented viscoelastic surface: springs let go at different times, then unloaded."""

from __future__ import annotations

from math import exp

import numpy as np

from tactile_resonance.simulation.tissue import FloatArray

Values = list[float]  # one per Prony term
Node = tuple[float, float, Values]


class FreeSprings:
    """Springs of a Prony series without load: ``E0 u = sum E_j z_j``, ``tau_j z_j' = u - z_j``.

    A free spring is a node (x, time it was let go, modal state then).

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
        self._rates = rates.tolist()
        self._into = (vectors.T * weights).tolist()  # (modes, terms)
        self._out = (vectors / weights[:, None]).tolist()  # (terms, modes)
        self._displacement = (vectors.T @ root / glassy_pa).tolist()

    def state(self, z: Values) -> Values:
        """Return the modal state of a spring that has just been let go."""
        return [sum(w * value for w, value in zip(row, z, strict=True)) for row in self._into]

    def displacement(self, node: Node, time: float) -> float:
        """Return u of a free spring [m]."""
        elapsed, state = node[1] - time, node[2]
        u = 0.0
        for weight, rate, value in zip(self._displacement, self._rates, state, strict=True):
            u += weight * value * exp(elapsed * rate)
        return u

    def deformation(self, node: Node, time: float) -> Values:
        """Return ``v_j = u - z_j`` of a free spring [m]."""
        elapsed = node[1] - time
        now = [y * exp(elapsed * rate) for y, rate in zip(node[2], self._rates, strict=True)]
        u = sum(w * y for w, y in zip(self._displacement, now, strict=True))
        return [u - sum(w * y for w, y in zip(row, now, strict=True)) for row in self._out]
