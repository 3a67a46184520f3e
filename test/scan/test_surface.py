# SPDX-License-Identifier: Apache-2.0
"""Heights and normals against surfaces with closed forms; a touched surface against its own statistics."""

import struct
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_resonance.scan.surface import (
    HeightField,
    Plane,
    TouchRequest,
    TriangleMesh,
    read_stl,
    read_surface,
)
from tactile_resonance.scan.surface_search import fit_surface

slopes = st.floats(-1.5, 1.5)


@given(slopes, slopes, st.floats(-0.1, 0.1))
def test_plane_is_normal_to_its_normal(slope_x, slope_y, z0):
    plane = Plane((0.01, -0.02, z0), (-slope_x, -slope_y, 1.0))
    xy = np.array([[0.01, -0.02], [0.05, 0.0], [0.0, 0.07]])
    z = plane.height_m(xy)
    assert z[0] == pytest.approx(z0)
    np.testing.assert_allclose(
        z - z0, slope_x * (xy[:, 0] - 0.01) + slope_y * (xy[:, 1] + 0.02), atol=1e-12
    )
    points = np.column_stack([xy, z])
    np.testing.assert_allclose((points - points[0]) @ plane.normal(xy[0]), 0, atol=1e-12)
    assert plane.normal(xy)[1, 2] > 0


def bowl(x, y):
    """Quadric, exact on a bicubic spline."""
    return 0.02 + 0.3 * x - 0.1 * y + 4.0 * x**2 + 2.0 * x * y - 3.0 * y**2


def test_height_field_reproduces_a_quadric():
    x, y = np.linspace(-0.03, 0.03, 9), np.linspace(-0.02, 0.02, 7)
    surface = HeightField(x, y, bowl(*np.meshgrid(x, y, indexing="ij")))
    rng = np.random.default_rng(1)
    xy = rng.uniform([-0.03, -0.02], [0.03, 0.02], (50, 2))
    np.testing.assert_allclose(surface.height_m(xy), bowl(*xy.T), rtol=1e-10)
    slope = np.stack([0.3 + 8 * xy[:, 0] + 2 * xy[:, 1], -0.1 + 2 * xy[:, 0] - 6 * xy[:, 1]], 1)
    normal = surface.normal(xy)
    np.testing.assert_allclose(-normal[:, :2] / normal[:, 2:], slope, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, rtol=1e-12)
    assert np.isnan(surface.height_m([0.031, 0.0]))
    assert np.isnan(surface.normal([0.0, 0.021])).all()


@pytest.mark.parametrize(("columns", "rows"), [(2, 2), (2, 4), (5, 2)])
def test_height_field_of_two_values_on_an_axis_is_straight_along_it(columns, rows):
    x, y = np.linspace(-0.03, 0.03, columns), np.linspace(-0.02, 0.02, rows)
    surface = HeightField(x, y, 0.02 + 0.3 * x[:, None] - 0.1 * y + 2.0 * x[:, None] * y)
    xy = np.random.default_rng(1).uniform([-0.03, -0.02], [0.03, 0.02], (20, 2))
    height, normal = surface.at(xy)
    np.testing.assert_allclose(height, 0.02 + xy @ [0.3, -0.1] + 2.0 * xy.prod(axis=1), rtol=1e-12)
    slope = [0.3, -0.1] + 2.0 * xy[:, ::-1]
    np.testing.assert_allclose(-normal[:, :2] / normal[:, 2:], slope, rtol=1e-9, atol=1e-12)


def cap(radius_m, steps, flip=False):
    """Triangles of a spherical cap with its pole up, about the origin."""
    polar, turn = np.linspace(0, 1.0, steps), np.linspace(0, 2 * np.pi, 4 * steps + 1)
    turn[-1] = 0.0

    def at(i, j):
        s, c = np.sin(polar[i]), np.cos(polar[i])
        return radius_m * np.array([s * np.cos(turn[j]), s * np.sin(turn[j]), c])

    triangles = []
    for i in range(steps - 1):
        for j in range(4 * steps):
            triangles.append([at(i, j), at(i + 1, j), at(i + 1, j + 1)])
            if i:
                triangles.append([at(i, j), at(i + 1, j + 1), at(i, j + 1)])
    out = np.array(triangles)
    return out[:, ::-1] if flip else out


