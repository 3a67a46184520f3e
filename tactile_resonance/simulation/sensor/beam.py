# SPDX-License-Identifier: Apache-2.0
"""Modes of a bimorph cantilever with a tip mass (Euler-Bernoulli) and their coupling.

Free-vibration equation and shapes of a cantilever with a tip mass: Erturk & Inman, *Piezoelectric
Energy Harvesting* (2011), appendix C.1, without rotary inertia of the tip.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from tactile_resonance.sensor import (
    BeamParameters,
    ElectricParameters,
    SensorParameters,
    TipParameters,
)

VACUUM_PERMITTIVITY = 8.8541878128e-12  # F/m, CODATA 2018

FloatArray = NDArray[np.float64]


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


def frequency_equation(beta: float, mass_ratio: float) -> float:
    """Return the frequency equation divided by cosh(beta), so that it does not overflow.

    ``1/cosh + cos + mu beta (cos tanh - sin)``, zero at the eigenvalues.
    """
    # exp(-beta) form of 1 / cosh: no overflow at any beta
    sech = 2 * np.exp(-beta) / (1 + np.exp(-2 * beta))
    inertia = mass_ratio * beta * (np.cos(beta) * np.tanh(beta) - np.sin(beta))
    return float(sech + np.cos(beta) + inertia)


def cantilever_eigenvalues(mass_ratio: float, count: int) -> FloatArray:
    """Return the first `count` eigenvalues beta of a cantilever with tip mass, shape (count,).

    Parameters
    ----------
    mass_ratio : float
        Tip mass over beam mass, 0 or above.
    count : int
        Number of modes.

    Notes
    -----
    With growing tip mass root n falls from that of the bare cantilever (mu = 0) to that of a beam
    clamped at one end and pinned at the other (mu = infinity, ``tan = tanh``). Both bounds lie in
    ``((n - 1) pi, n pi)``, n = 1 ... count, and no other root does; at ``n pi`` the equation has
    the sign of ``cos(n pi)``, at ``(n - 1) pi`` the opposite: a bracket for every root.
    """
    if mass_ratio < 0:
        raise ValueError(f"mass_ratio: got {mass_ratio!r}; accepted is 0 or above")
    roots = [
        brentq(frequency_equation, n * np.pi, (n + 1) * np.pi, args=(mass_ratio,), xtol=1e-15)
        for n in range(count)
    ]
    return np.array(roots)


def beam_modes(beam: BeamParameters, tip: TipParameters, electric: ElectricParameters) -> BeamModes:
    """Return the modal model of the beam with its tip."""
    length, line_mass = beam.free_length_m, mass_per_length(beam)
    stiffness = bending_stiffness(beam)
    beta = cantilever_eigenvalues(tip.mass_kg / (line_mass * length), beam.mode_count)  # (n,)
    deflection, slope = _tip_shape(beta, line_mass * length, tip.mass_kg)  # (n,), (n,)
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


def mode_shape(beta: FloatArray, position: FloatArray) -> FloatArray:
    """Return unnormalised mode shapes, shape (n, x).

    ``cosh bx - cos bx - sigma (sinh bx - sin bx)`` with ``sigma = (cosh + cos) / (sinh + sin)`` at
    the tip (no bending moment there). The growing exponentials are joined beforehand,
    ``cosh bx - sigma sinh bx = exp(-bx) + (1 - sigma) sinh bx``, so that no large terms cancel.

    Parameters
    ----------
    beta : (n,) array
        Eigenvalues.
    position : (x,) array
        Positions over the free length, 0 (clamp) to 1 (tip).
    """
    sigma, growing = _shape_factors(beta)  # (n,), (n,)
    bx = beta[:, None] * position  # (n, x)
    decay, sharp = np.exp(-bx), np.exp(bx - beta[:, None])  # exp(-bx), exp(bx - b)
    # (1 - sigma) sinh bx, with (1 - sigma) = growing * exp(-b)
    rising = growing[:, None] * (sharp - decay * np.exp(-beta[:, None])) / 2
    return decay + rising - np.cos(bx) + sigma[:, None] * np.sin(bx)


def _shape_factors(beta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return sigma and ``(1 - sigma) exp(beta)``, both without overflow or cancellation."""
    fall = np.exp(-beta)
    denominator = (1 - fall**2) / 2 + np.sin(beta) * fall  # (sinh + sin) exp(-beta)
    sigma = ((1 + fall**2) / 2 + np.cos(beta) * fall) / denominator
    growing = (np.sin(beta) - np.cos(beta) - fall) / denominator
    return sigma, growing


def _tip_shape(
    beta: FloatArray, beam_mass: float, tip_mass: float
) -> tuple[FloatArray, FloatArray]:
    """Return mass-normalised deflection and slope (per unit of relative position) at the tip."""
    nodes, weights = np.polynomial.legendre.leggauss(16 * beta.size + 32)
    shape = mode_shape(beta, (nodes + 1) / 2)  # (n, x)
    deflection = mode_shape(beta, np.ones(1))[:, 0]
    modal_mass = beam_mass * (shape**2 @ weights) / 2 + tip_mass * deflection**2  # (n,)
    sigma, growing = _shape_factors(beta)
    fall = np.exp(-beta)
    slope = -fall + growing * (1 + fall**2) / 2 + np.sin(beta) + sigma * np.cos(beta)
    return deflection / np.sqrt(modal_mass), beta * slope / np.sqrt(modal_mass)
