# SPDX-License-Identifier: Apache-2.0
"""Classes on trial: nothing rests on what is called, and rates are those stated."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from tissue.reference_points import drawn, joined

from tactile_resonance.tissue.classify import UNKNOWN, classify, posteriors
from tactile_resonance.tissue.references import (
    library_text,
    parse_classes,
    read_classes,
    read_sources,
)
from tactile_resonance.tissue.spread import spreads_of
from tactile_resonance.tissue.trial import (
    Trial,
    call_points,
    effective_groups,
    leave_out,
    reliability,
    share_limits,
)

STEP = np.array([2.5, 2.5e-3])  # 2 % w/w
TWO_GELATINES = Path("config/scenes/two_gelatines.yaml")


def gelatines(rng, sizes, step=STEP, kinds=4):
    mean = np.array([254.0, 0.0336])
    return joined(
        *(drawn(rng, sizes, mean=mean + k * step, tissue=f"gel{k}") for k in range(kinds))
    )


def test_classes_of_few_preparations_state_probabilities_and_rates_that_hold():
    """Each of 60 libraries of six preparations calls preparations of its own that it has not seen."""
    rng, level, trials = np.random.default_rng(1), 0.05, []
    for _ in range(60):
        library = [s.as_class() for s in spreads_of(gelatines(rng, [(2, 2)] * 6, 0.4 * STEP, 3))]
        trials.append(call_points(gelatines(rng, [(1,)] * 10, 0.4 * STEP, 3), library, level))
    unknown = sum(int(np.sum(t.called == UNKNOWN)) for t in trials)
    assert unknown <= stats.binom.ppf(0.9999, 1800, level)
    # bins of all libraries together: the groups of each are others
    for k, trial in enumerate(trials):
        trials[k] = replace(
            trial, preparation=np.array([f"{k}, {n}" for n in range(len(trial.tissue))])
        )
    bins = reliability(Trial.joined(trials), 0.9999)
    assert len(bins) == 7
    assert sum(each.points for each in bins) == 1800 - unknown
    assert all(each.holds for each in bins), bins


def test_what_is_left_out_is_not_in_the_classes_that_call_it():
    rng = np.random.default_rng(2)
    points = gelatines(rng, [(2, 2)] * 10)
    odd = points.preparation == "gel13"
    moved = points.estimate + np.where(odd[:, None], [0.0, 6e-3], 0.0)
    points = replace(points, estimate=moved)
    for by in ("preparation", "run"):
        trial = leave_out(points, by, False, 0.01)
        assert len(trial.tissue) == len(points.tissue)
        assert set(trial.called[trial.preparation == "gel1, gel13"]) == {UNKNOWN}
    # its own library takes it for a member
    own = call_points(points, [s.as_class() for s in spreads_of(points)], 0.01)
    assert "gel1" in own.called[own.preparation == "gel1, gel13"]


def test_a_preparation_in_several_runs_is_left_out_of_all_of_them():
    points = gelatines(np.random.default_rng(3), [(2, 2)] * 6, kinds=2)
    halves = np.array([f"run {k % 2}" for k in range(len(points.tissue))])
    with pytest.raises(ValueError, match="runs: .*so many that classes remain"):
        leave_out(replace(points, run=halves), "run", False, 0.01)


def test_a_tissue_outside_of_the_library_is_called_unknown():
    points = gelatines(np.random.default_rng(4), [(2, 2)] * 20)
    trial = leave_out(points, "tissue", False, 0.01)
    assert not trial.known.any()
    assert np.mean(trial.called == UNKNOWN) > 0.95
    assert reliability(trial) == ()


def test_shares_count_groups_that_share_their_fate_once():
    assert share_limits(0, 100, 10) == share_limits(0, 10, 10)
    low, high = share_limits(3, 60, 60)
    exact = stats.binomtest(3, 60).proportion_ci(0.95)
    assert (low, high) == pytest.approx((exact.low, exact.high))
    assert share_limits(60, 60, 60)[1] == 1.0
    assert share_limits(0, 0, 0) == (0.0, 1.0)


@pytest.mark.parametrize("sizes", [[20] * 10, [100] + [1] * 9, [50, 50] + [2] * 8])
@pytest.mark.parametrize("true", [0.5, 0.9])
def test_a_share_that_few_preparations_rule_is_as_uncertain_as_they_make_it(sizes, true):
    """Preparations share their fate and are of unequal size: limits of 95 % hold the truth as often, of 400."""
    rng, group = np.random.default_rng(8), np.repeat([f"{k}" for k in range(len(sizes))], sizes)
    made = Trial(group, *(np.zeros(len(group), kind) for kind in ("U9", bool, float, "U9", float)), group)
    held, bins_hold = 0, 0
    for _ in range(400):
        right = np.repeat(rng.random(len(sizes)) < true, sizes)
        low, high = share_limits(int(right.sum()), len(group), effective_groups(group))
        assert f"{low:.2%} to {high:.2%}" in made.share(right)
        held += low <= true <= high
        likely = np.where(right, group, "another")
        stated = np.full(len(group), true)
        trial = replace(made, likely=likely, called=likely, known=np.ones(len(group), bool), probability=stated)
        bins_hold += all(each.holds for each in reliability(trial))
    assert held >= stats.binom.ppf(0.001, 400, 0.95)
    assert bins_hold >= stats.binom.ppf(0.001, 400, 0.95)


@pytest.mark.parametrize("preparations", [3, 12])
def test_a_library_is_read_as_it_was_built(tmp_path, preparations):
    spreads = spreads_of(gelatines(np.random.default_rng(5), [(2, 1)] * preparations), pool=True)
    _, nominal = read_classes(TWO_GELATINES)
    path = tmp_path / "library.yaml"
    path.write_text(library_text(spreads, nominal, ["built from nothing"]))
    classes, again = read_classes(path)
    for spread, got in zip(spreads, classes, strict=True):
        wanted = spread.as_class()
        assert got.name == wanted.name
        np.testing.assert_allclose(got.mean, wanted.mean, rtol=1e-7)
        np.testing.assert_allclose(got.spread, wanted.spread, rtol=1e-3)
        assert got.degrees_of_freedom == pytest.approx(wanted.degrees_of_freedom, abs=0.01)
    np.testing.assert_allclose(again.sensitivity.covariance, nominal.sensitivity.covariance)
    for item in fields(nominal):
        if item.name != "sensitivity":
            assert getattr(again, item.name) == getattr(nominal, item.name)
    sources = read_sources(path)
    for spread in spreads:
        for got, wanted in zip(sources[spread.name], spread.sources, strict=True):
            assert (got.name, got.holds) == (wanted.name, wanted.holds)
            assert got.degrees_of_freedom == wanted.degrees_of_freedom
            np.testing.assert_allclose(got.covariance, wanted.covariance, rtol=1e-3, atol=1e-12)


def test_refusals(tmp_path):
    points = gelatines(np.random.default_rng(6), [(1,)] * 5, kinds=1)
    with pytest.raises(ValueError, match="tissues: got .'gel0'.; accepted is two or more"):
        leave_out(points, "tissue", False, 0.01)
    entry = {"f0_hz": 250, "damping_ratio": 0.03, "f0_std_hz": 1, "damping_ratio_std": 1e-3}
    with pytest.raises(ValueError, match="c.a.degrees_of_freedom: got 1.0; accepted is .* above 1"):
        parse_classes({"a": {**entry, "degrees_of_freedom": 1}}, "c")
    path = tmp_path / "library.yaml"
    path.write_text("spread: {gel: {batch: {f0_std_hz: 1, damping_ratio_std: 0}}}")
    with pytest.raises(ValueError, match="library.yaml: spread.gel.batch"):
        read_sources(path)


def test_points_are_called_as_one_by_one():
    rng = np.random.default_rng(7)
    points = gelatines(rng, [(2, 2)] * 6, 0.4 * STEP, 3)
    classes = [spread.as_class() for spread in spreads_of(points)]
    trial = call_points(points, classes, 0.3)
    assert UNKNOWN in trial.called
    for k, (x, noise) in enumerate(zip(points.estimate, points.covariance, strict=True)):
        call = classify(x, noise, classes, 0.3)
        assert call.name == trial.called[k]
        if call.name != UNKNOWN:
            assert call.probability == pytest.approx(trial.probability[k])
        probability, tail = posteriors(x, noise, classes)
        assert (probability.max(), tail.max()) == pytest.approx((trial.probability[k], trial.tail[k]))
