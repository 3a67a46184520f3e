# SPDX-License-Identifier: Apache-2.0
"""Beam and housing over surfaces that are not flat: closed forms, and ways as the controller goes them."""

import sys
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.samples import Pose
from tactile_resonance.scan.clearance import TipUse, clear_points, lowest_at_depth, lowest_between
from tactile_resonance.scan.plan import make_plan
from tactile_resonance.scan.scene import ScanScene, SensorUse
from tactile_resonance.scan.surface import HeightField, Plane
from tactile_resonance.scan.surface_search import fit_surface

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "contact"))
from contacts import QUICK
from test_turning import EDGE, Travel

TIP = TipGeometry()
LIMITS = Limits(depth_m=4e-3)
USE = TipUse(TIP, ContactParameters(), LIMITS)
RUN, RISE = 0.064 * np.cos(0.17), 0.064 * np.sin(0.17)


def field(height, extent_m=0.1, step_m=1e-3):
    """A surface of a formula z(x, y); its spline is exact for quadratic ones."""
    axis = np.arange(-extent_m, extent_m + step_m / 2, step_m)
    return HeightField(axis, axis, height(axis[:, None], axis[None, :]))


def planned(surface, xy, use=None, heading_rad=0.0):
    positions = np.column_stack([xy, np.full(len(xy), np.nan)])
    sensor = SensorUse(heading_rad=heading_rad)
    scene = ScanScene("test", 0.01, positions, surface=surface, sensor=sensor)
    plan = make_plan(scene)
    return plan if use is None else plan.with_points(*clear_points(plan.points, surface, use))


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.4, -0.3)])
@pytest.mark.parametrize("heading_rad", [0.0, 2.0])
def test_over_a_plane_it_is_what_contact_control_admits(slope, heading_rad):
    surface = Plane((0.0, 0.0, 0.01), (-slope[0], -slope[1], 1.0))
    (point,) = planned(surface, [[0.01, 0.02]], heading_rad=heading_rad).points
    low = lowest_at_depth(point, surface, USE)
    assert LIMITS.clearance_m <= low <= TIP.worst_height(4e-3, 0.05) + 1e-12
    # held as it should be, the housing alone is lower than the rest of what counts
    straight = TipUse(TIP, USE.parameters, Limits(depth_m=4e-3, misalignment_rad=1e-3))
    low = lowest_at_depth(point, surface, straight)
    assert low <= TIP.worst_height(4e-3, 1e-3)


@pytest.mark.parametrize("radius_m", [0.3, 1.0, -0.3])
def test_over_a_bend_the_housing_is_lower_by_the_square_of_its_distance(radius_m):
    surface = field(lambda x, y: x**2 / (2 * radius_m) + 0 * y)  # a gutter, or a barrel
    (point,) = planned(surface, [[0.0, 0.0]]).points
    x = -RUN * np.cos(0.05) + (RISE - 6e-3) * -np.sin(0.05)
    z = 2.5e-3 - 4e-3 + (RISE - 6e-3) * np.cos(0.05) - RUN * np.sin(0.05)
    slope = x / radius_m
    housing = (z - x**2 / (2 * radius_m)) / np.hypot(1, slope)
    low = lowest_at_depth(point, surface, USE)
    if radius_m > 0:
        assert low == pytest.approx(housing, abs=1e-9)
        assert low < 0
    else:  # all of it higher than over a plane; the beam is what is near
        assert low > LIMITS.clearance_m
    # across the gutter's axis all is as on a plane
    (along,) = planned(surface, [[0.0, 0.0]], heading_rad=np.pi / 2).points
    flat = lowest_at_depth(along, Plane(), USE)
    assert lowest_at_depth(along, surface, USE) == pytest.approx(flat, abs=1e-9)


def test_a_way_beside_a_step_is_met_by_the_side_of_the_ball():
    # at 0.7 mm beside the way it rises by 4.2 mm; the ball's lowest place is 3 mm high, at half of its radius
    # beside that 2.5 mm less sqrt(2.5^2 - 1.25^2) mm higher
    rise = field(lambda x, y: 2.1e-3 * (1 + np.tanh((y - 7e-4) / 2e-4)) + 0 * x, 0.01, 1e-4)
    points = planned(Plane(), [[-1e-3, 0.0], [1e-3, 0.0]]).points
    side = 3e-3 + 2.5e-3 * (1 - np.sqrt(0.75)) - 2.1e-3 * (1 + np.tanh(2.75))
    low = lowest_between(*points, rise, USE)
    assert low == pytest.approx(side, abs=5e-5)
    # over a plane it is the lowest place of the ball that counts
    flat = lowest_between(*points, Plane(), USE)
    assert flat == pytest.approx(USE.parameters.standoff_m, abs=1e-12)


def test_wall_beside_the_tip_is_met_by_the_beam_though_the_housing_is_clear():
    wall = field(lambda x, y: 4e-3 * np.exp(-(((x + 0.035) / 3e-3) ** 2)) + 0 * y)
    (point,) = planned(wall, [[0.0, 0.0]]).points
    # 35 mm from the ball the beam is at -1.5 mm + 35 tan(0.12)
    assert lowest_at_depth(point, wall, USE) == pytest.approx(
        -1.5e-3 + 0.035 * np.tan(0.12) - 4e-3, abs=0.3e-3
    )


