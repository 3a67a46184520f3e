# SPDX-License-Identifier: Apache-2.0
"""What a region is filled with: one tissue, a gradient between two, random heterogeneity."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance.fields import known_keys, number, numbers, require, section
from tactile_resonance.simulation.library import TissueLibrary
from tactile_resonance.simulation.modal import FloatArray
from tactile_resonance.simulation.shapes import Point
from tactile_resonance.simulation.tissue import Tissue

WAVES = 512  # of a random field: kurtosis within 0.6 % of the Gaussian one


class Material(Protocol):
    """A filling of space."""

    def tissue_at(self, position_m: FloatArray) -> Tissue:
        """Return the tissue at one position (3,) [m]."""
        ...


@dataclass(frozen=True)
class Uniform:
    """The same tissue everywhere."""

    tissue: Tissue

    def tissue_at(self, position_m: FloatArray) -> Tissue:
        """Return the tissue."""
        return self.tissue


@dataclass(frozen=True)
class Gradient:
    """A tissue that changes along the way from one point to another, constant beyond both.

    Attributes
    ----------
    start_m, end_m : tuple of 3 floats
    tissue_between : callable
        Tissue at a share of the way, 0 (start) to 1 (end).
    """

    start_m: Point
    end_m: Point
    tissue_between: Callable[[float], Tissue]

    def tissue_at(self, position_m: FloatArray) -> Tissue:
        """Return the tissue at the foot of the perpendicular on the way."""
        start = np.asarray(self.start_m)
        way = np.asarray(self.end_m) - start
        share = float((position_m - start) @ way / (way @ way))
        return self.tissue_between(min(1.0, max(0.0, share)))


@dataclass(frozen=True)
class RandomField:
    """A Gaussian random field of unit variance, correlation ``exp(-r^2 / (2 l^2))``.

    A sum of plane waves with Gaussian wave vectors (spectral representation: Shinozuka & Deodatis,
    Appl. Mech. Rev. 44 (1991)), so that its value at a place depends on the seed and the place
    alone, in whatever order places are asked for.

    Attributes
    ----------
    correlation_length_m : float
        l: distance at which the correlation is 0.61.
    seed : int
    """

    correlation_length_m: float
    seed: int

    def __post_init__(self) -> None:
        length = self.correlation_length_m
        require(0 < length < np.inf, "correlation_length_m", length, "a number above 0")
        require(self.seed >= 0, "seed", self.seed, "an integer, 0 or above")

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


@dataclass(frozen=True)
class Heterogeneous:
    """A material whose modulus varies at random: log-normal with mean 1, ratios unchanged.

    Attributes
    ----------
    material : Material
    field : RandomField
    modulus_spread : float
        Standard deviation of ln E.
    """

    material: Material
    field: RandomField
    modulus_spread: float

    def __post_init__(self) -> None:
        spread = self.modulus_spread
        require(0 <= spread <= 1, "modulus_spread", spread, "0 to 1")

    def tissue_at(self, position_m: FloatArray) -> Tissue:
        """Return the tissue there, its modulus times the local factor."""
        tissue = self.material.tissue_at(position_m)
        spread = self.modulus_spread
        factor = float(np.exp(spread * self.field.value(position_m) - spread**2 / 2))
        return replace(
            tissue,
            relaxation_modulus_1s_pa=tissue.relaxation_modulus_1s_pa * factor,
            gelatine_percent=None,
        )


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


def read_tissue(entry: Mapping[str, Any], library: TissueLibrary, where: str) -> Tissue:
    """Read the one of ``tissue`` and ``gelatine_percent`` that `entry` has."""
    given = [key for key in ("tissue", "gelatine_percent") if key in entry]
    require(len(given) == 1, where, given, "exactly one of tissue, gelatine_percent")
    try:
        if given == ["tissue"]:
            return library[str(entry["tissue"])]
        return library.gelatine(number(entry["gelatine_percent"], "gelatine_percent"))
    except ValueError as error:
        raise ValueError(f"{where}.{error}") from error


def read_material(entry: Mapping[str, Any], library: TissueLibrary, where: str) -> Material:
    """Read ``tissue``, ``gelatine_percent`` or ``gradient``, and ``heterogeneity`` where given."""
    material: Material
    if "gradient" in entry:
        both = [key for key in ("tissue", "gelatine_percent") if key in entry]
        require(not both, where, both, "no tissue beside a gradient")
        material = _read_gradient(section(entry, "gradient", where), library, f"{where}.gradient")
    else:
        material = Uniform(read_tissue(entry, library, where))
    if "heterogeneity" not in entry:
        return material
    fields, where = section(entry, "heterogeneity", where), f"{where}.heterogeneity"
    known_keys(fields, {"modulus_spread", "correlation_length_m", "seed"}, where)
    seed = fields.get("seed", 0)
    require(type(seed) is int, f"{where}.seed", seed, "an integer")
    spread = number(fields.get("modulus_spread"), f"{where}.modulus_spread")
    length = number(fields.get("correlation_length_m"), f"{where}.correlation_length_m")
    try:
        return Heterogeneous(material, RandomField(length, seed), spread)
    except ValueError as error:
        raise ValueError(f"{where}.{error}") from error


def _read_gradient(fields: Mapping[str, Any], library: TissueLibrary, where: str) -> Gradient:
    known_keys(fields, {"from", "to", "start_m", "end_m"}, where)
    first = read_tissue(section(fields, "from", where), library, f"{where}.from")
    second = read_tissue(section(fields, "to", where), library, f"{where}.to")
    start, end = (numbers(fields.get(key), f"{where}.{key}", 3) for key in ("start_m", "end_m"))
    require(start != end, f"{where}.end_m", end, "a point other than start_m")
    low, high = first.gelatine_percent, second.gelatine_percent
    if low is not None and high is not None:
        span = high - low
        return Gradient(start, end, lambda share: library.gelatine(low + share * span))
    return Gradient(start, end, lambda share: geometric_mixture(first, second, share))