@pytest.mark.parametrize("flip", [False, True])
def test_mesh_of_a_sphere_converges_to_the_sphere(flip):
    radius, rng = 0.05, np.random.default_rng(2)
    xy = rng.uniform(-0.025, 0.025, (60, 2))
    exact = np.sqrt(radius**2 - np.sum(xy**2, axis=1))
    outward = np.column_stack([xy, exact]) / radius
    errors = []
    for steps in (8, 16, 32):
        mesh = TriangleMesh.from_triangles(cap(radius, steps, flip))
        height = np.max(np.abs(mesh.height_m(xy) - exact))
        angle = np.max(np.arccos(np.clip(np.sum(mesh.normal(xy) * outward, axis=1), -1, 1)))
        errors.append((height, angle))
    height, angle = np.array(errors).T
    assert np.all(height[:-1] / height[1:] > 3)  # second order
    assert height[-1] < 1e-3 * radius
    assert angle[-1] < 0.01
    assert np.isnan(mesh.height_m([0.049, 0.0]))


def block(size, top, flip):
    """(12, 3, 3) triangles of a block, two to a side as CAD writes them."""
    x, y, z = np.meshgrid(*[[-size, size]] * 2, [0.0, top], indexing="ij")
    p = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    quads = [(0, 2, 6, 4), (1, 5, 7, 3), (0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5)]
    faces = [tri for a, b, c, d in quads for tri in ((a, b, c), (a, c, d))]
    return p[np.array(faces)][:, ::-1] if flip else p[np.array(faces)]


@pytest.mark.parametrize("flip", [False, True])
def test_the_flat_top_of_a_block_is_flat_up_to_its_edges(flip):
    mesh = TriangleMesh.from_triangles(block(0.025, 0.01, flip))
    xy = np.random.default_rng(4).uniform(-0.0249, 0.0249, (200, 2))
    height, normal = mesh.at(xy)
    np.testing.assert_allclose(height, 0.01, rtol=1e-12)
    np.testing.assert_allclose(normal, np.broadcast_to([0.0, 0.0, 1.0], (200, 3)), atol=1e-12)


def test_the_topmost_face_counts():
    low = np.array([[[-1, -1, 0], [1, -1, 0], [0, 2, 0]]], float)
    mesh = TriangleMesh.from_triangles(np.concatenate([low, low / 4 + [0, 0, 0.5]]))
    np.testing.assert_allclose(mesh.height_m([[0, 0], [0.6, -0.6], [0, 3]]), [0.5, 0, np.nan])


def test_stl_text_and_binary_are_the_same(tmp_path, caplog):
    triangles = cap(0.05, 5).astype(np.float32)
    binary, text = tmp_path / "b.stl", tmp_path / "t.stl"
    rows = b"".join(np.zeros(3, "<f4").tobytes() + t.tobytes() + b"\0\0" for t in triangles)
    binary.write_bytes(b"solid misleading".ljust(80) + struct.pack("<I", len(triangles)) + rows)
    lines = ["solid cap"]
    for t in triangles:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += ["vertex " + " ".join(f"{v:.9g}" for v in corner) for corner in t]
        lines += ["endloop", "endfacet"]
    text.write_text("\n".join([*lines, "endsolid cap"]).replace("normal 0 0 0", "normal 0 0 ?", 1))
    np.testing.assert_array_equal(read_stl(binary), triangles.astype(float))
    np.testing.assert_array_equal(read_stl(text).astype(np.float32), triangles)
    surface = read_surface({"mesh": {"file": "b.stl", "unit_m": 0.001}}, tmp_path, "surface")
    assert surface.height_m([0.0, 0.0]) == pytest.approx(0.05e-3, rel=1e-6)
    for content, reason in ((b"solid x\nendsolid", "a triangle or more"), (b"\0" * 90, "a triangle or more")):
        binary.write_bytes(content)
        with pytest.raises(ValueError, match=reason):
            read_stl(binary)
    binary.write_bytes(b"solid misleading".ljust(80) + struct.pack("<I", len(triangles)) + rows[:-7])
    for path, reason in ((binary, "cannot be read"), (tmp_path / "none.stl", "a file that is there")):
        with pytest.raises(ValueError, match=reason):
            read_stl(path)
    assert not caplog.records  # its library would log a traceback


