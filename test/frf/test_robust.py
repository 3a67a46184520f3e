# SPDX-License-Identifier: Apache-2.0
"""Robust method: noise and stochastic nonlinear distortion apart."""

import re

import numpy as np
import pytest
from scipy import signal, stats

from tactile_resonance.frf import estimate
from tactile_resonance.frf.estimate import (
    disagreement,
    frf_of_realisations,
    frf_of_record,
    transient_lines,
)
from tactile_resonance.frf.result import FrfStatus
from tactile_resonance.frf.spectra import (
    Spectrum,
    averaged_spectra,
    neighbourhoods,
    transient_free_spectra,
)

SIGMAS = 4.0
LINES = np.arange(1, 120, 2)
SAMPLES = 512
SYSTEM = ([0.5], [1.0, -0.5])


def test_equals_the_reference_implementation(shared_data):
    with np.load(shared_data / "oracle" / "nl_odd_random_grid.npz") as data:
        record = Spectrum.of(data["u"], data["y"])
        spectra = transient_free_spectra(record, data["ex"], order=2, dof=2)
        result = frf_of_realisations(spectra, sample_rate_hz=float(data["fs"]))
        for mine, theirs in (
            (result.frequency_hz, "freq"),
            (result.g, "G"),
            (result.variance_noise, "CGn"),
            (result.variance_total, "CGNL"),
            (result.variance_distortion, "CGS"),
            (spectra.covariance.mean(axis=0) / 4, "CZn"),
        ):
            assert np.max(np.abs(mine / data[f"robust_{theirs}"] - 1)) < 1e-6, theirs
    assert (result.noise_dof, result.total_dof) == (4 * 3, 3)


@pytest.mark.parametrize("levels", [(1.0, 0.1), (1.0, 1.0, 0.5, 0.1)])
def test_noise_variance_of_realisations_of_unequal_level(multisine, levels):
    """The weakest realisations hold most of the noise of the mean response."""
    rng = np.random.default_rng(9)
    runs, realisations, periods = 40, len(levels), 4
    u = multisine(LINES, SAMPLES, rng, records=(runs, realisations)) * np.array(levels)[:, None]
    u = np.tile(u, periods)
    clean = np.stack([signal.lfilter(*SYSTEM, np.tile(u, 2))[..., -u.shape[-1] :], u])
    noisy = clean + 0.01 * rng.standard_normal(clean.shape)
    y, u = noisy.reshape(2, runs, realisations, periods, SAMPLES)
    spectra = transient_free_spectra(Spectrum.of(u, y), LINES)
    result = frf_of_realisations(spectra, sample_rate_hz=1.0)
    truth = signal.freqz(*SYSTEM, 2 * np.pi * LINES / SAMPLES)[1]
    assert spectra.noise_dof <= result.noise_dof <= 1.2 * spectra.noise_dof
    squared = np.abs(result.g - truth) ** 2 / result.variance_noise
    for probability in (0.68, 0.95):
        inside = squared < stats.f.ppf(probability, 2, 2 * result.noise_dof)
        error = np.sqrt(probability * (1 - probability) / runs / 10)  # variances of neighbours share bins
        assert np.mean(inside) == pytest.approx(probability, abs=4 * error)


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
    spectra = transient_free_spectra(Spectrum.of(u, y), LINES, order=2, dof=6)
    result = frf_of_realisations(spectra, sample_rate_hz=1.0)
    # the best linear approximation, from as many realisations again without noise
    y0, u0 = cubic_records(rng, multisine, 1, 2000, 2, 0.0)
    settled = averaged_spectra(Spectrum.of(u0[0], y0[0]), LINES, unsettled_periods=1)
    g_each = settled.spectra[:, 0] / settled.spectra[:, 1]
    best, distortion = g_each.mean(axis=0), g_each.var(axis=0, ddof=1)
    ratio, sigmas = deviation_from_one(result.variance_total, np.abs(result.g - best) ** 2)
    assert sigmas < SIGMAS, ratio
    ratio, sigmas = deviation_from_one(
        result.variance_distortion, np.broadcast_to(distortion, result.g.shape)
    )
    assert sigmas < SIGMAS, ratio
    # noise of the same level on a linear system of the same best linear approximation: the noise
    # variance does not see the distortion
    white = noise**2 / (SAMPLES * periods) * (1 + _extrapolation(periods))
    input_power = np.mean(np.abs(settled.spectra[:, 1]) ** 2, axis=0)
    expected = white * (1 + np.abs(best) ** 2) / input_power / realisations
    ratio, sigmas = deviation_from_one(
        result.variance_noise, np.broadcast_to(expected, result.g.shape)
    )
    assert sigmas < SIGMAS, ratio


