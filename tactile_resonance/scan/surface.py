# SPDX-License-Identifier: Apache-2.0
"""Surfaces to scan: height and outward normal over x, y, of planes, height fields and triangle meshes."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
import scipy  # its parts are loaded where they are used first

from tactile_resonance._typing import BoolArray, FloatArray, IntArray
from tactile_resonance.array_files import read_arrays
from tactile_resonance.contact.vectors import Vector
from tactile_resonance.fields import (
    AboveZero,
    Checked,
    FileName,
    Range,
    build,
    cut,
    one_of,
    read,
    require,
)

MOST_SEARCH_M = 0.02
EDGE_RAD = 0.7
"""Between the normals of faces of a mesh that meet in an edge; less is a round surface."""
_INSIDE = 1e-9  # of the barycentric coordinates: points on a shared edge belong to both triangles


class Surface(ABC):
    """A surface seen from above: one height for each x, y. NaN where there is none."""

    @abstractmethod
    def at(self, xy_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """(...) height [m] and (..., 3) outward (upward) unit normal at (..., 2) positions [m]."""

    def height_m(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(...) height [m]."""
        return self.at(xy_m)[0]

    def normal(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(..., 3) unit normal."""
        return self.at(xy_m)[1]

    def height_std_m(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(...) standard deviation of the height [m]; 0 where the surface is given."""
        return np.zeros(np.shape(xy_m)[:-1])

    def known(self, xy_m: npt.ArrayLike) -> BoolArray:
        """(...) whether the surface is known there, not only continued from beside it."""
        return ~np.isnan(self.height_m(xy_m))


@dataclass(frozen=True)
class Plane(Surface):
    """A plane through a point [m]; its normal points upwards and need not be of length 1."""

    point_m: Vector = (0.0, 0.0, 0.0)
    normal_: Vector = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        good = bool(np.all(np.isfinite(self.normal_))) and self.normal_[2] > 0
        require(good, "normal", self.normal_, "a vector with z above 0")

    def at(self, xy_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """(...) height [m] and (..., 3) unit normal."""
        xy, n = np.asarray(xy_m, float), np.asarray(self.normal_)
        height = self.point_m[2] - (xy - self.point_m[:2]) @ n[:2] / n[2]
        unit = np.broadcast_to(n / np.linalg.norm(n), (*xy.shape[:-1], 3))
        return np.asarray(height), unit.copy()


@dataclass(frozen=True, eq=False)
class HeightField(Surface):
    """Heights on a rectangular grid, joined by a bicubic spline (of lower order on small grids).

    Attributes
    ----------
    x_m : (n,) float
        Ascending, two values or more.
    y_m : (m,) float
    z_m : (n, m) float
    """

    x_m: FloatArray
    y_m: FloatArray
    z_m: FloatArray

    def __post_init__(self) -> None:
        for name in ("x_m", "y_m"):
            axis = getattr(self, name)
            good = axis.ndim == 1 and axis.size >= 2 and bool(np.all(np.diff(axis) > 0))
            require(good, name, axis.tolist()[:5], "two ascending numbers or more")
        shape = (self.x_m.size, self.y_m.size)
        require(self.z_m.shape == shape, "z_m", self.z_m.shape, f"shape {shape}, z_m[x, y]")
        good = bool(np.all(np.isfinite(self.z_m)))
        require(good, "z_m", int(np.sum(~np.isfinite(self.z_m))), "finite heights only")

    def at(self, xy_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """(...) height [m] and (..., 3) unit normal, NaN outside of the grid."""
        x, y = np.moveaxis(np.asarray(xy_m, float), -1, 0)
        inside = self.known(xy_m)
        height, slope_x, slope_y = (
            np.where(inside, self._spline.ev(np.where(inside, x, self.x_m[0]), y, dx=dx, dy=dy), np.nan)
            for dx, dy in ((0, 0), (1, 0), (0, 1))
        )
        return height, unit_normal(slope_x, slope_y)

    def known(self, xy_m: npt.ArrayLike) -> BoolArray:
        """(...) inside of the grid."""
        x, y = np.moveaxis(np.asarray(xy_m, float), -1, 0)
        return (x >= self.x_m[0]) & (x <= self.x_m[-1]) & (y >= self.y_m[0]) & (y <= self.y_m[-1])

    @cached_property
    def _spline(self) -> scipy.interpolate.RectBivariateSpline:
        x, y, z = self.x_m, self.y_m, self.z_m
        # a spline of order 1 has no slope in scipy: the middle of two makes it one of order 2
        if x.size == 2:
            x, z = np.insert(x, 1, x.mean()), np.insert(z, 1, z.mean(axis=0), axis=0)
        if y.size == 2:
            y, z = np.insert(y, 1, y.mean()), np.insert(z, 1, z.mean(axis=1), axis=1)
        return scipy.interpolate.RectBivariateSpline(x, y, z, kx=min(3, x.size - 1), ky=min(3, y.size - 1))


def unit_normal(slope_x: npt.ArrayLike, slope_y: npt.ArrayLike) -> FloatArray:
    """(..., 3) upward unit normal of a surface with slopes dz/dx, dz/dy (...)."""
    normal = np.stack(np.broadcast_arrays(-np.asarray(slope_x), -np.asarray(slope_y), 1.0), axis=-1)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


@dataclass(frozen=True, eq=False)
class TriangleMesh(Surface):
    """A mesh seen from above; its topmost face counts.

    Normals are those of the corners, interpolated over each triangle, so that a finely meshed organ is
    smooth; the normal of a corner is the mean of its faces' weighted by their angles there (Thuermer and
    Wuethrich, J. Graphics Tools 3 (1998) 43), for each triangle of those turned against it by no more than
    `EDGE_RAD`: a sharper edge stays one, and the flat top of a block is flat up to it.

    Attributes
    ----------
    corners_m : (c, 3) float
    faces : (t, 3) int
        Indices into the corners.
    corner_normals : (t, 3, 3) float
        Of each triangle's corners.
    """

    corners_m: FloatArray
    faces: IntArray
    corner_normals: FloatArray

    @classmethod
    def from_triangles(cls, triangles_m: npt.ArrayLike) -> TriangleMesh:
        """Mesh of (t, 3, 3) triangles [m], all wound in the same sense.

        Corners nearer than a millionth of the mesh's size are one.

        Raises
        ------
        ValueError
            If there is no triangle of finite size, or neighbours are wound in opposite senses.
        """
        import trimesh  # of the extra `mesh`

        triangles = np.asarray(triangles_m, float)
        good = triangles.ndim == 3 and triangles.shape[1:] == (3, 3) and triangles.shape[0] > 0
        require(good, "triangles", triangles.shape, "shape (t, 3, 3) with t above 0")
        require(bool(np.all(np.isfinite(triangles))), "triangles", "NaN", "finite coordinates")
        flat = triangles.reshape(-1, 3)
        size = float(np.max(np.ptp(flat, axis=0)))
        require(size > 0, "triangles", size, "a mesh larger than a point")
        low = flat.min(axis=0)
        mesh = trimesh.Trimesh(
            (flat - low) / size, np.arange(len(flat)).reshape(-1, 3), process=False
        )
        mesh.merge_vertices(digits_vertex=6)
        faces = mesh.faces[np.all(mesh.faces != np.roll(mesh.faces, 1, axis=1), axis=1)]
        require(len(faces) > 0, "triangles", 0, "one triangle of finite size or more")
        mesh.faces = faces
        accepted = "one winding for all"
        require(mesh.is_winding_consistent, "triangles", "edges run twice in one sense", accepted)
        normals = _corner_normals(np.asarray(faces), mesh.face_normals, mesh.face_angles)
        return cls(low + size * mesh.vertices, np.asarray(faces), normals)

    def at(self, xy_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """(...) height [m] and (..., 3) upward unit normal of the topmost face, NaN beside the mesh."""
        from trimesh.triangles import points_to_barycentric  # of the extra `mesh`

        xy = np.asarray(xy_m, float)
        points = xy.reshape(-1, 2)
        triangles = self.corners_m[self.faces]  # (t, 3, 3)
        flat = triangles * [1.0, 1.0, 0.0]
        low, high = triangles[..., :2].min(axis=1), triangles[..., :2].max(axis=1)  # (t, 2)
        margin = _INSIDE * float(np.max(np.ptp(self.corners_m, axis=0)))
        heights, normals = np.full(len(points), np.nan), np.full((len(points), 3), np.nan)
        for i, point in enumerate(points):
            near = np.flatnonzero(
                np.all((point >= low - margin) & (point <= high + margin), axis=1)
            )
            places = np.broadcast_to([*point, 0.0], (near.size, 3))
            with np.errstate(divide="ignore", invalid="ignore"):
                weights = points_to_barycentric(flat[near], places, method="cross")  # (k, 3), exact on slivers
            hit = np.all(weights >= -_INSIDE, axis=1)  # NaN of upright faces: no hit
            if not hit.any():
                continue
            height = np.where(hit, np.sum(weights * triangles[near, :, 2], axis=1), -np.inf)
            top = int(np.argmax(height))
            normal = weights[top] @ self.corner_normals[near[top]]
            heights[i] = height[top]
            # the topmost face looks upwards, however the mesh is wound
            normals[i] = normal / np.linalg.norm(normal) * np.copysign(1.0, normal[2])
        return heights.reshape(xy.shape[:-1]), normals.reshape(*xy.shape[:-1], 3)


def _corner_normals(faces: IntArray, normals: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """(t, 3, 3) unit normals at the corners of faces (t, 3) with normals (t, 3) and angles (t, 3)."""
    count = faces.size
    at = scipy.sparse.csr_array((np.ones(count), (np.arange(count), faces.ravel())))  # (3 t, c)
    pairs = (at @ at.T).tocoo()  # corners of faces at one place
    one, other = normals[pairs.row // 3], normals[pairs.col // 3]
    # a face too thin to have a normal takes those of all
    alike = np.sum(one * other, axis=1) >= math.cos(EDGE_RAD) * np.sum(one * one, axis=1)
    shares = angles_rad.ravel()[pairs.col] * alike
    weights = scipy.sparse.csr_array((shares, (pairs.row, pairs.col)), shape=pairs.shape)
    summed = weights @ np.repeat(normals, 3, axis=0)
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    return np.asarray(summed / np.where(length > 0, length, 1.0)).reshape(-1, 3, 3)


def read_stl(path: Path) -> FloatArray:
    """(t, 3, 3) triangles of an STL file, binary or text, in the file's own unit.

    Raises
    ------
    ValueError
        If it is not there, cannot be read or holds no triangle, or trimesh is not installed.
    """
    try:
        import trimesh  # of the extra `mesh`
    except ImportError as error:
        need = "trimesh, which reads STL: pip install trimesh"
        raise ValueError(f"file: got {path.name!r}; accepted with {need}") from error
    require(path.is_file(), "file", str(path), "a file that is there")
    log, quiet = trimesh.util.log, trimesh.util.log.disabled
    try:
        log.disabled = True  # of damaged files it logs tracebacks, which appear on stderr
        mesh = trimesh.load_mesh(path, file_type="stl", process=False)
    except Exception as error:  # whatever its readers meet in a damaged file
        raise ValueError(f"file: {path} cannot be read as STL ({cut(str(error))})") from error
    finally:
        log.disabled = quiet
    corners = np.asarray(mesh.triangles, float)
    require(len(corners) > 0, "file", str(path), "STL, binary or text, with a triangle or more")
    return corners


@dataclass(frozen=True)
class TouchRequest(Checked):
    """A surface that is to be found by touching it.

    Attributes
    ----------
    points_m : tuple of (x, y)
        Where to touch [m].
    form : str
        plane or quadric.
    expected_height_m : float
        Where the first touch is expected [m]; those after it follow from those before.
    force_n : float or None
        That ends each touch [N]; None: that of the scene.
    tolerance_m : float
        By which a touch may lie off the form fitted through all [m].
    search_m : float
        So far above and below the expected height each touch is searched for [m], from above in steps, until
        the plane through those before is known to 0.4 mm there; 0: as far as one contact searches.
    """

    points_m: tuple[tuple[float, float], ...]
    form: Literal["plane", "quadric"] = "plane"
    expected_height_m: float = 0.0
    force_n: AboveZero | None = None
    tolerance_m: float = 2e-4
    search_m: Annotated[float, Range(0.0, MOST_SEARCH_M)] = 0.0

    def __post_init__(self) -> None:
        least, given = 3 if self.form == "plane" else 6, len(self.points_m)
        require(given >= least, "points_m", given, f"{least} positions or more for a {self.form}")
        super().__post_init__()
        require(self.tolerance_m > 0, "tolerance_m", self.tolerance_m, "a number above 0")


@dataclass(frozen=True)
class NormalRequest(Checked):
    """How normals are found by touch.

    Attributes
    ----------
    radius_m : float
        Of the circle about the point [m]. A larger one leaves less of the touches' noise and more of curvature;
        one much smaller than the ball touches the same tissue again.
    touches : int
        On it.
    force_n : float
        That ends each touch [N]; 0: that of the scene.
    most_angle_rad : float
        From the normal as it is expected [rad].
    most_std_rad : float
        Standard deviation of the normal about any axis [rad].
    tolerance_m : float
        By which a touch may lie off the plane through all, where there are more than three [m].
    """

    radius_m: Annotated[float, Range(5e-4, 0.01)] = 2e-3
    touches: Annotated[int, Range(3, 12)] = 3
    force_n: Annotated[float, Range(0.0, 1.0)] = 0.0
    most_angle_rad: Annotated[float, Range(0.0, 0.8)] = 0.35
    most_std_rad: Annotated[float, Range(1e-3, 0.1)] = 0.03
    tolerance_m: Annotated[float, Range(1e-5, 2e-3)] = 2e-4


def read_surface(fields: Mapping[str, Any], folder: Path, where: str) -> Surface | TouchRequest:
    """Surface of a scene's section; files are looked for in the scene's folder.

    Raises
    ------
    ValueError
        If it is none of the known forms, or a field or file of it is wrong.
    """
    form, entry = one_of(_FORMS, fields, where)
    filed = isinstance(entry, (_Mesh, _HeightFile))
    return build(entry.surface, f"{where}.{form}", folder) if filed else entry


def with_file_beside(fields: object, folder: Path) -> tuple[Any, Path | None]:
    """Section ``surface`` of a scene as it stands in a run, and the file that it names, or None."""
    for form, value in fields.items() if isinstance(fields, Mapping) else ():
        if isinstance(value, Mapping) and isinstance(value.get("file"), str):
            path = folder / value["file"]
            return {form: {**value, "file": path.with_stem("surface").name}}, path
    return fields, None


@dataclass(frozen=True)
class _Mesh:
    file: FileName
    unit_m: float

    def surface(self, folder: Path) -> Surface:
        require(self.unit_m > 0, "unit_m", self.unit_m, "above 0: metres per unit of the file")
        return TriangleMesh.from_triangles(read_stl(folder / self.file) * self.unit_m)


@dataclass(frozen=True)
class _HeightFile:
    file: FileName

    def surface(self, folder: Path) -> Surface:
        path = folder / self.file
        try:
            arrays, _ = read_arrays(path, names := ("x_m", "y_m", "z_m"))
            axes = [np.asarray(arrays[name], float) for name in names]
        except (OSError, KeyError, TypeError, ValueError) as error:
            accepted = f"an .npz with x_m, y_m, z_m ({error})"
            raise ValueError(f"file: got {str(path)!r}; accepted is {accepted}") from error
        return HeightField(*axes)


def _read_heights(value: object, where: str) -> _HeightFile | HeightField:
    filed = isinstance(value, Mapping) and "file" in value
    return read(_HeightFile if filed else HeightField, value, where)


_FORMS = {
    "plane": Plane,
    "height_field": Annotated[Any, _read_heights],
    "mesh": _Mesh,
    "touch": TouchRequest,
}
