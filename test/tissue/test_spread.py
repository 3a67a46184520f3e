# SPDX-License-Identifier: Apache-2.0
"""Spread by source: closed forms, and seeded Monte Carlo of what is stated."""

import numpy as np
import pytest
from scipy import stats
from tissue.reference_points import NOISE, SOURCES, drawn, joined

from tactile_resonance.frf.variance_analysis import nested_means
from tactile_resonance.tissue.classify import posteriors
from tactile_resonance.tissue.spread import LEVELS, not_negative, spreads_of, within_preparation


def test_balanced_data_give_the_classical_analysis_of_variance():
    rng = np.random.default_rng(1)
    a, b, c = 5, 4, 3
    x = rng.standard_normal((a, b, c))
    groups = np.stack([np.zeros(a * b * c, int), *np.indices((a, b, c)).reshape(3, -1)[:2]], 1)
    found = nested_means(x.ravel(), groups, LEVELS)
    squares = [np.sum(level.deviations**2) / level.dof for level in found.levels]
    means = x.mean(axis=2)
    expected = [
        means.mean(axis=1).var(ddof=1),
        means.var(axis=1, ddof=1).mean(),
        x.var(axis=2, ddof=1).mean(),
    ]
    np.testing.assert_allclose(squares, expected)
    assert [level.dof for level in found.levels] == [a - 1, a * (b - 1), a * b * (c - 1)]
    np.testing.assert_allclose(
        [level.holds for level in found.levels],
        [[1, 1 / b, 1 / (b * c)], [0, 1, 1 / c], [0, 0, 1]],
    )
    np.testing.assert_allclose(found.mean, x.mean())
    np.testing.assert_allclose(found.mean_holds, [[1 / a, 1 / (a * b), 1 / (a * b * c)]])


def test_expectations_are_exact_for_groups_of_any_size():
    """By the quadratic form itself: trace of A V with V of each source, A of each mean square."""
    groups = np.array([[0, 0, 0], [0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 1, 1], [0, 1, 1], [0, 2, 0]])
    n = len(groups)
    found = nested_means(np.eye(n), groups, LEVELS)  # deviations are the rows of the contrasts
    same = [
        np.all(groups[:, None, : k + 1] == groups[None, :, : k + 1], axis=2).astype(float)
        for k in (1, 2)
    ]
    for level in found.levels:
        form = level.deviations.T @ level.deviations / level.dof
        np.testing.assert_allclose(np.diag(form), level.holds_noise)
        held = [np.trace(form @ each) for each in (*same, np.eye(n))]
        np.testing.assert_allclose(held, level.holds, atol=1e-15)
    weight = found.mean[0]
    np.testing.assert_allclose(weight, found.weight)
    np.testing.assert_allclose(
        [weight @ each @ weight for each in (*same, np.eye(n))], found.mean_holds[0]
    )


def test_spreads_are_unbiased_for_groups_of_any_size():
    """Mean over 1200 experiments within 4 of its standard errors, each element of each source."""
    rng, sizes = np.random.default_rng(2), [(2, 3), (1, 4, 2), (2, 2), (3, 1, 1), (2,), (5, 2)]
    found = {name: [] for name in LEVELS}
    for _ in range(1200):
        (spread,) = spreads_of(drawn(rng, sizes))
        for source in spread.sources:
            found[source.name].append(source.covariance)
    assert [source.degrees_of_freedom for source in spread.sources] == [5, 7, 17]
    for name, each in found.items():
        std = np.std(each, axis=0) / np.sqrt(len(each))
        # cut at 0 a remainder is a little too large: at most a tenth of the truth here
        bias = np.abs(np.mean(each, axis=0) - SOURCES[name])
        assert np.all(bias < 4 * std + 0.1 * np.abs(SOURCES[name])), name


def test_sources_that_one_measurement_each_cannot_tell_are_named():
    rng = np.random.default_rng(3)
    (once,) = spreads_of(drawn(rng, [(1, 1)] * 400))
    preparation, position, repetition = once.sources
    assert position.holds == ("repetition",)
    assert repetition.degrees_of_freedom == 0
    assert np.isnan(repetition.covariance).all()
    assert once.undetermined == ()
    expected = SOURCES["position"] + SOURCES["repetition"]
    np.testing.assert_allclose(position.covariance, expected, rtol=0.35)
    np.testing.assert_allclose(preparation.covariance, SOURCES["preparation"], rtol=0.35)


def test_one_preparation_leaves_the_spread_of_preparations_undetermined():
    rng = np.random.default_rng(4)
    (one,) = spreads_of(drawn(rng, [(2,) * 200]))
    assert one.undetermined == ("preparation",)
    within = SOURCES["position"] + SOURCES["repetition"]
    np.testing.assert_allclose(one.covariance, within, rtol=0.35)
    # the spread of another tissue serves it, where both are said to scatter alike
    two = joined(drawn(rng, [(2,) * 200]), drawn(rng, [(2,) * 2] * 200, tissue="other"))
    pooled, other = spreads_of(two, pool=True)
    assert pooled.undetermined == ()
    assert pooled.degrees_of_freedom > 100
    # its mean is that of one preparation: twice their spread is about it
    np.testing.assert_allclose(pooled.covariance[0, 0], 2 * 0.4**2 + 0.2**2 + 0.05**2, rtol=0.3)
    assert other.covariance[0, 0] < 0.65 * pooled.covariance[0, 0]


