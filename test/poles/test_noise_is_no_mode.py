# SPDX-License-Identifier: Apache-2.0
"""Modes that noise alone could have made: a batch tells them as its points do."""

import numpy as np
import pytest
from poles.mode_at_250_hz import (
    BARE,
    HARMONICS,
    LINES_HZ,
    PERIODS,
    RATE_HZ,
    SAMPLES,
    G,
    circular,
    frf,
    record,
)
from scipy import stats

from tactile_resonance.frf.result import FRF
from tactile_resonance.poles.identify import identify_batch
from tactile_resonance.poles.joint import JointPlan
from tactile_resonance.poles.result import PolesStatus, single
from tactile_resonance.poles.significance import squared_distance
from tactile_resonance.poles.structure import ModelStructure

RUNS = 400


def from_frfs(size, variance):
    """FRFs with so much of the mode, and the constant beside it."""
    rng = np.random.default_rng(1)
    noisy = 0.1 + size * (G - 0.1) + circular(rng, (RUNS, LINES_HZ.size), variance)
    return identify_batch(
        frf(g=noisy, variance_noise=np.full(LINES_HZ.size, variance)), structure=BARE
    )


def from_noise(plan_of, structure):
    """Records whose output is noise and nothing else."""
    plan = plan_of(RATE_HZ, SAMPLES, PERIODS, HARMONICS, (200, 300), structure)
    rng = np.random.default_rng(2)
    u, _ = plan.transform(*record(noise=0.0))
    variance = 1e-6 / (SAMPLES * PERIODS)
    noise = circular(rng, (2, RUNS, u.size), variance)
    return plan.from_bins(u + noise[0], noise[1])


def test_frfs_without_a_mode_have_none():
    result = from_frfs(0.0, 1e-4)
    told = result.has_status(PolesStatus.OK) | result.has_status(PolesStatus.MODEL_ERROR)
    assert stats.binom.sf(told.sum() - 1, RUNS, 1e-3) > 1e-3
    assert (
        result.significant == np.isfinite(result.poles_rad_s)
    ).mean() < 0.5  # some fits found one


@pytest.mark.parametrize("order", [2, 4])
@pytest.mark.parametrize("every", [1, 3])
def test_frfs_whose_variance_is_not_known_have_none_either(order, every):
    """The level is that of the residuals, of as few as 14 lines."""
    rng, lines_hz = np.random.default_rng(3), LINES_HZ[::every]
    noise = circular(rng, (RUNS, lines_hz.size), 1e-2)
    kind = ModelStructure(order, order + 2)
    told = identify_batch(FRF(lines_hz, 1 + noise), structure=kind).has_status(PolesStatus.NO_RESONANCE)
    assert stats.binom.sf((~told).sum() - 1, RUNS, 0.01) > 1e-3  # of some no minimum is found
    there = identify_batch(FRF(lines_hz, G[::every] + noise), structure=BARE)
    assert there.has_status(PolesStatus.NO_COVARIANCE).mean() > 0.98


def test_a_level_from_few_residuals_is_not_taken_for_known():
    """Seven lines, eleven coefficients: residues are F distributed; by chi-squared 4.3 % of fits had a mode."""
    runs, lines_hz = 6000, np.linspace(200, 300, 7)
    g = 1 + circular(np.random.default_rng(4), (runs, 7), 1e-2)
    told = identify_batch(FRF(lines_hz, g), structure=ModelStructure(4, 6)).has_status(PolesStatus.NO_RESONANCE)
    assert stats.binom.sf((~told).sum() - 1, runs, 0.033) > 1e-3


@pytest.mark.parametrize("structure", [BARE, ModelStructure()], ids=["bare", "default"])
def test_records_of_noise_have_none(structure):
    result = from_noise(JointPlan, structure)
    told = result.has_status(PolesStatus.OK) | result.has_status(PolesStatus.MODEL_ERROR)
    assert stats.binom.sf(told.sum() - 1, RUNS, 1e-3) > 1e-3


@pytest.mark.parametrize("peak_over_noise", [1.0, 3.0, 30.0])
def test_a_batch_says_what_its_points_say(peak_over_noise):
    result = from_frfs(1.0, (1 / peak_over_noise) ** 2)
    for k in range(RUNS):
        poles = single(result, (k,))
        assert poles.status is result.status(k)
        assert poles.f0_hz.size == result.significant[k].sum()


@pytest.mark.parametrize("variance", [0.1, 1e-3])
def test_a_mode_that_is_there_is_kept(variance):
    """Down to noise on each line of a third of the mode's height."""
    assert from_frfs(1.0, variance).significant.mean() > 0.99


@pytest.mark.parametrize("correlation", [0.0, 0.9, -0.99])
def test_residues_of_noise_are_as_far_from_zero_as_chi_square_says(correlation):
    std = np.array([1e-9, 1e-7])
    covariance = np.array([[1, correlation], [correlation, 1]]) * std * std[:, None]
    rng = np.random.default_rng(4)
    drawn = rng.standard_normal((5000, 2)) @ np.linalg.cholesky(covariance).T
    distance = squared_distance(drawn[:, 0] + 1j * drawn[:, 1], covariance)
    assert stats.kstest(distance, stats.chi2(2).cdf).pvalue > 1e-3


@pytest.mark.parametrize("variance", [1.0, 0.5])
def test_poles_that_noise_moves_out_of_their_ellipses_are_not_said_to_be_ok(variance):
    """The linearised ellipses of 250 Hz hold half to two thirds of these, and miss by up to 80 deviations."""
    result = from_frfs(1.0, variance)
    stable = result.damping_ratio[:, 0] > 0
    errors = np.stack([result.f0_hz - 250, result.damping_ratio - 0.02], -1)[stable, 0]
    solved = np.linalg.solve(result.covariance[stable, 0], errors[..., None])[..., 0]
    assert np.mean(np.sum(errors * solved, axis=-1) < -2 * np.log(0.05)) < 0.8
    assert result.has_status(PolesStatus.OK).mean() < 0.05