def test_without_its_library_a_mesh_names_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ValueError, match="file: got 'a.stl'; accepted with .*pip install trimesh"):
        read_stl(tmp_path / "a.stl")


def test_a_mesh_wound_both_ways_is_refused():
    a = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[1, 0, 0], [0, 1, 0], [1, 1, 0]]], float)
    with pytest.raises(ValueError, match="one winding for all"):
        TriangleMesh.from_triangles(a)
    assert TriangleMesh.from_triangles([a[0], a[1][::-1]]).height_m([0.9, 0.9]) == 0


@pytest.mark.parametrize(("form", "contacts"), [("plane", 3), ("plane", 6), ("quadric", 9)])
def test_touched_surface_covers_the_truth(form, contacts):
    """Seeded Monte Carlo: heights lie within the stated deviation as often as stated."""
    rng, std = np.random.default_rng(3), 2e-5
    xy = rng.uniform(-0.02, 0.02, (contacts, 2))
    at = np.array([0.005, -0.012])

    def true(x, y):
        return bowl(x, y) if form == "quadric" else 0.02 + 0.3 * x - 0.1 * y

    height, inconsistent, runs = [], 0, 600
    for _ in range(runs):
        z = true(*xy.T) + std * rng.standard_normal(contacts)
        surface = fit_surface(np.column_stack([xy, z]), std, form)
        inconsistent += not surface.consistent
        height.append((surface.height_m(at) - true(*at)) / surface.height_std_m(at))
    # mean square 1 within 4 standard deviations of chi-square
    assert np.mean(np.square(height)) == pytest.approx(1, abs=4 * np.sqrt(2 / runs))
    assert inconsistent <= 6  # 0.1 % expected of those with contacts to spare


def test_a_bad_contact_is_told_and_widens_the_uncertainty():
    rng = np.random.default_rng(4)
    xy = rng.uniform(-0.02, 0.02, (8, 2))
    z = 0.01 + 0.1 * xy[:, 0] + 1e-5 * rng.standard_normal(8)
    good = fit_surface(np.column_stack([xy, z]), 1e-5)
    z[3] += 1e-3
    bad = fit_surface(np.column_stack([xy, z]), 1e-5)
    assert good.consistent
    assert not bad.consistent
    assert bad.height_std_m([0.0, 0.0]) > 10 * good.height_std_m([0.0, 0.0])


@pytest.mark.parametrize(
    ("contacts", "form", "reason"),
    [
        ([[0, 0, 0], [1, 1, 0], [2, 2, 0]], "plane", "not on one line"),
        ([[0, 0, 0]] * 3, "plane", "positions apart"),
    ],
)
def test_contacts_that_determine_nothing_are_refused(contacts, form, reason):
    with pytest.raises(ValueError, match=reason):
        fit_surface(np.array(contacts, float), 1e-5, form)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({}, "exactly one of"),
        ({"plane": {}, "mesh": {}}, "exactly one of"),
        ({"plain": {}}, "one of"),
        ({"plane": {"normal": [1, 0, 0]}}, r"surface.plane.normal: got \(1.0, 0.0, 0.0\)"),
        ({"plane": {"nomal": [1, 0, 0]}}, "surface.plane.nomal"),
        ({"mesh": {"file": "x.stl"}}, "surface.mesh.unit_m"),
        ({"mesh": {"file": "x.stl", "unit_m": 1.0}}, "surface.mesh.file: .*x.stl.*a file that is there"),
        (
            {"height_field": {"x_m": [0, 1], "y_m": [0, 1], "z_m": [[0, 1]]}},
            r"z_m: got \(1, 2\); accepted is shape \(2, 2\)",
        ),
        ({"height_field": {"x_m": [1, 0], "y_m": [0, 1], "z_m": [[0, 1]] * 2}}, "ascending"),
        ({"touch": {"points_m": [[0, 0]]}}, "points_m: got 1; accepted is 3 positions or more"),
    ],
)
def test_wrong_surfaces_are_refused(fields, reason, tmp_path):
    with pytest.raises(ValueError, match=reason):
        read_surface(fields, tmp_path, "surface")


def test_a_surface_to_be_touched_is_a_request(tmp_path):
    fields = {"touch": {"points_m": [[0, 0], [0.01, 0], [0, 0.01]], "form": "plane"}}
    assert isinstance(read_surface(fields, tmp_path, "s"), TouchRequest)
