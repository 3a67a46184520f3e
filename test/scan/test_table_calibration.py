# SPDX-License-Identifier: Apache-2.0
"""A table found by touch: exact from exact touches, and its covariance is that of the error."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy import stats
from scipy.spatial.transform import Rotation

from tactile_resonance.contact.geometry import touch_pose
from tactile_resonance.contact.goal import ContactGoal
from tactile_resonance.contact.samples import Pose
from tactile_resonance.scan.hands import Touch
from tactile_resonance.scan.surface_search import LEAST_TOUCH_STD_M
from tactile_resonance.scan.table_calibration import (
    NOT_ESTIMATED,
    ORDER,
    CalibrationRequest,
    as_text,
    calibrate_table,
    read_table,
)

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "contact"))
from contacts import RADIUS_M, contact

KNOWN = Pose.from_vector(np.array([-0.49, -0.13, 0.2, 0.3, -0.2, -1.2]))
TRIANGLE = ((0.0, 0.0), (0.05, 0.0), (0.01, 0.04))
SIX = ((-0.02, -0.03), (0.03, -0.02), (0.02, 0.03), (-0.03, 0.02), (0.0, 0.0), (0.04, 0.04))


def request(xy, z=0.0, **options):
    return CalibrationRequest(tuple((x, y, z) for x, y in xy), **options)


def moved(table, height_m, tilt_x_rad, tilt_y_rad):
    """The table where it truly stands."""
    turn = Rotation.from_rotvec([tilt_x_rad, tilt_y_rad, 0.0])
    place = table.position_m + table.rotation.apply([0.0, 0.0, height_m])
    return Pose(place, (table.rotation * turn).as_rotvec())


def ball_on(true, known, xy, top_m=0.0):
    """Centre, in the known frame, of a ball that comes down along the known normal onto the true surface."""
    normal = true.rotation.apply([0.0, 0.0, 1.0])
    above = known.position_m + known.rotation.apply([*xy, 0.0])
    down = known.rotation.apply([0.0, 0.0, 1.0])
    # normal . (above + z down - true) = radius + top
    z = (RADIUS_M + top_m - normal @ (above - true.position_m)) / (normal @ down)
    return (*xy, float(z))


def touches_on(true, known, xys, top_m=0.0, std_m=2e-5):
    return [Touch(ball_on(true, known, xy, top_m), std_m, 0.01) for xy in xys]


def table_from_touches(request, known, radius_m, touches):
    return calibrate_table(request, known, radius_m, lambda point: touches[point.index])


def angle_between(first, second):
    return (first.rotation.inv() * second.rotation).magnitude()


@pytest.mark.parametrize("top_m", [0.0, 0.012])
@pytest.mark.parametrize("xys", [TRIANGLE, SIX])
def test_exact_touches_give_the_table_exactly_through_ball_and_plate(xys, top_m):
    true = moved(KNOWN, 3e-3, 0.02, -0.03)
    made = table_from_touches(
        request(xys, top_m), KNOWN, RADIUS_M, touches_on(true, KNOWN, xys, top_m)
    )
    np.testing.assert_allclose(made.correction, [3e-3, 0.02, -0.03], atol=1e-10)
    np.testing.assert_allclose(made.table_in_base.position_m, true.position_m, atol=1e-10)
    assert angle_between(made.table_in_base, true) < 1e-8
    np.testing.assert_allclose(made.residuals_m, 0.0, atol=1e-10)
    assert math.isnan(made.reduced_chi_square) == (len(xys) == 3)


def test_what_no_touch_tells_stays_as_it_was_known():
    """Touches are the same on a table that is shifted in its plane or turned about its normal."""
    true = moved(KNOWN, 1e-3, 0.01, 0.0)
    slid = Pose(
        true.position_m + true.rotation.apply([4e-3, -7e-3, 0.0]),
        (true.rotation * Rotation.from_rotvec([0.0, 0.0, 0.4])).as_rotvec(),
    )
    for table in (true, slid):
        made = table_from_touches(request(SIX), KNOWN, RADIUS_M, touches_on(table, KNOWN, SIX))
        np.testing.assert_allclose(made.table_in_base.position_m, true.position_m, atol=1e-9)
        assert angle_between(made.table_in_base, true) < 1e-7
        assert made.covariance.shape == (3, 3)


def test_base_and_order_of_the_touches_do_not_matter():
    rng = np.random.default_rng(5)
    clean = np.array([t.ball_m for t in touches_on(moved(KNOWN, 2e-3, 0.01, 0.02), KNOWN, SIX)])
    noisy = clean + np.outer(rng.normal(0, 3e-5, len(SIX)), [0, 0, 1])
    xs = [Touch(tuple(ball), 3e-5, 0.01) for ball in noisy.tolist()]
    made = table_from_touches(request(SIX), KNOWN, RADIUS_M, xs)
    turned = table_from_touches(request(SIX[::-1]), KNOWN, RADIUS_M, xs[::-1])
    np.testing.assert_allclose(turned.correction, made.correction, atol=1e-12)
    np.testing.assert_allclose(turned.covariance, made.covariance, rtol=1e-9)
    # the whole bench moved as one: the table found moves with it
    by = Pose.from_vector(np.array([0.3, 0.1, -0.2, 0.5, 1.0, -0.4]))

    def carried(pose):
        place = by.position_m + by.rotation.apply(pose.position_m)
        return Pose(place, (by.rotation * pose.rotation).as_rotvec())

    there = table_from_touches(request(SIX), carried(KNOWN), RADIUS_M, xs).table_in_base
    expected = carried(made.table_in_base)
    np.testing.assert_allclose(there.position_m, expected.position_m, atol=1e-12)
    assert angle_between(there, expected) < 1e-7


def test_deviations_of_a_square_are_those_of_the_textbook():
    """Corners of a square of half side a: s / 2 for the height of its centre, s / 2a for both tilts."""
    a, s = 0.03, 4e-5
    square = ((-a, -a), (a, -a), (a, a), (-a, a))
    made = table_from_touches(
        request(square), KNOWN, RADIUS_M, touches_on(KNOWN, KNOWN, square, std_m=s)
    )
    np.testing.assert_allclose(
        made.covariance, np.diag([s / 2, s / 2 / a, s / 2 / a]) ** 2, atol=1e-18
    )
    far = tuple((x + 0.2, y) for x, y in square)  # the origin 200 mm beside them
    made = table_from_touches(request(far), KNOWN, RADIUS_M, touches_on(KNOWN, KNOWN, far, std_m=s))
    assert made.std[0] == pytest.approx(math.hypot(s / 2, 0.2 * s / 2 / a))
    flat = table_from_touches(
        request(square, flatness_m=3e-5), KNOWN, RADIUS_M, touches_on(KNOWN, KNOWN, square, std_m=s)
    )
    np.testing.assert_allclose(flat.std_m, 5e-5)
    assert flat.std[0] == pytest.approx(2.5e-5)


@pytest.mark.parametrize("top_m", [0.0, 0.03])
def test_stated_covariance_is_that_of_the_error(top_m):
    """Monte Carlo, unequal deviations: the error in its covariance is chi-square of 3 degrees of freedom."""
    rng, count = np.random.default_rng(11), 600
    std = np.array([2e-5, 4e-5, 1e-4, 3e-5, 6e-5, 2e-5])
    truth = np.array([2e-3, 0.02, -0.01])
    clean = np.array([t.ball_m for t in touches_on(moved(KNOWN, *truth), KNOWN, SIX, top_m)])
    wanted = request(SIX, top_m)
    distances, chi_squares = [], []
    for _ in range(count):
        noisy = clean + np.outer(rng.normal(size=len(SIX)) * std, [0, 0, 1])
        touches = [
            Touch(tuple(b), s, 0.01) for b, s in zip(noisy.tolist(), std.tolist(), strict=True)
        ]
        try:
            made = table_from_touches(wanted, KNOWN, RADIUS_M, touches)
        except ValueError:
            continue  # one in a thousand, as stated
        error = made.correction - truth
        distances.append(error @ np.linalg.solve(made.covariance, error))
        chi_squares.append(3 * made.reduced_chi_square)
    refused = count - len(distances)
    assert refused <= stats.binom.ppf(0.999, count, 1e-3)
    for drawn in (distances, chi_squares):
        assert stats.kstest(drawn, stats.chi2(3).cdf).pvalue > 1e-3
    inside = np.sum(np.array(distances) < stats.chi2(3).ppf(0.95))
    low, high = stats.binom.interval(0.999, len(distances), 0.95)
    assert low <= inside <= high


def test_touches_of_the_contact_keep_what_they_state():
    """Control, load cell and estimation of the contact in virtual time, on soft tissue 0.5 mm and 1 deg off."""
    height_m, tilt_rad, count = 5e-4, np.deg2rad(1.0), 4
    square = ((-0.015, -0.015), (0.015, -0.015), (0.015, 0.015), (-0.015, 0.015), (0.0, 0.0))
    known, distance, chi_square = Pose(np.zeros(3), np.zeros(3)), 0.0, 0.0
    for seed in range(200, 200 + count):
        bench = contact(height_m=height_m, tilt_rad=tilt_rad, start_m=4e-3, seed=seed)

        def touch(point, bench=bench):
            pose = touch_pose(point.position_m, point.normal, [1, 0, 0], RADIUS_M)
            result = bench.loop.make(ContactGoal(pose, 0.01))
            assert result.reached, result.message
            bench.loop.retract()
            x, y, z = point.position_m
            std = max(result.surface_std_m, LEAST_TOUCH_STD_M)
            return Touch((x, y, z + RADIUS_M + result.surface_m), std, result.force_n)

        made = calibrate_table(request(square), known, RADIUS_M, touch)
        error = made.correction - [height_m, 0.0, tilt_rad]  # towards x: about y
        distance += error @ np.linalg.solve(made.covariance, error)
        chi_square += 2 * made.reduced_chi_square
    low, high = stats.chi2(3 * count).interval(0.998)
    assert low < distance < high
    assert chi_square < stats.chi2(2 * count).ppf(0.999)


def test_a_touch_that_is_none_is_named():
    touches = touches_on(moved(KNOWN, 1e-3, 0.01, 0.01), KNOWN, SIX)
    x, y, z = touches[2].ball_m
    touches[2] = replace(touches[2], ball_m=(x, y, z + 5e-4))
    with pytest.raises(ValueError, match=r"touch 3 lies \+0\.500 mm off the plane of the others"):
        table_from_touches(request(SIX), KNOWN, RADIUS_M, touches)
    # four cannot tell which: every three of them lie on a plane
    with pytest.raises(ValueError, match="more touches would show which"):
        table_from_touches(request(SIX[:4]), KNOWN, RADIUS_M, touches[:4])
    # whoever states that the surface is so uneven gets the deviations that go with it
    made = table_from_touches(request(SIX, flatness_m=2e-4), KNOWN, RADIUS_M, touches)
    assert np.all(np.abs(made.correction - [1e-3, 0.01, 0.01]) < 4 * made.std)


@pytest.mark.parametrize("off_m", [1e-3, 2e-3])
def test_a_touch_that_is_far_off_is_not_laid_to_the_points(off_m):
    """Its residual makes the tilts uncertain, which is no fault of where the touches are."""
    touches = touches_on(moved(KNOWN, 1e-3, 0.01, 0.01), KNOWN, SIX)
    x, y, z = touches[2].ball_m
    touches[2] = replace(touches[2], ball_m=(x, y, z + off_m))
    with pytest.raises(ValueError, match="touches: .* touch 3 lies .* off the plane of the others"):
        table_from_touches(request(SIX), KNOWN, RADIUS_M, touches)
    with pytest.raises(ValueError, match="touches: .* more touches would show which"):
        table_from_touches(request(SIX[:4]), KNOWN, RADIUS_M, touches[:4])


def test_a_table_tilted_further_than_accepted_is_refused():
    touches = touches_on(moved(KNOWN, 0.0, 0.04, 0.0), KNOWN, SIX)
    with pytest.raises(ValueError, match=r"tilt of the table \[rad\]: got 0\.04; .*most_tilt_rad"):
        table_from_touches(request(SIX, most_tilt_rad=0.03), KNOWN, RADIUS_M, touches)


LINE = tuple((x, 2 * x + 1e-4 * (x > 0.01)) for x in (0.0, 0.01, 0.02, 0.03))


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        (TRIANGLE[:2], {}, "points: got 2; accepted is three points or more"),
        (((0.0, 0.0), (0.01, 0.02), (0.02, 0.04)), {}, "points: .*not on one line"),
        (LINE, {}, "points: standard deviation of the tilt .* not on one line"),
        (tuple((0.1 * x, 0.1 * y) for x, y in TRIANGLE), {}, "points further apart"),
        (TRIANGLE, {"force_n": 0.0}, "force_n: got 0.0; accepted is a number above 0"),
        (TRIANGLE, {"search_m": 0.1}, "search_m: got 0.1; accepted is 0 to 0.02"),
        (TRIANGLE, {"search_m": math.nan}, "search_m: got nan; accepted is 0 to 0.02"),
        (TRIANGLE, {"sensor": "nose"}, "name: got 'nose'; accepted is one of config/sensors"),
        (TRIANGLE, {"most_tilt_rad": 1.0}, "most_tilt_rad: got 1.0"),
        (((0.0, math.inf), *TRIANGLE), {}, r"points\[0\].y: got inf"),
    ],
)
def test_a_wrong_request_is_refused_before_anything_is_touched(points, options, message):
    with pytest.raises(ValueError, match=message):
        request(points, **options)


def test_heights_of_the_points_are_one():
    points = ((0.0, 0.0, 0.0), (0.05, 0.0, 0.01), (0.0, 0.05, 0.0))
    with pytest.raises(ValueError, match=r"points: z: got \[0.0, 0.01\]; accepted is one height"):
        CalibrationRequest(points)


def test_touches_are_asked_for_at_the_points_and_the_surface_that_is_expected():
    true, asked = moved(KNOWN, 1e-3, 0.01, -0.02), []

    def touch(point):
        asked.append(point)
        return Touch(ball_on(true, KNOWN, point.position_m[:2], 0.01), 2e-5, 0.01)

    made = calibrate_table(request(SIX, 0.01, heading_rad=0.3), KNOWN, RADIUS_M, touch)
    np.testing.assert_allclose(made.correction, [1e-3, 0.01, -0.02], atol=1e-9)
    assert [point.position_m[:2] for point in asked] == list(SIX)
    assert asked[0].position_m[2] == 0.01
    x_axis = Rotation.from_quat(asked[0].orientation_xyzw).apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(x_axis, [math.cos(0.3), math.sin(0.3), 0.0], atol=1e-12)


@pytest.fixture
def written(tmp_path):
    touches = touches_on(moved(KNOWN, 1e-3, 0.01, 0.01), KNOWN, SIX)
    made = table_from_touches(request(SIX), KNOWN, RADIUS_M, touches)
    path = tmp_path / "table.yaml"
    path.write_text(as_text(made, request(SIX), {"base_frame": "base", "date": "2026-01-01"}))
    return path, made


def test_the_file_gives_back_what_was_found_to_the_bit(written):
    path, made = written
    assert read_table(path, "base") == made.table_in_base.vector.tolist()
    content = yaml.safe_load(path.read_text())
    assert (content["estimated"], content["not_estimated"]) == (list(ORDER), list(NOT_ESTIMATED))
    assert content["covariance"] == made.covariance.tolist()
    assert [t["residual_m"] for t in content["touches"]] == made.residuals_m.tolist()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": None}, "format: got None; accepted is 'tactile_resonance table 1'"),
        ({"table_in_base": [0.0] * 5}, "table_in_base: .* a list of 6 numbers"),
        ({"table_in_base": [0.0] * 5 + [math.nan]}, r"table_in_base\[5\]: got nan"),
        ({"base_frame": "base_link"}, "base_frame: got 'base_link'; accepted is 'base'"),
    ],
)
def test_a_damaged_or_foreign_file_is_refused(written, change, message):
    path, _ = written
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **change}))
    with pytest.raises(ValueError, match=message):
        read_table(path, "base")
