# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy import signal

from tactile_resonance.frf.averaging import average_periods
from tactile_resonance.frf.result import FrfStatus
from tactile_resonance.multisine import design_multisine

N, RATE_HZ = 1000, 1000.0


def records(seed, realisations=1, periods=4, noise_y=0.0, noise_u=0.0, correlation=0.0, batch=()):
    """Steady state of a 5 Hz-wide resonance at 100 Hz, with white noise on both channels."""
    rng = np.random.default_rng(seed)
    b, a = signal.iirpeak(100.0, 20.0, fs=RATE_HZ)
    excitations = [
        design_multisine(
            sample_rate_hz=RATE_HZ,
            samples_per_period=N,
            band_hz=(80, 120),
            seed=5,
            realisation=m,
        )
        for m in range(realisations)
    ]
    harmonics = excitations[0].harmonics
    _, g = signal.freqz(b, a, worN=excitations[0].frequency_hz, fs=RATE_HZ)
    u = np.stack([np.tile(e.period(), (periods, 1)) for e in excitations])
    spectra = np.zeros((realisations, N // 2 + 1), complex)
    for m, e in enumerate(excitations):
        spectra[m, harmonics] = e.spectrum()[harmonics] * g
    y = np.repeat(np.fft.irfft(spectra * N, N)[:, None], periods, axis=1)
    shape = (*batch, realisations, periods, N)
    common = rng.standard_normal(shape)
    own = rng.standard_normal((2, *shape))
    mix = np.sqrt(1 - correlation**2)
    u = u + noise_u * (correlation * common + mix * own[0])
    y = y + noise_y * (correlation * common + mix * own[1])
    return u, y, harmonics, g


def estimate(u, y, harmonics, unsettled=0):
    return average_periods(
        u, y, sample_rate_hz=RATE_HZ, harmonics=harmonics, unsettled_periods=unsettled
    )


def test_exact_without_noise():
    u, y, harmonics, g = records(0, realisations=2)
    frf = estimate(u, y, harmonics)
    np.testing.assert_allclose(frf.g, g, rtol=1e-12)
    np.testing.assert_allclose(frf.frequency_hz, harmonics * 1.0)
    assert np.max(frf.variance_noise) < 1e-25


def test_delay_has_negative_phase():
    u, _, harmonics, _ = records(0)
    frf = estimate(u, np.roll(u, 3, axis=-1), harmonics)
    np.testing.assert_allclose(
        frf.g, np.exp(-2j * np.pi * frf.frequency_hz * 3 / RATE_HZ), rtol=1e-11
    )


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_noise_variance_is_unbiased(correlation):
    """Mean of |g - g0|^2 over mean stated variance: chi-square with 2 x 4000 x 41 degrees of freedom."""
    u, y, harmonics, g = records(
        1, noise_y=0.01, noise_u=0.01, correlation=correlation, batch=(4000,)
    )
    frf = estimate(u, y, harmonics)
    ratio = np.mean(np.abs(frf.g - g) ** 2) / np.mean(frf.variance_noise)
    # std of numerator 1/sqrt(n), of the denominator 1/sqrt(3 n); four standard deviations
    assert abs(ratio - 1) < 4 * np.sqrt((1 + 1 / 3) / (4000 * 41))


def test_total_variance_matches_noise_where_there_is_no_distortion():
    u, y, harmonics, g = records(2, realisations=6, noise_y=0.01, batch=(500,))
    frf = estimate(u, y, harmonics)
    for variance, dof in ((frf.variance_noise, 18), (frf.variance_total, 5)):
        ratio = np.mean(np.abs(frf.g - g) ** 2) / np.mean(variance)
        assert abs(ratio - 1) < 4 * np.sqrt((1 + 1 / dof) / (500 * 41))
    assert (frf.noise_dof, frf.total_dof) == (18, 5)


def test_what_cannot_be_told_is_none():
    u, y, harmonics, _ = records(3, periods=2, noise_y=0.01)
    frf = estimate(u, y, harmonics, unsettled=1)
    assert frf.variance_noise is None
    assert frf.variance_total is None
    assert frf.status is FrfStatus.NO_COVARIANCE
    assert frf.message


def test_single_precision_stays_close():
    u, y, harmonics, _ = records(4, noise_y=0.01)
    double = estimate(u, y, harmonics)
    single = estimate(u.astype(np.float32), y.astype(np.float32), harmonics)
    np.testing.assert_allclose(single.g, double.g, rtol=2e-6)


def test_too_many_unsettled_periods_are_refused():
    u, y, harmonics, _ = records(5)
    with pytest.raises(ValueError, match=r"unsettled_periods: 4, accepted is 0\.\.3"):
        estimate(u, y, harmonics, unsettled=4)
