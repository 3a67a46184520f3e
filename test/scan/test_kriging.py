# SPDX-License-Identifier: Apache-2.0
"""The surface goes through exact points, and where it does not it says by how much."""

import numpy as np
import pytest

from tactile_resonance.scan import kriging
from tactile_resonance.scan.kriging import MIXED_POINTS, krige


def matern(distance, length):
    s = np.sqrt(5) * distance / length
    return (1 + s + s**2 / 3) * np.exp(-s)


def draw(rng, xy, length, std, mean):
    distance = np.linalg.norm(xy[:, None] - xy, axis=-1)
    covariance = std**2 * matern(distance, length) + 1e-12 * np.eye(len(xy))
    return mean + np.linalg.cholesky(covariance) @ rng.standard_normal(len(xy))


def test_exact_points_are_met_with_no_uncertainty():
    rng = np.random.default_rng(1)
    xy = rng.uniform(0, 0.02, (20, 2))
    y = 250 + 3 * np.sin(200 * xy[:, 0]) + 100 * xy[:, 1]
    surface = krige(xy, y, np.zeros(20))
    value, std = surface.predict(xy)
    np.testing.assert_allclose(value, y, atol=1e-5)
    assert np.all(std < 1e-3)
    _, between = surface.predict([[0.1, 0.1]])
    assert between > 1


def test_a_constant_and_units_of_length_and_value_do_not_matter():
    rng = np.random.default_rng(2)
    xy = rng.uniform(0, 0.02, (15, 2))
    y = draw(rng, xy, 0.006, 2.0, 0.0)
    noise = rng.uniform(0.05, 0.2, 15)
    at = rng.uniform(0, 0.02, (7, 2))
    value, std = krige(xy, y, noise).predict(at)
    moved, moved_std = krige(1000 * xy + 5, 0.01 * y + 250, 0.01 * noise).predict(1000 * at + 5)
    np.testing.assert_allclose(moved, 0.01 * value + 250, atol=1e-5)
    np.testing.assert_allclose(moved_std, 0.01 * std, rtol=1e-2)


def test_among_nothing_but_noise_it_is_the_weighted_mean():
    rng = np.random.default_rng(3)
    xy = rng.uniform(0, 0.02, (200, 2))
    y = 250 + 0.1 * rng.standard_normal(200)
    value, std = krige(xy, y, np.full(200, 0.1)).predict([[0.01, 0.01]])
    assert value == pytest.approx(250, abs=0.05)
    assert std < 0.05


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_equal_values_are_that_value_everywhere(noise):
    xy = np.random.default_rng(5).uniform(0, 0.02, (9, 2))
    value, std = krige(xy, np.full(9, 250.0), np.full(9, noise)).predict([[0.01, 0.01], [0.1, 0]])
    np.testing.assert_allclose(value, 250.0)
    assert np.all(std < noise + 1e-6)


@pytest.mark.parametrize("noise", [0.05, 0.7])
def test_coverage_is_honest(noise):
    """Seeded Monte Carlo over processes: errors in stated standard deviations have mean square 1 or less.

    Less, for 36 points do not show that nothing scatters from place to place.
    """
    rng, runs, count = np.random.default_rng(4), 60, 36
    grid = np.stack(np.meshgrid(*[np.linspace(0, 0.02, 6)] * 2), axis=-1).reshape(-1, 2)
    errors = []
    for _ in range(runs):
        at = rng.uniform(0, 0.02, (10, 2))
        truth = draw(rng, np.concatenate([grid, at]), 0.006, 2.0, 255.0)
        surface = krige(grid, truth[:count] + noise * rng.standard_normal(count), [noise] * count)
        value, std = surface.predict(at)
        errors.append((value - truth[count:]) / std)
    errors = np.array(errors)
    per_run = np.mean(errors**2, axis=1)
    standard_error = per_run.std() / np.sqrt(runs)
    assert 0.5 < per_run.mean() < 1 + 4 * standard_error
    assert np.mean(np.abs(errors) < 1.96) > 0.92


@pytest.mark.parametrize(("side", "runs", "least"), [(4, 40, 0.88), (6, 30, 0.72), (8, 20, 0.85), (33, 1, 0.9)])
def test_what_scatters_from_place_to_place_is_in_the_band(side, runs, least):
    """Seeded Monte Carlo of a bump of 3 Hz with 0.2 Hz of scatter, noise 0.02 Hz: the next place's value.

    By noise and a smooth field alone 0.45 to 0.8 of them lie in the band of 95 %.
    """
    rng, n, within = np.random.default_rng(12), side**2, []
    grid = np.stack(np.meshgrid(*[np.linspace(-0.01, 0.01, side)] * 2), axis=-1).reshape(-1, 2)
    for _ in range(runs):
        at = rng.uniform(-0.01, 0.01, (50, 2))
        middle, width = rng.uniform(-0.003, 0.003, 2), rng.uniform(0.003, 0.005)
        off = np.sum((np.concatenate([grid, at]) - middle) ** 2, axis=1)
        truth = 254 + 3 * np.exp(-off / (2 * width**2)) + 0.2 * rng.standard_normal(n + 50)
        noise = np.full(n, 0.02)
        value, std = krige(grid, truth[:n] + noise * rng.standard_normal(n), noise).predict(at)
        within.append(np.mean(np.abs(value - truth[n:]) < 1.96 * std))
    assert least < np.mean(within) < 0.99


