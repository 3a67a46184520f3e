# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes as surfaces, and reading them from STL."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import BoolArray, FloatArray, IntArray
from tactile_resonance.fields import cut, require

_INSIDE = 1e-9  # of the barycentric coordinates: points on a shared edge belong to both triangles


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A mesh seen from above; its topmost face counts.

    Normals are those of the corners, interpolated over each triangle, so that a finely meshed organ is
    smooth; the normal of a corner is the mean of its faces' weighted by their angles there (Thuermer and
    Wuethrich, J. Graphics Tools 3 (1998) 43; trimesh computes it). A sharp edge is rounded over the triangles
    beside it.

    Attributes
    ----------
    corners_m : (c, 3) float
    faces : (t, 3) int
        Indices into the corners.
    corner_normals : (c, 3) float
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
        return cls(low + size * mesh.vertices, np.asarray(faces), np.asarray(mesh.vertex_normals))

    def height_m(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(...) height of the topmost face [m], NaN beside the mesh."""
        return self._over(xy_m)[0]

    def normal(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(..., 3) upward unit normal, NaN beside the mesh."""
        return self._over(xy_m)[1]

    def height_std_m(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(...) zeros."""
        return np.zeros(np.shape(xy_m)[:-1])

    def known(self, xy_m: npt.ArrayLike) -> BoolArray:
        """(...) over the mesh."""
        return ~np.isnan(self.height_m(xy_m))

    def _over(self, xy_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Height (...) and normal (..., 3)."""
        xy = np.asarray(xy_m, float)
        points = xy.reshape(-1, 2)
        triangles = self.corners_m[self.faces]  # (t, 3, 3)
        low, high = triangles[..., :2].min(axis=1), triangles[..., :2].max(axis=1)  # (t, 2)
        margin = _INSIDE * float(np.max(np.ptp(self.corners_m, axis=0)))
        heights, normals = np.full(len(points), np.nan), np.full((len(points), 3), np.nan)
        for i, point in enumerate(points):
            near = np.flatnonzero(
                np.all((point >= low - margin) & (point <= high + margin), axis=1)
            )
            weights = _barycentric(triangles[near, :, :2], point)  # (k, 3)
            hit = np.all(weights >= -_INSIDE, axis=1)  # NaN of upright faces: no hit
            if not hit.any():
                continue
            height = np.where(hit, np.sum(weights * triangles[near, :, 2], axis=1), -np.inf)
            top = int(np.argmax(height))
            normal = weights[top] @ self.corner_normals[self.faces[near[top]]]
            heights[i] = height[top]
            # the topmost face looks upwards, however the mesh is wound
            normals[i] = normal / np.linalg.norm(normal) * np.copysign(1.0, normal[2])
        return heights.reshape(xy.shape[:-1]), normals.reshape(*xy.shape[:-1], 3)


def read_stl(path: Path) -> FloatArray:
    """(t, 3, 3) triangles of an STL file, binary or text, in the file's own unit.

    Raises
    ------
    ValueError
        If it cannot be read or holds no triangle, or trimesh is not installed.
    """
    try:
        import trimesh  # of the extra `mesh`
    except ImportError as error:
        need = "trimesh, which reads STL: pip install trimesh"
        raise ValueError(f"file: got {path.name!r}; accepted with {need}") from error
    log = trimesh.util.log
    try:
        log.addFilter(_nothing)  # of damaged files it logs tracebacks, which appear on stderr
        mesh = trimesh.load_mesh(path, file_type="stl", process=False)
    except Exception as error:  # whatever its readers meet in a damaged file
        raise ValueError(f"file: {path} cannot be read as STL ({cut(str(error))})") from error
    finally:
        log.removeFilter(_nothing)
    corners = np.asarray(mesh.triangles, float)
    require(len(corners) > 0, "file", str(path), "STL, binary or text, with a triangle or more")
    return corners


def _nothing(_: logging.LogRecord) -> bool:
    """Of a filter: no record passes."""
    return False


def _barycentric(triangles: FloatArray, point: FloatArray) -> FloatArray:
    """(k, 3) weights of the corners of (k, 3, 2) triangles at a point (2,); NaN for upright faces."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]

    def area(p: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
        u, v = q - p, r - p
        return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])

    whole = area(a, b, c)
    with np.errstate(divide="ignore", invalid="ignore"):
        weights = np.stack([area(b, c, point), area(c, a, point), area(a, b, point)], axis=1)
        return np.where(whole[:, None] == 0, np.nan, weights / whole[:, None])
