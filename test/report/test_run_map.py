# SPDX-License-Identifier: Apache-2.0
"""The map of a run as a recording of its own: what it shows, when, and where its frames stand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_resonance.configuration import share_path
from tactile_resonance.report import run_map
from tactile_resonance.report.run_map import (
    boundary_of_run,
    draw_pole_map,
    true_f0_hz,
    write_map_recording,
)
from tactile_resonance.scan.map_messages import CLOUD, MARKERS, POINT
from tactile_resonance.scan.messages import make_message, to_cdr
from tactile_resonance.scan.point_file import read_content, read_messages
from tactile_resonance.scan.point_result import PointKind, PointOutcome, PointResult
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.pole_map import MapPoint, PoleMap
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.run_directory import RunDirectory
from tactile_resonance.scan.scene import read_scan_scene
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.tissue.library import read_tissues, uniform
from tactile_resonance.simulation.tissue.scene import Disc, PhantomScene, Region, read_scene

TABLE_IN_BASE = [0.3, -0.1, 0.05, 0.0, 0.0, np.pi / 2]
TIP = Rotation.from_rotvec([0.1, 0.2, -0.3])
START_NS = 1_700_000_000_000_000_000


def result_of(index, attempt=0, outcome=PointOutcome.DONE, f0_hz=250.0, **more):
    return PointResult(
        index=index,
        attempt=attempt,
        outcome=outcome,
        f0_hz=f0_hz,
        f0_std_hz=0.01,
        damping_ratio=0.03,
        damping_ratio_std=1e-4,
        f0_damping_covariance_hz=0.0,
        x_m=0.002 * index,
        y_m=0.001,
        z_m=0.0,
        normal_z=1.0,
        frame_id="table",
        simulated=True,
        time_ns=START_NS + index * 10**9,
        **more,
    )


ATTEMPTS = (
    result_of(0),
    result_of(1, outcome=PointOutcome.DISCARDED, f0_hz=999.0),
    result_of(1, attempt=1, f0_hz=251.0),
    result_of(2, outcome=PointOutcome.FAILED, f0_hz=np.nan),
    result_of(3, outcome=PointOutcome.SKIPPED, f0_hz=np.nan),
)


def pose(x_m):
    header = make_message("std_msgs/msg/Header", frame_id="base")
    message = make_message("geometry_msgs/msg/PoseStamped", header=header)
    message.pose.position.x = x_m
    turn = message.pose.orientation
    turn.x, turn.y, turn.z, turn.w = TIP.as_quat().tolist()
    return to_cdr(message)


@pytest.fixture
def folder(tmp_path):
    """Four points, one repeated, one failed and one skipped, and a reference in free air."""
    plan = [ScanPoint(i, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)) for i in range(4)]
    facts = {"scan_node": {"table_in_base": TABLE_IN_BASE, "base_frame": "base"}}
    with RunDirectory.create(tmp_path / "run", "name: x\n", plan, facts) as run:
        for k, result in enumerate(ATTEMPTS):
            with run.begin_point(result.index) as recording:
                recording.write(
                    "/left/tcp_pose", "geometry_msgs/msg/PoseStamped", START_NS + k, pose(0.01 * k)
                )
                recording.finish(result)
        with run.begin_reference("air-after") as recording:
            recording.finish(result_of(4, kind=PointKind.AIR, f0_hz=246.6))
    return tmp_path / "run"


def told(path, topic):
    types = CLOUD, MARKERS, "tf2_msgs/msg/TFMessage"
    return [(at_ns, message) for at_ns, of, message in read_messages(path, *types) if of == topic]


def test_the_map_grows_with_the_tissue_that_counts(folder):
    path = write_map_recording(read_run(folder))
    clouds = told(path, "/pole_map")
    shown = [np.frombuffer(cloud.data.tobytes(), POINT)["f0_hz"].tolist() for _, cloud in clouds]
    # neither the discarded attempt nor free air; the failure is a cross
    assert [sorted(f0) for f0 in shown] == [[250.0], *3 * [[250.0, 251.0]]]
    for time_ns, cloud in clouds:
        assert cloud.header.frame_id == "table"
        assert cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec == time_ns
    crosses = [
        {m.ns: m for m in array.markers}["failures"] for _, array in told(path, "/pole_map/markers")
    ]
    assert [len(marker.points) for marker in crosses] == [0, 0, 4, 4]
    texts = [marker.text for marker in told(path, "/pole_map/legend")[-1][1].markers]
    assert "2 points, 1 failed" in texts
    assert "simulated, not measured" in texts


def test_of_two_attempts_the_later_one_counts_whatever_the_clock_showed(tmp_path):
    plan = [ScanPoint(i, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)) for i in range(2)]
    with RunDirectory.create(tmp_path / "run", "name: x\n", plan, {}) as run:
        for attempt, index in ((0, 0), (0, 1), (1, 1)):
            result = result_of(index, attempt, f0_hz=250.0 + index + 2 * attempt)
            set_back_ns = attempt * 3600 * 10**9
            with run.begin_point(index) as recording:
                recording.finish(replace(result, time_ns=result.time_ns - set_back_ns))
    clouds = told(write_map_recording(read_run(tmp_path / "run")), "/pole_map")
    shown = [np.frombuffer(cloud.data.tobytes(), POINT)["f0_hz"].tolist() for _, cloud in clouds]
    assert [sorted(f0) for f0 in shown] == [[250.0], [250.0, 251.0], [250.0, 253.0]]


def test_its_frames_are_those_of_the_scan(folder):
    path = write_map_recording(read_run(folder))
    ((_, static),) = told(path, "/tf_static")
    (table,) = static.transforms
    assert (table.header.frame_id, table.child_frame_id) == ("base", "table")
    to, turn = table.transform.translation, table.transform.rotation
    np.testing.assert_allclose([to.x, to.y, to.z], TABLE_IN_BASE[:3])
    found = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])
    np.testing.assert_allclose(found.apply([1.0, 0.0, 0.0]), [0.0, 1.0, 0.0], atol=1e-12)
    tips = [(time_ns, message.transforms[0]) for time_ns, message in told(path, "/tf")]
    assert [tip.child_frame_id for _, tip in tips] == ["tip"] * len(ATTEMPTS)
    np.testing.assert_allclose([t.transform.translation.x for _, t in tips], 0.01 * np.arange(5))
    turn = tips[0][1].transform.rotation
    assert (Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]) * TIP.inv()).magnitude() < 1e-12


def test_late_readers_get_the_map_of_a_file_that_is_played(folder):
    content = read_content(write_map_recording(read_run(folder)))
    latched = {topic.name for topic in content.topics if "transient_local" in topic.qos}
    assert latched == {"/tf_static", "/pole_map"} | {
        f"/pole_map/{name}" for name in ("markers", "legend", "surface")
    }


@pytest.mark.parametrize(("bound", "most"), [("MOST_STATES", 2), ("MOST_DRAWN", 2 * 4)])
def test_a_long_run_is_drawn_at_some_points_and_at_the_last(folder, monkeypatch, bound, most):
    monkeypatch.setattr(run_map, bound, most)
    path = write_map_recording(read_run(folder))  # in place of the one before
    assert [cloud.width for _, cloud in told(path, "/pole_map")] == [2, 2]  # of four
    crosses = told(path, "/pole_map/markers")[-1][1].markers[1]
    assert len(crosses.points) == 4
    assert {file.name for file in folder.iterdir()} >= {"map.mcap", "recording"}
    assert not list(folder.glob(".map-*"))


def test_without_a_point_there_is_no_map(tmp_path):
    plan = [ScanPoint(0, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))]
    RunDirectory.create(tmp_path / "run", "name: x\n", plan, {}).close()
    assert write_map_recording(read_run(tmp_path / "run")) is None
    assert not (tmp_path / "run" / "map.mcap").exists()


def test_classes_have_the_numbers_that_they_have_in_the_scene(tmp_path):
    scene = share_path("config/scenes/demo.yaml")
    assert [tissue.name for tissue in read_scan_scene(scene).tissue_classes] == ["gelatine 10 %", "inclusion"]
    plan = [ScanPoint(0, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))]
    run = RunDirectory.create(tmp_path / "run", scene.read_text(), plan, {})
    with run, run.begin_point(0) as recording:
        recording.finish(result_of(0, tissue_class="inclusion"))
    path = write_map_recording(read_run(tmp_path / "run"))
    ((_, cloud),) = told(path, "/pole_map")
    assert np.frombuffer(cloud.data.tobytes(), POINT)["tissue_class"].tolist() == [1]
    texts = [marker.text for marker in told(path, "/pole_map/legend")[-1][1].markers]
    assert "class 1, inclusion: 1" in texts


def test_a_row_of_points_has_no_surface_and_the_picture_says_why():
    row = PoleMap(tuple(MapPoint.planned(result_of(k)) for k in range(8)))  # more than a surface takes
    texts = [text.get_text() for text in draw_pole_map(row, "row").axes[1].texts]
    assert texts == ["no surface: 5 points with a standard deviation, not on one line, are needed"]


@pytest.mark.parametrize("referred", [True, False])
def test_the_boundary_drawn_is_that_of_boundary_json(tmp_path, referred):
    """Of an adaptive scan, whose scene states the region and the smallest thing that is looked for."""
    scene = share_path("config/scenes/demo.yaml")
    adaptive = read_scan_scene(scene).adaptive
    places = adaptive.places_m()
    touched = np.vstack([places[adaptive.first(places)], [[0.002, -0.001], [0.003, 0.002]]])
    f0_hz = 258.0 - 4.2 * (np.linalg.norm(touched - [0.002, -0.001], axis=1) / 0.006) ** 2
    at = ((float(x), float(y), 0.0) for x, y in touched)
    plan = [ScanPoint(k, place, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)) for k, place in enumerate(at)]
    facts = {"scan_node": {"table_in_base": TABLE_IN_BASE, "base_frame": "base"}}
    text = scene.read_text().replace("  force_n: 0.01\n  age_s: 1.0\n", "  force_n: 0.012\n  age_s: 3.0\n")
    with RunDirectory.create(tmp_path / "run", text, plan, facts) as run:
        for point in plan:
            x_m, y_m, _ = point.position_m
            with run.begin_point(point.index) as recording:
                result = result_of(point.index, f0_hz=float(f0_hz[point.index]))
                nominal = {"nominal_f0_hz": result.f0_hz, "nominal_f0_std_hz": 0.01} if referred else {}
                recording.finish(replace(result, x_m=x_m, y_m=y_m, **nominal))
    content = read_run(tmp_path / "run")
    of_run = boundary_of_run(content)
    found = of_run.boundary
    assert found.outline_m
    # of the contact to which the poles of the map refer
    force_n, hold_s = (0.012, 3.0) if referred else (0.01, 1.0)
    phantoms = replace(read_scene(read_tissues(), scene), force_n=force_n)
    truth = true_f0_hz(phantoms, adaptive, found.level_set.levels[0], hold_s)
    want = adaptive.raster.lines(found.level_set.depth(truth))
    np.testing.assert_array_equal(np.concatenate(of_run.true_outline_m), np.concatenate(want))
    *_, (_, last) = told(write_map_recording(content), "/pole_map/markers")
    outline, band = (marker for marker in last.markers if marker.ns == "boundary")
    for marker, lines in ((outline, found.outline_m), (band, (*found.inner_m, *found.outer_m))):
        drawn = [(point.x, point.y) for point in marker.points[::2]]  # each begins a stretch of a line
        np.testing.assert_allclose(drawn, np.concatenate([line[:-1] for line in lines]), atol=1e-12)


def test_truth_of_a_map_is_sharp_at_edges_and_is_that_of_the_nominal_contact():
    asked = read_scan_scene(share_path("config/scenes/demo.yaml")).adaptive
    library, centre_m, radius_m = read_tissues(), (0.7e-3, 0.4e-3), 4e-3
    tissues = [library["gel10"], library["gel16"]]
    phantoms = PhantomScene(
        "dish in a dish",
        0.01,
        tuple(
            Region(tissue.name, Disc(place, radius), uniform(tissue))
            for tissue, place, radius in zip(tissues, ((0, 0), centre_m), (7e-3, radius_m), strict=True)
        ),
    )
    bench = SimulatedBench.from_configuration()
    for force_n, hold_s in ((0.01, 1.0), (0.008, 3.0)):
        held = {"force_n": force_n, "hold_time_s": hold_s}
        want = [bench.coupled(tissue, **held).mode_near(255.0).f0_hz for tissue in tissues]
        got = true_f0_hz(replace(phantoms, force_n=force_n), asked, 255.0, hold_s)
        xy_m = asked.raster.xy_m
        within = [np.linalg.norm(xy_m - c, axis=-1) <= r for c, r in (((0, 0), 7e-3), (centre_m, radius_m))]
        want_there = np.where(within[1], want[1], np.where(within[0], want[0], np.nan))
        np.testing.assert_allclose(got, want_there, rtol=1e-9)
        assert 0 < np.isnan(got).mean() < 0.5