@pytest.mark.parametrize(
    ("length_m", "touches", "least"), [(0.006, 1, 0.89), (0.015, 1, 0.92), (0.006, 12, 0.88)]
)
def test_of_nine_places_the_uncertainty_of_length_and_size_counts(length_m, touches, least):
    """Seeded Monte Carlo: with length and size of greatest likelihood 0.83 and 0.89 lie in the band of 95 %."""
    rng, runs, errors = np.random.default_rng(9), 80, []
    grid = np.stack(np.meshgrid(*[np.linspace(0, 0.02, 3)] * 2), axis=-1).reshape(-1, 2)
    for _ in range(runs):
        at = rng.uniform(0, 0.02, (10, 2))
        truth = draw(rng, np.concatenate([grid, at]), length_m, 2.0, 255.0)
        values = truth[:9] + 0.05 * rng.standard_normal((touches, 9))
        surface = krige(np.tile(grid, (touches, 1)), values.ravel(), np.full(values.size, 0.05))
        value, std = surface.predict(at)
        errors.append((value - truth[9:]) / std)
    assert least < np.mean(np.abs(errors) < 1.96) < 1


def test_a_mixture_has_the_moments_of_its_processes():
    """Law of total covariance, from draws of the processes with their probabilities."""
    rng = np.random.default_rng(10)
    xy = rng.uniform(0, 0.02, (8, 2))
    y = draw(rng, xy, 0.006, 2.0, 255.0)
    at = rng.uniform(0, 0.02, (3, 2))
    surface = krige(xy, y, np.full(8, 0.1))
    assert len(surface.processes) > 5
    assert np.sum(surface.shares) == pytest.approx(1)
    draws = []
    for share, process in zip(surface.shares, surface.processes, strict=True):
        mean = process.moments(process.before(xy, at))[0]
        covariance = process.covariance(at, at) + process.scatter**2 * np.eye(3)
        draws.append(rng.multivariate_normal(mean, covariance, round(4e5 * share)))
    draws = np.concatenate(draws)
    value, std = surface.predict(at)
    np.testing.assert_allclose(draws.mean(axis=0), value, atol=0.02 * std.max())
    np.testing.assert_allclose(draws.std(axis=0), std, rtol=0.015)


def test_what_determines_nothing_is_refused():
    xy = np.array([[0, 0], [0, 0], [1, 0], [2, 0], [3, 0]])
    with pytest.raises(ValueError, match="one place twice"):
        krige(xy, np.arange(5), np.zeros(5))


def test_several_measurements_of_a_place_are_as_good_as_their_mean():
    """With its noise; that they agree says nothing of what scatters from place to place."""
    rng = np.random.default_rng(8)
    at = np.stack(np.meshgrid(*[np.linspace(0, 0.01, 4)] * 2), axis=-1).reshape(-1, 2)
    truth, noise = draw(rng, at, 0.004, 2.0, 255.0), rng.uniform(0.1, 0.4, (3, 16))
    noise[2, :4] = 0.0  # exact: what else was measured there does not matter
    each = truth + noise * rng.standard_normal((3, 16))
    several = krige(np.tile(at, (3, 1)), each.ravel(), noise.ravel())
    weight = 1 / np.maximum(noise, 1e-12) ** 2
    mean = np.sum(weight * each, axis=0) / weight.sum(axis=0)
    once = krige(at, mean, np.where(noise[2] == 0, 0.0, weight.sum(axis=0) ** -0.5))
    to = at + 1e-3
    for found, expected in zip(several.predict(to), once.predict(to), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_covariance_is_what_a_further_point_takes_away():
    """The variance that is left after one more measurement, by the covariance and by the points themselves."""
    rng, n = np.random.default_rng(6), MIXED_POINTS + 5
    xy = rng.uniform(0, 0.02, (n, 2))
    y = draw(rng, xy, 0.004, 2.0, 255.0)
    at = rng.uniform(0, 0.02, (5, 2))
    surface = krige(xy, y, np.full(n, 0.1))
    process = surface.likeliest
    covariance = process.covariance(at, at) + process.scatter**2 * np.eye(5)
    _, std = surface.predict(at)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), std, rtol=1e-9)
    # ordinary kriging as its bordered system, with the first place measured too
    both = np.concatenate([xy, at[:1]])

    def k(a, b):
        distance = np.linalg.norm(a[:, None] - b, axis=-1)
        return process.std**2 * matern(distance, process.length_m)

    system = np.ones((n + 2, n + 2))
    system[:-1, :-1] = k(both, both) + (0.1**2 + process.scatter**2) * np.eye(n + 1)
    system[-1, -1] = 0
    right = np.vstack([k(both, at), np.ones((1, 5))])
    right[n, 0] += process.scatter**2
    left = process.std**2 + process.scatter**2 - np.sum(right * np.linalg.solve(system, right), axis=0)
    update = std**2 - covariance[:, 0] ** 2 / (covariance[0, 0] + 0.1**2)
    np.testing.assert_allclose(update, left, rtol=1e-6, atol=1e-9)


