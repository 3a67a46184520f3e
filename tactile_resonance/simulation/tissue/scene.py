# SPDX-License-Identifier: Apache-2.0
"""Phantoms on the table: regions of space, what fills them, and what is buried under the surface."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance._typing import FloatArray, IntArray
from tactile_resonance.configuration import share_path
from tactile_resonance.fields import build, check_above_zero, read_dataclass, read_yaml, require
from tactile_resonance.sensor import read_sensor
from tactile_resonance.simulation.plant.surfaces import SurfaceMotion
from tactile_resonance.simulation.tissue.hertz import Tissue
from tactile_resonance.simulation.tissue.library import (
    FillingEntry,
    Material,
    TissueEntry,
    TissueLibrary,
    mixture,
)
from tactile_resonance.simulation.tissue.shapes import Shape, ShapeEntry, energy_share


@dataclass(frozen=True)
class Region:
    """A shape filled with one material."""

    name: str
    shape: Shape
    material: Material


@dataclass(frozen=True)
class Buried:
    """Something under the surface: an inclusion, the layer below a layer.

    The tip feels it as far as the stresses of its contact reach: with the share f of the strain
    energy inside the shape (`energy_share`), ``1/E = (1 - f)/E_region + f/E_buried``, and Prony
    ratios at f between the two. Exact to first order in the contrast, otherwise less than the truth
    for what is stiffer. The contact radius is that of the tip on the region alone.

    Attributes
    ----------
    name : str
    shape : Shape
    tissue : Tissue
    """

    name: str
    shape: Shape
    tissue: Tissue

    def felt_at(self, surface_point_m: FloatArray, above: Tissue, radius_m: float) -> Tissue:
        """Return what the tip feels at a point (3,) of the surface where `above` lies."""
        share = energy_share(self.shape, surface_point_m, radius_m)
        if share == 0:
            return above
        low, high = above.relaxation_modulus_1s_pa, self.tissue.relaxation_modulus_1s_pa
        return mixture(above, self.tissue, share, 1 / ((1 - share) / low + share / high))


@dataclass(frozen=True)
class PhantomScene:
    """What lies on the table, its surface at height 0. Where regions overlap, the later is there.

    Attributes
    ----------
    name : str
    force_n : float
        Contact force asked for [N].
    regions : tuple of Region
    buried : tuple of Buried
        Felt from the surface of whatever region is there.
    motion : SurfaceMotion or None
        How the surface moves along its normal; None: it is at rest.
    tip_radius_m, poisson_ratio : float
        They set how deep the tip feels; of no account where nothing is buried.
    """

    name: str
    force_n: float
    regions: tuple[Region, ...]
    buried: tuple[Buried, ...] = ()
    motion: SurfaceMotion | None = None
    tip_radius_m: float = 2.5e-3
    poisson_ratio: float = 0.49

    def region_index(self, position_m: ArrayLike) -> IntArray:
        """Return the index of the region at positions (..., 2 or 3) [m], -1 where there is none."""
        position = np.asarray(position_m, dtype=float)
        good = position.ndim >= 1 and position.shape[-1] in (2, 3)
        require(good, "position_m", position.shape, "shape (..., 2) or (..., 3)")
        index = np.full(position.shape[:-1], -1, dtype=np.int64)
        for i, region in enumerate(self.regions):
            index = np.where(region.shape.contains(position), i, index)
        return index

    def region_at(self, position_m: ArrayLike) -> Region | None:
        """Return the region at one position (2 or 3 coordinates) [m], or None."""
        index = int(self.region_index(position_m))
        return None if index < 0 else self.regions[index]

    def tissue_at(self, position_m: ArrayLike) -> Tissue | None:
        """Return what the tip feels at one position (2 or 3 coordinates) [m], or None: nothing.

        Regions are looked up at the position itself; what is buried is felt from the surface
        straight above or below it.
        """
        region = self.region_at(position_m)
        if region is None:
            return None
        position = np.zeros(3)
        given = np.asarray(position_m, dtype=float)
        position[: given.size] = given
        tissue = region.material(position)
        position[2] = 0.0
        for buried in self.buried:
            # Hertz contact of the preload, as in `hertz_contact`
            plane_modulus = tissue.relaxation_modulus_1s_pa / (1 - self.poisson_ratio**2)
            radius = (0.75 * self.force_n * self.tip_radius_m / plane_modulus) ** (1 / 3)
            tissue = buried.felt_at(position, tissue, radius)
        return tissue


def read_scene(library: TissueLibrary, path: Path | None = None) -> PhantomScene:
    """Read the phantoms of a scene file; by default ``config/scenes/gelatine_phantoms.yaml``.

    Only the fields ``name``, ``force_n``, ``regions`` and, where they are there, ``buried`` and
    ``motion`` are read here; the tip is that of ``config/sensors/bimorph.yaml``.

    Raises
    ------
    ValueError
        If the file cannot be read, or one of these fields is missing or wrong.
    """
    path = share_path("config/scenes/gelatine_phantoms.yaml") if path is None else Path(path)
    content, where = read_yaml(path), f"{path.name}:"
    ours = {
        field.name: content[field.name] for field in fields(_BenchPart) if field.name in content
    }
    file = read_dataclass(_BenchPart, ours, where)
    return PhantomScene(
        name=path.stem if file.name is None else file.name,
        force_n=file.force_n,
        regions=tuple(
            build(entry.region, f"{where} regions[{i}]", library)
            for i, entry in enumerate(file.regions)
        ),
        buried=tuple(
            build(entry.buried, f"{where} buried[{i}]", library)
            for i, entry in enumerate(file.buried)
        ),
        motion=file.motion,
        tip_radius_m=read_sensor().tip.radius_m,
        poisson_ratio=library.contact.poisson_ratio,
    )


@dataclass(frozen=True, kw_only=True)
class _RegionEntry(FillingEntry, ShapeEntry):
    name: str | None = None

    def region(self, library: TissueLibrary) -> Region:
        percent = self.gelatine_percent
        called = "gradient" if percent is None else f"gel{percent:g}"
        name = self.name or self.tissue or called
        return Region(name, self.shape(), self.material_of(library))


@dataclass(frozen=True, kw_only=True)
class _BuriedEntry(TissueEntry, ShapeEntry):
    name: str | None = None

    def buried(self, library: TissueLibrary) -> Buried:
        require(self.disc is None, "disc", self.disc, "sphere, box or half_space")
        tissue = self.tissue_of(library)
        return Buried(self.name or tissue.name, self.shape(), tissue)


@dataclass(frozen=True, kw_only=True)
class _BenchPart:
    """What a scene file has for the bench."""

    name: str | None = None
    force_n: float
    regions: tuple[_RegionEntry, ...]
    buried: tuple[_BuriedEntry, ...] = ()
    motion: SurfaceMotion | None = None

    def __post_init__(self) -> None:
        check_above_zero(self, "force_n")
        require(bool(self.regions), "regions", [], "a list of one region or more")
