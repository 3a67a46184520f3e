# SPDX-License-Identifier: Apache-2.0
"""Calls are as sure as they say, in seeded Monte Carlo."""

import numpy as np
import pytest

from tactile_resonance.tissue.classify import (
    UNKNOWN,
    TissueClass,
    class_from_samples,
    classify,
    posteriors,
)
from tactile_resonance.tissue.references import parse_classes

NOISE = np.array([[0.05**2, 0.3 * 0.05 * 2e-4], [0.3 * 0.05 * 2e-4, 2e-4**2]])


def tissue(name, f0_hz, damping, f0_std_hz=0.4, damping_std=1e-3, correlation=0.8, **values):
    std = np.array([f0_std_hz, damping_std])
    spread = np.outer(std, std) * [[1, correlation], [correlation, 1]]
    return TissueClass(name, np.array([f0_hz, damping]), spread, **values)


# near enough that calls are uncertain, with unlike spreads and priors
CLASSES = (
    tissue("a", 250.0, 0.0300, prior=2.0),
    tissue("b", 250.6, 0.0312, f0_std_hz=0.6, correlation=-0.3),
    tissue("c", 251.5, 0.0325, damping_std=5e-4),
)


def draw(rng, classes, size):
    weights = np.array([c.prior for c in classes])
    which = rng.choice(len(classes), size, p=weights / weights.sum())
    x = np.empty((size, 2))
    for k, c in enumerate(classes):
        here = which == k
        x[here] = rng.multivariate_normal(c.mean, c.spread + NOISE, here.sum())
    return which, x


def test_a_call_of_p_is_right_in_p_of_the_cases():
    rng, size = np.random.default_rng(11), 4000
    which, x = draw(rng, CLASSES, size)
    names = [c.name for c in CLASSES]
    calls = [classify(point, NOISE, CLASSES, 1e-9) for point in x]
    p, _ = posteriors(x, NOISE, CLASSES)
    np.testing.assert_allclose(p.sum(axis=1), 1)
    np.testing.assert_allclose([call.probability for call in calls], p.max(axis=1))
    truth = np.eye(3)[which]
    # every class, in every decile of stated probability: frequency within 4 standard deviations
    for k in range(3):
        for low in np.arange(0, 1, 0.1):
            inside = (p[:, k] >= low) & (p[:, k] < low + 0.1)
            if inside.sum() < 50:
                continue
            std = np.sqrt(np.sum(p[inside, k] * (1 - p[inside, k]))) / inside.sum()
            assert abs(truth[inside, k].mean() - p[inside, k].mean()) < 4 * std + 1e-12
    right = np.mean([call.name == names[w] for call, w in zip(calls, which, strict=True)])
    stated = np.mean([call.probability for call in calls])
    assert right == pytest.approx(stated, abs=4 * np.sqrt(0.25 / size))
    assert 0.6 < right < 0.95  # neither hopeless nor trivial


def test_members_are_unknown_as_often_as_the_level_says():
    rng, size, level = np.random.default_rng(12), 4000, 0.05
    (only,) = CLASSES[:1]
    _, x = draw(rng, [only], size)
    unknown = np.mean([classify(p, NOISE, [only], level).name == UNKNOWN for p in x])
    assert unknown == pytest.approx(level, abs=4 * np.sqrt(level * (1 - level) / size))


def test_what_is_none_of_the_classes_is_unknown():
    call = classify([247.0, 0.030], NOISE, CLASSES, 1e-6)
    assert call.name == UNKNOWN
    assert np.isnan(call.probability)
    assert "farther from" in call.reason
    none = classify([np.nan, np.nan], NOISE, CLASSES)
    assert none.name == UNKNOWN
    assert np.isnan(none.probability)
    assert none.reason == "no pole with a covariance"


def test_noise_makes_calls_less_sure_never_surer_of_the_wrong():
    x = CLASSES[0].mean
    certain = [posteriors(x, NOISE * s, CLASSES)[0][0] for s in (1, 100, 10_000)]
    assert certain[0] > certain[1] > certain[2]


def test_a_class_from_few_samples_predicts_its_next_member():
    """The tail probability of the next member is uniform: Geisser's predictive distribution is exact."""
    rng, n, runs = np.random.default_rng(13), 6, 3000
    spread = CLASSES[0].spread
    tails = []
    for _ in range(runs):
        x = rng.multivariate_normal([250.0, 0.03], spread, n + 1)
        learnt = class_from_samples("a", x[:-1])
        tails.append(posteriors(x[-1], np.zeros((2, 2)), [learnt])[1][0])
    for level in (0.01, 0.05, 0.2, 0.5):
        share = np.mean(np.array(tails) < level)
        assert share == pytest.approx(level, abs=4 * np.sqrt(level * (1 - level) / runs))


@pytest.mark.parametrize(
    "points",
    [
        [[250.0, 0.03]] * 4,  # one point four times
        [[249.7, 0.03], [250.1, 0.03], [250.4, 0.03], [249.9, 0.03]],  # rounded
        [[249.7, 0.029], [250.1, 0.031], [249.7, 0.029], [250.1, 0.031]],  # two points, each twice
        np.array([250.0, 0.03]) + np.outer([-0.3, 0.1, 0.4, 0.7, 0.2], [1.0, 2.5e-3]),
    ],
)
def test_points_that_show_no_spread_are_no_class(points):
    with pytest.raises(ValueError, match="points: got .* accepted is points that scatter"):
        class_from_samples("a", points)


def test_gaussian_density_of_student_with_many_degrees():
    wide = tissue("a", 250.0, 0.03)
    student = TissueClass("b", wide.mean, wide.spread, degrees_of_freedom=1e7)
    probability, _ = posteriors(np.array([250.5, 0.0309]), NOISE, [wide, student])
    assert probability[0] == pytest.approx(0.5, abs=1e-5)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"name": UNKNOWN}, "name: got 'unknown'"),
        ({"prior": 0.0}, "prior: got 0"),
    ],
)
def test_wrong_classes_are_refused(values, reason):
    given = {"name": "a", "mean": np.array([250.0, 0.03]), "spread": np.eye(2), **values}
    with pytest.raises(ValueError, match=reason):
        TissueClass(**given)


def test_wrong_fields_of_classes_are_refused():
    fields = {"f0_hz": 250, "damping_ratio": 0.03, "f0_std_hz": 1, "damping_ratio_std": 1}
    with pytest.raises(ValueError, match=r"classes.a.correlation: got 2.0; accepted is -1 to 1"):
        parse_classes({"a": {**fields, "correlation": 2.0}}, "classes")
    with pytest.raises(ValueError, match="classes.a.points: .*n at least 4"):
        parse_classes({"a": {"points": [[250, 0.03]]}}, "classes")
