# SPDX-License-Identifier: Apache-2.0
"""Phantoms on the table: regions of space, what fills them, and how much of what is buried a tip feels.

Where the modulus under the tip varies from place to place, the compliance it feels is, to first order in the
contrast, the mean of 1 / E weighted with the strain energy of the homogeneous contact. For any contrast this
mean is an upper bound of the compliance (principle of least complementary energy: the homogeneous stresses are
statically admissible), hence it never overstates what a stiff inclusion does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance._typing import BoolArray, FloatArray, IntArray
from tactile_resonance.configuration import share_path
from tactile_resonance.contact.samples import Pose
from tactile_resonance.contact.vectors import Vector
from tactile_resonance.fields import AboveZero, Checked, build, read_dataclass, read_yaml, require
from tactile_resonance.sensor import read_sensor
from tactile_resonance.simulation.plant.surfaces import PlantSurface, SurfaceMotion
from tactile_resonance.simulation.tissue.library import (
    GradientEntry,
    HeterogeneityEntry,
    Material,
    Tissue,
    TissueEntry,
    TissueLibrary,
    mixture,
    uniform,
)

Point = tuple[float, ...]


@dataclass(frozen=True)
class Disc(Checked):
    """A disc in x, y at any height: the surface of a round dish."""

    center_m: tuple[float, float]
    radius_m: AboveZero

    def contains(self, position_m: FloatArray) -> BoolArray:
        """Tell which positions lie inside or on the edge."""
        distance = np.linalg.norm(position_m[..., :2] - np.asarray(self.center_m), axis=-1)
        return np.asarray(distance <= self.radius_m)


@dataclass(frozen=True)
class Box:
    """A box with edges along the axes; two coordinates per corner leave the height open."""

    low_m: Point
    high_m: Point

    def __post_init__(self) -> None:
        low, high = self.low_m, self.high_m
        require(len(low) in (2, 3), "low_m", low, "2 or 3 coordinates")
        above = len(high) == len(low) and all(a < b for a, b in zip(low, high, strict=True))
        require(above, "high_m", high, f"above low_m = {low} in every coordinate")

    def contains(self, position_m: FloatArray) -> BoolArray:
        """Tell which positions lie inside or on the faces."""
        position = position_m[..., : len(self.low_m)]
        inside = (position >= np.asarray(self.low_m)) & (position <= np.asarray(self.high_m))
        return np.asarray(inside.all(axis=-1))


@dataclass(frozen=True)
class HalfSpace:
    """All positions with ``normal . (position - point) <= 0``."""

    point_m: Point
    normal: Point

    def __post_init__(self) -> None:
        require(len(self.point_m) in (2, 3), "point_m", self.point_m, "2 or 3 coordinates")
        good = len(self.normal) == len(self.point_m) and any(self.normal)
        require(good, "normal", self.normal, "a vector other than 0, of as many coordinates")

    def contains(self, position_m: FloatArray) -> BoolArray:
        """Tell which positions lie on the side the normal points away from."""
        position = position_m[..., : len(self.normal)]
        return np.asarray((position - np.asarray(self.point_m)) @ np.asarray(self.normal) <= 0)


@dataclass(frozen=True)
class Sphere(Checked):
    """A ball."""

    center_m: Vector
    radius_m: AboveZero

    def contains(self, position_m: FloatArray) -> BoolArray:
        """Tell which positions lie inside or on the surface."""
        x, y, z = np.moveaxis(position_m - np.asarray(self.center_m), -1, 0)
        return np.asarray(x * x + y * y + z * z <= self.radius_m**2)


Shape = Disc | Box | HalfSpace | Sphere


def _in_space(position_m: ArrayLike) -> FloatArray:
    """Positions (..., 2 or 3) as (..., 3); those without a height are at height 0."""
    position = np.asarray(position_m, dtype=float)
    good = position.ndim >= 1 and position.shape[-1] in (2, 3)
    require(good, "position_m", position.shape, "shape (..., 2) or (..., 3)")
    return np.pad(position, [(0, 0)] * (position.ndim - 1) + [(0, 3 - position.shape[-1])])


@dataclass(frozen=True, kw_only=True)
class ShapeEntry:
    """Part of a file: one shape."""

    disc: Disc | None = None
    box: Box | None = None
    half_space: HalfSpace | None = None
    sphere: Sphere | None = None

    def shape(self) -> Shape:
        """Return the one that is given; ``ValueError`` if there is none, or more than one."""
        names = ("disc", "box", "half_space", "sphere")
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        require(len(given) == 1, "shape", list(given), f"exactly one of {', '.join(names)}")
        (shape,) = given.values()
        return shape


def hertz_stress(radial: ArrayLike, depth: ArrayLike) -> tuple[FloatArray, ...]:
    """Return (s_r, s_theta, s_z, tau_rz) below a sphere on an incompressible half-space.

    Closed form of Huber (1904), see Johnson, *Contact Mechanics* (1985), ch. 3.4, or
    Fischer-Cripps, *Introduction to Contact Mechanics* (2007), ch. 5.4.

    Parameters
    ----------
    radial, depth : (...) arrays
        In contact radii; depth above 0.

    Returns
    -------
    tuple of (...) arrays
        In units of the mean contact pressure, tension positive.
    """
    r, z = np.asarray(radial, dtype=float), np.asarray(depth, dtype=float)
    sum_ = r**2 + z**2 - 1
    root = np.sqrt(sum_**2 + 4 * z**2)
    # (sum + root) / 2 without cancellation where the sum is negative
    u = np.where(sum_ > 0, (sum_ + root) / 2, 2 * z**2 / (root - np.minimum(sum_, 0)))
    slant = z / np.sqrt(u)
    own = slant**3 * u / (u**2 + z**2)
    side = slant * (0.5 * u / (1 + u) + 1.5 * np.sqrt(u) * np.arctan(1 / np.sqrt(u)))
    s_r = 1.5 * (own + side - 2 * slant)
    s_theta = -1.5 * (slant + slant * 0.5 * u / (1 + u))
    s_theta = s_theta + 1.5 * slant * 1.5 * np.sqrt(u) * np.arctan(1 / np.sqrt(u))
    s_z = -1.5 * own
    tau = -1.5 * r * z**2 / (u**2 + z**2) * np.sqrt(u) / (1 + u)
    return s_r, s_theta, s_z, tau


def energy_density(radial: ArrayLike, depth: ArrayLike) -> FloatArray:
    """Return the strain energy density times G over the mean pressure squared, (...) array."""
    s_r, s_theta, s_z, tau = hertz_stress(radial, depth)
    mean = (s_r + s_theta + s_z) / 3
    square = (s_r - mean) ** 2 + (s_theta - mean) ** 2 + (s_z - mean) ** 2 + 2 * tau**2
    return np.asarray(square / 4)


@lru_cache(maxsize=1)
def energy_nodes() -> tuple[FloatArray, FloatArray]:
    """Return points (k, n, 3) below the contact, in contact radii, and their energies (k, n), sum 1.

    Products of Gauss-Legendre rules in distance and polar angle, turned about the normal by the
    golden angle from one to the next, so that no plane of symmetry meets many points at once.
    A simulated robot asks for them as it moves, so they lie coordinate by coordinate, in parts of 100 kB: what
    is computed of larger ones gets its memory from the system each time, which takes longer than a step.
    """
    s, ws = np.polynomial.legendre.leggauss(64)
    t, wt = np.polynomial.legendre.leggauss(32)
    azimuths = 48
    s, ws = (s + 1) / 2, ws / 2
    distance, jacobian = s / (1 - s), 1 / (1 - s) ** 2
    angle = (t + 1) * np.pi / 4  # from the normal
    radial = np.outer(distance, np.sin(angle))  # (s, t)
    depth = np.outer(distance, np.cos(angle))
    weight = np.outer(ws * jacobian * distance**2, wt * np.sin(angle)) * energy_density(
        radial, depth
    )
    turn = np.arange(radial.size).reshape(radial.shape) * np.pi * (3 - np.sqrt(5))
    phi = turn[..., None] + 2 * np.pi / azimuths * np.arange(azimuths)  # (s, t, azimuths)
    coordinates = np.stack(
        [
            radial[..., None] * np.cos(phi),
            radial[..., None] * np.sin(phi),
            np.broadcast_to(-depth[..., None], phi.shape),
        ]
    ).reshape(3, -1, 4096)
    points = np.ascontiguousarray(coordinates.swapaxes(0, 1)).swapaxes(1, 2)
    weights = np.broadcast_to(weight[..., None], phi.shape).reshape(-1, 4096)
    return points, weights / weights.sum()


def energy_share(
    shape: Shape, surface_point_m: ArrayLike, contact_radius_m: float, but: Sequence[Shape] = ()
) -> float:
    """Return the share of the strain energy that lies inside a shape, 0 to 1.

    Parameters
    ----------
    shape : Shape
    surface_point_m : (3,) array
        Where the tip touches; the normal is +z.
    contact_radius_m : float
    but : sequence of Shape
        What lies inside one of these, too, does not count.
    """
    points, weights = energy_nodes()
    at_m = np.asarray(surface_point_m)
    inside = []
    for place_m in (at_m + contact_radius_m * part for part in points):
        elsewhere = np.any([other.contains(place_m) for other in but], axis=0)
        inside.append(shape.contains(place_m) & ~elsewhere)
    return float(weights[np.array(inside)].sum())


@dataclass(frozen=True)
class Region:
    """A shape filled with one material."""

    name: str
    shape: Shape
    material: Material


@dataclass(frozen=True)
class Buried:
    """Something under the surface: an inclusion, the layer below a layer."""

    name: str
    shape: Shape
    tissue: Tissue


def felt_at(
    surface_point_m: FloatArray, above: Tissue, buried: Sequence[Buried], radius_m: float
) -> Tissue:
    """Return what the tip feels at a point (3,) of the surface where `above` lies.

    It feels what is buried as far as the stresses of its contact reach: with the shares f_i of the strain
    energy inside each (`energy_share`; where they overlap, the later one is there),
    ``1/E = (1 - sum f_i)/E_above + sum f_i/E_i``, and Prony ratios by the same shares. Exact to first order in
    the contrast, otherwise less than the truth for what is stiffer. The contact radius is that of the tip on
    `above` alone.
    """
    shapes = [each.shape for each in buried]
    shares = [
        energy_share(shape, surface_point_m, radius_m, shapes[n:]) for n, shape in enumerate(shapes, 1)
    ]
    felt, so_far = above, 1 - sum(shares)
    for each, part in zip(buried, shares, strict=True):
        so_far += part
        if part:
            share = min(1.0, part / so_far)
            low, high = felt.relaxation_modulus_1s_pa, each.tissue.relaxation_modulus_1s_pa
            felt = mixture(felt, each.tissue, share, 1 / ((1 - share) / low + share / high))
    return felt


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
        Felt from the surface of whatever region is there (`felt_at`).
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
        position = _in_space(position_m)
        index = np.full(position.shape[:-1], -1, dtype=np.int64)
        for i, region in enumerate(self.regions):
            index = np.where(region.shape.contains(position), i, index)
        return index

    def tissue_at(self, position_m: ArrayLike) -> Tissue | None:
        """Return what the tip feels at one position (2 or 3 coordinates) [m], or None: nothing.

        Regions are looked up at the position itself; what is buried is felt from the surface
        straight above or below it.
        """
        index = int(self.region_index(position_m))
        if index < 0:
            return None
        position = _in_space(position_m)
        tissue = self.regions[index].material(position)
        position[2] = 0.0
        # Hertz contact of the preload, as in `hertz_contact`
        plane_modulus = tissue.relaxation_modulus_1s_pa / (1 - self.poisson_ratio**2)
        radius = (0.75 * self.force_n * self.tip_radius_m / plane_modulus) ** (1 / 3)
        return felt_at(position, tissue, self.buried, radius)


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
class _RegionEntry(TissueEntry, ShapeEntry):
    gradient: GradientEntry | None = None
    heterogeneity: HeterogeneityEntry | None = None
    name: str | None = None

    def region(self, library: TissueLibrary) -> Region:
        percent, shape = self.gelatine_percent, self.shape()
        if self.gradient is None:
            material = uniform(self.tissue_of(library))
        else:
            given = [value for value in (self.tissue, percent) if value is not None]
            require(not given, "gradient", given, "no tissue beside a gradient")
            material = build(self.gradient.gradient_of, "gradient", library)
        if self.heterogeneity is not None:
            material = self.heterogeneity.over(material)
        called = "gradient" if percent is None else f"gel{percent:g}"
        return Region(self.name or self.tissue or called, shape, material)


@dataclass(frozen=True, kw_only=True)
class _BuriedEntry(TissueEntry, ShapeEntry):
    name: str | None = None

    def buried(self, library: TissueLibrary) -> Buried:
        require(self.disc is None, "disc", self.disc, "sphere, box or half_space")
        tissue = self.tissue_of(library)
        return Buried(self.name or tissue.name, self.shape(), tissue)


@dataclass(frozen=True, kw_only=True)
class _BenchPart(Checked):
    """What a scene file has for the bench."""

    name: str | None = None
    force_n: AboveZero
    regions: tuple[_RegionEntry, ...]
    buried: tuple[_BuriedEntry, ...] = ()
    motion: SurfaceMotion | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require(bool(self.regions), "regions", [], "a list of one region or more")


@dataclass(frozen=True)
class LaidScene:
    """A scene on the table: its surface, at height 0, and what lies where.

    Attributes
    ----------
    scene : PhantomScene
    table : Pose
        Frame of the scene in the robot's base.
    """

    scene: PhantomScene
    table: Pose

    def surface(self) -> PlantSurface:
        """The undisturbed surface in the base."""
        return PlantSurface(self.table.position_m, self.table.rotation.apply([0.0, 0.0, 1.0]))

    def tissue_at(self, position_m: FloatArray) -> Tissue | None:
        """What the tip touches under a place (3,) in the base."""
        x, y, _ = self.table.rotation.inv().apply(position_m - self.table.position_m)
        return self.scene.tissue_at(np.array([x, y, 0.0]))