def test_known_noise_is_taken_off():
    """Points that scatter by their noise alone have no spread beyond a tenth of it."""
    rng, zero = np.random.default_rng(5), dict.fromkeys(LEVELS, np.zeros((2, 2)))
    (spread,) = spreads_of(drawn(rng, [(5,) * 5] * 50, zero))
    for source in spread.sources:
        assert np.all(np.diag(source.covariance) < 0.1 * np.diag(NOISE)), source.name
    np.testing.assert_allclose(spread.noise, NOISE / 2)
    np.testing.assert_allclose(spread.force, NOISE / 2)
    np.testing.assert_allclose(spread.block, 2 * spread.noise)


@pytest.mark.parametrize("preparations", [4, 8])
def test_the_next_preparation_lies_outside_as_often_as_stated(preparations):
    """Hotelling's distribution, not the normal one, for so few preparations; a plug-in one fails."""
    rng, runs = np.random.default_rng(6), 1200
    tails, plug_in = [], []
    for _ in range(runs):
        drawn_all = drawn(rng, [(2, 2)] * preparations + [(1,)])
        (spread,) = spreads_of(drawn_all.where(np.arange(4 * preparations + 1) < 4 * preparations))
        x = drawn_all.estimate[-1]
        tails.append(posteriors(x, NOISE, [spread.as_class()])[1][0])
        off = x - spread.mean
        plug_in.append(stats.chi2.sf(off @ np.linalg.solve(spread.covariance + NOISE, off), 2))
    for level in (0.01, 0.05):
        count = int(np.sum(np.array(tails) < level))
        # Satterthwaite's degrees of freedom are on the safe side, by up to a factor of three
        low, high = stats.binom.interval(0.9999, runs, [level / 3, level])
        assert low[0] <= count <= high[1], level
    assert np.mean(np.array(plug_in) < 0.01) > 0.025


def test_degrees_of_freedom_of_single_measurements_are_those_of_their_scatter():
    points = drawn(np.random.default_rng(7), [(1,)] * 9, noise=np.zeros((2, 2)))
    (spread,) = spreads_of(points)
    # all of it is one Wishart matrix of 8 degrees of freedom, and its tenth is the mean's
    assert spread.degrees_of_freedom == pytest.approx(8)
    np.testing.assert_allclose(spread.covariance, 10 / 9 * np.cov(points.estimate.T))


@pytest.mark.parametrize("preparations", [3, 4])
def test_four_points_are_a_class_as_those_of_a_scene_are(preparations):
    """Whatever rounding makes of the degrees of freedom of the fourth."""
    rng = np.random.default_rng(9)
    for _ in range(20):
        (spread,) = spreads_of(drawn(rng, [(1,)] * preparations, noise=np.zeros((2, 2))))
        assert spread.degrees_of_freedom == pytest.approx(preparations - 1)
        assert spread.usable == (preparations == 4)


def test_two_preparations_are_no_class_however_alike_their_positions():
    (spread,) = spreads_of(drawn(np.random.default_rng(10), [(1,) * 6] * 2))
    assert 1 < spread.degrees_of_freedom < 3
    with pytest.raises(ValueError, match="gel: degrees_of_freedom: .*3 or more: more prep"):
        spread.as_class()


def test_refusals():
    points = drawn(np.random.default_rng(8), [(1,)])
    (one,) = spreads_of(points)
    assert one.degrees_of_freedom == 0
    with pytest.raises(ValueError, match="gel: degrees_of_freedom: got 0"):
        one.as_class()
    (two,) = spreads_of(drawn(np.random.default_rng(8), [(1,), (1,)], noise=np.zeros((2, 2))))
    with pytest.raises(ValueError, match="gel: degrees_of_freedom: .*3 or more: more prep"):
        two.as_class()
    with pytest.raises(ValueError, match="points: got 0"):
        spreads_of(points.where(np.zeros(1, bool)))
    with pytest.raises(ValueError, match="values: .*not finite"):
        nested_means([np.nan], [[0]], ["a"])
    with pytest.raises(ValueError, match=r"groups: got \(1, 2\)"):
        nested_means([1.0], [[0, 0]], ["a"])


def test_repetitions_at_one_place_do_not_show_how_points_of_a_map_scatter():
    """One place in each of six preparations, three repetitions: positions are part of the preparations."""
    (spread,) = spreads_of(drawn(np.random.default_rng(11), [(3,)] * 6))
    with pytest.raises(ValueError, match=r"spread: got \['repetition'\]; accepted is position among them"):
        within_preparation([spread.sources])
    (spread,) = spreads_of(drawn(np.random.default_rng(11), [(1, 1)]))
    with pytest.raises(ValueError, match=r"spread: got '1 degree of freedom of positions'; accepted is more"):
        within_preparation([spread.sources])


def test_nearest_covariance():
    np.testing.assert_allclose(not_negative(np.diag([2.0, -1.0]), np.eye(2)), np.diag([2.0, 0.0]))
    np.testing.assert_allclose(not_negative(NOISE, NOISE), NOISE)
