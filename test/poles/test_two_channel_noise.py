# SPDX-License-Identifier: Apache-2.0
"""Noise on both channels makes the variance of a response largest at the resonance."""

import numpy as np
import pytest
from scipy import stats

from benchmarks.poles import MARGIN_HZ
from benchmarks.poles_methods import local_polynomial_spectra
from benchmarks.poles_plant import BAND_HZ, Plant
from tactile_resonance.frf.result import FRF
from tactile_resonance.frf.spectra import error_variance, power, ratio
from tactile_resonance.poles.identify import identify_batch
from tactile_resonance.poles.noise_level import model_variance
from tactile_resonance.poles.result import PolesStatus
from tactile_resonance.poles.structure import ModelStructure

LINES_HZ = np.arange(200.0, 300.1, 2.5)
S = 2j * np.pi * LINES_HZ
W0 = 2 * np.pi * 250


def response(damping):
    return 0.1 + (2 * damping * W0 * S + 0.2 * W0**2 * damping) / (
        S**2 + 2 * damping * W0 * S + W0**2
    )


def realisations(rng, runs, count, damping):
    """Mean FRF over realisations and its sample variance: noise of U weighs |G|^2 times Y's."""
    g = response(damping)
    std = 1e-3 * np.sqrt(0.02 + np.abs(g) ** 2)
    noise = rng.standard_normal((runs, count, g.size, 2)).view(complex)[..., 0] / np.sqrt(2)
    each = g + std * noise
    return FRF(
        LINES_HZ,
        each.mean(axis=1),
        variance_total=np.var(each, axis=1, ddof=1) / count,
        total_dof=count - 1,
        realisations=count,
    )


@pytest.mark.parametrize("count", [2, 3, 4, 7])
@pytest.mark.parametrize("structure", [ModelStructure(2, 2), ModelStructure()])
def test_ellipses_of_few_realisations_hold_the_truth(count, structure):
    runs, damping = 3000, 0.02
    rng = np.random.default_rng(count)
    result = identify_batch(realisations(rng, runs, count, damping), structure=structure)
    errors = np.stack([result.f0_hz[:, 0] - 250, result.damping_ratio[:, 0] - damping], -1)
    solved = np.linalg.solve(result.total_covariance[:, 0], errors[..., None])[..., 0]
    inside = np.sum(np.sum(errors * solved, -1) < -2 * np.log(0.05))
    assert stats.binom.cdf(inside, runs, 0.93 if count == 2 else 0.94) > 0.0005
    assert stats.binom.sf(inside - 1, runs, 0.96) > 0.0005


def test_levels_of_both_channels_are_found():
    rng = np.random.default_rng(0)
    gain = np.abs(response(0.02)) ** 2
    for a, b in ((1.0, 0.0), (0.0, 3.0), (0.3, 2.0)):
        truth = a + b * gain
        sample = truth * rng.gamma(4, 1 / 4, (2000, gain.size))
        model = model_variance(sample, 4, np.broadcast_to(gain, sample.shape))
        assert np.mean(model.kind > 0) < 0.005  # a test at 1e-4
        bias = np.median(model.variance / truth, axis=0)
        assert np.all(np.abs(bias - 1) < 0.1)


def test_other_shapes_are_still_seen():
    rng = np.random.default_rng(1)
    gain = np.broadcast_to(np.abs(response(0.02)) ** 2, (200, 41))
    steps = np.where(np.arange(41) % 2, 1.0, 30.0)
    kinds = [
        model_variance(shape * rng.gamma(7, 1 / 7, (200, 41)), 7, gain).kind
        for shape in (np.exp(np.linspace(0, 4, 41)), steps)
    ]
    assert np.all(kinds[0] == 1)
    assert np.all(kinds[1] == 2)


def test_two_periods_raise_no_more_alarms_than_stated():
    """Lines share the bins between them: ten of a pattern, but one new one a line."""
    plant, runs = Plant(0.1, 20.0, 2), 1000
    wide = plant.bins(BAND_HZ[0] - MARGIN_HZ, BAND_HZ[1] + MARGIN_HZ)
    u, y = plant.noisy(np.random.default_rng(3), runs, wide)
    lines_hz, spectra, covariance, dof = local_polynomial_spectra(plant, u, y, wide)
    frf = FRF(
        lines_hz,
        ratio(spectra),
        variance_noise=error_variance(ratio(spectra), covariance) / power(spectra[:, 1]),
        noise_dof=dof,
        periods=2,
    )
    result = identify_batch(frf, structure=ModelStructure(2, 2))
    alarms = result.has_status(PolesStatus.MODEL_ERROR).sum()
    assert stats.binom.sf(alarms - 1, runs, 3e-3) > 0.0005
