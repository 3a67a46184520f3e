# SPDX-License-Identifier: Apache-2.0
"""Normals found by touch: balls on planes, spheres, cylinders in closed form; contacts in virtual time."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_resonance.contact.geometry import touch_pose
from tactile_resonance.contact.goal import ContactGoal
from tactile_resonance.contact.loop import ContactLoop
from tactile_resonance.contact.machine import ContactController
from tactile_resonance.contact.parameters import Limits
from tactile_resonance.contact.samples import Pose
from tactile_resonance.scan.failures import PointDisturbed, PointFailed, SurfaceMissing
from tactile_resonance.scan.hands import Touch
from tactile_resonance.scan.plan import make_plan
from tactile_resonance.scan.points import ScanPoint, tip_orientation
from tactile_resonance.scan.scene import ScanScene, parse_scan_scene
from tactile_resonance.scan.surface import NormalRequest
from tactile_resonance.scan.surface_search import find_normals, normal_of_touches, places_around
from tactile_resonance.simulation.plant.contact_bench import ContactBench
from tactile_resonance.simulation.plant.surfaces import PlantSurface
from tactile_resonance.simulation.plant.tip import Tip

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "contact"))
from contacts import FORCE_N, QUICK, RADIUS_M, SOFT

STD_M = 3e-5
THREE, FOUR = NormalRequest(), NormalRequest(touches=4)


def expected(normal, place_m=(0.0, 0.0, 0.0), index=0):
    normal = np.array(normal) / np.linalg.norm(normal)
    turn = tip_orientation(normal, 0.3)
    return ScanPoint(index, tuple(place_m), tuple(normal.tolist()), tuple(turn.tolist()), "point 1")


def touching(height, noise=lambda: 0.0):
    """Lowers a ball along the normal of a point; `height` is that of its centre when it touches."""

    def touch(point):
        place, normal = np.array(point.position_m), np.array(point.normal)
        ball = place + (height(place, normal) + noise()) * normal
        return Touch(tuple(ball.tolist()), STD_M, FORCE_N)

    return touch


def on_plane(at_m, normal):
    """A plane through a point: the ball's centre is one radius from it."""
    normal = np.array(normal) / np.linalg.norm(normal)
    return lambda place, along: (RADIUS_M - (place - at_m) @ normal) / (along @ normal)


def on_sphere(centre_m, radius_m):
    """A sphere of the ball's centres: met from outside, or from inside where the radius is below 0."""

    def height(place, along):
        off = place - centre_m
        middle = -(off @ along)
        root = np.sqrt(radius_m**2 - off @ off + middle**2)
        return middle + np.sign(radius_m) * root

    return height


def found_of(point, request, touch):
    touches = tuple(touch(around) for around in places_around(point, request))
    made, facts = normal_of_touches(point, touches, RADIUS_M, 0.3)
    return SimpleNamespace(point=made, **facts)


def angle(a, b):
    return np.arctan2(np.linalg.norm(np.cross(a, b)), np.dot(a, b))


@pytest.mark.parametrize("request_", [THREE, FOUR])
def test_normal_of_a_plane_is_exact_and_the_point_lies_on_it(request_):
    rng = np.random.default_rng(2)
    for _ in range(20):
        told = Rotation.random(random_state=rng).as_matrix()[:, 2] * [1, 1, 0] + [0, 0, 1]
        true = told / np.linalg.norm(told) + 0.3 * rng.uniform(-1, 1, 3)
        true /= np.linalg.norm(true)
        place = rng.uniform(-0.02, 0.02, 3)
        at = place + rng.uniform(-5e-4, 5e-4) * told
        point = expected(told, place)
        found = found_of(point, request_, touching(on_plane(at, true)))
        np.testing.assert_allclose(found.point.normal, true, atol=1e-12)
        assert (found.point.position_m - at) @ true == pytest.approx(0, abs=1e-12)
        # where the ball touches when it is straight above the point that was asked for
        ball = found.point.position_m + RADIUS_M * true
        np.testing.assert_allclose(np.cross(ball - place, point.normal), 0, atol=1e-12)
        assert found.angle_rad == pytest.approx(angle(true, point.normal), abs=1e-7)
        turn = Rotation.from_quat(found.point.orientation_xyzw).as_matrix()
        np.testing.assert_allclose(turn[:, 2], true, atol=1e-12)
        # least squares on a circle: each slope is known to sigma sqrt(2 / n) / radius
        assert found.std_rad == pytest.approx(STD_M * np.sqrt(2 / request_.touches) / 2e-3)


