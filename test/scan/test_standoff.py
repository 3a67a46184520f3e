# SPDX-License-Identifier: Apache-2.0
"""How low a scan lets the tip begin: never where the surface may be, and lower the better it is known."""

import math

import numpy as np
import pytest

from tactile_resonance.scan.clearance import LEAST_M, NEAR_M, Standoffs
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.surface import HeightField, Plane, TouchRequest

UP, TURN, STD_M = (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0), 2e-5
FLAT = Plane()


def point(x_m, y_m=0.0, z_m=0.0, normal=UP, std_m=0.0):
    return ScanPoint(0, (x_m, y_m, z_m), normal, TURN, height_std_m=std_m)


def serpentine(side=4, spacing_m=5e-3):
    for row in range(side):
        columns = range(side) if row % 2 == 0 else reversed(range(side))
        yield from (point(column * spacing_m, row * spacing_m) for column in columns)


def test_nothing_is_known_before_the_first_touch_nor_far_from_it():
    known = Standoffs(FLAT)
    assert known.lowest_m(point(0.0)) == math.inf
    known.add(point(0.0), 1e-5, STD_M)
    assert known.lowest_m(point(0.9 * NEAR_M)) < 3e-3
    assert known.lowest_m(point(1.1 * NEAR_M)) == math.inf


@pytest.mark.parametrize(("off_m", "std_m"), [(math.nan, STD_M), (0.0, math.nan)])
def test_a_touch_of_which_little_is_known_lowers_nothing(off_m, std_m):
    known = Standoffs(FLAT)
    known.add(point(0.0), off_m, std_m)
    assert known.lowest_m(point(2e-3)) == math.inf


def test_it_falls_with_each_touch_and_rises_with_the_way_and_what_is_stated():
    known = Standoffs(FLAT)
    known.add(point(0.0), 0.0, STD_M)
    near, far = known.lowest_m(point(2e-3)), known.lowest_m(point(8e-3))
    assert LEAST_M < near < far
    assert known.lowest_m(point(2e-3, std_m=2e-4)) > near + 3e-4
    known.add(point(0.0, 5e-3), 0.0, STD_M)
    known.add(point(5e-3, 0.0), 0.0, STD_M)
    assert known.lowest_m(point(8e-3)) < far


def test_surface_of_tilt_and_height_as_assumed_is_above_it_once_in_many_thousands():
    rng = np.random.default_rng(1)
    clear_m = []
    for _ in range(400):
        height_m, *tilt = rng.normal(0, [2e-4, 0.03, 0.03])
        known = Standoffs(FLAT)
        for at in serpentine():
            true_m = height_m + np.dot(tilt, at.position_m[:2])
            lowest_m = known.lowest_m(at)
            if math.isfinite(lowest_m):
                clear_m.append(lowest_m - true_m)
            known.add(at, true_m + rng.normal(0, STD_M), STD_M)
    assert min(clear_m) > 0.5 * LEAST_M
    # and on average by no more than it takes
    assert np.mean(clear_m) < LEAST_M + 4e-4


def test_touches_that_scatter_keep_the_tip_high():
    rng = np.random.default_rng(2)
    still, scattered = Standoffs(FLAT), Standoffs(FLAT)
    for at in serpentine(3):
        still.add(at, rng.normal(0, STD_M), STD_M)
        scattered.add(at, rng.normal(0, 4e-4), STD_M)
    at = point(5e-3, 10e-3)
    assert scattered.lowest_m(at) > still.lowest_m(at) + 5e-4


@pytest.mark.parametrize(
    "surface",
    [
        HeightField(np.array([0.0, 0.01]), np.array([0.0, 0.01]), np.zeros((2, 2))),
        TouchRequest(tuple((k * 1e-3, k * k * 1e-3) for k in range(6)), form="quadric"),
    ],
)
def test_nothing_is_known_of_a_surface_that_is_not_plane(surface):
    known = Standoffs(surface)
    known.add(point(0.0), 0.0, STD_M)
    assert known.lowest_m(point(1e-3)) == math.inf


def test_nothing_is_known_off_the_plane_of_the_last_touch_or_after_it_was_wrong():
    known = Standoffs(TouchRequest(((0, 0), (0, 1), (1, 0))))
    known.add(point(0.0), 0.0, STD_M)
    assert known.lowest_m(point(1e-3)) < 3e-3
    assert known.lowest_m(point(1e-3, z_m=5e-4)) == math.inf
    assert known.lowest_m(point(1e-3, normal=(0.1, 0.0, np.sqrt(0.99)))) == math.inf
    known.forget()
    assert known.lowest_m(point(1e-3)) == math.inf
