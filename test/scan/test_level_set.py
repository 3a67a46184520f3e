# SPDX-License-Identifier: Apache-2.0
"""Boundary of a level set: probabilities are those of Gaussians, lines and areas those of known forms."""

import json

import numpy as np
import pytest
from scipy.stats import norm

from tactile_resonance.scan.kriging import krige
from tactile_resonance.scan.level_set import LevelSet, Raster, boundary_of, difference_m2

SQUARE = np.array([[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]])


def test_a_place_is_on_the_wrong_side_as_often_as_stated():
    above = LevelSet(low=255.0)
    value, std = np.array([254.0, 255.0, 256.5]), np.array([1.0, 0.3, 0.5])
    np.testing.assert_allclose(above.loss(value, std), norm.cdf(-np.abs(value - 255.0) / std))
    np.testing.assert_allclose(above.inside(value, std), norm.sf(255.0, value, std))
    between = LevelSet(254.0, 256.0)
    value = np.array([253.0, 255.0, 256.1])
    inside = norm.cdf(256.0, value, 0.5) - norm.cdf(254.0, value, 0.5)
    np.testing.assert_allclose(between.inside(value, np.full(3, 0.5)), inside)
    np.testing.assert_array_equal(between.depth(value) > 0, [False, True, False])
    np.testing.assert_allclose(
        between.loss(value, np.full(3, 0.5)), [inside[0], 1 - inside[1], inside[2]]
    )


def test_a_narrow_band_is_wrong_as_often_as_stated_where_little_is_known():
    """A band much narrower than the deviation: within it most places are wrong. Drawn; within 4 errors."""
    rng, runs = np.random.default_rng(3), 100_000
    band, value, std = LevelSet(254.0, 256.0), np.array([255.3, 253.0]), np.array([3.0, 3.0])
    truth = value[:, None] + std[:, None] * rng.standard_normal((2, runs))
    drawn = np.mean((band.depth(truth) > 0) != (band.depth(value) > 0)[:, None], axis=1)
    stated = band.loss(value, std)
    assert np.all(np.abs(drawn - stated) < 4 * np.sqrt(stated * (1 - stated) / runs))
    assert stated[0] > 0.7


@pytest.mark.parametrize(
    ("value", "std", "after"), [(0.4, 1.0, 0.5), (-1.5, 0.8, 0.1), (0.0, 2.0, 1.9)]
)
def test_after_a_touch_it_is_wrong_as_often_as_was_expected(value, std, after):
    """Seeded Monte Carlo of Owen's T: truth and estimate after the touch, drawn together; within 4 errors."""
    rng, runs = np.random.default_rng(1), 400_000
    estimate = value + np.sqrt(std**2 - after**2) * rng.standard_normal(runs)
    truth = estimate + after * rng.standard_normal(runs)
    drawn = np.mean((estimate > 0) != (truth > 0))
    stated = LevelSet(low=0.0).loss_after(*(np.array([v]) for v in (value, std, after)))[0]
    assert abs(drawn - stated) < 4 * np.sqrt(stated * (1 - stated) / runs)


def test_a_touch_that_shows_nothing_changes_nothing_and_an_exact_one_ends_all_doubt():
    above, value, std = LevelSet(low=255.0), np.array([254.0, 255.2]), np.array([1.0, 0.3])
    for wanted in (above, LevelSet(253.8, 255.0), LevelSet(255.0, 255.5), LevelSet(high=255.0)):
        np.testing.assert_allclose(wanted.loss_after(value, std, std), wanted.loss(value, std))
        np.testing.assert_allclose(wanted.loss_after(value, std, 0 * std), 0, atol=1e-15)


def cone(xy, radius=0.005, slope_hz_per_m=800.0):
    """255 Hz on a circle about the origin, less outside."""
    return 255.0 + slope_hz_per_m * (radius - np.linalg.norm(xy, axis=-1))


def test_the_boundary_of_a_cone_is_its_circle():
    axis = np.linspace(-0.01, 0.01, 15)
    at = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    surface = krige(at, cone(at), np.full(len(at), 0.01))
    raster = Raster.over(SQUARE, 2e-4)
    found = boundary_of(surface, LevelSet(low=255.0), raster)
    (line,) = found.outline_m
    np.testing.assert_array_equal(line[0], line[-1])  # closed
    np.testing.assert_allclose(np.linalg.norm(line, axis=1), 0.005, atol=1e-4)
    assert found.area_m2 == pytest.approx(np.pi * 0.005**2, rel=0.02)
    (inner,), (outer,) = found.inner_m, found.outer_m
    assert np.linalg.norm(inner, axis=1).max() < 0.005 < np.linalg.norm(outer, axis=1).min()
    assert difference_m2(surface, LevelSet(low=255.0), raster, cone(raster.xy_m)) < 0.5e-6
    # a level that is 0.8 mm off is wrong on a ring of that width
    ring = np.pi * (0.005**2 - 0.0042**2)
    off = difference_m2(surface, LevelSet(low=255.0), raster, cone(raster.xy_m, radius=0.0042))
    assert off == pytest.approx(ring, rel=0.05)
    # and what lies between two levels has both circles
    both = boundary_of(surface, LevelSet(254.2, 255.0), raster)
    radii = sorted(float(np.linalg.norm(line, axis=1).mean()) for line in both.outline_m)
    np.testing.assert_allclose(radii, [0.005, 0.006], atol=1e-4)
    assert json.loads(json.dumps(found.as_json()))["f0_hz"] == [255.0, None]


def test_a_region_ends_where_its_polygon_does():
    triangle = np.array([[0.0, 0.0], [0.01, 0.0], [0.0, 0.01]])
    raster = Raster.over(triangle, 1e-4)
    assert raster.within.sum() * raster.cell_m2 == pytest.approx(0.5e-4, rel=0.02)
    lines = raster.lines(raster.xy_m[..., 0] - 0.004)
    ends = np.concatenate(lines)
    np.testing.assert_allclose(ends[:, 0], 0.004)
    assert ends[:, 1].max() < 0.0061


@pytest.mark.parametrize("levels", [(256.0, 255.0), (-np.inf, np.inf)])
def test_what_is_no_level_set_is_refused(levels):
    with pytest.raises(ValueError, match="two levels, ascending"):
        LevelSet(*levels)
