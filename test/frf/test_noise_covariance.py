# SPDX-License-Identifier: Apache-2.0
"""Seeded Monte Carlo: covariances of mean spectra and FRF are unbiased.

Estimated covariances are compared with the scatter of the estimates themselves about the truth. A
ratio may lie 4 of its standard errors from 1: 6e-5 false alarms per comparison.
"""

import numpy as np
import pytest
from scipy import signal

from tactile_resonance.frf.estimate import frf_of_realisations
from tactile_resonance.frf.spectra import Spectrum, averaged_spectra, transient_free_spectra

SIGMAS = 4.0
RUNS = 200
SAMPLES = 512
LINES = np.arange(3, 120)
SYSTEM = ([0.3, 0.2], [1.0, -1.2, 0.8])  # settles within some 100 samples


def white(rng, shape):
    return 0.05 * rng.standard_normal((2, *shape))


def coloured(rng, shape):
    e = 0.05 * rng.standard_normal((2, *shape[:-1], shape[-1] + 200))
    return signal.lfilter([1, 0.4], [1, -0.9], e, axis=-1)[..., 200:]


def correlated(rng, shape):
    """Output noise holds the input noise, delayed: the cross covariance is complex."""
    e = 0.05 * rng.standard_normal((2, *shape[:-1], shape[-1] + 200))
    y = signal.lfilter([0, 0, 0, 0.9], [1, -0.6], e[1], axis=-1) + 0.3 * e[0]
    return np.stack([y, e[1]])[..., 200:]


def simulate(rng, multisine, noise, periods, transient):
    """Noise-free and noisy [Y; U] records, (2, RUNS, P, N); noise-free spectra (2, 1, F)."""
    u0 = multisine(LINES, SAMPLES, rng)
    lead = 0 if transient else 4
    y0 = signal.lfilter(*SYSTEM, np.tile(u0, periods + lead))[lead * SAMPLES :]
    shape = (RUNS, periods * SAMPLES)
    clean = np.stack([y0, np.tile(u0, periods)])  # (2, P N)
    noisy = clean[:, None] + noise(rng, shape)
    u_line = np.fft.rfft(u0)[LINES] / SAMPLES
    truth = np.stack([u_line * signal.freqz(*SYSTEM, 2 * np.pi * LINES / SAMPLES)[1], u_line])
    return noisy.reshape(2, RUNS, periods, SAMPLES), truth


@pytest.mark.parametrize("transient", [False, True], ids=["steady", "from rest"])
@pytest.mark.parametrize("noise", [white, coloured, correlated])
@pytest.mark.parametrize(("periods", "order", "dof"), [(2, 2, 2), (3, 2, 6), (6, 4, 6)])
def test_local_polynomial(multisine, deviation_from_one, noise, transient, periods, order, dof):
    rng = np.random.default_rng([periods, order, transient])
    (y, u), truth = simulate(rng, multisine, noise, periods, transient)
    result = transient_free_spectra(Spectrum.of(u, y), LINES, order=order, dof=dof)
    error = result.spectra - truth  # (RUNS, 2, F)
    scatter = np.einsum("rif,rjf->rijf", error, error.conj())
    for i in (0, 1):
        ratio, sigmas = deviation_from_one(result.covariance[:, i, i], scatter[:, i, i])
        assert sigmas < SIGMAS, (i, ratio)
    assert_same_cross_covariance(result.covariance[:, 0, 1], scatter[:, 0, 1])


@pytest.mark.parametrize("noise", [white, coloured, correlated])
def test_average_over_periods(multisine, deviation_from_one, noise):
    rng = np.random.default_rng(10)
    (y, u), truth = simulate(rng, multisine, noise, 4, transient=False)
    result = averaged_spectra(Spectrum.of(u, y), LINES)
    error = result.spectra - truth
    scatter = np.einsum("rif,rjf->rijf", error, error.conj())
    for i in (0, 1):
        ratio, sigmas = deviation_from_one(result.covariance[:, i, i], scatter[:, i, i])
        assert sigmas < SIGMAS, (i, ratio)
    assert_same_cross_covariance(result.covariance[:, 0, 1], scatter[:, 0, 1])


def assert_same_cross_covariance(estimated, scatter):
    """Complex means over runs agree at each eighth of the band."""
    for part in np.array_split(np.arange(estimated.shape[-1]), 8):
        difference = (estimated - scatter)[:, part].mean(axis=1)
        for value in (difference.real, difference.imag):
            assert abs(value.mean()) < SIGMAS * value.std(ddof=1) / np.sqrt(value.size)


@pytest.mark.parametrize("noise", [white, correlated])
def test_variance_of_the_response(multisine, deviation_from_one, noise):
    rng = np.random.default_rng(11)
    (y, u), truth = simulate(rng, multisine, noise, 4, transient=True)
    spectra = transient_free_spectra(Spectrum.of(u[:, None], y[:, None]), LINES)
    frf = frf_of_realisations(spectra, sample_rate_hz=1.0)
    error = np.abs(frf.g - truth[0] / truth[1]) ** 2
    ratio, sigmas = deviation_from_one(frf.variance_noise, error)
    assert sigmas < SIGMAS, ratio


def test_degrees_of_freedom(multisine):
    """A covariance of n degrees of freedom scatters by 1/sqrt(n)."""
    rng = np.random.default_rng(12)
    (y, u), _ = simulate(rng, multisine, white, 4, transient=False)
    for dof in (2, 6, 12):
        result = transient_free_spectra(Spectrum.of(u, y), LINES, dof=dof)
        power = result.covariance[:, 0, 0].real  # (RUNS, F)
        scatter = np.mean(np.var(power, axis=0, ddof=1) / np.mean(power, axis=0) ** 2)
        assert scatter * result.noise_dof == pytest.approx(1, abs=0.1)


def test_dropping_nothing_from_a_transient_is_worse(multisine):
    """Averaging all periods from rest errs by far more than its variance says; the fit does not."""
    rng = np.random.default_rng(13)
    (y, u), truth = simulate(rng, multisine, lambda rng, s: 0.02 * white(rng, s), 3, True)
    plain = averaged_spectra(Spectrum.of(u, y), LINES)
    fitted = transient_free_spectra(Spectrum.of(u, y), LINES)
    error = {
        name: np.sqrt(np.mean(np.abs(s.spectra[:, 0] - truth[0]) ** 2))
        for name, s in (("plain", plain), ("fitted", fitted))
    }
    assert error["plain"] > 10 * error["fitted"]
