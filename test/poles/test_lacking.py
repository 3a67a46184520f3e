# SPDX-License-Identifier: Apache-2.0
"""What a model lacks is told where neither cost nor smoothness of the residuals shows it."""

import numpy as np
import pytest
from scipy import stats

from benchmarks.poles_plant import (
    BAND_HZ,
    HARMONICS,
    SAMPLE_RATE_HZ,
    SAMPLES_PER_PERIOD,
    Plant,
)
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.joint import JointPlan
from tactile_resonance.poles.judgement import single
from tactile_resonance.poles.lacking import lacking_terms
from tactile_resonance.poles.likelihood import invert, moments
from tactile_resonance.poles.result import PolesStatus
from tactile_resonance.poles.structure import ModelStructure

BARE = ModelStructure(2, 2)


def plan_for(plant, structure=None, kind=JointPlan):
    return kind(
        *(SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, plant.periods, HARMONICS, BAND_HZ),
        structure or ModelStructure(),
        input_noise_ratio=0.01 if plant.periods == 1 else None,
    )


def with_mode(plant, runs, f0_hz, damping_ratio, size):
    """Bins of the plant and a mode more, settled, of so many times the peak of the first one."""
    bins = plant.bins()
    s = 2j * np.pi * bins * SAMPLE_RATE_HZ / SAMPLES_PER_PERIOD / plant.periods
    w, width = 2 * np.pi * f0_hz, 2 * damping_ratio
    u, y = plant.noisy(np.random.default_rng(3), runs, bins)
    return u, y + size * width * w**2 / (s**2 + width * w * s + w**2) * plant.input(bins)


def errors(result, truths):
    """(runs,) Mahalanobis distance from the nearest truth by the total covariance, else that of noise."""
    total, noise = result.total_covariance[:, 0], result.covariance[:, 0]
    covariance = np.where(np.isfinite(total), total, noise)
    estimate = np.stack([result.f0_hz[:, 0], result.damping_ratio[:, 0]], -1)
    off = estimate - np.array(truths)[:, None]  # (truths, runs, 2)
    solved = np.linalg.solve(covariance, off[..., None])[..., 0]
    return np.sqrt(np.sum(off * solved, axis=-1)).min(axis=0)


def test_a_neighbour_of_a_third_the_size_is_told_and_named():
    """4 Hz away, within the width of 10 Hz: its cost alone shows it in one record of ten."""
    plant = Plant(0.02, 14.0, 2)
    u, y = with_mode(plant, 100, 254.0, 0.02, 0.33)
    plan = plan_for(plant)
    parts = [plan.from_bins(u[k], y[k]) for k in range(100)]
    told = [part for part in parts if part.status() is PolesStatus.MODEL_ERROR]
    assert len(told) > 85
    named = [single(part).message for part in told]
    assert np.mean(["one mode more near 25" in message for message in named]) > 0.9
    assert all("for 4 parameters" in message for message in named)
    # the same in a batch, for those whose cost is above its expectation
    batch = plan.from_bins(u, y)
    assert batch.has_status(PolesStatus.MODEL_ERROR).mean() > 0.4
    told = batch.has_status(PolesStatus.MODEL_ERROR)
    truths = [(250, 0.02), (254, 0.02)]
    assert np.mean(errors(batch, truths)[told] < 2.45) > 0.75
    assert np.mean(errors(batch, truths)[~told] > 10) > 0.9


def test_a_strong_mode_beyond_the_band_is_told():
    """Ten times as strong at 320 Hz: half of the poles are three deviations off, or more."""
    plant = Plant(0.02, 10.0, 2)
    u, y = with_mode(plant, 200, 320.0, 0.01, 10.0)
    result = plan_for(plant).from_bins(u, y)
    told = result.has_status(PolesStatus.MODEL_ERROR)
    assert told.mean() > 0.7
    assert np.mean(errors(result, [(250, 0.02)])[told] < 2.45) > 0.9
    # of residual terms no frequency is named
    terms = result.lacking[:, 1] == 2
    assert terms.any()
    assert np.isnan(result.lacking[terms, 2]).all()
    k = int(np.flatnonzero(terms)[0])
    assert "two residual terms more fit better" in single(result, (k,)).message


def test_one_period_lacks_residual_terms():
    """No level is known, and the residuals are not yet smooth enough to be told by that."""
    plant = Plant(0.02, 40.0, 1)
    bins = plant.bins()
    u, y = with_mode(plant, 100, 330.0, 0.01, 1.0)
    clean = plant.noisy(np.random.default_rng(3), 100, bins)[1]
    error = (y - clean) * 5 * np.sqrt(plant.noise[0]) / np.abs(y - clean).max()
    plan = plan_for(plant, BARE)
    told = [
        plan.from_bins(u[k], clean[k] + error[k]).status() is PolesStatus.MODEL_ERROR
        for k in range(100)
    ]
    richer = plan_for(plant).from_bins(u, clean + error).has_status(PolesStatus.MODEL_ERROR)
    assert np.mean(told) > 0.9
    assert richer.mean() < 0.02


@pytest.mark.parametrize("structure", [BARE, ModelStructure()], ids=["bare", "default"])
@pytest.mark.parametrize(
    "cell", [(0.02, 40.0, 1), (0.005, 10.0, 2), (0.1, 40.0, 8)], ids=["one", "two", "eight"]
)
def test_a_complete_model_lacks_nothing(cell, structure):
    """Of all points, not only those of a batch that are asked: two tests of 2 in 10 000 each."""
    runs, plant = 4000, Plant(*cell)
    bins = plant.bins()
    u, y = plant.noisy(np.random.default_rng(7), runs, bins)
    plan = plan_for(plant, structure)
    fit = plan.from_bins(u, y)
    theta = [fit.fit.denominator[:, :-1], fit.fit.numerator, fit.fit.transient]
    variance_y, variance_u = (np.ascontiguousarray(v) for v in np.split(fit.noise_variance, 2, 1))
    data = BinData.of(
        y[:, None],
        u[:, None],
        plan.order,
        plan.other_bins.size,
        rest=variance_y,
        variance_y=variance_y,
        variance_u=variance_u,
    )
    theta = np.concatenate(theta, axis=1)
    cost, _, normal = moments(plan.problem.tables, data, theta[:, None])
    inverse, _ = invert(normal[:, 0].sum(axis=1))
    lacking = lacking_terms(plan, data, theta, inverse, cost.sum(axis=1))
    alarms = np.isfinite(lacking[:, 0]).sum()
    assert stats.binom.sf(alarms - 1, runs, 4e-4) > 0.0005
