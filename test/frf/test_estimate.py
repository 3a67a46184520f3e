# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy import signal

from tactile_resonance.frf.estimate import frf_of_realisations, frf_of_record
from tactile_resonance.frf.result import FrfStatus
from tactile_resonance.frf.spectra import Spectrum, mean_spectra
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


@pytest.fixture(params=["local polynomial", "average"])
def estimate(request):
    def run(u, y, harmonics):
        return frf_of_record(
            Spectrum.of(u, y), sample_rate_hz=RATE_HZ, harmonics=harmonics, method=request.param
        )

    return run


def test_exact_without_noise(estimate):
    u, y, harmonics, g = records(0, realisations=2)
    frf = estimate(u, y, harmonics)
    np.testing.assert_allclose(frf.g, g, rtol=1e-12)
    np.testing.assert_allclose(frf.frequency_hz, harmonics * 1.0)
    assert np.max(frf.variance_noise) < 1e-25


def test_delay_has_negative_phase(estimate):
    u, _, harmonics, _ = records(0)
    frf = estimate(u, np.roll(u, 3, axis=-1), harmonics)
    np.testing.assert_allclose(
        frf.g, np.exp(-2j * np.pi * frf.frequency_hz * 3 / RATE_HZ), rtol=1e-11
    )


def assert_unbiased(frf, g, variance, dof):
    """Mean of |g - g0|^2 over mean stated variance is 1, to four standard deviations.

    Numerator and denominator have relative variances 1/n and 1/(dof n) over n lines; the local polynomial
    method shares bins between neighbours, so that at least every third line is independent.
    """
    ratio = np.mean(np.abs(frf.g - g) ** 2) / np.mean(variance)
    assert abs(ratio - 1) < 4 * np.sqrt((1 + 1 / dof) * 3 / frf.g.size)


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_noise_variance_is_unbiased(estimate, correlation):
    u, y, harmonics, g = records(
        1, noise_y=0.01, noise_u=0.01, correlation=correlation, batch=(1000,)
    )
    frf = estimate(u, y, harmonics)
    assert_unbiased(frf, g, frf.variance_noise, frf.noise_dof)


def test_total_variance_matches_noise_where_there_is_no_distortion(estimate):
    u, y, harmonics, g = records(2, realisations=6, noise_y=0.01, batch=(300,))
    frf = estimate(u, y, harmonics)
    assert_unbiased(frf, g, frf.variance_noise, frf.noise_dof)
    assert_unbiased(frf, g, frf.variance_total, frf.total_dof)
    assert frf.total_dof == 5


def test_degrees_of_freedom():
    u, y, harmonics, _ = records(2, realisations=6, noise_y=0.01)
    options = {"sample_rate_hz": RATE_HZ, "harmonics": harmonics}
    average = frf_of_record(Spectrum.of(u, y), method="average", **options)
    assert (average.noise_dof, average.periods) == (6 * 2, 3)  # the first period is dropped
    spectra = mean_spectra(Spectrum.of(u, y), harmonics, dof=9)
    assert frf_of_realisations(spectra, sample_rate_hz=RATE_HZ).noise_dof >= 6 * 9


def test_what_cannot_be_told_is_none(estimate):
    u, y, harmonics, _ = records(3, periods=1, noise_y=0.01)
    frf = estimate(u, y, harmonics)
    assert frf.variance_noise is None
    assert frf.variance_total is None
    assert frf.status is FrfStatus.NO_COVARIANCE
    assert frf.message


def test_single_precision_stays_close(estimate):
    u, y, harmonics, _ = records(4, noise_y=0.01)
    double = estimate(u, y, harmonics)
    single = estimate(u.astype(np.float32), y.astype(np.float32), harmonics)
    np.testing.assert_allclose(single.g, double.g, rtol=2e-6)


def test_an_unknown_method_is_refused():
    u, y, harmonics, _ = records(5)
    with pytest.raises(ValueError, match="method: 'welch', accepted are local polynomial, average"):
        frf_of_record(
            Spectrum.of(u, y), sample_rate_hz=RATE_HZ, harmonics=harmonics, method="welch"
        )