def _extrapolation(periods):
    """Variance that the extrapolated transient adds, relative to the line's own noise."""
    groups = neighbourhoods(LINES.tobytes(), SAMPLES, periods, 2, 6)
    most = max(groups, key=lambda group: group.bins.shape[1])
    return float(np.sum(most.projector[0, 1:] ** 2))


def test_linear_system_has_no_distortion(multisine, deviation_from_one):
    rng = np.random.default_rng(2)
    u = np.tile(multisine(LINES, SAMPLES, rng, records=(200, 3)), 2)
    y = signal.lfilter(*SYSTEM, u, axis=-1)
    u, y = ((x + 0.05 * rng.standard_normal(x.shape)).reshape(200, 3, 2, SAMPLES) for x in (u, y))
    spectra = transient_free_spectra(Spectrum.of(u, y), LINES)
    result = frf_of_realisations(spectra, sample_rate_hz=1.0)
    ratio, sigmas = deviation_from_one(result.variance_total, result.variance_noise)
    assert sigmas < SIGMAS, ratio


def test_single_periods_tell_the_total_only(multisine):
    rng = np.random.default_rng(5)
    y, u = cubic_records(rng, multisine, 1, 4, 1, 0.01)
    spectra = averaged_spectra(Spectrum.of(u[0], y[0]), LINES)
    result = frf_of_realisations(spectra, sample_rate_hz=1.0)
    assert result.variance_noise is None
    assert result.variance_distortion is None
    assert result.variance_total is not None
    assert result.total_dof == 3
    assert "not distinguished" in result.message


def test_refusals(multisine):
    rng = np.random.default_rng(7)
    u = multisine(LINES, SAMPLES, rng, records=(2,))  # (P, N)
    with pytest.raises(ValueError, match="expected .* with realisations M"):
        frf_of_realisations(averaged_spectra(Spectrum.of(u, u), LINES), sample_rate_hz=1.0)


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
        frf_of_record(Spectrum.of(u, y[:, k]), sample_rate_hz=float(n), harmonics=lines) for k in (0, 1)
    )
    assert from_rest.status is FrfStatus.MODEL_ERROR
    assert re.match("a transient at [0-9]+ to [0-9]+ Hz", from_rest.message)
    assert settled.status is FrfStatus.OK
    assert "transient" not in settled.message
    y[0, 1, 0, :300] += 30 * impulse[:300]  # as a knock leaves it
    knocked = frf_of_record(Spectrum.of(u, y[:, 1]), sample_rate_hz=float(n), harmonics=lines)
    assert "knock" in knocked.message


@pytest.mark.parametrize("false_alarm", [estimate.FALSE_ALARM, 0.02])
@pytest.mark.parametrize("records", [2, 3, 8])
def test_noise_that_differs_over_lines_is_no_transient(records, false_alarm, monkeypatch):
    monkeypatch.setattr(estimate, "FALSE_ALARM", false_alarm)
    rng = np.random.default_rng(9)
    alarms = 0
    for _ in range(2000):
        shape = (records, 2, 60, 2)
        each = rng.standard_normal(shape).view(complex)[..., 0] * [[1.0], [0.0]]
        each = each * np.logspace(0, 2, 60)
        each[:, 1] = np.exp(2j * np.pi * rng.random((records, 60)))
        alarms += transient_lines(each, (each[:, 0] / each[:, 1]).mean(axis=0)) is not None
    assert stats.binom.sf(alarms - 1, 2000, false_alarm) > 0.001


