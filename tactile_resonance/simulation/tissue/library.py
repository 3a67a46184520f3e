# SPDX-License-Identifier: Apache-2.0
"""Tissue, the tip that rests on it, tissues by name (``config/tissues.yaml``), and what fills regions.

Tissue is a generalised Maxwell solid (Prony series). A small vibration about a Hertz contact sees the flat
punch of the contact radius under the preload; waves carry energy away as from a disc on a half-space (cone
model of Lysmer and Wolf, nu -> 1/2). Regions are filled with one tissue, gelatine of any concentration, a
gradient between two, random heterogeneity.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.calibration.model import ContactStiffness
from tactile_resonance.configuration import share_path
from tactile_resonance.contact.vectors import Vector
from tactile_resonance.fields import AboveZero, Checked, Range, Seed, build, read_file, require
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


GELATINE_PERCENT_RANGE = (8.0, 20.0)  # how far the power law is trusted beyond the tabulated values


@dataclass(frozen=True)
class TissueLibrary:
    """Tissues by name, and the contact they share."""

    contact: HertzParameters
    tissues: Mapping[str, Tissue]

    def __getitem__(self, name: str) -> Tissue:
        """Return the tissue `name`; ``ValueError`` listing the known names otherwise."""
        require(name in self.tissues, "tissue", name, f"one of {sorted(self.tissues)}")
        return self.tissues[name]

    def gelatine(self, percent: float) -> Tissue:
        """Return gelatine of any concentration [% w/w].

        E(1 s) follows a power law of the concentration between neighbouring tabulated values (a
        straight line in log-log), which it reproduces exactly; the outermost segments are
        continued. The Prony ratios are those of all tabulated gelatine.

        Raises
        ------
        ValueError
            If `percent` lies outside 8 to 20, or the library holds fewer than two gelatines, or
            gelatines of different Prony terms.
        """
        low, high = GELATINE_PERCENT_RANGE
        require(low <= percent <= high, "gelatine_percent", percent, f"{low:g} to {high:g} % w/w")
        table = {t.gelatine_percent: t for t in self.tissues.values() if t.gelatine_percent}
        require(len(table) >= 2, "tissues", len(table), "a library with two or more gelatines")
        first = next(iter(table.values()))
        for t in table.values():
            same = (t.prony_times_s, t.prony_ratios) == (first.prony_times_s, first.prony_ratios)
            require(same, f"{t.name}.prony_ratios", t.prony_ratios, "those of all gelatine")
        concentrations = np.array(sorted(table))
        moduli = np.array([table[c].relaxation_modulus_1s_pa for c in concentrations])
        exponents = np.diff(np.log(moduli)) / np.diff(np.log(concentrations))
        # power law through the tabulated value at or below: exact there, continuous at the next
        start = max(0, int(np.searchsorted(concentrations, percent, side="right")) - 1)
        exponent = exponents[min(start, len(exponents) - 1)]
        modulus = float(moduli[start] * (percent / concentrations[start]) ** exponent)
        return Tissue(
            name=f"gel{percent:g}",
            relaxation_modulus_1s_pa=modulus,
            prony_times_s=first.prony_times_s,
            prony_ratios=first.prony_ratios,
            label=f"gelatine {percent:g} %",
            gelatine_percent=float(percent),
        )


def read_tissues(path: Path | None = None) -> TissueLibrary:
    """Read a tissue library; without a path, ``config/tissues.yaml``.

    Raises
    ------
    ValueError
        If the file cannot be read, or a field is missing, unknown or out of range.
    """
    path = share_path("config/tissues.yaml") if path is None else Path(path)
    file = read_file(_LibraryFile, path)
    tissues = {
        name: build(entry.tissue, f"{path.name}: tissues.{name}", name, file.prony)
        for name, entry in file.tissues.items()
    }
    return TissueLibrary(file.contact, MappingProxyType(tissues))


@dataclass(frozen=True)
class _Prony:
    fast_times_s: tuple[float, ...]
    slow_times_s: tuple[float, ...]


@dataclass(frozen=True)
class _TissueFields:
    relaxation_modulus_1s_pa: float
    fast_ratios: tuple[float, ...]
    slow_ratios: tuple[float, ...]
    label: str | None = None
    gelatine_percent: float | None = None

    def tissue(self, name: str, prony: _Prony) -> Tissue:
        for field, ratios, times in (
            ("fast_ratios", self.fast_ratios, prony.fast_times_s),
            ("slow_ratios", self.slow_ratios, prony.slow_times_s),
        ):
            require(len(ratios) == len(times), field, ratios, f"{len(times)} numbers")
        return Tissue(
            name=name,
            relaxation_modulus_1s_pa=self.relaxation_modulus_1s_pa,
            prony_times_s=prony.fast_times_s + prony.slow_times_s,
            prony_ratios=self.fast_ratios + self.slow_ratios,
            label=name if self.label is None else self.label,
            gelatine_percent=self.gelatine_percent,
        )


@dataclass(frozen=True)
class _LibraryFile:
    contact: HertzParameters
    prony: _Prony
    tissues: Mapping[str, _TissueFields]


WAVES = 512  # of a random field: kurtosis within 0.6 % of the Gaussian one


Material = Callable[[FloatArray], Tissue]
"""A filling of space: from a position (3,) [m] to the tissue there."""


def uniform(tissue: Tissue) -> Material:
    """Return the same tissue everywhere."""
    return lambda position_m: tissue


@dataclass(frozen=True, kw_only=True)
class HeterogeneityEntry(Checked):
    """Part of a file: a Gaussian random field, and how far the modulus follows it.

    Of unit variance, correlation ``exp(-r^2 / (2 l^2))``: a sum of plane waves with Gaussian wave vectors
    (spectral representation: Shinozuka & Deodatis, Appl. Mech. Rev. 44 (1991)), so that its value at a place
    depends on the seed and the place alone, in whatever order places are asked for.

    Attributes
    ----------
    correlation_length_m : float
        l: distance at which the correlation is 0.61.
    seed : int
    modulus_spread : float
        Standard deviation of ln E.
    """

    correlation_length_m: AboveZero
    seed: Seed = 0
    modulus_spread: Annotated[float, Range(0, 1)]

    @cached_property
    def _waves(self) -> tuple[FloatArray, FloatArray]:
        """Wave vectors (3, waves) [rad/m] and phases (waves,)."""
        rng = np.random.default_rng(self.seed)
        vectors = rng.standard_normal((3, WAVES)) / self.correlation_length_m
        return vectors, rng.uniform(0, 2 * np.pi, WAVES)

    def value(self, position_m: ArrayLike) -> FloatArray:
        """Return the field at positions (..., 3) [m], shape (...)."""
        vectors, phases = self._waves
        wave = np.cos(np.asarray(position_m, dtype=float) @ vectors + phases)  # (..., waves)
        return np.asarray(np.sqrt(2 / WAVES) * wave.sum(axis=-1))

    def over(self, material: Material) -> Material:
        """Return a material whose modulus varies at random: log-normal with mean 1, ratios unchanged."""

        def tissue_at(position_m: FloatArray) -> Tissue:
            tissue, spread = material(position_m), self.modulus_spread
            exponent = spread * self.value(position_m) - spread**2 / 2
            modulus = tissue.relaxation_modulus_1s_pa * float(np.exp(exponent))
            return replace(tissue, relaxation_modulus_1s_pa=modulus, gelatine_percent=None)

        return tissue_at


def mixture(first: Tissue, second: Tissue, share: float, modulus_1s_pa: float) -> Tissue:
    """Return a tissue of a given E(1 s) whose Prony ratios lie at `share` between two tissues.

    Ratios in between leave Einf above 0 where those of both do, so a mixture is passive.

    Raises
    ------
    ValueError
        If the tissues differ in their Prony times.
    """
    times = first.prony_times_s
    require(second.prony_times_s == times, "prony_times_s", second.prony_times_s, f"{times}")
    if share in (0, 1):
        return (first, second)[int(share)]
    pairs = zip(first.prony_ratios, second.prony_ratios, strict=True)
    return Tissue(
        name=f"{first.name}_{second.name}",
        relaxation_modulus_1s_pa=modulus_1s_pa,
        prony_times_s=times,
        prony_ratios=tuple((1 - share) * a + share * b for a, b in pairs),
        label=f"{first.label or first.name}, {100 * share:.1f} % {second.label or second.name}",
    )


def geometric_mixture(first: Tissue, second: Tissue, share: float) -> Tissue:
    """Return a mixture whose E(1 s) is the weighted geometric mean (a choice: no law is known)."""
    low, high = first.relaxation_modulus_1s_pa, second.relaxation_modulus_1s_pa
    return mixture(first, second, share, low ** (1 - share) * high**share)


@dataclass(frozen=True, kw_only=True)
class TissueEntry:
    """Part of a file: a tissue by its name, or gelatine by its concentration [% w/w]."""

    tissue: str | None = None
    gelatine_percent: float | None = None

    def tissue_of(self, library: TissueLibrary) -> Tissue:
        """Return it; ``ValueError`` where neither or both are given, or the library has none such."""
        name, percent = self.tissue, self.gelatine_percent
        one = (name is None) != (percent is None)
        require(one, "tissue", name, "exactly one of tissue, gelatine_percent")
        return library.gelatine(percent) if percent is not None else library[str(name)]


@dataclass(frozen=True, kw_only=True)
class GradientEntry:
    """Part of a file: two tissues, and where they are."""

    from_: TissueEntry
    to: TissueEntry
    start_m: Vector
    end_m: Vector

    def __post_init__(self) -> None:
        apart = self.start_m != self.end_m
        require(apart, "end_m", self.end_m, "a point other than start_m")

    def gradient_of(self, library: TissueLibrary) -> Material:
        """Return what lies there, constant beyond both: gelatine between two of gelatine, else a mixture."""
        first = build(self.from_.tissue_of, "from", library)
        second = build(self.to.tissue_of, "to", library)
        low, high = first.gelatine_percent, second.gelatine_percent

        start = np.asarray(self.start_m)
        way = np.asarray(self.end_m) - start

        def tissue_at(position_m: FloatArray) -> Tissue:
            # at the foot of the perpendicular on the way
            share = min(1.0, max(0.0, float((position_m - start) @ way / (way @ way))))
            if low is None or high is None:
                return geometric_mixture(first, second, share)
            return library.gelatine(low + share * (high - low))

        return tissue_at
