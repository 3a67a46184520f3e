# SPDX-License-Identifier: Apache-2.0
"""Noise that start values show badly: far louder at the input, the same in both channels, peaked."""

from functools import cached_property

import numpy as np
import pytest
from scipy import stats

from benchmarks.poles_plant import (
    BAND_HZ,
    HARMONICS,
    SAMPLE_RATE_HZ,
    SAMPLES_PER_PERIOD,
    Plant,
    judge,
)
from tactile_resonance.poles.joint import JointPlan
from tactile_resonance.poles.noise_level import chance_of_pieces
from tactile_resonance.poles.result import PolesStatus
from tactile_resonance.poles.structure import ModelStructure

RUNS = 2000


class LoudInput(Plant):
    """Noise of the input 40 dB above that of the output [V^2]."""

    @cached_property
    def noise(self):
        return super().noise[0], 1e4 * super().noise[0]


def fits(plant, u, y):
    plan = JointPlan(
        *(SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, plant.periods, HARMONICS, BAND_HZ),
        ModelStructure(2, 2),
    )
    return plan.from_bins(u, y)


def assert_honest(result, lowest, bound=None):
    """Coverage of the ellipse, alarms, and where a bound is known the distance to it."""
    errors = np.stack([result.f0_hz[:, 0] - 250, result.damping_ratio[:, 0] - 0.02], -1)
    ratio, coverage = judge(errors, result.covariance[:, 0], np.eye(2) if bound is None else bound)
    assert stats.binom.cdf(coverage * RUNS, RUNS, lowest) > 0.0005
    assert stats.binom.sf(coverage * RUNS - 1, RUNS, 0.97) > 0.0005
    if bound is not None:
        assert np.all(ratio * RUNS / stats.chi2.ppf(0.9995, RUNS) <= 1.10)
    alarms = result.has_status(PolesStatus.MODEL_ERROR).sum()
    assert stats.binom.sf(alarms - 1, RUNS, 1e-2) > 0.0005


def circular(rng, size, variance):
    return np.sqrt(variance / 2) * rng.standard_normal((RUNS, size, 2)).view(complex)[..., 0]


@pytest.mark.parametrize("periods", [2, 8])
def test_input_noise_far_above_that_of_the_output(periods):
    plant = LoudInput(0.02, 60.0, periods)
    u, y = plant.noisy(np.random.default_rng(1), RUNS, plant.bins())
    assert_honest(fits(plant, u, y), 0.94, plant.bound())


@pytest.mark.parametrize("periods", [2, 8])
def test_nine_tenths_of_both_noises_are_one(periods):
    """The input's ten times as large [V]."""
    plant = Plant(0.02, 40.0, periods)
    bins, rng = plant.bins(), np.random.default_rng(2)
    size, variance = bins.size, plant.noise[0]
    both = circular(rng, size, variance)
    y = plant.output(bins) + 0.9 * both + np.sqrt(0.19) * circular(rng, size, variance)
    assert_honest(fits(plant, plant.input(bins) + 10 * both, y), 0.93)


@pytest.mark.parametrize("at_output", ["response", 2.0, -2.0, 2j, -2j])
def test_disturbances_seen_at_the_input_are_no_noise_of_the_output(at_output):
    """40 dB above the output's own: what U shows of them between harmonics is taken from Y.

    What is left to tell the transient and the noise level by is the output's own noise. Of a generator
    they are an input like any other; alike in both channels, whatever the gain and its phase, they stay in
    the lines that are excited, as noise of both.
    """
    plant = Plant(0.02, 60.0, 8)
    bins, rng = plant.bins(), np.random.default_rng(5)
    variance_y = plant.noise[0]
    s, w0 = 2j * np.pi * bins * SAMPLE_RATE_HZ / SAMPLES_PER_PERIOD / 8, 2 * np.pi * 250
    g = 0.1 + 0.04 * w0**2 / (s**2 + 0.04 * w0 * s + w0**2)
    disturbance = circular(rng, bins.size, 1e4 * variance_y)
    generator = at_output == "response"
    gain = g if generator else at_output
    y = plant.output(bins) + gain * disturbance + circular(rng, bins.size, variance_y)
    result = fits(plant, plant.input(bins) + disturbance, y)
    jacobian, _ = plant.derivatives()
    excited = bins % 8 == 0
    variance = variance_y * (1 + 1e4 * excited * np.abs(gain - g) ** 2)
    information = 2 * np.real((jacobian.conj().T / variance) @ jacobian)
    assert_honest(result, 0.94, np.linalg.inv(information)[:2, :2])
    assert np.mean(result.variance_model == "flat") > 0.98
    assert np.median(result.noise_variance[:, 0]) == pytest.approx(variance_y, rel=0.02)
    assert result.cost.mean() == pytest.approx(result.expected_cost.mean(), rel=0.08)
    at_input = 0.0 if generator else 1e4 * variance_y
    assert np.median(result.noise_variance[:, 1]) == pytest.approx(at_input, rel=0.1)