@pytest.mark.parametrize("spoilt", ["noisier", "gain"])
def test_a_realisation_unlike_the_others_is_no_transient(spoilt):
    """One with five times the noise, or a tenth more gain: called one in up to all of such sets."""
    rng = np.random.default_rng(12)
    g, alarms = mode(200), 0
    for _ in range(200):
        u = np.exp(2j * np.pi * rng.random((8, 200)))
        y = g * u + 1e-3 * noise(rng, 8, 200)
        if spoilt == "gain":
            y[1] *= 1.1
        else:
            y[1] += 5e-3 * noise(rng, 200)
        alarms += transient_lines(np.stack([y, u], axis=1), (y / u).mean(axis=0)) is not None
    assert alarms < 2


def mode(lines):
    """Response of a mode, damping 2 %, in the middle of so many lines."""
    f = np.linspace(0.8, 1.2, lines)
    return 0.04 / (1 - f**2 + 0.04j * f)


def noise(rng, *shape):
    return rng.standard_normal((*shape, 2)).view(complex)[..., 0] / np.sqrt(2)


@pytest.mark.parametrize("signal_to_noise", [30.0, 3.0, 1.0, 0.3, 0.1])
@pytest.mark.parametrize("records", [2, 3, 10])
@pytest.mark.parametrize("noisier", [1.0, 5.0])
def test_realisations_of_one_system_do_not_contradict_each_other(signal_to_noise, records, noisier):
    """At any level of noise, also where one record holds 14 dB more of it."""
    rng = np.random.default_rng(10)
    for g in (*map(mode, (8, 15, 41, 200)), np.ones(200)):
        lines = g.size
        level = np.sqrt(np.mean(np.abs(g) ** 2)) / signal_to_noise * np.ones((records, 1))
        level[1] *= noisier
        responses = g + level * noise(rng, 500, records, lines)
        found, _ = disagreement(responses, np.ones((1, records, lines)))
        assert np.sum(found != "") <= 2  # of 500; four tests of one in ten thousand each


OTHER = "realisation 2 is not of the same system as the others: "
FAULTS = {
    "inverted": (-1.0, OTHER + "[.0-9]+ times the gain, phase off by 1(80|79) degrees"),
    "gain": (1.5, OTHER + "1.[45][0-9] times the gain"),
    "sensor not connected": (0.0, "response of realisation 2 has nothing in common"),
}


@pytest.mark.parametrize("amplitude", ["flat", "over 60 dB"])
@pytest.mark.parametrize("periods", [1, 2])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_realisation_that_contradicts_the_others_is_named(fault, periods, amplitude, multisine):
    """Noise of lines that are hardly driven does not hide it."""
    factor, message = FAULTS[fault]
    rng = np.random.default_rng(11)
    shape = 10 ** rng.uniform(-3, 0, LINES.size) if amplitude != "flat" else 1.0
    u = np.repeat(multisine(LINES, SAMPLES, rng, amplitude=shape, records=(4, 1)), periods, axis=-2)
    y = signal.lfilter(*SYSTEM, np.tile(u, (1, 3, 1)).reshape(4, -1)).reshape(4, 3 * periods, SAMPLES)
    y = y[:, -periods:]
    y[1] *= factor
    y = y + 0.01 * rng.standard_normal(y.shape)
    result = frf_of_record(Spectrum.of(u, y), sample_rate_hz=1.0, harmonics=LINES)
    assert result.status is FrfStatus.MODEL_ERROR
    assert re.search(message, result.message), result.message
    rest = [0, 2, 3]
    good = frf_of_record(Spectrum.of(u[rest], y[rest]), sample_rate_hz=1.0, harmonics=LINES)
    assert good.status is FrfStatus.OK


@pytest.mark.parametrize("records", [2, 4])
def test_actuator_and_sensor_of_different_records_are_named(records, multisine):
    rng = np.random.default_rng(13)
    u = np.repeat(multisine(LINES, SAMPLES, rng, records=(records, 1)), 2, axis=-2)
    y = signal.lfilter(*SYSTEM, np.tile(u, (1, 2, 1)).reshape(records, -1)).reshape(records, 4, SAMPLES)
    y = np.roll(y[:, 2:], 1, axis=0) + 0.01 * rng.standard_normal(u.shape)
    result = frf_of_record(Spectrum.of(u, y), sample_rate_hz=1.0, harmonics=LINES)
    assert result.status is FrfStatus.MODEL_ERROR
    assert "have nothing in common" in result.message