def test_normals_scatter_as_much_as_they_are_said_to():
    rng = np.random.default_rng(3)
    true = np.array([0.1, -0.05, 1.0]) / np.linalg.norm([0.1, -0.05, 1.0])
    point = expected([0, 0, 1])
    touch = touching(on_plane(np.zeros(3), true), lambda: STD_M * rng.standard_normal())
    found = [found_of(point, THREE, touch) for _ in range(2000)]
    off = np.array([normal.point.normal for normal in found]) - true
    across = np.cross(true, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    for axis in (across, np.cross(true, across)):
        assert np.std(off @ axis) == pytest.approx(found[0].std_rad, rel=0.06)


def test_the_first_touch_lies_in_the_direction_of_the_beam():
    point = expected([0.3, -0.2, 1.0], (0.01, 0.02, 0.03))
    (first, *_), normal = places_around(point, FOUR), np.array(point.normal)
    way = np.subtract(first.position_m, point.position_m)
    heading = np.array([np.cos(0.3), np.sin(0.3), 0.0])  # of the tip, seen from above
    beam = heading - (heading @ normal) * normal
    np.testing.assert_allclose(way, FOUR.radius_m * beam / np.linalg.norm(beam), atol=1e-15)


@pytest.mark.parametrize("hollow", [False, True])
def test_error_on_a_sphere_of_10_mm_is_that_of_its_closed_form(hollow):
    # the ball's centres lie on a sphere of 12.5 mm, or of 7.5 mm inside of the hollow
    radius, sign = (10e-3 - RADIUS_M, -1.0) if hollow else (10e-3 + RADIUS_M, 1.0)
    for tilt in (0.0, np.deg2rad(5), np.deg2rad(15)):
        # straight above the point the ball touches where the normal is `true`
        point = expected([0, 0, 1])
        first = np.array(places_around(point, THREE)[0].position_m)
        east = first / np.linalg.norm(first)
        true = np.sin(tilt) * east + np.cos(tilt) * np.array([0, 0, 1.0])
        found = found_of(point, THREE, touching(on_sphere(-sign * radius * true, sign * radius)))
        # heights of the sphere of centres over the plane, at the first touch and at the other two
        shift, p = -sign * radius * np.sin(tilt), 2e-3
        there = np.sqrt(radius**2 - (p - shift) ** 2)
        back = np.sqrt(radius**2 - (-p / 2 - shift) ** 2 - 0.75 * p**2)
        slope = sign * (there - back) / (1.5 * p)
        got = -(np.array(found.point.normal) @ east) / found.point.normal[2]
        assert got == pytest.approx(slope, abs=1e-12)
        off = angle(found.point.normal, true)
        assert off == pytest.approx(abs(np.arctan(-slope) - tilt), abs=1e-9)
        # met along its normal it is exact; else off by far less than a touch's noise leaves
        assert off < (1e-12 if tilt == 0 else 0.006 if hollow else 0.007)


@pytest.mark.parametrize(("count", "share"), [(3, 1.0), (4, 0.0), (6, 0.0)])
def test_three_touches_are_misled_by_a_cylinder_and_four_are_not(count, share):
    radius, request_ = 12.5e-3, NormalRequest(touches=count)
    point = expected([0, 0, 1])
    first = np.array(places_around(point, request_)[0].position_m)
    east = first / np.linalg.norm(first)
    found = found_of(
        point, request_, touching(lambda place, _: np.sqrt(radius**2 - (place @ east) ** 2))
    )
    off = angle(found.point.normal, [0, 0, 1])
    # exactly the chord of the arc from -p/2 to p; to first order p / 4 R
    p = request_.radius_m
    chord = (np.sqrt(radius**2 - p**2) - np.sqrt(radius**2 - p**2 / 4)) / (1.5 * p)
    assert off == pytest.approx(share * np.arctan(-chord), abs=1e-9)
    assert -chord == pytest.approx(p / (4 * radius), rel=0.02)


def test_what_cannot_be_relied_on_is_left_out_with_its_figure():
    points = [expected([0, 0, 1], (0.01 * n, 0.0, 0.0), n) for n in range(4)]
    tilts = [0.1, 0.5, 0.1, 0.1]

    def touch(point):
        n = point.index
        if n == 2:
            raise SurfaceMissing("nothing there")
        at = np.array(points[n].position_m)
        height = on_plane(at, [np.sin(tilts[n]), 0, np.cos(tilts[n])])
        made = touching(height)(point)
        if n == 3 and point.label.endswith("touch 2"):
            x, y, z = made.ball_m
            made = Touch((x, y, z + 1e-3), made.std_m, made.force_n)
        return made

    found, facts, left = find_normals(points, FOUR, RADIUS_M, 0.3, touch)
    assert [point.index for point in found] == [0]
    assert facts[0]["position_m"] == list(found[0].position_m)
    assert [point for point, _ in left] == points[1:]
    for (_, why), text in zip(
        left,
        (
            "got 0.5; accepted is most_angle_rad = 0.35",
            "nothing there",
            "got 0.00025; accepted is tolerance_m = 0.0002",
        ),
        strict=True,
    ):
        assert text in why
    vague = NormalRequest(radius_m=5e-4)
    found, facts, ((_, why),) = find_normals(points[:1], vague, RADIUS_M, 0.3, touch)
    assert not found
    assert not facts
    assert "got 0.049; accepted is most_std_rad = 0.03 or less: a larger radius_m" in why

    def disturbed(point):
        raise PointDisturbed("a late sensor", "late")

    with pytest.raises(PointDisturbed):
        find_normals(points, THREE, RADIUS_M, 0.3, disturbed)


def test_plan_goes_on_with_the_points_whose_normals_were_found():
    xy = np.array([[0.0, 0.0, np.nan], [0.01, 0.0, np.nan]])
    scene = ScanScene("dome", 0.01, xy, normals=THREE)
    plan = make_plan(scene)

    def touch(point):
        if point.position_m[0] < 5e-3:
            raise PointFailed("adhesion")
        return touching(on_plane(np.zeros(3), [0.2, 0.0, 1.0]))(point)

    found, _, left = find_normals(plan.points, THREE, RADIUS_M, 0.0, touch)
    after = plan.with_points(found, left)
    (point,) = after.points
    beside = RADIUS_M * np.sin(np.arctan(0.2))  # where a ball straight above the place touches
    assert (point.index, point.label) == (0, "dome, point 1")
    np.testing.assert_allclose(
        point.position_m, [0.01 - beside, 0.0, -0.002 + 0.2 * beside], atol=1e-12
    )
    assert after.skipped[0].what == "the point at x = 0.00, y = 0.00 mm"
    assert after.skipped[0].why == "normals: adhesion"
    assert after.longest_s < plan.longest_s
    with pytest.raises(ValueError, match="all 1 are left out; the first: normals: adhesion"):
        plan.with_points([], left)


def test_scene_asks_for_it():
    content = {"force_n": 0.01, "positions": {"list": [[0, 0]]}}
    path = Path("scene.yaml")
    assert parse_scan_scene(content, path).normals is None
    asked = parse_scan_scene({**content, "normals": {"radius_m": 1.5e-3, "touches": 4}}, path)
    assert asked.normals == NormalRequest(radius_m=1.5e-3, touches=4)
    assert parse_scan_scene({**content, "normals": {}}, path).normals == THREE
    for fields, text in (
        ({"touches": 2}, "normals.touches: got 2; accepted is 3 to 12"),
        ({"most_angle_rad": 1.0}, "normals.most_angle_rad: got 1.0; accepted is 0 to 0.8"),
        ({"angle": 1}, "normals.angle"),
    ):
        with pytest.raises(ValueError, match=text):
            parse_scan_scene({**content, "normals": fields}, path)


@pytest.mark.parametrize("hollow", [False, True])
def test_normal_of_a_sphere_of_tissue_is_found_by_contacts(hollow):
    tilt, azimuth = np.deg2rad(10), 0.7
    true = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
    # the ball touches level with the point, its centre straight above it; a level normal is expected there
    centre = np.array([0, 0, RADIUS_M]) + (7.5e-3 if hollow else -12.5e-3) * true
    curved = -100.0 if hollow else 100.0
    surface = PlantSurface(centre + true / curved, true, curved)
    told = touch_pose([0, 0, 0], [0, 0, 1], [1, 0, 0], RADIUS_M)
    start = Pose(told.position_m + [0, 0, 3e-3], told.rotation_rad)
    bench = ContactBench(SOFT, surface, start, tip=Tip(RADIUS_M), seed=1)
    loop = ContactLoop(bench.arm, bench.cell, bench, ContactController(QUICK, Limits()))

    def touch(point):
        pose = touch_pose(point.position_m, point.normal, [1, 0, 0], RADIUS_M)
        result = loop.make(ContactGoal(pose, FORCE_N))
        if not result.reached:
            raise PointFailed(result.message)
        loop.retract()
        ball = np.array(point.position_m) + (RADIUS_M + result.surface_m) * np.array(point.normal)
        return Touch(tuple(ball.tolist()), max(result.surface_std_m, 2e-5), result.force_n)

    (found,), (facts,), left = find_normals([expected([0, 0, 1])], THREE, RADIUS_M, 0.0, touch)
    assert not left
    # of curvature less than 0.01 rad, as the closed form above has it
    off = angle(found.normal, true)
    assert off < 3 * facts["std_rad"] + 0.01
    assert off < 0.6 * tilt
    assert facts["std_rad"] < THREE.most_std_rad
    place = np.array(found.position_m)
    assert np.linalg.norm(place - centre) == pytest.approx(10e-3, abs=4e-4)
    # and the contact is then made along what was found
    pose = touch_pose(found.position_m, found.normal, [1, 0, 0], RADIUS_M)
    assert loop.make(ContactGoal(pose, FORCE_N)).reached
