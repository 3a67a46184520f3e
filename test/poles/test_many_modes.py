# SPDX-License-Identifier: Apache-2.0
"""Models of many modes: noise does not take the place of a mode that is there."""

import numpy as np
import pytest

from tactile_resonance.frf.result import FRF
from tactile_resonance.poles.identify import identify_batch
from tactile_resonance.poles.result import PolesStatus
from tactile_resonance.poles.structure import ModelStructure

RUNS = 6
DAMPING_RATIO = 0.02
DOF = 14  # of the sample variance of each line


@pytest.mark.parametrize(
    ("f0_hz", "lines_hz"),
    [
        (100 + 20.0 * np.arange(10), np.linspace(80, 300, 480)),
        (10 * 10 ** (np.arange(10) / 3), np.geomspace(5, 2e4, 480)),
    ],
    ids=["side by side", "over decades"],
)
def test_each_of_ten_modes_is_found_in_noise(f0_hz, lines_hz):
    """At 10 dB: Sanathanan-Koerner iterations alone miss one to six of the ten in nine of ten records."""
    poles = identify_batch(responses(f0_hz, lines_hz, 10.0, seed=5), None, ModelStructure(20, 20))
    assert poles.has_status(PolesStatus.OK).all()
    assert poles.significant.all()
    std = np.sqrt(np.diagonal(poles.covariance, axis1=-2, axis2=-1))  # (RUNS, 10, 2)
    truth = np.stack([f0_hz, np.full(10, DAMPING_RATIO)], axis=-1)
    deviation = (np.stack([poles.f0_hz, poles.damping_ratio], axis=-1) - truth) / std
    assert np.abs(deviation).max() < 5
    assert np.sqrt(np.mean(deviation**2)) == pytest.approx(1, abs=0.25)


def test_what_noise_hides_is_no_mode():
    """Of eight modes at 0 dB: next to none is seen, and those are where there is one."""
    f0_hz = 100 + 20.0 * np.arange(8)
    frf = responses(f0_hz, np.linspace(80, 260, 384), 0.0, seed=208, runs=12)
    poles = identify_batch(frf, None, ModelStructure(16, 16))
    assert poles.has_status(PolesStatus.NO_RESONANCE).sum() > 10
    away_hz = np.abs(poles.f0_hz[poles.significant][:, None] - f0_hz).min(axis=-1)
    assert (away_hz < 5).all()


def responses(f0_hz, lines_hz, snr_db, seed, runs=RUNS):
    """Of modes of equal height, with noise of that rms beside theirs."""
    x = 1j * lines_hz / f0_hz[:, None]
    g = 0.1 + np.sum(2 * DAMPING_RATIO / (x**2 + 2 * DAMPING_RATIO * x + 1), axis=0)
    variance = 10 ** (-snr_db / 10) * np.mean(np.abs(g) ** 2)
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((2, runs, lines_hz.size)) * np.sqrt(variance / 2)
    sample = variance * rng.gamma(DOF, 1 / DOF, (runs, lines_hz.size))
    return FRF(lines_hz, g + noise[0] + 1j * noise[1], variance_noise=sample, noise_dof=DOF)
