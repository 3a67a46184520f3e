# SPDX-License-Identifier: Apache-2.0
"""Robust method: noise and stochastic nonlinear distortion apart."""

import numpy as np
import pytest
from scipy import signal

from tactile_resonance.frf.estimate import estimate_frf
from tactile_resonance.frf.local_polynomial import LocalPolynomialPlan
from tactile_resonance.frf.result import FrfStatus
from tactile_resonance.frf.robust import TRANSIENT_SCORE, robust_frf, transient_score
from tactile_resonance.frf.spectra import averaged_spectra

SIGMAS = 4.0
LINES = np.arange(1, 120, 2)
SAMPLES = 512
SYSTEM = ([0.5], [1.0, -0.5])


def test_equals_the_reference_implementation(shared_data):
    with np.load(shared_data / "oracle" / "nl_odd_random_grid.npz") as data:
        plan = LocalPolynomialPlan(data["ex"], 4000, 4, order=2, dof=2)
        spectra = plan(data["u"], data["y"])
        result = robust_frf(spectra, sample_rate_hz=float(data["fs"]))
        for mine, theirs in (
            (result.frf.frequency_hz, "freq"),
            (result.frf.g, "G"),
            (result.frf.variance_noise, "CGn"),
            (result.frf.variance_total, "CGNL"),
            (result.variance_distortion, "CGS"),
            (spectra.covariance.mean(axis=0) / 4, "CZn"),
        ):
            assert np.max(np.abs(mine / data[f"robust_{theirs}"] - 1)) < 1e-6, theirs
    assert (result.frf.noise_dof, result.frf.total_dof) == (4 * 3, 3)


def cubic_records(rng, multisine, runs, realisations, periods, noise):
    """[Y; U] of ``(u + 0.1 u^3)`` filtered, from rest: (2, runs, M, P, N)."""
    u = multisine(LINES, SAMPLES, rng, amplitude=0.2, records=(runs, realisations))
    u = np.tile(u, periods)
    y = signal.lfilter(*SYSTEM, u + 0.1 * u**3, axis=-1)
    clean = np.stack([y, u])
    noisy = clean + noise * rng.standard_normal(clean.shape)
    return noisy.reshape(2, runs, realisations, periods, SAMPLES)


@pytest.mark.parametrize("noise", [0.002, 0.05])
def test_total_is_noise_plus_distortion(multisine, deviation_from_one, noise):
    """Each of the three variances against an independent measure of it."""
    rng = np.random.default_rng(1)
    runs, realisations, periods = 80, 5, 3
    y, u = cubic_records(rng, multisine, runs, realisations, periods, noise)
    plan = LocalPolynomialPlan(LINES, SAMPLES, periods)
    result = robust_frf(plan(u, y), sample_rate_hz=1.0)
    frf = result.frf
    # the best linear approximation, from as many realisations again without noise
    y0, u0 = cubic_records(rng, multisine, 1, 2000, 2, 0.0)
    settled = averaged_spectra(u0[0], y0[0], LINES, unsettled_periods=1)
    g_each = settled.spectra[:, 0] / settled.spectra[:, 1]
    best, distortion = g_each.mean(axis=0), g_each.var(axis=0, ddof=1)
    ratio, sigmas = deviation_from_one(frf.variance_total, np.abs(frf.g - best) ** 2)
    assert sigmas < SIGMAS, ratio
    ratio, sigmas = deviation_from_one(
        result.variance_distortion, np.broadcast_to(distortion, frf.g.shape)
    )
    assert sigmas < SIGMAS, ratio
    # noise of the same level on a linear system of the same best linear approximation: the noise
    # variance does not see the distortion
    white = noise**2 / (SAMPLES * periods) * (1 + _extrapolation(plan))
    input_power = np.mean(np.abs(settled.spectra[:, 1]) ** 2, axis=0)
    expected = white * (1 + np.abs(best) ** 2) / input_power / realisations
    ratio, sigmas = deviation_from_one(frf.variance_noise, np.broadcast_to(expected, frf.g.shape))
    assert sigmas < SIGMAS, ratio


def _extrapolation(plan):
    """Variance that the extrapolated transient adds, relative to the line's own noise."""
    row = plan.groups[0].projector[0] * plan.samples_per_period * plan.periods
    return float(np.sum(row[1:] ** 2))


def test_linear_system_has_no_distortion(multisine, deviation_from_one):
    rng = np.random.default_rng(2)
    u = np.tile(multisine(LINES, SAMPLES, rng, records=(200, 3)), 2)
    y = signal.lfilter(*SYSTEM, u, axis=-1)
    u, y = ((x + 0.05 * rng.standard_normal(x.shape)).reshape(200, 3, 2, SAMPLES) for x in (u, y))
    result = robust_frf(LocalPolynomialPlan(LINES, SAMPLES, 2)(u, y), sample_rate_hz=1.0)
    ratio, sigmas = deviation_from_one(result.frf.variance_total, result.frf.variance_noise)
    assert sigmas < SIGMAS, ratio