def test_length_and_size_are_of_greatest_restricted_likelihood():
    """By its textbook form: one percent more or less of either makes it smaller."""
    rng, n = np.random.default_rng(9), MIXED_POINTS + 5
    xy = rng.uniform(0, 0.02, (n, 2))
    noise = rng.uniform(0.05, 0.3, n)
    y = draw(rng, xy, 0.006, 2.0, 255.0) + noise * rng.standard_normal(n)
    distance = np.linalg.norm(xy[:, None] - xy, axis=-1)

    def cost(length, std):
        covariance = std**2 * matern(distance, length) + np.diag(noise**2)
        inverse = np.linalg.inv(covariance)
        gap = y - np.sum(inverse @ y) / np.sum(inverse)
        volume = np.linalg.slogdet(covariance)[1] + np.log(np.sum(inverse))
        return 0.5 * (gap @ inverse @ gap + volume)

    (found,) = krige(xy, y, noise).processes
    least = cost(found.length_m, found.std)
    for change in ((1.01, 1.0), (1 / 1.01, 1.0), (1.0, 1.01), (1.0, 1 / 1.01)):
        assert cost(found.length_m * change[0], found.std * change[1]) > least


def test_length_and_size_stay_within_what_is_known_beforehand():
    xy = np.random.default_rng(7).uniform(0, 0.02, (9, 2))
    flat = krige(xy, np.full(9, 254.0), np.full(9, 0.02), most_length_m=0.004, least_std=1.0)
    for process in flat.processes:
        assert process.length_m <= 0.004 * (1 + 1e-9)
        assert process.std >= 1.0 * (1 - 1e-9)
    assert flat.predict([[0.1, 0.1]])[1] >= 1.0


def test_of_many_points_tiles_predict_what_all_points_together_do(monkeypatch):
    """On the same length and size: the neighbours of a tile screen what is farther away."""
    rng = np.random.default_rng(5)
    xy = rng.uniform(0, 0.05, (1200, 2))
    noise = np.full(len(xy), 0.05)
    y = 250 + np.sin(200 * xy[:, 0]) * np.cos(150 * xy[:, 1]) + noise * rng.standard_normal(len(xy))
    at = rng.uniform(0.002, 0.048, (400, 2))
    surface = krige(xy, y, noise)
    value, std = surface.predict(at)
    monkeypatch.setattr(kriging, "MOST_JOINT", len(xy))
    together, std_together = surface.predict(at)
    truth = 250 + np.sin(200 * at[:, 0]) * np.cos(150 * at[:, 1])
    assert np.sqrt(np.mean((value - together) ** 2)) < 0.2 * np.median(std_together)
    assert 0.8 < np.median(std / std_together) < 1.4
    assert 0.9 < np.mean(np.abs(value - truth) < 1.96 * std) <= 1


@pytest.mark.parametrize("count", [25, 30, 33, 40, 50])
def test_something_small_in_a_large_map_is_neither_smoothed_away_nor_sure(count):
    """A bump of 10 Hz in a flat map, of a grid touched row by row; a point's noise is 0.05 Hz."""
    rng = np.random.default_rng(11)
    axis = 1e-3 * np.arange(count)
    xy = np.array([(x, y) for k, y in enumerate(axis) for x in (axis, axis[::-1])[k % 2]])
    middle = xy.mean(axis=0) + [0.003, 0.002]

    def truth(at):
        return 250 + 10 * np.exp(-np.sum((at - middle) ** 2, axis=-1) / (2 * 0.0015**2))

    noise = np.full(len(xy), 0.05)
    at = middle + rng.uniform(-0.003, 0.003, (200, 2))
    value, std = krige(xy, truth(xy) + noise * rng.standard_normal(len(xy)), noise).predict(at)
    off = value - truth(at)
    assert np.max(np.abs(off)) < 0.6
    assert np.sqrt(np.mean((off / std) ** 2)) < 3
    with pytest.raises(ValueError, match="one place twice"):
        krige(np.concatenate([xy, xy[:1]]), truth(np.concatenate([xy, xy[:1]])), np.zeros(len(xy) + 1))
