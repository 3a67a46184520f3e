# SPDX-License-Identifier: Apache-2.0
"""Patterns, poses, time and what is left out."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tactile_resonance.fields import read_dataclass
from tactile_resonance.multisine import Grid
from tactile_resonance.poles.structure import PoleBand
from tactile_resonance.scan.measurement import design_measurement
from tactile_resonance.scan.plan import (
    CONTACT_S,
    NEAR_CONTACT_S,
    TRAVEL_M_S,
    make_plan,
)
from tactile_resonance.scan.points import (
    ScanPoint,
    grid,
    inside_polygon,
    read_positions,
    tip_orientation,
)
from tactile_resonance.scan.scene import Output, ScanScene
from tactile_resonance.scan.surface import HeightField, Plane, TouchRequest


def scene(positions, **values):
    positions = np.array(positions, float)
    if positions.shape[1] == 2:
        positions = np.column_stack([positions, np.full(len(positions), np.nan)])
    return ScanScene("test", 0.01, positions, **values)


def test_serpentine_visits_the_grid_by_shortest_steps():
    raster = grid([0, 0], [0.02, 0.01], [0.005, 0.005], "raster")
    snake = grid([0, 0], [0.02, 0.01], [0.005, 0.005], "serpentine")
    assert raster.shape == (15, 2)
    assert {tuple(p) for p in raster} == {tuple(p) for p in snake}
    np.testing.assert_allclose(np.linalg.norm(np.diff(snake, axis=0), axis=1), 0.005)
    np.testing.assert_allclose(raster.mean(axis=0), 0, atol=1e-15)


def test_spiral_covers_its_disc_evenly():
    asked = {"center_m": [0.01, 0.02], "radius_m": 0.02, "spacing_m": 0.002}
    points = read_positions({"spiral": asked}, "positions")[:, :2]
    distance = np.linalg.norm(points - [0.01, 0.02], axis=1)
    assert distance.max() <= 0.02
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert np.all(step <= 0.002 * (1 + 1e-6))  # a chord is no longer than its arc
    assert np.all(step[3:] > 0.0017)
    # as many as the area holds, one per square of the spacing
    assert len(points) == pytest.approx(np.pi * 0.02**2 / 0.002**2, rel=0.05)


@given(
    st.lists(st.tuples(st.floats(0.2, 1), st.floats(0, 6.28)), min_size=3, max_size=9), st.data()
)
def test_inside_a_star_shaped_polygon(corners, data):
    """Seen from its centre, a point is inside iff it is nearer than the edge in its direction."""
    angles = np.sort([a for _, a in corners])
    gaps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
    if np.any(gaps > 3.0) or np.any(gaps < 1e-3):
        return
    radius = np.array([r for r, _ in corners])
    polygon = radius[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    k = data.draw(st.integers(0, len(corners) - 1))
    share = data.draw(st.floats(0.0, 1.0))
    edge = (1 - share) * polygon[k] + share * polygon[(k + 1) % len(polygon)]
    assert inside_polygon(0.999 * edge, polygon)
    assert not inside_polygon(1.001 * edge, polygon)
    assert inside_polygon(edge, polygon)


def test_region_keeps_the_grid_points_in_it():
    fields = {"region": {"polygon_m": [[0, 0], [0.02, 0], [0, 0.02]], "spacing_m": 0.001}}
    points = read_positions(fields, "positions")
    assert len(points) == 21 * 22 / 2
    assert np.all(points[:, :2].sum(axis=1) <= 0.02 + 1e-12)
    assert np.isnan(points[:, 2]).all()


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({}, "exactly one of .*adaptive"),
        ({"grid": {"center_m": [0, 0], "size_m": [1, 1]}}, "grid.spacing_m: got None"),
        ({"grid": {"center_m": [0], "size_m": [1, 1], "spacing_m": 1}}, "grid.center_m"),
        ({"grid": {"center_m": [0, 0], "size_m": [1, 1], "spacing_m": 1e-5}}, "at most 100000"),
        ({"spiral": {"center_m": [0, 0], "radius_m": -1, "spacing_m": 1}}, "radius_m: got -1"),
        ({"list": []}, "one position or more"),
        ({"list": [[0, 0], [1]]}, r"list\[1\]"),
        ({"list": [[0, 0], [0, 1e200]]}, r"positions\[1\]: got .*1e\+200.* within 10 m"),
        ({"around": dict.fromkeys(("centres_m", "offsets_m"), [[0, 0]] * 400)}, "at most 100000"),
        ({"region": {"polygon_m": [[0, 0], [1, 0]], "spacing_m": 1}}, "three corners"),
        (
            {"region": {"polygon_m": [[0, 0], [1, 1], [2, 2]], "spacing_m": 1}},
            "not all on one line",
        ),
    ],
)
def test_wrong_positions_are_refused(fields, reason):
    with pytest.raises(ValueError, match=reason):
        read_positions(fields, "positions")


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-3.2, 3.2))
def test_tip_frame_is_normal_and_along_the_heading(slope_x, slope_y, heading):
    normal = np.array([-slope_x, -slope_y, 1.0]) / np.sqrt(1 + slope_x**2 + slope_y**2)
    frame = Rotation.from_quat(tip_orientation(normal, heading)).as_matrix()
    np.testing.assert_allclose(frame[:, 2], normal, atol=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1)
    # +x lies in the surface and in the upright plane of the heading-and-normal
    ahead = np.array([np.cos(heading), np.sin(heading), 0])
    assert frame[:, 0] @ ahead > 0
    assert abs(frame[:, 1] @ ahead) < 1e-12


def test_points_lie_on_the_surface_in_order():
    surface = Plane((0.0, 0.0, 0.1), (-0.2, 0.0, 1.0))
    plan = make_plan(scene([[0.01, 0], [0.02, 0], [0.0, 0.03]], surface=surface))
    assert [p.index for p in plan.points] == [0, 1, 2]
    np.testing.assert_allclose(
        [p.position_m for p in plan.points],
        [[0.01, 0, 0.102], [0.02, 0, 0.104], [0, 0.03, 0.1]],
    )
    for p in plan.points:
        assert read_dataclass(ScanPoint, asdict(p), "points") == p
    # a height that is given wins
    given = make_plan(scene([[0.01, 0, 0.5]], surface=surface))
    assert given.points[0].position_m == (0.01, 0.0, 0.5)


def test_points_beside_or_too_steep_are_skipped_and_say_what_that_saves():
    x = np.linspace(-0.02, 0.02, 9)
    z = np.where(x > 0, 2.5 * x, 0.0)[:, None] + np.zeros(9)
    surface = HeightField(x, x, z)
    asked = scene([[-0.015, 0], [0.03, 0], [0.015, 0], [-0.01, 0]], surface=surface)
    plan = make_plan(asked)
    assert len(plan.points) == 2
    left = {s.why: s for s in plan.skipped if "point" in s.what}
    assert set(left) == {"beside the surface", "steeper than 60 degrees"}
    one_s = replace(plan, points=plan.points[:1]).longest_s
    assert left["beside the surface"].saved_s == pytest.approx(one_s)
    with pytest.raises(ValueError, match="1 beside the surface and 0 too steep"):
        make_plan(scene([[1.0, 0]], surface=surface))
    # a surface that is still to be found is expected level
    found = TouchRequest(((0, 0), (1, 0), (0, 1)), expected_height_m=0.02)
    assert make_plan(scene([[0, 0]], surface=found)).points[0].position_m == (0.0, 0.0, 0.02)


def test_time_adds_up():
    plan = make_plan(scene([[0, 0], [0.05, 0]]))
    assert plan.duration_s(5) == pytest.approx(0.05 / TRAVEL_M_S + 2 * (CONTACT_S + 5 * 0.4))
    assert (plan.shortest_s, plan.longest_s) == (plan.duration_s(3), plan.duration_s(8))
    assert plan.shortest_s < plan.longest_s
    near = make_plan(scene([[0, 0], [0.005, 0], [0.01, 0]]))
    contacts_s = CONTACT_S + 2 * NEAR_CONTACT_S
    assert near.duration_s(5) == pytest.approx(0.01 / TRAVEL_M_S + contacts_s + 3 * 5 * 0.4)


def test_what_nobody_reads_is_not_excited():
    poles = design_measurement(scene([[0, 0]]))
    whole = design_measurement(scene([[0, 0]], outputs=(Output.POLES, Output.FRF)))
    distortion = design_measurement(scene([[0, 0]], outputs=(Output.POLES, Output.DISTORTION)))
    assert poles.stretches_hz == ((180.0, 320.0),)
    assert poles.lines == 57
    assert (whole.stretches_hz, whole.lines) == (((10.0, 10_000.0),), 3997)
    # the same amplitude per line
    assert poles.level_v**2 / poles.lines == pytest.approx(whole.level_v**2 / whole.lines)
    assert whole.level_v == 1.0
    assert poles.grid is Grid.FULL
    assert (distortion.grid, distortion.lines) == (Grid.ODD_RANDOM, 3997)
    assert any(f"{3997 - poles.lines} of 3997 lines" in s.what for s in poles.skipped)
    assert not any("lines" in s.what for s in whole.skipped)
    saved = {s.why: s.saved_s for s in poles.skipped}
    assert saved["silent is not wanted"] == pytest.approx(3 * 0.4)
    many = make_plan(scene([[0, 0], [0.001, 0], [0.002, 0]]))
    saved = {s.why: s.saved_s for s in many.skipped}
    assert saved["silent is not wanted"] == pytest.approx(3 * 0.4)  # one is taken of a run
    assert "distortion is not wanted" in saved
    asked = scene([[0, 0]])
    asked = replace(asked, sensor=replace(asked.sensor, band_high_hz=2e4))
    with pytest.raises(ValueError, match=r"got \(200.0, 20000.0\); accepted is within 10 to 10000"):
        design_measurement(asked)


def test_several_bands_are_excited_and_nothing_between_them():
    asked = scene([[0, 0]])
    one = design_measurement(asked)
    further = (PoleBand(600.0, 800.0, 4, 8), PoleBand(320.0, 400.0))
    two = design_measurement(replace(asked, sensor=replace(asked.sensor, further_bands=further)))
    assert two.bands == (PoleBand(200.0, 300.0), *further)
    assert two.stretches_hz == ((180.0, 420.0), (580.0, 820.0))
    # the same amplitude per line
    assert two.level_v**2 / two.lines == pytest.approx(one.level_v**2 / one.lines)
    slow = replace(asked.sensor, sample_rate_hz=10e3, samples_per_period=8000)
    slow = design_measurement(replace(asked, sensor=slow))
    assert (slow.sample_rate_hz, slow.samples, slow.block_s) == (10e3, 8000, 0.8)
    assert slow.lines == 97  # of 1.25 Hz, eight on either side
    coarse = replace(asked.sensor, samples_per_period=1000)
    with pytest.raises(ValueError, match="sensor: excited lines from 200 to 300 Hz: got 3; .*50 Hz apart"):
        design_measurement(replace(asked, sensor=coarse))
    with pytest.raises(ValueError, match="further_bands: .*accepted is bands that do not overlap"):
        replace(asked.sensor, further_bands=(PoleBand(250.0, 400.0),))