def test_reference_averages_input_noise_before_the_ratio(multisine, deviation_from_one):
    """Where the input is weak, Y/U is biased; with the reference it is less so, variances fit."""
    rng = np.random.default_rng(3)
    runs, realisations = 60, 20
    clean = multisine(LINES, SAMPLES, rng, amplitude=0.2, records=(runs, realisations))
    reference = np.fft.rfft(clean)[..., LINES]
    u = np.tile(clean, 3)
    y = 2 * u + 0.5 * rng.standard_normal(u.shape)
    u = u + 2.5 * rng.standard_normal(u.shape)
    u, y = (x.reshape(runs, realisations, 3, SAMPLES) for x in (u, y))
    spectra = averaged_spectra(u, y, LINES)
    plain = robust_frf(spectra, sample_rate_hz=1.0)
    turned = robust_frf(spectra, sample_rate_hz=1.0, reference=reference)
    assert plain.frf.status is FrfStatus.SUSPECT
    bias = [abs(result.frf.g.mean() - 2) for result in (plain, turned)]
    assert bias[1] < 0.2 * bias[0]
    error = np.abs(turned.frf.g - 2) ** 2
    for variance in (turned.frf.variance_noise, turned.frf.variance_total):
        ratio, _ = deviation_from_one(variance, error)
        assert ratio == pytest.approx(1, abs=0.1)
    assert turned.frf.spectra.shape == (runs, 2, LINES.size)
    assert turned.spectra_total_covariance.shape == (runs, 2, 2, LINES.size)
    # turned by its own phases the mean input is real and as large as the lines, 0.1
    assert np.allclose(turned.frf.spectra[:, 1].mean(axis=0), 0.1, atol=0.01)


def test_both_estimates_agree_without_input_noise(multisine):
    rng = np.random.default_rng(4)
    y, u = cubic_records(rng, multisine, 1, 3, 2, 0.0)
    spectra = averaged_spectra(u[0], y[0], LINES, unsettled_periods=1)
    reference = np.fft.rfft(u[0, :, 0])[..., LINES]
    plain = robust_frf(spectra, sample_rate_hz=1.0)
    turned = robust_frf(spectra, sample_rate_hz=1.0, reference=reference)
    assert np.allclose(plain.frf.g, turned.frf.g, rtol=1e-10)
    assert np.allclose(plain.frf.variance_total, turned.frf.variance_total, rtol=1e-6)


def test_single_periods_tell_the_total_only(multisine):
    rng = np.random.default_rng(5)
    y, u = cubic_records(rng, multisine, 1, 4, 1, 0.01)
    result = robust_frf(averaged_spectra(u[0], y[0], LINES), sample_rate_hz=1.0)
    assert result.frf.variance_noise is None
    assert result.variance_distortion is None
    assert result.frf.variance_total is not None
    assert result.frf.total_dof == 3
    assert "cannot be told" in result.frf.message


def test_refusals(multisine):
    rng = np.random.default_rng(7)
    u = multisine(LINES, SAMPLES, rng, records=(2, 2))  # (M, P, N)
    spectra = averaged_spectra(u, u, LINES)
    with pytest.raises(ValueError, match="expected .* M >= 2 realisations"):
        robust_frf(averaged_spectra(u[:1], u[:1], LINES), sample_rate_hz=1.0)
    with pytest.raises(ValueError, match=r"reference: shape \(3,\), expected \(2, 60\)"):
        robust_frf(spectra, sample_rate_hz=1.0, reference=np.ones(3))
    with pytest.raises(ValueError, match="reference: zero"):
        robust_frf(spectra, sample_rate_hz=1.0, reference=np.zeros((2, 60)))


def test_single_periods_from_rest_are_told_from_settled_ones():
    """Realisations of one period of a resonance at 20 lines' distance of zero, damping 5 %."""
    rng = np.random.default_rng(8)
    n, lines = 2000, np.arange(1, 400)
    pole = 2 * np.pi * 60 / n * (-0.05 + 1j)
    time = np.arange(2 * n)
    impulse = np.exp(pole * time).imag  # decays within a period
    u = np.empty((6, 1, n))
    for m in range(6):
        spectrum = np.zeros(n // 2 + 1, complex)
        spectrum[lines] = np.exp(2j * np.pi * rng.random(lines.size))
        u[m, 0] = np.fft.irfft(spectrum) * n / 20
    twice = np.tile(u[:, 0], 2)
    response = np.fft.rfft(impulse, 4 * n)
    y = np.fft.irfft(np.fft.rfft(twice, 4 * n) * response)[:, : 2 * n].reshape(6, 2, 1, n)
    y = y + 0.1 * rng.standard_normal(y.shape)
    from_rest, settled = (
        estimate_frf(u, y[:, k], sample_rate_hz=float(n), harmonics=lines) for k in (0, 1)
    )
    assert from_rest.status is FrfStatus.SUSPECT
    assert "transient" in from_rest.message
    assert settled.status is FrfStatus.OK
    assert "transient" not in settled.message


def test_noise_that_differs_over_lines_is_no_transient():
    rng = np.random.default_rng(9)
    scores = []
    for _ in range(2000):
        shape = (3, 2, 60, 2)
        each = rng.standard_normal(shape).view(complex)[..., 0] * [[1.0], [0.0]]
        each = each * np.logspace(0, 2, 60)
        each[:, 1] = np.exp(2j * np.pi * rng.random((3, 60)))
        scores.append(transient_score(each, (each[:, 0] / each[:, 1]).mean(axis=0)))
    assert np.mean(np.array(scores) > 2.33) < 0.015
    assert np.max(scores) < TRANSIENT_SCORE