@pytest.mark.parametrize(("height_m", "clear"), [(2e-3, True), (3.5e-3, False)])
def test_bump_between_two_points_is_crossed_at_the_standoff_or_not_at_all(height_m, clear):
    bump = field(lambda x, y: height_m * np.exp(-(((y - 0.02) / 8e-3) ** 2)) + 0 * x)
    first, then = planned(bump, [[0.0, 0.0], [0.0, 0.04]]).points
    low = lowest_between(first, then, bump, USE)
    assert low == pytest.approx(
        3e-3 - height_m, abs=0.02e-3
    )  # the ball's lowest point on top of it
    kept, left = clear_points((first, then), bump, USE)
    assert len(kept) == (2 if clear else 1)
    if not clear:
        ((point, why),) = left
        assert point == then
        assert "on the way from point 1 the sensor would be -0." in why


@pytest.mark.parametrize(("radius_m", "reach_m"), [(-0.03, 0.012), (0.15, 0.02)])
def test_way_is_as_low_as_the_controller_goes_it(radius_m, reach_m):
    surface = field(lambda x, y: (x**2 + y**2) / (2 * radius_m))  # a dome, a bowl
    use = TipUse(TIP, QUICK, Limits())
    first, then = planned(surface, [[-reach_m, 0.0], [reach_m, 0.003]], heading_rad=1.0).points

    def pose(point, height_m):
        turn = Pose(np.zeros(3), np.zeros(3)).rotation.from_quat(point.orientation_xyzw)
        place = np.array(point.position_m) + (2.5e-3 + height_m) * np.array(point.normal)
        return Pose(place, turn.as_rotvec())

    made = Travel(pose(first, QUICK.standoff_m))
    made.go(pose(then, 0.0))
    beam = np.linspace(0, 1, 32)[:, None] * np.array([-RUN, 0.0, RISE])
    drops = np.array([2.5e-3, *[0.0] * 32])
    body = np.vstack([beam, EDGE])
    at = made.places[:, None] + np.stack([turn.apply(body) for turn in made.turns])
    height = (at[..., 2] - surface.height_m(at[..., :2])) * surface.normal(at[..., :2])[..., 2]
    gone = np.nanmin(height - drops)
    assert lowest_between(first, then, surface, use) == pytest.approx(gone, abs=0.3e-3)


def test_plan_leaves_out_what_is_not_clear_and_says_by_how_much():
    # flat, but for a bank 20 mm high that a housing 63 mm to the left of its point would stand in
    bank = field(lambda x, y: 0.02 / (1 + np.exp(-(-0.05 - x) / 2e-3)) + 0 * y)
    xy = [[0.0, 0.0], [0.05, 0.0], [0.06, 0.0], [0.005, 0.0]]
    plan = planned(bank, xy, USE)
    assert [point.position_m[0] for point in plan.points] == [0.05, 0.06]
    assert [point.index for point in plan.points] == [0, 1]
    out = [entry for entry in plan.skipped if entry.what.startswith("the point at")]
    assert [entry.what for entry in out] == [
        "the point at x = 0.00, y = 0.00 mm",
        "the point at x = 5.00, y = 0.00 mm",
    ]
    for entry in out:
        assert "at the depth limit of 4 mm the housing would be -1" in entry.why
        assert "accepted is clearance_m = 0.1 mm or more" in entry.why
    with pytest.raises(ValueError, match="all 1 are left out; the first: at the depth limit"):
        planned(bank, xy[:1], USE)
    # towards the other side the housing is over the flat
    assert len(planned(bank, xy[:1], USE, heading_rad=np.pi).points) == 1


def test_what_is_not_known_of_a_surface_is_not_judged():
    # of what counts the beam begins 13 mm from the ball
    bowl = field(lambda x, y: (x**2 + y**2) / 0.1, extent_m=0.012)
    (point,) = planned(bowl, [[0.0, 0.0]]).points
    assert lowest_at_depth(point, bowl, USE) == np.inf
    assert lowest_at_depth(point, field(lambda x, y: (x**2 + y**2) / 0.1), USE) < -0.02
    spread = np.linspace(-0.012, 0.012, 4)
    x, y = (values.ravel() for values in np.meshgrid(spread, spread))
    touched = fit_surface(np.column_stack([x, y, (x**2 + y**2) / 0.1]), 1e-5, "quadric")
    np.testing.assert_array_equal(
        touched.known([[0.0, 0.0], [0.0119, -0.0119], [0.0121, 0.0]]), [True, True, False]
    )
    assert lowest_at_depth(point, touched, USE) == np.inf


def test_uncertain_surface_counts_as_two_deviations_higher():
    spread = np.array([[-0.1, -0.1], [-0.1, 0.1], [0.1, -0.1], [0.1, 0.1]])
    contacts = np.column_stack([spread, np.zeros(4)])
    sure, unsure = (fit_surface(contacts, std, "plane") for std in (1e-9, 1e-4))
    (point,) = planned(Plane(), [[0.0, 0.0]]).points
    less = lowest_at_depth(point, sure, USE) - lowest_at_depth(point, unsure, USE)
    # of the mean of four half of 0.1 mm, of the slope somewhat more, 13 to 63 mm away
    assert 0.1e-3 < less < 0.13e-3
