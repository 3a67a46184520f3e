# SPDX-License-Identifier: Apache-2.0
"""The bimorph sensor coupled to what it touches: modes, exact poles, zeros, residues and response.

Equations of motion (q modal coordinates, w tip deflection, v strain voltage, z_j Prony states):

- ``q_i'' + 2 zeta w_i q_i' + w_i^2 q_i = chi_i (Ua - Us) - phi_i(L) f_c``, ``w = sum phi_i(L) q_i``
- ``f_c = kinf w + sum k_j (w - z_j) + c w' + m w''``, ``tau_j z_j' = w - z_j``
- ``Us = v + gamma Ua``, ``v' = sum chi_i q_i' / Ct - Us / (R Ct)``

Actuator and sensor layer are collocated. Piezoelectric beam equations: Erturk & Inman,
*Piezoelectric Energy Harvesting* (2011), ch. 3; here one layer drives and the other senses.

Where the contact changes slowly, it is over an interval h that of the interval's middle, which takes over the
state of the one before. With the contact at rest this is exact. Otherwise the part of the response that a
pole p makes is off by at most ``|p'| h^2 / 12`` of itself, and on the mean over an interval by nothing: it
lags behind its steady state by ``|p'| / Re(p)^2``, as it has to.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.calibration.model import AIR, SensorModel
from tactile_resonance.cantilever import cantilever_eigenvalues, tip_shape
from tactile_resonance.fields import require
from tactile_resonance.sensor import BeamParameters, SensorParameters
from tactile_resonance.simulation.sensor.response import Lines, PoleResidueModel, ResponseStream
from tactile_resonance.simulation.tissue.library import HertzContact

VACUUM_PERMITTIVITY = 8.8541878128e-12  # F/m, CODATA 2018
INTERVAL_S = 0.04
"""Over which a contact that changes is held."""


@dataclass(frozen=True)
class BeamModes:
    """Modal model of the beam with its tip (Euler-Bernoulli) in air, short-circuited electrodes.

    Attributes
    ----------
    natural_rad_s : (n,) array
        Undamped natural angular frequencies [rad/s], ascending.
    damping_ratio : float
        Modal damping ratio, the same for all modes.
    tip_deflection : (n,) array
        Mass-normalised mode shapes at the tip [kg^-1/2].
    coupling : (n,) array
        ``chi_i = theta slope_i`` [N kg^-1/2 / V]: modal force per volt, of the slope of a mode at the tip.
    capacitance_f : float
        Total capacitance ``Ct = Cp + Cs`` across the sensing layer [F], Cp clamped.
    eigenvalues : (n,) array
        Roots beta of the frequency equation, ``natural = (beta / L)^2 sqrt(EI / m)``.
    static_stiffness_n_per_m : float
        Of the whole beam at the tip, ``3 EI / L^3``.
    """

    natural_rad_s: FloatArray
    damping_ratio: float
    tip_deflection: FloatArray
    coupling: FloatArray
    capacitance_f: float
    eigenvalues: FloatArray
    static_stiffness_n_per_m: float

    @property
    def spring(self) -> tuple[float, float, float]:
        """Static stiffness [N/m], damping [N s/m] and mass [kg] that swings like mode 1."""
        stiffness, natural = self.static_stiffness_n_per_m, float(self.natural_rad_s[0])
        mass = stiffness / natural**2
        return stiffness, 2 * self.damping_ratio * natural * mass, mass


def mass_per_length(beam: BeamParameters) -> float:
    """Return the mass per unit length [kg/m]."""
    piezo = 2 * beam.piezo_thickness_m * beam.piezo_density_kg_per_m3
    return beam.width_m * (piezo + beam.shim_thickness_m * beam.shim_density_kg_per_m3)


@lru_cache(maxsize=8)
def sensor_modes(sensor: SensorParameters) -> BeamModes:
    """Return the modal model of a sensor's beam; computed once, whatever the sensor touches.

    With ``EI = b [2/3 Yp ((hs/2+hp)^3 - (hs/2)^3) + Ys hs^3/12]``, the clamped capacitance of one layer
    ``Cp = (K33T eps0 - d31^2 Yp) b L / hp``, and the moment per volt of the driven one
    ``theta = |d31| Yp b (hp + hs) / 2``.
    """
    beam, tip = sensor.beam, sensor.tip
    length, line_mass = beam.free_length_m, mass_per_length(beam)
    half = beam.shim_thickness_m / 2
    piezo = 2 / 3 * beam.piezo_modulus_pa * ((half + beam.piezo_thickness_m) ** 3 - half**3)
    shim = beam.shim_modulus_pa * beam.shim_thickness_m**3 / 12
    stiffness = beam.width_m * (piezo + shim)
    permittivity = beam.relative_permittivity_t33 * VACUUM_PERMITTIVITY
    permittivity -= beam.d31_m_per_v**2 * beam.piezo_modulus_pa
    require(
        permittivity > 0,
        "relative_permittivity_t33",
        beam.relative_permittivity_t33,
        "above d31^2 Y11 / eps0, below which the clamped capacitance is not positive",
    )
    clamped_f = permittivity * beam.width_m * length / beam.piezo_thickness_m
    beta = cantilever_eigenvalues(tip.mass_kg / (line_mass * length), beam.mode_count)  # (n,)
    deflection, slope = tip_shape(beta, line_mass * length, tip.mass_kg)  # (n,), (n,)
    slope = slope / length
    arm = (beam.piezo_thickness_m + beam.shim_thickness_m) / 2
    moment = abs(beam.d31_m_per_v) * beam.piezo_modulus_pa * beam.width_m * arm
    return BeamModes(
        natural_rad_s=(beta / length) ** 2 * np.sqrt(stiffness / line_mass),
        damping_ratio=beam.modal_damping_ratio,
        tip_deflection=deflection,
        coupling=moment * slope,
        capacitance_f=clamped_f / (1 - sensor.electric.feedthrough),
        eigenvalues=beta,
        static_stiffness_n_per_m=3 * stiffness / length**3,
    )


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


@lru_cache(maxsize=8)
def sensor_model(sensor: SensorParameters) -> SensorModel:
    """Return a sensor in the parameters that its calibration finds, of channels without gain and delay."""
    beam, electric = sensor_modes(sensor), sensor.electric
    return SensorModel(
        beam.natural_rad_s,
        np.full(beam.natural_rad_s.size, beam.damping_ratio),
        np.abs(beam.coupling) / np.sqrt(beam.capacitance_f),
        beam.tip_deflection * np.sign(beam.coupling),
        np.array(electric.feedthrough),
        np.array(1 / (electric.input_resistance_ohm * beam.capacitance_f)),
        np.array(1.0),
        np.array(0.0),
    )


@dataclass(frozen=True, eq=False)
class CoupledBimorph:
    """The linear sensor, in air (`contact` None) or on tissue. G = Us / Ua.

    Attributes
    ----------
    sensor : SensorModel
        Its feedthrough is gamma, the limit of G at infinite frequency.
    contact : HertzContact or None
    """

    sensor: SensorModel
    contact: HertzContact | None

    @cached_property
    def state_space(self) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """(A (N, N), B (N,), C (N,), D) from actuator to sensor voltage; states: `SensorModel.state_space`."""
        a, b = self.sensor.state_space(AIR if self.contact is None else self.contact.stiffness)
        c = np.zeros(b.size)
        c[2 * self.sensor.modes] = 1.0
        return a, b, c, float(self.sensor.feedthrough)

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
        size, accepted = after.poles_rad_s.size, f"a system of {self.poles_rad_s.size} states"
        require(size == self.poles_rad_s.size, "after", size, accepted)
        keep = self.poles_rad_s.imag >= 0
        x = (self._expansion[2][:, keep] @ (self.modal.weights * modal_state)).real
        if self.contact is not None and after.contact is not None:
            old, new = (c.stiffness.relaxing_n_per_m for c in (self.contact, after.contact))
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
        direct = float(self.sensor.feedthrough)
        return PoleResidueModel(self.poles_rad_s[keep], self.residues_rad_s[keep], direct)

    def response(self, s_rad_s: ArrayLike) -> ComplexArray:
        """Return G(s) at complex s [rad/s] in closed form, independent of the state space.

        At s = 0, G = 0 is returned (the input resistance discharges the sensing layer).
        """
        s = np.asarray(s_rad_s, dtype=complex)
        at_rest = s == 0
        s = np.where(at_rest, 1.0, s)
        k = 0.0 if self.contact is None else self.contact.dynamic_stiffness(s)
        return np.where(at_rest, 0.0, self.sensor.response(s, k).reshape(s.shape))

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


def pole_trajectory(sensors: Iterable[CoupledBimorph]) -> ComplexArray:
    """Return the pole of one resonance of each of some sensors, one after another in time [rad/s].

    The resonance is that of the first whose natural frequency is nearest to 250 Hz, and then the nearest
    to itself.
    """
    poles: list[complex] = []
    for coupled in sensors:
        if poles:
            found = min((m.pole_rad_s for m in coupled.modes), key=lambda p: abs(p - poles[-1]))
        else:
            found = coupled.mode_near(250.0).pole_rad_s
        poles.append(found)
    return np.array(poles)


def parts_of(length_s: float) -> int:
    """Fewest equal parts of a length that are no longer than `INTERVAL_S`."""
    return max(1, math.ceil(length_s / INTERVAL_S - 1e-9))


class VaryingStream:
    """Counterpart of `ResponseStream` for a sensor that is another at every time.

    Parameters
    ----------
    coupled_at : callable
        The linear sensor at a time [s] since the start.
    delay_s, negligible_v : float
        As in `ResponseStream`.
    """

    def __init__(
        self,
        coupled_at: Callable[[float], CoupledBimorph],
        *,
        delay_s: float = 0.0,
        negligible_v: float = 0.0,
    ) -> None:
        self._coupled_at = coupled_at
        self._coupled = coupled_at(0.0)
        self._stream = ResponseStream(
            self._coupled.modal, delay_s=delay_s, negligible_v=negligible_v
        )
        self._time = 0.0

    def play(self, lines: Lines) -> FloatArray:
        """Return the response to the next period of an excitation, as `ResponseStream.play`."""
        samples, rate_hz = lines.samples_per_period, lines.sample_rate_hz
        ends = np.linspace(0, samples, parts_of(samples / rate_hz) + 1).astype(int)
        start, parts = self._time, []
        for begin, end in pairwise(ends):
            middle_s = start + float(begin + end) / 2 / rate_hz
            contact = self._coupled_at(middle_s)
            self._stream.become(contact.modal, self._coupled.carry_state(self._stream.state, contact))
            self._coupled = contact
            parts.append(self._stream.play(lines, int(end - begin)))
        self._time = start + samples / rate_hz
        return np.concatenate(parts)
