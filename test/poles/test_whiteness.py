# SPDX-License-Identifier: Apache-2.0
"""The score of smooth residuals: its chance under noise, what moves it and what must not."""

import numpy as np
import pytest
from scipy import stats

from tactile_resonance.poles.whiteness import SMOOTH_RESIDUAL, are_smooth, whiteness

RUNS = 20000


def noise(rng, lines, runs=RUNS):
    return rng.standard_normal((runs, lines, 2)).view(complex)[..., 0]


@pytest.mark.parametrize("lines", [5, 41, 300])
@pytest.mark.parametrize("left_out", [0, 0.2])
def test_noise_exceeds_a_score_no_more_often_than_a_normal_variable(lines, left_out):
    rng = np.random.default_rng(lines)
    residual = noise(rng, lines)
    residual[:, rng.random(lines) < left_out] = 0
    score = whiteness(residual, 5)
    for limit in (stats.norm.isf(0.05), SMOOTH_RESIDUAL):
        beyond = np.sum(score > limit)
        assert stats.binom.sf(beyond - 1, RUNS, stats.norm.sf(limit)) > 0.0005
    # nor is the test asleep: levels share their coefficients, no more than that makes it rarer
    if not left_out:
        assert np.mean(score > stats.norm.isf(0.05)) > 0.02


def test_score_does_not_depend_on_level_or_phase():
    residual = noise(np.random.default_rng(1), 60, 50)
    changed = residual * (1e-100 * np.exp(1j))
    assert whiteness(changed, 7) == pytest.approx(whiteness(residual, 7), abs=1e-9)


@pytest.mark.parametrize(("waves", "share"), [(2, 0.08), (10, 0.1), (40, 0.25)])
def test_a_smooth_part_far_below_the_noise_is_seen(waves, share):
    """The smoother, the smaller; alternating from line to line it is the contrary of smooth."""
    line = np.arange(500)
    smooth = np.sqrt(2 * share) * np.exp(2j * np.pi * waves * line / 500)
    residual = noise(np.random.default_rng(2), 500, 200)
    assert np.mean(whiteness(residual + smooth, 5) > SMOOTH_RESIDUAL) > 0.95
    assert np.mean(whiteness(residual + smooth * (-1) ** line, 5) > 2) < 0.05


@pytest.mark.parametrize("lines", [5, 41, 300])
def test_limit_of_the_best_level_is_that_of_the_score(lines):
    rng = np.random.default_rng(lines)
    residual = noise(rng, lines, 4000) + 2 * rng.random((4000, 1))
    smooth = are_smooth(residual, 5)
    assert 0 < smooth.sum() < 4000
    np.testing.assert_array_equal(smooth, whiteness(residual, 5) > SMOOTH_RESIDUAL)


def test_fewer_than_three_lines_tell_nothing():
    assert np.isnan(whiteness(np.ones((4, 2), complex), 1)).all()
    assert not are_smooth(np.ones((4, 2), complex), 1).any()
