# SPDX-License-Identifier: Apache-2.0
"""Modes of a bimorph cantilever with a tip mass (Euler-Bernoulli) and their coupling.

Free-vibration equation and shapes of a cantilever with a tip mass: Erturk & Inman, *Piezoelectric
Energy Harvesting* (2011), appendix C.1, without rotary inertia of the tip.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.cantilever import cantilever_eigenvalues, tip_shape
from tactile_resonance.sensor import (
    BeamParameters,
    ElectricParameters,
    SensorParameters,
    TipParameters,
)

VACUUM_PERMITTIVITY = 8.8541878128e-12  # F/m, CODATA 2018


@dataclass(frozen=True)
class BeamModes:
    """Modal model of the beam in air, short-circuited electrodes.

    Attributes
    ----------
    natural_rad_s : (n,) array
        Undamped natural angular frequencies [rad/s], ascending.
    damping_ratio : float
        Modal damping ratio, the same for all modes.
    tip_deflection : (n,) array
        Mass-normalised mode shapes at the tip [kg^-1/2].
    tip_slope : (n,) array
        Their slopes at the tip [kg^-1/2 m^-1].
    coupling : (n,) array
        ``chi_i = theta * tip_slope_i`` [N kg^-1/2 / V]: modal force per volt.
    capacitance_f : float
        Total capacitance ``Ct = Cp + Cs`` across the sensing layer [F], Cp clamped.
    eigenvalues : (n,) array
        Roots beta of the frequency equation, ``natural = (beta / L)^2 sqrt(EI / m)``.
    bending_stiffness_nm2 : float
        EI [N m^2].
    length_m : float
        Free length [m].
    """

    natural_rad_s: FloatArray
    damping_ratio: float
    tip_deflection: FloatArray
    tip_slope: FloatArray
    coupling: FloatArray
    capacitance_f: float
    eigenvalues: FloatArray
    bending_stiffness_nm2: float
    length_m: float

    @property
    def static_stiffness_n_per_m(self) -> float:
        """Stiffness of the whole beam at the tip, ``3 EI / L^3`` [N/m]."""
        return 3 * self.bending_stiffness_nm2 / self.length_m**3


def bending_stiffness(beam: BeamParameters) -> float:
    """Return EI [N m^2] of the section, ``b [2/3 Yp ((hs/2+hp)^3 - (hs/2)^3) + Ys hs^3/12]``."""
    half = beam.shim_thickness_m / 2
    piezo = 2 / 3 * beam.piezo_modulus_pa * ((half + beam.piezo_thickness_m) ** 3 - half**3)
    shim = beam.shim_modulus_pa * beam.shim_thickness_m**3 / 12
    return beam.width_m * (piezo + shim)


def mass_per_length(beam: BeamParameters) -> float:
    """Return the mass per unit length [kg/m]."""
    piezo = 2 * beam.piezo_thickness_m * beam.piezo_density_kg_per_m3
    return beam.width_m * (piezo + beam.shim_thickness_m * beam.shim_density_kg_per_m3)


def clamped_capacitance(beam: BeamParameters) -> float:
    """Return the clamped capacitance of one layer, ``(K33T eps0 - d31^2 Yp) b L / hp`` [F]."""
    permittivity = beam.relative_permittivity_t33 * VACUUM_PERMITTIVITY
    permittivity -= beam.d31_m_per_v**2 * beam.piezo_modulus_pa
    if permittivity <= 0:
        raise ValueError(
            f"relative_permittivity_t33: got {beam.relative_permittivity_t33!r}; accepted is above "
            "d31^2 Y11 / eps0, below which the clamped capacitance is not positive"
        )
    return permittivity * beam.width_m * beam.free_length_m / beam.piezo_thickness_m


def beam_modes(beam: BeamParameters, tip: TipParameters, electric: ElectricParameters) -> BeamModes:
    """Return the modal model of the beam with its tip."""
    length, line_mass = beam.free_length_m, mass_per_length(beam)
    stiffness = bending_stiffness(beam)
    beta = cantilever_eigenvalues(tip.mass_kg / (line_mass * length), beam.mode_count)  # (n,)
    deflection, slope = tip_shape(beta, line_mass * length, tip.mass_kg)  # (n,), (n,)
    slope = slope / length
    # moment per volt of one driven layer, |d31| Yp b (hp + hs) / 2
    arm = (beam.piezo_thickness_m + beam.shim_thickness_m) / 2
    moment = abs(beam.d31_m_per_v) * beam.piezo_modulus_pa * beam.width_m * arm
    return BeamModes(
        natural_rad_s=(beta / length) ** 2 * np.sqrt(stiffness / line_mass),
        damping_ratio=beam.modal_damping_ratio,
        tip_deflection=deflection,
        tip_slope=slope,
        coupling=moment * slope,
        capacitance_f=clamped_capacitance(beam) / (1 - electric.feedthrough),
        eigenvalues=beta,
        bending_stiffness_nm2=stiffness,
        length_m=length,
    )


@lru_cache(maxsize=8)
def sensor_modes(sensor: SensorParameters) -> BeamModes:
    """Return the modal model of a sensor's beam; computed once, whatever the sensor touches."""
    return beam_modes(sensor.beam, sensor.tip, sensor.electric)
