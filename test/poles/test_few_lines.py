# SPDX-License-Identifier: Apache-2.0
"""Lines just enough, and fewer: a status with its reason, or a `ValueError` that names the field."""

import warnings

import numpy as np
import pytest
from poles.mode_at_250_hz import circular
from scipy import stats

from benchmarks.poles_plant import HARMONICS, SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, Plant, judge
from tactile_resonance.frf.result import FRF
from tactile_resonance.poles.identify import identify_batch
from tactile_resonance.poles.joint import JointPlan, PoleEstimator
from tactile_resonance.poles.result import PolesStatus, single
from tactile_resonance.poles.structure import ModelStructure

STRUCTURES = [ModelStructure(), ModelStructure(2, 2), ModelStructure(1, 1), ModelStructure(4, 9)]


def plan_on(plan, lines, periods, structure, ratio):
    """Of a band with so many lines around 250 Hz."""
    low_hz = 250 - 2.5 * (lines // 2) - 0.1
    band_hz = (low_hz, low_hz + 2.5 * (lines - 1) + 0.2)
    ratio = ratio if periods == 1 else None
    kind = (SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, periods, HARMONICS, band_hz, structure)
    return plan(*kind, input_noise_ratio=ratio)


def records_of(plan, periods, realisations):
    """u, y (realisations, K)."""
    rng = np.random.default_rng(1)
    plants = [Plant(0.02, 40.0, periods, seed) for seed in range(1, realisations + 1)]
    noisy = [plant.noisy(rng, 1, plan.bins) for plant in plants]
    return (np.concatenate(channel) for channel in zip(*noisy, strict=True))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("ratio", [None, 0.01])
@pytest.mark.parametrize("structure", STRUCTURES, ids=lambda s: f"{s.numerator_order}/{s.order}")
@pytest.mark.parametrize("periods", [1, 2])
def test_every_count_of_lines_has_an_answer(periods, structure, ratio):
    answered = 0
    for lines in (1, 3, 5, 7, 9, 13):
        for plan, realisations in (
            (JointPlan, 1),
            (PoleEstimator, 1),
            (PoleEstimator, 2),
            (PoleEstimator, 3),
        ):
            try:
                made = plan_on(plan, lines, periods, structure, ratio)
            except ValueError as error:
                assert str(error).startswith("band_hz: ")  # noqa: PT017
                continue
            u, y = records_of(made, periods, realisations)
            if plan is not PoleEstimator:
                # one and a batch
                assert made.from_bins(np.tile(u, (6, 1)), np.tile(y, (6, 1))).shape == (6,)
                u, y = u[0], y[0]
            poles = single(made.from_bins(u, y))
            assert poles.status is PolesStatus.OK or poles.message
            if poles.status is PolesStatus.OK:
                assert np.isfinite(poles.covariance).all()
            answered += 1
    assert answered > 0


def test_one_degree_of_freedom_tells_no_noise():
    """Nine lines of one period: eighteen real equations, ten coefficients and six of the transient."""
    plan = plan_on(JointPlan, 9, 1, ModelStructure(), 0)
    u, y = records_of(plan, 1, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        poles = single(plan.from_bins(u[0], y[0]))
    assert poles.status is PolesStatus.NO_COVARIANCE
    assert "too few degrees of freedom" in poles.message
    assert poles.covariance is None
    assert poles.total_covariance is None


@pytest.mark.parametrize("lines", [7, 8, 12])
def test_few_lines_of_an_frf_without_variance_have_the_deviations_of_student(lines):
    """95 % ellipses held the mode in 83, 87 and 92 % without the factor."""
    f = np.linspace(230, 270, lines)
    s, w0 = 2j * np.pi * f, 2 * np.pi * 250
    g = 0.04 * w0**2 / (s**2 + 0.04 * w0 * s + w0**2)
    noise = circular(np.random.default_rng(2), (4000, lines), 1e-6)
    batch = identify_batch(FRF(f, g + noise))
    errors = np.stack([batch.f0_hz[:, 0] - 250, batch.damping_ratio[:, 0] - 0.02], axis=-1)
    coverage = judge(errors, batch.total_covariance[:, 0], np.eye(2))[1]
    assert stats.binom.cdf(coverage * 4000, 4000, 0.935) > 0.0005
