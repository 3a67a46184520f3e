# SPDX-License-Identifier: Apache-2.0
"""Statements over a map: rates of false discoveries, groups behind known noise, smallest steps."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import special, stats
from scipy.special import logsumexp
from tissue.reference_points import NOISE, SOURCES, covariance, drawn, joined

from tactile_resonance.tissue.comparison import (
    differences_from_rest,
    find_clusters,
    pairs_that_differ,
)
from tactile_resonance.tissue.spread import (
    SpreadSource,
    TissueSpread,
    percent_of,
    smallest_steps,
    spreads_of,
    within_preparation,
)

NONE = np.zeros((2, 2))
MEAN = np.array([254.0, 0.0336])
STEP = np.array([2.5, 2.5e-3])


def points(rng, shifts, spread=NONE, noisy=(1, 1)):
    """Points at MEAN + shifts (n, 2), with noise of their own between `noisy` times the usual deviation."""
    factor = rng.uniform(*noisy, len(shifts)) ** 2
    noise = factor[:, None, None] * NOISE
    own = np.array([rng.multivariate_normal([0, 0], each + spread) for each in noise])
    return MEAN + shifts + own, noise


def test_false_discoveries_are_as_rare_as_asked_for():
    """100 maps of 40 points, 10 of them off; the rate is the mean over maps."""
    rng, rate = np.random.default_rng(1), 0.1
    spread = covariance(0.1, 2e-4, 0.9)
    off = np.zeros((40, 2))
    off[:10, 1] = 6 * 1e-4 * np.linspace(1, 1.5, 10)
    false, found, pairs_false = [], [], []
    for _ in range(100):
        x, noise = points(rng, off, spread)
        result = differences_from_rest(x, noise, spread, rate)
        false.append(np.sum(result.differs[10:]) / max(1, np.sum(result.differs)))
        found.append(np.mean(result.differs[:10]))
        pairs = pairs_that_differ(x, noise, spread, rate)
        assert not np.diag(pairs).any()
        np.testing.assert_array_equal(pairs, pairs.T)
        pairs_false.append(pairs[10:, 10:].sum() / max(1, pairs.sum()))
    assert np.mean(false) < rate + 4 * np.std(false) / 10
    assert np.mean(found) > 0.9
    assert np.mean(pairs_false) < rate


def test_a_map_of_one_tissue_has_no_points_that_differ_but_as_often_as_asked_for():
    rng, rate = np.random.default_rng(2), 0.05
    any_ = [
        differences_from_rest(
            *points(rng, np.zeros((25, 2)), noisy=(1, 5)), NONE, rate
        ).differs.any()
        for _ in range(600)
    ]
    assert np.sum(any_) <= stats.binom.ppf(0.9999, 600, rate)
    assert np.sum(any_) >= stats.binom.ppf(0.0001, 600, rate / 2)


def test_the_rest_is_the_larger_group_wherever_it_lies():
    rng = np.random.default_rng(3)
    shifts = np.repeat([[0, 0], [2.5, 2.5e-3], [5, 5e-3]], [10, 12, 9], axis=0)
    result = differences_from_rest(*points(rng, shifts), NONE)
    np.testing.assert_array_equal(result.differs, shifts[:, 0] != 2.5)
    np.testing.assert_allclose(result.rest, MEAN + shifts[12], atol=0.02)
    x, noise = points(rng, np.zeros((1, 2)))
    assert not differences_from_rest(x, noise, NONE).differs.any()
    assert pairs_that_differ(x, noise, NONE).shape == (1, 1)


def test_a_point_that_is_hardly_known_hides_no_difference():
    """Two groups 13 deviations apart, and one point between them whose noise covers both: 100 maps."""
    rng = np.random.default_rng(7)
    noise = np.tile(covariance(0.3, 1e-3, 0.0), (51, 1, 1))
    noise[50] = covariance(5.0, 0.02, 0.0)
    shifts = np.repeat([[0.0, 0.0], [4.0, 0.0], [2.0, 0.0]], [30, 20, 1], axis=0)
    missed, false = 0, 0
    for _ in range(100):
        x = MEAN + shifts + np.array([rng.multivariate_normal([0, 0], each) for each in noise])
        differs = differences_from_rest(x, noise, NONE).differs
        missed += int(np.sum(~differs[30:50]))
        false += int(np.sum(differs[:30]))
    assert missed <= 2
    assert false <= stats.binom.ppf(0.9999, 3000, 0.05)


def test_distances_are_those_of_a_point_from_the_mean_of_the_others():
    x, noise = points(np.random.default_rng(4), np.zeros((3, 2)), noisy=(1, 3))
    result = differences_from_rest(x, noise, NONE, 1e-9)
    for k in range(3):
        others = [j for j in range(3) if j != k]
        information = sum(np.linalg.inv(noise[j]) for j in others)
        of_mean = np.linalg.inv(information)
        off = x[k] - of_mean @ sum(np.linalg.inv(noise[j]) @ x[j] for j in others)
        squared = off @ np.linalg.solve(noise[k] + of_mean, off)
        assert result.p[k] == pytest.approx(np.exp(-squared / 2))


def test_groups_are_found_without_the_noise_of_their_points():
    """Three groups of spread less than the noise of the worst points: number, means and spreads."""
    rng, spread = np.random.default_rng(5), covariance(0.1, 1.2e-4, 0.5)
    kind = np.repeat([0, 1, 2], [120, 80, 60])
    x, noise = points(rng, kind[:, None] * STEP, spread, (0.5, 12))
    found = find_clusters(x, noise)
    assert len(found.mean) == 3
    np.testing.assert_allclose(found.weight, [120 / 260, 80 / 260, 60 / 260], atol=0.02)
    np.testing.assert_allclose(found.mean, MEAN + np.arange(3)[:, None] * STEP, atol=0.08)
    for each in found.covariance:
        # 60 points of which a half tell: within a factor of two of the variance
        assert 0.5 < each[0, 0] / spread[0, 0] < 2
    assert np.mean(found.of_point == kind) > 0.99
    np.testing.assert_allclose(found.probability.sum(axis=1), 1)


def test_one_tissue_is_one_group():
    rng = np.random.default_rng(6)
    for _ in range(10):
        assert len(find_clusters(*points(rng, np.zeros((25, 2)), noisy=(1, 8)), most=3).mean) == 1


@pytest.mark.parametrize(("count", "least_found"), [(8, 0.3), (10, 0.6), (15, 0.85), (25, 0.95)])
def test_few_points_that_lie_together_by_chance_are_no_group(count, least_found):
    """One tissue that scatters a hundred times its noise: 100 maps, at most 7 % of which are split, at 99.9 %.

    And two tissues six deviations apart are two in most of 40 maps, from 10 points on.
    """
    rng, spread = np.random.default_rng(9), 1e4 * NOISE
    maps = [points(rng, np.zeros((count, 2)), spread) for _ in range(100)]
    split = [len(find_clusters(*each, most=3).mean) > 1 for each in maps]
    assert np.sum(split) <= stats.binom.ppf(0.999, 100, 0.07)
    shifts = np.zeros((count, 2))
    shifts[count // 2 :, 0] = 6 * np.sqrt(spread[0, 0])
    found = [len(find_clusters(*points(rng, shifts, spread), most=2).mean) == 2 for _ in range(40)]
    assert np.sum(found) >= stats.binom.ppf(0.001, 40, least_found)


@pytest.mark.parametrize("pool", [False, True])
def test_one_tissue_is_one_by_the_spread_of_few_castings_too(pool):
    """Libraries of two tissues, four castings of two positions each: eight degrees of freedom, pooled or not.

    With the spread taken for known a third of the maps would hold points, and pairs, that differ, and be split.
    """
    rng, runs = np.random.default_rng(10), 30
    spread, rate = SOURCES["position"] + SOURCES["repetition"], 0.05
    differ, pairs, split = [], [], []
    for _ in range(runs):
        library = joined(*(drawn(rng, [(1, 1)] * 4, tissue=name) for name in "ab"))
        given, degrees = within_preparation([each.sources for each in spreads_of(library, pool)])
        assert degrees == pytest.approx(8)
        map_ = points(rng, np.zeros((16, 2)), spread)
        differ.append(differences_from_rest(*map_, given, rate, degrees).differs.any())
        pairs.append(pairs_that_differ(*map_, given, rate, degrees).any())
        split.append(len(find_clusters(*map_, given, most=2, degrees_of_freedom=degrees).mean) > 1)
    most = stats.binom.ppf(0.9999, runs, rate)
    assert np.sum(differ) <= most
    assert np.sum(pairs) <= most
    assert np.sum(split) <= stats.binom.ppf(0.9999, runs, 0.13)


def test_an_estimated_spread_counts_as_so_many_points():
    """Of two groups far apart: between that of the map and the one given, and that given where it is known."""
    rng, spread = np.random.default_rng(11), covariance(0.1, 1.2e-4, 0.5)
    kind = np.repeat([0, 1], 30)
    x, noise = points(rng, kind[:, None] * 4 * STEP, spread)
    wide = 9 * (spread + NOISE) - NOISE
    by = {nu: find_clusters(x, noise, wide, 2, degrees_of_freedom=nu) for nu in (30.0, 1e9, np.inf)}
    assert [len(each.mean) for each in by.values()] == [2, 2, 2]
    off = x - np.array([x[kind == k].mean(axis=0) for k in (0, 1)])[kind]
    expected = (off.T @ off + 30 * (wide + NOISE)) / 90 - NOISE
    np.testing.assert_allclose(by[30.0].covariance, [expected] * 2, rtol=0.02)
    np.testing.assert_allclose(by[1e9].covariance, [wide] * 2, rtol=1e-5)
    np.testing.assert_allclose(by[1e9].bic, by[np.inf].bic, rtol=1e-4)


def test_distances_behind_an_estimated_spread_are_hotellings():
    """Two points against each other, and a spread of as many deviations as it has degrees of freedom."""
    rng, nu, runs = np.random.default_rng(12), 5, 1000
    p = []
    for _ in range(runs):
        drawn_ = rng.multivariate_normal([0, 0], NOISE, nu + 2)
        estimated = drawn_[:nu].T @ drawn_[:nu] / nu
        p.append(differences_from_rest(drawn_[nu:], np.zeros((2, 2, 2)), estimated, 0.05, nu).p.min())
    assert stats.kstest(p, "uniform").pvalue > 1e-4


@pytest.mark.parametrize(("count", "most_wrong"), [(8, 0.008), (12, 0.008)])
def test_of_few_points_groups_are_not_taken_for_true(count, most_wrong):
    """Two tissues three deviations apart, 80 maps: of points stated with 99 % few are of the other tissue.

    By the groups as they were found 1.5 % and more are.
    """
    spread, other, wrong, sure = 25 * NOISE, np.arange(count) >= count // 2, 0, 0
    shifts = np.where(other[:, None], [3 * np.sqrt(spread[0, 0] + NOISE[0, 0]), 0.0], 0.0)
    for seed in range(80):
        found = find_clusters(*points(np.random.default_rng(seed), shifts, spread), spread, most=3)
        if len(found.mean) == 2:
            stated = found.probability.max(axis=1) > 0.99
            sure += np.sum(stated)
            wrong += np.sum(stated & (found.of_point != other))
    assert sure > 100
    assert wrong <= most_wrong * sure


def test_likelihood_and_criterion_are_those_of_their_definitions():
    rng, spread = np.random.default_rng(7), covariance(0.1, 1.2e-4, 0.5)
    x, noise = points(rng, np.repeat([[0, 0], STEP], [20, 10], axis=0), spread, (1, 4))
    unit = np.sqrt(np.var(x, axis=0) + np.mean(noise, axis=0).diagonal())
    for known, parameters in ((None, 11), (spread, 5)):
        found = find_clusters(x, noise, known)
        each = [
            [
                np.log(w) + stats.multivariate_normal.logpdf(one, m, c + v)
                for w, m, v in zip(found.weight, found.mean, found.covariance, strict=True)
            ]
            for one, c in zip(x, noise, strict=True)
        ]
        log_likelihood = float(logsumexp(each, axis=1).sum() + len(x) * np.log(unit).sum())
        assert found.bic[1] == pytest.approx(parameters * np.log(30) - 2 * log_likelihood, abs=2e-4)
        assert np.argmin(found.bic) == 1
        if known is not None:
            np.testing.assert_allclose(found.covariance, [spread] * 2)


def tissue(name, mean, **parts):
    """With covariances of noise, force, block and by source."""
    sources = tuple(
        SpreadSource(s, parts.get(s, NONE), 5) for s in ("preparation", "position", "repetition")
    )
    known = [parts.get(part, NONE) for part in ("noise", "force", "block")]
    return TissueSpread(name, 9, np.asarray(mean), NONE, 5.0, sources, *known)


def test_the_smallest_step_is_where_both_errors_are_one_in_a_hundred():
    """Gelatines that much apart, with these spreads, are confused as often as the quantile says."""
    parts = {
        "block": NOISE,
        "force": covariance(0.05, 1e-4, 0.2),
        "preparation": covariance(0.4, 5e-4, 0.8),
    }
    low, high = (
        tissue("gelatine 10 %", MEAN, **parts),
        tissue("gelatine 12 %", MEAN + STEP, **parts),
    )
    other = replace(low, name="liver")
    (step,) = smallest_steps([high, other, low], 0.99)
    assert (step.first, step.from_percent, step.to_percent) == ("gelatine 10 %", 10.0, 12.0)
    assert list(step.one_block) == ["noise", "force", "repetition", "position", "preparation"]
    total = NONE
    for name in step.one_block:
        total = total + parts.get("block" if name == "noise" else name, NONE)
        distance = np.sqrt(STEP @ np.linalg.solve(total, STEP)) * step.one_block[name] / 2
        assert special.ndtr(-distance / 2) == pytest.approx(0.01, rel=1e-6)
    assert step.limit["noise"] == 0
    assert step.limit["preparation"] < step.one_block["preparation"]
    assert smallest_steps([low, other]) == ()
    assert (percent_of("gel 12.5% w/w"), percent_of("liver")) == (12.5, None)


def test_a_source_that_is_not_determined_makes_no_step():
    """One casting of the second tissue, two positions of one repetition each in all others."""
    rng, n = np.random.default_rng(13), 4
    low = drawn(rng, [(1, 1)] * n, tissue="gelatine 10 %")
    high = drawn(rng, [(1, 1)] * n, mean=MEAN + STEP, tissue="gelatine 12 %")
    for castings, outer in ((n, ["position", "preparation"]), (1, ["position"])):
        (step,) = smallest_steps(spreads_of(joined(low, high.where(np.arange(2 * n) < 2 * castings))))
        assert list(step.one_block) == list(step.limit) == ["noise", "force", *outer]


def test_refusals():
    with pytest.raises(ValueError, match="rate: got 0; accepted is between"):
        differences_from_rest([MEAN], [NOISE], NONE, 0)
    with pytest.raises(ValueError, match="most: got 0"):
        find_clusters([MEAN], [NOISE], most=0)


@pytest.mark.parametrize("covariance", [np.zeros((2, 2)), -NOISE, np.diag([1e-4, 0.0])])
@pytest.mark.parametrize("of", [differences_from_rest, pairs_that_differ])
def test_points_without_a_covariance_are_neither_compared_nor_grouped(of, covariance):
    x, noise, none = np.array([[250.0, 0.03], [251.0, 0.03]]), np.stack([covariance, NOISE]), np.zeros((2, 2))
    with pytest.raises(ValueError, match="covariances: got .* accepted is positive definite ones"):
        of(x, noise, none)
    with pytest.raises(ValueError, match="covariances: got .* accepted is positive definite ones"):
        find_clusters(x, noise)
