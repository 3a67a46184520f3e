# SPDX-License-Identifier: Apache-2.0
"""Delay between channels: measured, corrected, suspected."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal, stats

from tactile_resonance.frf.estimate import frf_of_realisations
from tactile_resonance.frf.faults import FaultKind
from tactile_resonance.frf.result import PER_LINE
from tactile_resonance.frf.skew import correct_skew, skew_from_loopback, suspected_skew
from tactile_resonance.frf.spectra import Spectrum, averaged_spectra, transient_free_spectra

SAMPLES, RATE = 1000, 10e3
LINES = np.arange(3, 400)
F_HZ = np.arange(SAMPLES // 2 + 1) * RATE / SAMPLES


def loopback(rng, multisine, delay_s, gain=1.0, response=1.0, noise=0.01, periods=3):
    u = multisine(LINES, SAMPLES, rng, amplitude=0.1)
    y = np.fft.irfft(
        np.fft.rfft(u) * gain * response * np.exp(-2j * np.pi * F_HZ * delay_s), SAMPLES
    )
    return tuple(
        np.tile(x, (periods, 1)) + noise * rng.standard_normal((periods, SAMPLES)) for x in (u, y)
    )


@pytest.mark.parametrize("gain", [0.7, -2.0])
def test_delay_is_unbiased_and_its_deviation_true(multisine, gain):
    rng = np.random.default_rng(1)
    true = 37e-6
    errors = []
    for _ in range(200):
        skew = skew_from_loopback(
            *loopback(rng, multisine, true, gain), sample_rate_hz=RATE, harmonics=LINES
        )
        errors.append((skew.delay_s - true) / skew.delay_std_s)
    # 200 runs: the mean within 4 / sqrt(200), the deviation within 4 / sqrt(400) of 1
    assert abs(np.mean(errors)) < 0.28
    assert np.std(errors) == pytest.approx(1, abs=0.2)
    assert skew.gain == pytest.approx(gain, rel=0.01)


@pytest.mark.parametrize("lines", [3, 4, 6])
def test_few_lines_hold_the_delay_as_often_as_many(lines, multisine):
    rng, runs, at = np.random.default_rng(5), 600, np.arange(20, 20 + 15 * lines, 15)
    u = multisine(at, SAMPLES, rng, amplitude=0.1)
    held = 0
    for _ in range(runs):
        noisy = (np.tile(u, (2, 1)) + 0.003 * rng.standard_normal((2, SAMPLES)) for _ in range(2))
        skew = skew_from_loopback(*noisy, sample_rate_hz=RATE, harmonics=at)
        held += abs(skew.delay_s) < 1.96 * skew.delay_std_s
    assert stats.binom.cdf(held, runs, 0.95) > 1e-3
    assert stats.binom.sf(held - 1, runs, 0.95) > 1e-3


@pytest.mark.parametrize("delay_s", [-2.3e-3, -1e-6, 0.0, 4.5e-3])
def test_delays_of_many_samples_need_no_unwrapping(multisine, delay_s):
    rng = np.random.default_rng(2)
    skew = skew_from_loopback(
        *loopback(rng, multisine, delay_s), sample_rate_hz=RATE, harmonics=LINES
    )
    assert skew.delay_s == pytest.approx(delay_s, abs=6 * skew.delay_std_s)


@pytest.mark.parametrize("gain", [1.0, -1.0])
def test_a_phase_that_no_delay_takes_out_is_told(gain):
    """One channel is coupled through a capacitor: far above its corner the phase is straight."""
    lines = np.arange(20, 31)
    f = F_HZ[lines]
    response = gain * 1j * f / (1j * f + 10)
    period = np.zeros(SAMPLES // 2 + 1, complex)
    period[lines] = np.exp(1j * np.random.default_rng(4).uniform(0, 2 * np.pi, lines.size))
    u = np.tile(np.fft.irfft(period), (2, 1))
    period[lines] *= response
    y = np.tile(np.fft.irfft(period), (2, 1))
    skew = skew_from_loopback(u, y, sample_rate_hz=RATE, harmonics=lines)
    left = np.angle(gain * response * np.exp(2j * np.pi * f * skew.delay_s))
    assert skew.gain == pytest.approx(gain, rel=0.01)
    assert skew.residual_rad == pytest.approx(np.max(np.abs(left)), rel=1e-6)
    assert skew.residual_rad > 0.05


def settled_frf(u, y):
    spectra = averaged_spectra(Spectrum.of(u[None], y[None]), LINES)
    return frf_of_realisations(spectra, sample_rate_hz=RATE)


def test_correction_restores_the_response(multisine):
    delay, response = 37e-6, 1 / (1 + 1j * F_HZ / 800)
    records = [loopback(np.random.default_rng(4), multisine, d, 1, response) for d in (0, delay)]
    clean, delayed = (
        transient_free_spectra(Spectrum.of(u[None], y[None]), LINES) for u, y in records
    )
    true, skewed = (frf_of_realisations(x, sample_rate_hz=RATE) for x in (clean, delayed))
    corrected = correct_skew(skewed, delay)
    scatter = np.sqrt(true.variance_noise)
    assert np.max(np.abs(skewed.g - true.g) / scatter) > 5
    assert np.max(np.abs(corrected.g - true.g) / scatter) < 5
    # as if the spectra had come so
    turn = np.stack([np.exp(2j * np.pi * skewed.frequency_hz * delay), np.ones(LINES.size)])  # [Y; U]
    expected = frf_of_realisations(
        replace(
            delayed,
            spectra=delayed.spectra * turn,
            covariance=delayed.covariance * turn[:, None] * turn.conj(),
        ),
        sample_rate_hz=RATE,
    )
    for name in set(PER_LINE) - {"variance_total"}:
        assert np.allclose(getattr(corrected, name), getattr(expected, name), rtol=1e-9, atol=0)


def test_skew_is_suspected_where_a_flat_response_has_straight_phase(multisine):
    rng = np.random.default_rng(5)
    # feed-through with a mode low in the band, as of a bimorph
    mode = 1 + 0.2 / (1 - (F_HZ / 300) ** 2 + 0.04j * F_HZ / 300)
    frf = {
        delay: settled_frf(*loopback(rng, multisine, delay, 1, mode))
        for delay in (0.0, 20e-6)
    }
    assert suspected_skew(frf[0.0]) is None
    fault = suspected_skew(frf[20e-6])
    assert fault.kind is FaultKind.CHANNEL_SKEW
    assert not fault.spoils
    assert fault.value == pytest.approx(20e-6, rel=0.1)
    assert "loop-back" in fault.message


def test_phases_of_noise_are_no_delay(multisine):
    rng = np.random.default_rng(7)
    suspected = []
    for _ in range(50):
        u, y = loopback(rng, multisine, 0.0, 1)
        suspected.append(suspected_skew(settled_frf(u, rng.standard_normal(y.shape))))
    assert suspected == [None] * 50


def test_refusals(multisine):
    rng = np.random.default_rng(6)
    u, y = loopback(rng, multisine, 0.0)
    with pytest.raises(ValueError, match="harmonics: 2 lines, expected at least 3"):
        skew_from_loopback(u, y, sample_rate_hz=RATE, harmonics=[3, 4])
    resonance = signal.lfilter([1], [1, -1.8, 0.95], y, axis=-1)
    with pytest.raises(ValueError, match="expected a loop-back"):
        skew_from_loopback(u, resonance, sample_rate_hz=RATE, harmonics=LINES)
    frf = settled_frf(u, y)
    with pytest.raises(ValueError, match="delay_s: nan"):
        correct_skew(frf, float("nan"))
