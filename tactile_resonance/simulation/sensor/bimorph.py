# SPDX-License-Identifier: Apache-2.0
"""The bimorph sensor coupled to what it touches: exact poles, zeros, residues and response.

Equations of motion (q modal coordinates, w tip deflection, v strain voltage, z_j Prony states):

- ``q_i'' + 2 zeta w_i q_i' + w_i^2 q_i = chi_i (Ua - Us) - phi_i(L) f_c``, ``w = sum phi_i(L) q_i``
- ``f_c = kinf w + sum k_j (w - z_j) + c w' + m w''``, ``tau_j z_j' = w - z_j``
- ``Us = v + gamma Ua``, ``v' = sum chi_i q_i' / Ct - Us / (R Ct)``

Actuator and sensor layer are collocated. Piezoelectric beam equations: Erturk & Inman,
*Piezoelectric Energy Harvesting* (2011), ch. 3; here one layer drives and the other senses.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.fields import require
from tactile_resonance.sensor import SensorParameters
from tactile_resonance.simulation.sensor.beam import BeamModes, sensor_modes
from tactile_resonance.simulation.sensor.linear import PoleResidueModel
from tactile_resonance.simulation.tissue.hertz import HertzContact


@dataclass(frozen=True)
class Mode:
    """One resonance: the pole with positive imaginary part, and its residue in G."""

    pole_rad_s: complex
    residue_rad_s: complex

    @property
    def f0_hz(self) -> float:
        """Undamped natural frequency |pole| / 2 pi [Hz]."""
        return abs(self.pole_rad_s) / (2 * np.pi)

    @property
    def damping_ratio(self) -> float:
        """``-Re(pole) / |pole|``."""
        return -self.pole_rad_s.real / abs(self.pole_rad_s)


@dataclass(frozen=True, eq=False)
class CoupledBimorph:
    """The linear sensor, in air (`contact` None) or on tissue. G = Us / Ua.

    Attributes
    ----------
    beam : BeamModes
    input_resistance_ohm : float
    feedthrough : float
        gamma, the limit of G at infinite frequency.
    contact : HertzContact or None
    """

    beam: BeamModes
    input_resistance_ohm: float
    feedthrough: float
    contact: HertzContact | None

    @cached_property
    def state_space(self) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """(A (N, N), B (N,), C (N,), D) from actuator voltage to sensor voltage.

        States ``w_i q_i``, ``q_i'``, ``sqrt(Ct) v``, ``sqrt(k_j) z_j``: their squares are energies,
        which keeps the eigenvalue problem well conditioned.
        """
        beam, contact = self.beam, self.contact
        natural, phi, chi = beam.natural_rad_s, beam.tip_deflection, beam.coupling  # (n,) each
        n = natural.size
        stiffness = np.zeros(0) if contact is None else contact.prony_stiffness_n_per_m  # (j,)
        size = 2 * n + 1 + stiffness.size
        q, dq, v, z = slice(0, n), slice(n, 2 * n), 2 * n, slice(2 * n + 1, size)
        root_c = np.sqrt(beam.capacitance_f)
        leak = 1 / (self.input_resistance_ohm * beam.capacitance_f)

        a, b, c = np.zeros((size, size)), np.zeros(size), np.zeros(size)
        a[q, dq] = np.diag(natural)
        a[dq, q] = -np.diag(natural)
        a[dq, dq] = -np.diag(2 * beam.damping_ratio * natural)
        a[dq, v] = -chi / root_c
        b[dq] = chi * (1 - self.feedthrough)
        a[v, dq] = chi / root_c
        a[v, v] = -leak
        b[v] = -self.feedthrough * leak * root_c
        c[v] = 1 / root_c
        if contact is not None:
            root_k = np.sqrt(stiffness)
            rate = 1 / np.asarray(contact.tissue.prony_times_s)  # (j,)
            glassy = contact.equilibrium_stiffness_n_per_m + stiffness.sum()
            a[dq, q] -= glassy * np.outer(phi, phi / natural)
            a[dq, z] = np.outer(phi, root_k)
            a[dq, dq] -= contact.radiation_damping_ns_per_m * np.outer(phi, phi)
            a[z, q] = np.outer(rate * root_k, phi / natural)
            a[z, z] = -np.diag(rate)
            # radiation mass: M = I + m phi phi^T, inverted by Sherman-Morrison
            mass = contact.radiation_mass_kg
            share = mass / (1 + mass * (phi @ phi))
            a[dq] -= share * np.outer(phi, phi @ a[dq])
            b[dq] -= share * phi * (phi @ b[dq])
        return a, b, c, self.feedthrough

    @cached_property
    def _expansion(self) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """All poles, residues and eigenvectors with C v = 1, by imaginary, then real part."""
        a, b, c, _ = self.state_space
        poles, vectors = np.linalg.eig(a)
        # in these coordinates the states are those of PoleResidueModel
        vectors = vectors / (c @ vectors)
        residues = np.linalg.solve(vectors, b.astype(complex))
        order = np.lexsort((poles.real, poles.imag))
        return poles[order].astype(complex), residues[order], vectors[:, order]

    def carry_state(self, modal_state: ComplexArray, after: CoupledBimorph) -> ComplexArray:
        """Return the modal state (K,) of `modal` just after the contact has become another.

        Deflections, velocities, strain voltage and the deformation of every Prony term stay.

        Parameters
        ----------
        modal_state : (K,) array
        after : CoupledBimorph
            The same sensor on a tissue of as many Prony terms.
        """
        require(
            after.poles_rad_s.size == self.poles_rad_s.size,
            "after",
            after.poles_rad_s.size,
            f"a system of {self.poles_rad_s.size} states",
        )
        keep = self.poles_rad_s.imag >= 0
        x = (self._expansion[2][:, keep] @ (self.modal.weights * modal_state)).real
        if self.contact is not None and after.contact is not None:
            old, new = (c.prony_stiffness_n_per_m for c in (self.contact, after.contact))
            # states sqrt(k_j) z_j; a term of no stiffness has none
            scale = np.divide(new, old, out=np.zeros_like(new), where=old > 0)
            x[x.size - old.size :] *= np.sqrt(scale)
        states = np.linalg.solve(after._expansion[2], x.astype(complex))
        return np.asarray(states[after.poles_rad_s.imag >= 0])

    @property
    def poles_rad_s(self) -> ComplexArray:
        """All poles [rad/s], shape (N,), conjugates included, by imaginary, then real part."""
        return self._expansion[0]

    @property
    def residues_rad_s(self) -> ComplexArray:
        """Residues of G at `poles_rad_s`, ``G = gamma + sum r_k / (s - p_k)`` [V/V rad/s]."""
        return self._expansion[1]

    @cached_property
    def zeros_rad_s(self) -> ComplexArray:
        """All zeros of G [rad/s], shape (N,), sorted like the poles; one is at the origin."""
        a, b, c, d = self.state_space
        zeros = np.linalg.eigvals(a - np.outer(b, c) / d).astype(complex)
        return zeros[np.lexsort((zeros.real, zeros.imag))]

    @cached_property
    def modal(self) -> PoleResidueModel:
        """The system in poles and residues, poles of the upper half plane and the real axis."""
        keep = self.poles_rad_s.imag >= 0
        return PoleResidueModel(self.poles_rad_s[keep], self.residues_rad_s[keep], self.feedthrough)

    def response(self, s_rad_s: ArrayLike) -> ComplexArray:
        """Return G(s) at complex s [rad/s] in closed form, independent of the state space.

        At s = 0, G = 0 is returned (the input resistance discharges the sensing layer).
        """
        s = np.asarray(s_rad_s, dtype=complex)
        at_rest = s == 0
        s = np.where(at_rest, 1.0, s)
        beam = self.beam
        natural, phi, chi = beam.natural_rad_s, beam.tip_deflection, beam.coupling
        ss = s[..., None]
        modal = 1 / (ss**2 + 2 * beam.damping_ratio * natural * ss + natural**2)  # (..., n)
        charge, cross, receptance = modal @ chi**2, modal @ (chi * phi), modal @ phi**2
        k = np.zeros_like(s) if self.contact is None else self.contact.dynamic_stiffness(s)
        strain = (charge - cross**2 * k / (1 + k * receptance)) / beam.capacitance_f
        leak = 1 / (s * self.input_resistance_ohm * beam.capacitance_f)
        return np.where(at_rest, 0.0, (strain + self.feedthrough) / (1 + strain + leak))

    def frequency_response(self, frequency_hz: ArrayLike) -> ComplexArray:
        """Return G(j 2 pi f), of the shape of `frequency_hz`, in closed form."""
        return self.response(2j * np.pi * np.asarray(frequency_hz, dtype=float))

    @property
    def modes(self) -> tuple[Mode, ...]:
        """All resonances, by natural frequency."""
        upper = self.poles_rad_s.imag > 0
        pairs = zip(self.poles_rad_s[upper], self.residues_rad_s[upper], strict=True)
        modes = [Mode(complex(pole), complex(residue)) for pole, residue in pairs]
        return tuple(sorted(modes, key=lambda mode: mode.f0_hz))

    def mode_near(self, frequency_hz: float) -> Mode:
        """Return the resonance whose natural frequency is nearest to `frequency_hz`."""
        require(bool(frequency_hz > 0), "frequency_hz", frequency_hz, "a number above 0")
        return min(self.modes, key=lambda mode: abs(mode.f0_hz - frequency_hz))


def couple(sensor: SensorParameters, contact: HertzContact | None) -> CoupledBimorph:
    """Return the linear sensor in air (`contact` None) or on tissue."""
    electric = sensor.electric
    return CoupledBimorph(
        sensor_modes(sensor), electric.input_resistance_ohm, electric.feedthrough, contact
    )
