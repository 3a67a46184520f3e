# SPDX-License-Identifier: Apache-2.0
"""What a simulation knows and a measurement does not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance.simulation.bimorph import CoupledBimorph, Mode
from tactile_resonance.simulation.modal import ComplexArray, FloatArray
from tactile_resonance.simulation.tissue import Tissue


@dataclass(frozen=True, eq=False)
class Truth:
    """The exact linear (small-signal) behaviour of a simulated sensor.

    At drives of 1 V rms and below estimates are to be compared with it; above, the best linear
    approximation of the nonlinear sensor differs.

    Attributes
    ----------
    tissue : Tissue or None
        None in air; the four fields after it are None with it.
    force_n, contact_radius_m, indentation_m : float or None
    contact_stiffness_n_per_m : (F,) complex array or None
        ``k*(j w)`` at `frequency_hz`.
    poles_rad_s, zeros_rad_s, residues_rad_s : (N,) arrays
        Conjugates included; ``G = feedthrough + sum r_k / (s - p_k)``.
    feedthrough : float
    modes : tuple of Mode
        All resonances by natural frequency.
    frequency_hz : (F,) array
    response : (F,) complex array
        G = U_sensor / U_actuator at `frequency_hz`, without channel skew.
    """

    tissue: Tissue | None
    force_n: float | None
    contact_radius_m: float | None
    indentation_m: float | None
    contact_stiffness_n_per_m: ComplexArray | None
    poles_rad_s: ComplexArray
    zeros_rad_s: ComplexArray
    residues_rad_s: ComplexArray
    feedthrough: float
    modes: tuple[Mode, ...]
    frequency_hz: FloatArray
    response: ComplexArray

    def mode_near(self, frequency_hz: float) -> Mode:
        """Return the resonance whose natural frequency is nearest to `frequency_hz`."""
        return min(self.modes, key=lambda mode: abs(mode.f0_hz - frequency_hz))


def truth_of(coupled: CoupledBimorph, frequency_hz: ArrayLike = ()) -> Truth:
    """Return the truth of a coupled sensor, with its response at `frequency_hz` (F,) [Hz]."""
    frequency = np.atleast_1d(np.asarray(frequency_hz, dtype=float))
    contact = coupled.contact
    return Truth(
        tissue=None if contact is None else contact.tissue,
        force_n=None if contact is None else contact.force_n,
        contact_radius_m=None if contact is None else contact.contact_radius_m,
        indentation_m=None if contact is None else contact.indentation_m,
        contact_stiffness_n_per_m=(
            None if contact is None else contact.dynamic_stiffness(2j * np.pi * frequency)
        ),
        poles_rad_s=coupled.poles_rad_s,
        zeros_rad_s=coupled.zeros_rad_s,
        residues_rad_s=coupled.residues_rad_s,
        feedthrough=coupled.feedthrough,
        modes=coupled.modes,
        frequency_hz=frequency,
        response=coupled.frequency_response(frequency),
    )