@pytest.mark.parametrize("periods", [3, 8])
def test_noise_with_a_peak_at_the_resonance(periods):
    plant = Plant(0.02, 40.0, periods)
    bins, rng = plant.bins(), np.random.default_rng(3)
    peak = 1 + 30 * np.exp(-((np.linspace(-5, 5, bins.size)) ** 2))
    y = plant.output(bins) + circular(rng, bins.size, plant.noise[0] * peak)
    u = plant.input(bins) + circular(rng, bins.size, plant.noise[1])
    result = fits(plant, u, y)
    by_piece = result.variance_model == "per line"
    assert np.mean(by_piece) > 0.9
    assert_honest(result, 0.93)
    # levels of eight bins each: by F(2, 16)
    cost = result.cost[by_piece].mean()
    assert cost == pytest.approx(result.expected_cost[by_piece].mean(), rel=0.04)


@pytest.mark.parametrize("periods", [2, 3])
def test_noise_through_a_mode_narrower_than_the_pieces_of_the_band(periods):
    """As of vibration: of a mean over the bins of a piece ellipses held the mode in 82 to 84 %."""
    plant = Plant(0.01, 40.0, periods)
    bins, rng = plant.bins(), np.random.default_rng(7)
    s, w0 = 2j * np.pi * bins * SAMPLE_RATE_HZ / SAMPLES_PER_PERIOD / periods, 2 * np.pi * 250
    through = 0.01 + np.abs(0.02 * w0**2 / (s**2 + 0.02 * w0 * s + w0**2)) ** 2
    y = plant.output(bins) + circular(rng, bins.size, 10 * plant.noise[0] * through)
    result = fits(plant, plant.input(bins), y)
    errors = np.stack([result.f0_hz[:, 0] - 250, result.damping_ratio[:, 0] - 0.01], -1)
    coverage = judge(errors, result.covariance[:, 0], np.eye(2))[1]
    assert stats.binom.cdf(coverage * RUNS, RUNS, 0.925) > 0.0005
    # lines of a piece share the error of its variance: taken for independent they were an error in 1.8 to 3 %
    by_piece = result.variance_model == "per line"
    alarms = np.sum(result.has_status(PolesStatus.MODEL_ERROR) & by_piece)
    assert stats.binom.sf(alarms - 1, by_piece.sum(), 4e-3) > 0.0005


def test_a_level_from_few_lines_widens_the_ellipse():
    """One period, nine lines: a level of 5.5 complex degrees of freedom; ignored it costs 3 % of coverage."""
    plant, band_hz, runs = Plant(0.02, 40.0, 1), (240.0, 260.0), 4000
    variance_y, variance_u = plant.noise
    plan = JointPlan(
        *(SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, 1, HARMONICS, band_hz),
        ModelStructure(2, 2),
        input_noise_ratio=variance_u / variance_y,
    )
    result = plan.from_bins(*plant.noisy(np.random.default_rng(4), runs, plan.bins))
    errors = np.stack([result.f0_hz[:, 0] - 250, result.damping_ratio[:, 0] - 0.02], -1)
    coverage = judge(errors, result.covariance[:, 0], np.eye(2))[1]
    # of a Student distribution of that variance: 0.9395
    assert stats.binom.cdf(coverage * runs, runs, 0.9395) > 0.0005
    assert stats.binom.sf(coverage * runs - 1, runs, 0.9395) > 0.0005


def test_levels_from_few_bins_are_unbiased():
    """Two periods, nine lines and eight bins between: what parameters take of either is no small part."""
    plant, band_hz, runs = Plant(0.02, 60.0, 2), (240.0, 260.0), 6000
    plan = JointPlan(
        *(SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, 2, HARMONICS, band_hz), ModelStructure(2, 2)
    )
    result = plan.from_bins(*plant.noisy(np.random.default_rng(6), runs, plan.bins))
    level = result.noise_variance[:, 0] / plant.noise[0]
    assert level.mean() == pytest.approx(1, abs=4 * level.std() / np.sqrt(runs))
    # residuals of both kinds share a transient, so that their costs are not quite independent
    assert result.cost.mean() == pytest.approx(result.expected_cost.mean(), rel=0.1)
    errors = np.stack([result.f0_hz[:, 0] - 250, result.damping_ratio[:, 0] - 0.02], -1)
    squared = errors**2 / np.diagonal(result.covariance[:, 0], axis1=-2, axis2=-1)
    assert squared.mean() == pytest.approx(1, abs=4 * np.sqrt(2.5 / squared.size))


@pytest.mark.parametrize(("size", "dof"), [(1, 4), (1, 10), (8, 8)])
def test_limit_of_costs_over_variances_of_few_degrees_of_freedom(size, dof):
    """40 lines, in pieces that share a variance: a normal limit of single ones .5 to 3 % exceeded."""
    rng, runs = np.random.default_rng(8), 20000
    power = rng.gamma(size, 1.0, (runs, 40 // size))
    cost = np.sum(power / rng.gamma(dof, 1 / dof, power.shape), axis=1)
    beyond = np.sum(chance_of_pieces(cost / (40 * dof / (dof - 1)), 40, size, dof) < 1e-3)
    assert stats.binom.sf(beyond - 1, runs, 5e-3) > 0.0005
    assert stats.binom.cdf(beyond, runs, 5e-4) > 0.0005
