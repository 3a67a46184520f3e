# SPDX-License-Identifier: Apache-2.0
"""Tissue, a generalised Maxwell solid (Prony series), and the spherical tip that rests on it.

A small vibration about a Hertz contact sees the flat punch of the contact radius under the preload; waves carry
energy away as from a disc on a half-space (cone model of Lysmer and Wolf, nu -> 1/2).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance._typing import ComplexArray
from tactile_resonance.calibration.model import ContactStiffness
from tactile_resonance.fields import AboveZero, Checked, Range, require
from tactile_resonance.mechanics.indentation import Prony


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

    @cached_property
    def prony(self) -> Prony:
        """The series, with Einf from ``E(1 s) = Einf + sum E_j exp(-1 s / tau_j)``."""
        times_s = np.asarray(self.prony_times_s, dtype=float)
        moduli_pa = self.relaxation_modulus_1s_pa * np.asarray(self.prony_ratios, dtype=float)
        left_pa = float(self.relaxation_modulus_1s_pa - moduli_pa @ np.exp(-1 / times_s))
        return Prony(left_pa, moduli_pa, times_s)


@dataclass(frozen=True)
class HertzParameters(Checked):
    """How the tip touches: preload [N] and what all tissues have in common."""

    force_n: AboveZero
    poisson_ratio: Annotated[float, Range(0, 0.5)]
    density_kg_per_m3: AboveZero
    radiation: bool
    radiation_reference_hz: AboveZero


@dataclass(frozen=True)
class HertzContact:
    """A tip resting on tissue, as the vibrating beam sees it.

    Attributes
    ----------
    tissue : Tissue
    force_n, contact_radius_m, indentation_m : float
        Preload, Hertz contact radius and indentation ``a^2 / R`` of it.
    stiffness_factor_m : float
        ``2 a / (1 - nu^2)`` [m]: dynamic stiffness per modulus.
    radiation_damping_ns_per_m, radiation_mass_kg : float
        c and m of ``k*(s) = stiffness_factor E*(s) + c s + m s^2``; 0 without radiation.
    """

    tissue: Tissue
    force_n: float
    contact_radius_m: float
    indentation_m: float
    stiffness_factor_m: float
    radiation_damping_ns_per_m: float
    radiation_mass_kg: float

    @property
    def stiffness(self) -> ContactStiffness:
        """``k*``, term by term."""
        prony, per_pa = self.tissue.prony, self.stiffness_factor_m
        radiated = self.radiation_damping_ns_per_m, self.radiation_mass_kg
        return ContactStiffness(
            per_pa * prony.equilibrium_pa, per_pa * prony.moduli_pa, prony.times_s, *radiated
        )

    def dynamic_stiffness(self, s_rad_s: ArrayLike) -> ComplexArray:
        """Return ``k*(s)`` [N/m] at complex s [rad/s], of the shape of `s_rad_s`."""
        s = np.asarray(s_rad_s, dtype=complex)
        radiated = self.radiation_damping_ns_per_m * s + self.radiation_mass_kg * s**2
        return np.asarray(self.stiffness_factor_m * self.tissue.prony.complex_modulus(s) + radiated)


def hertz_contact(
    tissue: Tissue,
    tip_radius_m: float,
    parameters: HertzParameters,
    *,
    force_n: float | None = None,
    hold_time_s: float = 1.0,
) -> HertzContact:
    """Return the contact at a preload.

    Parameters
    ----------
    tissue : Tissue
    tip_radius_m : float
        Radius R of the ball [m].
    parameters : HertzParameters
    force_n : float, optional
        Preload [N] in place of that of `parameters`.
    hold_time_s : float
        How long the force has been held [s]. At 1 s the contact radius is
        ``a = (3 F R / 4 E)^(1/3)``, ``E = E(1 s) / (1 - nu^2)``; under force hold ``a^3`` goes as
        the creep compliance J(t).

    Notes
    -----
    A force put on at once and held for 1 s has ``1 / J(1 s)`` in place of E(1 s): ``a^3`` is less by 0.1 % on
    the gelatines of the configuration, by 7 % on brain, whose cortex is 0.14 Hz higher then. E(1 s) is what a
    relaxation test measures, and what the truth is defined with.

    The shear wave speed of the radiation is
    ``sqrt(|E*(j 2 pi f_ref)| / (2 (1 + nu) rho))``, held constant; with other moduli the damping
    ratio found on brain cortex ranges over 0.034 to 0.057.
    """
    force = parameters.force_n if force_n is None else force_n
    require(0 < force < np.inf, "force_n", force, "a number above 0")
    require(0 < hold_time_s < np.inf, "hold_time_s", hold_time_s, "a number above 0")
    plane_modulus = tissue.relaxation_modulus_1s_pa / (1 - parameters.poisson_ratio**2)
    compliance = tissue.prony.creep_compliance
    creep = compliance(hold_time_s) / compliance(1.0)
    radius = float((3 * force * tip_radius_m / (4 * plane_modulus) * creep) ** (1 / 3))
    return contact_of_radius(
        tissue, radius, parameters, force_n=float(force), indentation_m=radius**2 / tip_radius_m
    )


def contact_of_radius(
    tissue: Tissue,
    radius_m: float,
    parameters: HertzParameters,
    *,
    force_n: float,
    indentation_m: float,
) -> HertzContact:
    """Return the contact of a given contact radius [m], however it came about.

    Force and indentation are carried along: a small vibration sees the radius alone.
    """
    require(0 < radius_m < np.inf, "radius_m", radius_m, "a number above 0")
    nu, density = parameters.poisson_ratio, parameters.density_kg_per_m3
    damping = mass = 0.0
    if parameters.radiation:
        reference_rad_s = 2 * np.pi * parameters.radiation_reference_hz
        modulus = tissue.prony.complex_modulus(1j * reference_rad_s)
        wave_speed = np.sqrt(np.abs(modulus) / (2 * (1 + nu) * density))
        damping = float(2 * density * wave_speed * np.pi * radius_m**2)
        mass = 1.257 * density * radius_m**3
    return HertzContact(
        tissue=tissue,
        force_n=force_n,
        contact_radius_m=radius_m,
        indentation_m=indentation_m,
        stiffness_factor_m=2 * radius_m / (1 - nu**2),
        radiation_damping_ns_per_m=damping,
        radiation_mass_kg=mass,
    )
