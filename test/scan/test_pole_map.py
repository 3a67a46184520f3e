# SPDX-License-Identifier: Apache-2.0
"""The map: which mode, which place, and where its ellipses lie."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from tactile_resonance.poles.result import Poles, PolesStatus
from tactile_resonance.record import Contact, ForceSpread, Origin
from tactile_resonance.recording.messages import POLES_STATUS
from tactile_resonance.scan.decision import Decision, Verdict
from tactile_resonance.scan.hands import Measured
from tactile_resonance.scan.map_messages import POINT, cloud_message, marker_message
from tactile_resonance.scan.messages import header_message
from tactile_resonance.scan.point_outcome import air_point, attempt_at, measured_result, with_poles
from tactile_resonance.scan.point_result import PointOutcome, PointResult
from tactile_resonance.scan.points import tip_orientation
from tactile_resonance.scan.pole_map import (
    SAME_PLACE_M,
    EllipseScale,
    GrowingMap,
    MapPoint,
    PoleMap,
    colours,
    shares,
)
from tactile_resonance.tissue.classify import UNKNOWN, TissueClass
from tactile_resonance.tissue.nominal_contact import ForceSensitivity, NominalContact

sys.path.insert(0, str(Path(__file__).resolve().parent))
from bench_hands import scene
from run_tables import as_csv

COVARIANCE = np.array([[0.02**2, 0.5 * 0.02 * 8e-5], [0.5 * 0.02 * 8e-5, 8e-5**2]])
SOFT = TissueClass("soft", np.array([250.0, 0.03]), np.diag([0.5**2, 0.001**2]))
FIRM = TissueClass("firm", np.array([256.0, 0.036]), np.diag([0.5**2, 0.001**2]))


def poles(f0_hz=(250.0,), residues=None, total=None, **values):
    f0 = np.array(f0_hz)
    damping = np.full(f0.size, 0.03)
    w = 2 * np.pi * f0
    return Poles(
        poles_rad_s=-damping * w + 1j * w * np.sqrt(1 - damping**2),
        f0_hz=f0,
        damping_ratio=damping,
        residues=np.ones(f0.size, complex) if residues is None else np.array(residues, complex),
        covariance=np.tile(COVARIANCE, (f0.size, 1, 1)),
        total_covariance=total,
        **{"status": PolesStatus.OK, **values},
    )


def test_the_drift_of_a_result_is_that_of_the_mode_on_the_map():
    drift = {
        "f0_drift_hz_per_s": np.array([0.1, -0.3]),
        "damping_drift_per_s": np.array([1e-4, 2e-4]),
        "drift_covariance": np.array([np.diag([0.01, 1e-9]), np.diag([0.04, 4e-10])]),
    }
    modes = poles((250.0, 280.0), residues=[1.0, 2.0], **drift)
    mode = modes.main
    assert mode.estimate[0] == 280.0
    np.testing.assert_allclose(mode.drift, [-0.3, 2e-4])
    np.testing.assert_allclose(mode.drift_std, [0.2, 2e-5])
    attempt, decision = attempt_at(air_point(3), 0, "table"), Decision(Verdict.MOST_BLOCKS, 8)
    result = measured_result(attempt, scene(), Measured(modes, origin()), decision)
    assert (result.f0_drift_hz_per_s, result.damping_drift_per_s) == (-0.3, 2e-4)
    assert result.f0_drift_std_hz_per_s == pytest.approx(0.2)
    assert result.damping_drift_std_per_s == pytest.approx(2e-5)
    constant = poles((250.0, 280.0), residues=[1.0, 2.0]).main
    assert np.isnan([*constant.drift, *constant.drift_std]).all()


def test_how_the_force_moved_stands_in_the_result():
    there = origin()
    there = replace(there, contact=replace(there.contact, spread=ForceSpread(3e-4, 0.009, 0.011)))
    attempt, decision = attempt_at(air_point(3), 0, "table"), Decision(Verdict.MOST_BLOCKS, 8)
    result = measured_result(attempt, scene(), Measured(poles((250.0,)), there), decision)
    assert (result.force_rms_n, result.force_min_n, result.force_max_n) == (3e-4, 0.009, 0.011)
    header, row = as_csv([result]).splitlines()
    at = header.split(",").index("force_rms_n")
    assert row.split(",")[at : at + 3] == ["0.0003", "0.009", "0.011"]


def map_point(poles, origin, *classes, age_s=np.nan, **given):
    """Point of poles that belong to no scan: where the tip was is its place."""
    x_m, y_m, z_m = origin.contact.position_m or (np.nan,) * 3
    place = {"x_m": x_m, "y_m": y_m, "z_m": z_m}
    result = PointResult(0, **place, reason=poles.message, contact_age_s=age_s)
    return MapPoint.of_tip(with_poles(result, poles, origin, *classes, **given), origin)


def origin(x=0.0, y=0.0, z=0.0, key=1, normal=(0.0, 0.0, 1.0)):
    turn = tuple(tip_orientation(np.array(normal) / np.linalg.norm(normal), 0.3))
    contact = Contact(0.0101, 1e-4, (x, y, z), turn, "table", 5)
    return Origin(measurement_id=key, label="here", contact=contact)


def grid_map(count=5, spacing=0.004, f0=lambda x, y: 250 + 300 * x, **values):
    result = GrowingMap()
    for i in range(count):
        for j in range(count):
            x, y = spacing * i, spacing * j
            point = map_point(poles((f0(x, y),), **values), origin(x, y, key=1 + count * i + j))
            result.add(point)
    return result.map


def test_a_point_takes_the_strongest_mode_and_the_fullest_covariance():
    two = poles((240.0, 260.0), residues=(1.0, -3.0j))
    assert map_point(two, origin()).result.f0_hz == 260.0
    total = 4 * np.tile(COVARIANCE, (1, 1, 1))
    found = map_point(poles(total=total), origin()).result
    np.testing.assert_allclose(found.covariance, total[0], rtol=1e-14)
    unknown = np.full((1, 2, 2), np.nan)
    found = map_point(poles(total=unknown), origin()).result
    np.testing.assert_allclose(found.covariance, COVARIANCE, rtol=1e-14)


def test_tissue_is_called_where_there_are_classes():
    points = [map_point(poles((f0,)), origin(), (SOFT, FIRM)) for f0 in (250.2, 262.0)]
    assert [point.result.tissue_class for point in points] == ["soft", UNKNOWN]
    assert map_point(poles(), origin()).result.tissue_class == ""


def test_tissue_is_called_at_the_nominal_contact_and_the_measured_pole_is_shown():
    """3 mN too much move a soft tissue to where it is neither; without a force nothing is said of it."""
    sensitivity = ForceSensitivity(np.array([1000.0, 0.0]), np.diag([10.0**2, 0.01**2]))
    nominal = NominalContact(0.01, 1.0, sensitivity)
    given = {"classes": (SOFT, FIRM), "nominal": nominal, "age_s": 1.0}

    def pressed(force_n, force_std_n=1e-4):
        contact = replace(origin().contact, force_n=force_n, force_std_n=force_std_n)
        return replace(origin(), contact=contact)

    plain = map_point(poles((253.0,)), pressed(0.013), (SOFT, FIRM)).result
    assert plain.tissue_class == UNKNOWN
    assert "farther from" in plain.tissue_reason
    assert "force and age of contact are not accounted for" in plain.tissue_reason
    found = map_point(poles((253.0,)), pressed(0.013), **given).result
    assert (found.tissue_class, found.tissue_reason) == ("soft", "")
    assert found.nominal_f0_hz == pytest.approx(250.0)
    np.testing.assert_array_equal(found.estimate, [253.0, 0.03])
    np.testing.assert_allclose(found.covariance, COVARIANCE, rtol=1e-14)
    assert found.nominal_f0_std_hz**2 > COVARIANCE[0, 0] + (1000 * 1e-4) ** 2
    # a force that is known to 1 mN only makes 1 Hz
    unsure = [
        map_point(poles((252.0,)), pressed(0.01, std), **given).result for std in (1e-4, 1e-3)
    ]
    assert [point.tissue_class for point in unsure] == [UNKNOWN, "soft"]
    unknown = map_point(poles((250.0,)), pressed(np.nan, np.nan), **given).result
    assert unknown.tissue_class == UNKNOWN
    assert np.isnan(unknown.tissue_probability)
    assert unknown.tissue_reason.startswith("the force is unknown")
    np.testing.assert_array_equal(unknown.estimate, [250.0, 0.03])


def grown(*points):
    found = GrowingMap()
    for point in points:
        found.add(point)
    return found


def test_a_point_that_is_skipped_takes_nothing_away_that_another_found_at_its_place():
    """As where one place is planned several times, to see how far its pole scatters."""
    done = PointResult(0, x_m=0.0, y_m=0.0, z_m=0.0, f0_hz=250.0, measurement_id=1)
    skipped = replace(done, index=1, f0_hz=np.nan, measurement_id=0, outcome=PointOutcome.SKIPPED)
    assert [point.result for point in GrowingMap([done, skipped]).map.points] == [done]
    assert not len(GrowingMap([replace(done, outcome=PointOutcome.FAILED), replace(skipped, index=0)]))


def test_a_map_holds_what_a_search_of_all_its_points_would_leave():
    random, found, wanted = np.random.default_rng(4), GrowingMap(), []
    taken = replace(map_point(poles((250.0,)), origin(key=1)).result, measurement_id=0)
    places = random.integers(-3, 4, (400, 3)) * 7e-5  # of neighbours one or two are within 1e-4
    for k, place in enumerate(np.vstack([places, np.full((2, 3), np.nan)])):
        x_m, y_m, z_m = place
        key, kind = int(random.integers(4) and 1 + random.integers(60)), random.integers(5)
        outcome = PointOutcome.SKIPPED if kind == 0 else PointOutcome.DONE
        frame = "phantom" if kind == 1 else "table"
        result = replace(taken, x_m=x_m, y_m=y_m, z_m=z_m, measurement_id=key)
        result = replace(result, outcome=outcome, frame_id=frame, time_ns=k)
        found.take(result)
        wanted = [
            other
            for other in wanted
            if other.frame_id != frame
            or not math.dist((other.x_m, other.y_m, other.z_m), place) <= SAME_PLACE_M
        ]
        if outcome is PointOutcome.DONE:
            wanted = [other for other in wanted if not key or other.measurement_id != key]
            wanted.append(result)
        assert [point.result.time_ns for point in found.map.points] == [r.time_ns for r in wanted]
    assert len(found) == len(wanted) > 20


def test_each_place_once_whatever_comes():
    block_1 = map_point(poles((250.0,)), origin(key=7))
    block_2 = map_point(poles((250.5,)), origin(x=0.00002, key=7))
    repeated = map_point(poles((251.0,)), origin(y=0.00005, key=8))
    elsewhere = map_point(poles((252.0,)), origin(x=0.004, key=9))
    found = grown(block_1, block_2)
    assert found.map.f0_hz.tolist() == [250.5]
    found.add(repeated)
    found.add(elsewhere)
    assert found.map.f0_hz.tolist() == [251.0, 252.0]


def test_the_same_numbers_in_two_frames_are_two_places():
    shown = GrowingMap()
    for key, frame in enumerate(("table", "phantom", "phantom"), 1):
        point = map_point(poles((250.0 + key,)), origin(x=0.1 * key, key=key))
        result = replace(point.result, x_m=0.0, y_m=0.0, z_m=0.0, frame_id=frame)
        shown.add(replace(point, result=result))
    assert shown.map.f0_hz.tolist() == [251.0, 253.0]
    shown.clear(result)
    assert shown.map.f0_hz.tolist() == [251.0]


def test_no_pose_is_refused_and_no_pole_is_a_failure():
    with pytest.raises(ValueError, match="tip_pose of measurement 3: got None; accepted is finite numbers"):
        map_point(poles(), Origin(measurement_id=3))
    failed = map_point(Poles(status=PolesStatus.NO_RESONANCE, message="none in band"), origin())
    elsewhere = replace(failed.result, measurement_id=99, x_m=1.0)
    found = PoleMap((*grid_map(2).points, MapPoint.planned(elsewhere)))
    assert failed.result.failed
    assert (len(found.estimated), len(found.failures)) == (4, 1)
    assert found.failures[0].result.reason == "none in band"
    assert np.isfinite(found.f0_hz).all()


def test_ellipses_hold_what_they_say_in_the_plane_of_the_surface():
    normal = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
    point = map_point(poles(), origin(0.01, 0.02, 0.03, normal=normal))
    found = PoleMap((point,))
    scale = EllipseScale(0.1, 20.0)
    (lines,) = found.ellipses(scale, 0.95)
    assert lines.shape == (36, 2, 3)
    np.testing.assert_allclose(lines[1:, 0], lines[:-1, 1])  # closed, without gaps
    np.testing.assert_allclose(lines[0, 0], lines[-1, 1], atol=1e-12)
    offset = lines[:, 0] - point.position_m
    np.testing.assert_allclose(offset @ normal, 0, atol=1e-12)
    along = np.array([1, 0, 0]) - normal[0] * normal
    along /= np.linalg.norm(along)
    pole = np.stack([offset @ along / 0.1, offset @ np.cross(normal, along) / 20.0], axis=1)
    distance2 = np.einsum("si,ij,sj->s", pole, np.linalg.inv(COVARIANCE), pole)
    np.testing.assert_allclose(distance2, chi2.ppf(0.95, 2))


def test_the_scale_keeps_ellipses_apart_in_round_numbers():
    found = grid_map()
    scale = found.ellipse_scale()
    reach = np.abs(found.ellipses(scale)[..., :2] - found.positions_m[:, None, None, :2])
    assert 0.1 * 0.004 < reach.max() <= 0.4 * 0.004
    for value in (scale.m_per_hz, scale.m_per_damping):
        assert f"{value:.0e}"[0] in "125"
        assert float(f"{value:.0e}") == pytest.approx(value)
    # one point that is far less certain does not make the others invisible
    sure = found.points[0].result
    unsure = replace(
        sure,
        f0_std_hz=100 * sure.f0_std_hz,
        damping_ratio_std=100 * sure.damping_ratio_std,
        f0_damping_covariance_hz=1e4 * sure.f0_damping_covariance_hz,
    )
    wild = replace(found.points[0], result=unsure)
    assert PoleMap((wild, *found.points[1:])).ellipse_scale() == scale
    # and one point alone, or none with a covariance, has a scale too
    assert PoleMap(found.points[:1]).ellipse_scale().m_per_hz > 0
    bare = MapPoint(
        PointResult(0, f0_hz=250.0, damping_ratio=0.03), np.zeros(3), np.array([0, 0, 1.0])
    )
    assert PoleMap((bare,)).ellipse_scale().m_per_hz > 0
    assert PoleMap((bare,)).ellipses(EllipseScale(1, 1)).shape == (0, 36, 2, 3)
    markers = marker_message(PoleMap((bare,)), EllipseScale(1, 1), 0.95, header_message("table", 1))
    assert [marker.points for marker in markers.markers] == [[], []]


def test_the_ellipses_of_a_message_are_those_of_the_map_in_their_colours():
    found, scale = grid_map(3), EllipseScale(0.1, 20.0)
    ellipses = marker_message(found, scale, 0.95, header_message("table", 1)).markers[0]
    shown = np.array([[p.x, p.y, p.z] for p in ellipses.points]).reshape(-1, 36, 2, 3)
    np.testing.assert_allclose(shown, found.ellipses(scale, 0.95), atol=1e-15)
    rgb = np.array([[c.r, c.g, c.b] for c in ellipses.colors]).reshape(-1, 72, 3)
    expected = colours(shares(found.f0_hz, found.f0_hz))
    np.testing.assert_allclose(rgb, np.repeat(expected[:, None], 72, axis=1))


def test_corners_of_many_small_ellipses_are_fewer_and_lie_on_them():
    (point,) = grid_map(1).points
    for count, segments in ((1, 36), (1000, 36), (2000, 18), (10_000, 8)):
        lines = PoleMap((point,) * count).ellipses(EllipseScale(1.0, 1.0), 0.95)
        assert lines.shape == (count, segments, 2, 3)
        offset = (lines[-1] - point.position_m)[..., :2].reshape(-1, 2)
        squared = np.sum(offset * np.linalg.solve(point.result.covariance, offset.T).T, axis=1)
        np.testing.assert_allclose(squared, chi2.ppf(0.95, 2), rtol=1e-9)


def test_what_is_drawn_refers_to_the_size_seen_from_above():
    row = PoleMap(tuple(p for p in grid_map().points if p.position_m[1] == 0))
    assert row.size_m == pytest.approx(0.016)
    in_air = map_point(poles(), origin(0.0, 0.0, 0.06, key=99))
    assert PoleMap((*row.points, in_air)).size_m == pytest.approx(0.016)
    assert PoleMap(row.points[:2]).size_m == pytest.approx(4 * 0.004)
    assert PoleMap(row.points[:1]).size_m == pytest.approx(4 * 0.005)


def test_a_point_is_seen_from_another_frame():
    normal = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
    here = map_point(poles(), origin(0.01, 0.02, 0.03, normal=normal))
    turn, place = Rotation.from_rotvec([0.1, 0.2, -1.5]), np.array([-0.5, 0.1, 0.2])
    there = replace(
        here, position_m=place + turn.apply(here.position_m), normal=turn.apply(here.normal)
    )
    again = there.seen_from(place, turn)
    np.testing.assert_allclose(again.position_m, here.position_m, atol=1e-15)
    np.testing.assert_allclose(again.normal, here.normal, atol=1e-15)
    assert again.result is here.result


def test_surface_follows_the_points_and_their_plane():
    found = grid_map(f0=lambda x, y: 250 + 300 * x - 100 * y)
    surface = found.surface(16)
    x, y, z = np.moveaxis(surface.position_m, -1, 0)
    assert x.min() == 0
    assert x.max() == pytest.approx(0.016)
    np.testing.assert_array_equal(z, 0)
    error = surface.f0_hz - (250 + 300 * x - 100 * y)
    assert np.max(np.abs(error)) < 0.05
    assert surface.f0_std_hz.max() < 0.2
    # it ends at the points whatever the ratio of its sides
    other = PoleMap(tuple(p for p in found.points if p.position_m[1] < 0.006)).surface(7)
    assert np.max(other.position_m[..., 0]) == pytest.approx(0.016)
    assert np.max(other.position_m[..., 1]) == pytest.approx(0.004)
    assert grid_map(2).surface() is None  # too few
    line = PoleMap(tuple(p for p in found.points if p.position_m[1] == 0))
    assert line.surface() is None  # on one line


def test_a_run_s_results_make_the_same_point():
    point = map_point(poles(), origin(0.01, 0.02))
    result = PointResult(
        0,
        x_m=0.01,
        y_m=0.02,
        z_m=0.0,
        normal_x=0.0,
        normal_y=0.0,
        normal_z=1.0,
        f0_hz=250.0,
        damping_ratio=0.03,
        f0_std_hz=0.02,
        damping_ratio_std=8e-5,
        f0_damping_covariance_hz=COVARIANCE[0, 1],
        poles_status="model error",
    )
    again = GrowingMap([result]).map
    (found,) = again.estimated
    np.testing.assert_allclose(found.result.covariance, point.result.covariance)
    np.testing.assert_allclose(found.position_m, point.position_m)
    cloud = cloud_message(again, (), header_message("table", 1))
    (row,) = np.frombuffer(cloud.data.tobytes(), POINT)
    assert row["status"] == POLES_STATUS[PolesStatus.MODEL_ERROR]
    unknown = GrowingMap([replace(result, poles_status="")]).map
    cloud = cloud_message(unknown, (), header_message("table", 1))
    (row,) = np.frombuffer(cloud.data.tobytes(), POINT)
    assert row["status"] not in POLES_STATUS.values()
    lost = replace(result, outcome=PointOutcome.FAILED, reason="contact lost")
    (failed,) = GrowingMap([result, lost]).map.failures
    assert failed.result.reason == "contact lost"
