# SPDX-License-Identifier: Apache-2.0
"""Surfaces to scan: height and outward normal over x, y."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from scipy.interpolate import RectBivariateSpline

from tactile_resonance.fields import known_keys, number, numbers, require, section
from tactile_resonance.scan.mesh import TriangleMesh, read_stl

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
FORMS = ("plane", "height_field", "mesh", "touch")
MOST_SEARCH_M = 0.02


class Surface(Protocol):
    """A surface seen from above: one height for each x, y. NaN where there is none."""

    def height_m(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(...) height [m] at (..., 2) positions [m]."""
        ...

    def normal(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(..., 3) outward (upward) unit normal at (..., 2) positions [m]."""
        ...

    def height_std_m(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(...) standard deviation of the height [m]; 0 where the surface is given."""
        ...

    def known(self, xy_m: npt.ArrayLike) -> BoolArray:
        """(...) whether the surface is known there, not only continued from beside it."""
        ...


@dataclass(frozen=True)
class Plane:
    """A plane through a point [m]; its normal points upwards and need not be of length 1."""

    point_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    normal_vector: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        good = bool(np.all(np.isfinite(self.normal_vector))) and self.normal_vector[2] > 0
        require(good, "normal", self.normal_vector, "a vector with z above 0")

    def height_m(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(...) height [m]."""
        xy, n = np.asarray(xy_m, float), self.normal_vector
        offset = xy - self.point_m[:2]
        return np.asarray(self.point_m[2] - offset @ np.asarray(n[:2]) / n[2])

    def normal(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(..., 3) unit normal."""
        unit = np.asarray(self.normal_vector) / np.linalg.norm(self.normal_vector)
        return np.broadcast_to(unit, (*np.shape(xy_m)[:-1], 3)).copy()

    def height_std_m(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(...) zeros."""
        return np.zeros(np.shape(xy_m)[:-1])

    def known(self, xy_m: npt.ArrayLike) -> BoolArray:
        """(...) everywhere."""
        return np.ones(np.shape(xy_m)[:-1], dtype=bool)


@dataclass(frozen=True, eq=False)
class HeightField:
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

    def height_m(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(...) height [m], NaN outside of the grid."""
        return self._evaluate(np.asarray(xy_m, float))

    def normal(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(..., 3) unit normal, NaN outside of the grid."""
        xy = np.asarray(xy_m, float)
        slope_x, slope_y = self._evaluate(xy, dx=1), self._evaluate(xy, dy=1)
        return unit_normal(slope_x, slope_y)

    def height_std_m(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(...) zeros."""
        return np.zeros(np.shape(xy_m)[:-1])

    def known(self, xy_m: npt.ArrayLike) -> BoolArray:
        """(...) inside of the grid."""
        return self._inside(np.asarray(xy_m, float))

    @cached_property
    def _spline(self) -> RectBivariateSpline:
        orders = [min(3, axis.size - 1) for axis in (self.x_m, self.y_m)]
        return RectBivariateSpline(self.x_m, self.y_m, self.z_m, kx=orders[0], ky=orders[1])

    def _inside(self, xy: FloatArray) -> BoolArray:
        x, y = xy[..., 0], xy[..., 1]
        return (x >= self.x_m[0]) & (x <= self.x_m[-1]) & (y >= self.y_m[0]) & (y <= self.y_m[-1])

    def _evaluate(self, xy: FloatArray, dx: int = 0, dy: int = 0) -> FloatArray:
        x, y = xy[..., 0], xy[..., 1]
        inside = self._inside(xy)
        value = self._spline.ev(np.where(inside, x, self.x_m[0]), y, dx=dx, dy=dy)
        return np.where(inside, value, np.nan)


def unit_normal(slope_x: npt.ArrayLike, slope_y: npt.ArrayLike) -> FloatArray:
    """(..., 3) upward unit normal of a surface with slopes dz/dx, dz/dy (...)."""
    normal = np.stack(np.broadcast_arrays(-np.asarray(slope_x), -np.asarray(slope_y), 1.0), axis=-1)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


@dataclass(frozen=True)
class TouchRequest:
    """A surface that is to be found by touching it.

    Attributes
    ----------
    xy_m : tuple of (x, y)
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
        So far above and below the expected height each of the first three touches is searched for [m], from
        above in steps; 0: as far as one contact searches.
    """

    xy_m: tuple[tuple[float, float], ...]
    form: str
    expected_height_m: float = 0.0
    force_n: float | None = None
    tolerance_m: float = 2e-4
    search_m: float = 0.0


@dataclass(frozen=True)
class NormalRequest:
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

    radius_m: float = 2e-3
    touches: int = 3
    force_n: float = 0.0
    most_angle_rad: float = 0.35
    most_std_rad: float = 0.03
    tolerance_m: float = 2e-4

    def __post_init__(self) -> None:
        for name, low, high in (
            ("radius_m", 5e-4, 0.01),
            ("touches", 3, 12),
            ("force_n", 0.0, 1.0),
            ("most_angle_rad", 0.0, 0.8),
            ("most_std_rad", 1e-3, 0.1),
            ("tolerance_m", 1e-5, 2e-3),
        ):
            value = getattr(self, name)
            require(low <= value <= high, name, value, f"{low:g} to {high:g}")


def read_surface(fields: Mapping[str, Any], folder: Path, where: str) -> Surface | TouchRequest:
    """Surface of a scene's section; files are looked for in the scene's folder.

    Raises
    ------
    ValueError
        If it is none of the known forms, or a field or file of it is wrong.
    """
    known_keys(fields, set(FORMS), where)
    require(len(fields) == 1, where, sorted(fields), f"exactly one of {', '.join(FORMS)}")
    form = next(iter(fields))
    content, where = section(fields, form, where), f"{where}.{form}"
    try:
        if form == "plane":
            known_keys(content, {"point_m", "normal"}, where)
            point = numbers(content.get("point_m", (0.0, 0.0, 0.0)), f"{where}.point_m", 3)
            normal = numbers(content.get("normal", (0.0, 0.0, 1.0)), f"{where}.normal", 3)
            return Plane(point, normal)  # type: ignore[arg-type]
        if form == "height_field":
            return _read_height_field(content, folder, where)
        if form == "mesh":
            known_keys(content, {"file", "unit_m"}, where)
            unit_m = number(content.get("unit_m"), f"{where}.unit_m")
            require(unit_m > 0, f"{where}.unit_m", unit_m, "above 0: metres per unit of the file")
            return TriangleMesh.from_triangles(read_stl(_file(content, folder, where)) * unit_m)
        return _read_touch(content, where)
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(where) else f"{where}.{text}") from error


def _read_height_field(content: Mapping[str, Any], folder: Path, where: str) -> HeightField:
    if "file" in content:
        known_keys(content, {"file"}, where)
        path = _file(content, folder, where)
        try:
            with np.load(path, allow_pickle=False) as archive:
                axes = [np.asarray(archive[name], float) for name in ("x_m", "y_m", "z_m")]
        except (OSError, KeyError, ValueError) as error:
            raise ValueError(
                f"file: got {str(path)!r}; accepted is an .npz with x_m, y_m, z_m ({error})"
            ) from error
        return HeightField(*axes)
    known_keys(content, {"x_m", "y_m", "z_m"}, where)
    x_m, y_m = (np.array(numbers(content.get(k), f"{where}.{k}")) for k in ("x_m", "y_m"))
    rows = content.get("z_m")
    good = isinstance(rows, list) and len(rows) == x_m.size
    require(good, f"{where}.z_m", rows, f"{x_m.size} rows, one per x")
    assert isinstance(rows, list)
    z_m = [numbers(row, f"{where}.z_m[{i}]", y_m.size) for i, row in enumerate(rows)]
    return HeightField(x_m, y_m, np.array(z_m))


def _read_touch(content: Mapping[str, Any], where: str) -> TouchRequest:
    options = ("expected_height_m", "force_n", "tolerance_m", "search_m")
    known_keys(content, {"points_m", "form", *options}, where)
    form = content.get("form", "plane")
    require(form in ("plane", "quadric"), f"{where}.form", form, "plane or quadric")
    points = content.get("points_m")
    least = 3 if form == "plane" else 6
    good = isinstance(points, list) and len(points) >= least
    require(good, f"{where}.points_m", points, f"{least} positions or more for a {form}")
    assert isinstance(points, list)
    read = [numbers(point, f"{where}.points_m[{i}]", 2) for i, point in enumerate(points)]
    given = {key: number(content[key], f"{where}.{key}") for key in options if key in content}
    for key in ("force_n", "tolerance_m"):
        require(given.get(key, 1.0) > 0, f"{where}.{key}", given.get(key), "a number above 0")
    check_search(given.get("search_m", 0.0), f"{where}.search_m")
    return TouchRequest(tuple((x, y) for x, y in read), form, **given)


def check_search(search_m: float, field: str) -> None:
    """``ValueError`` where a search is not from 0 to `MOST_SEARCH_M`."""
    accepted = f"a number from 0 to {MOST_SEARCH_M:g} [m]"
    require(0 <= search_m <= MOST_SEARCH_M, field, search_m, accepted)


def _file(content: Mapping[str, Any], folder: Path, where: str) -> Path:
    name = content.get("file")
    require(isinstance(name, str) and bool(name), f"{where}.file", name, "the name of a file")
    assert isinstance(name, str)
    return folder / name
