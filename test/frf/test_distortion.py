# SPDX-License-Identifier: Apache-2.0
"""Even and odd distortion at detection lines."""

import numpy as np
import pytest
from scipy import io, signal, stats

from tactile_resonance.frf.distortion import (
    decibel,
    estimate_distortion,
    nonlinear_distortion,
    spectra_between,
)
from tactile_resonance.frf.spectra import Spectrum, averaged_spectra, transient_free_spectra
from tactile_resonance.multisine import Grid, harmonics_on_grid

SILVERBOX_ENDS = (48946, 57646, 66346, 75046, 83746, 92396, 101096, 109796, 118496, 127196)
SAMPLES = 1024
EXCITED = harmonics_on_grid(1, 201, Grid.ODD_RANDOM, seed=3)
ALL = np.arange(1, 202)


def records(rng, multisine, nonlinearity, noise, *, realisations=3, periods=4):
    u = multisine(EXCITED, SAMPLES, rng, amplitude=0.15, records=(realisations, 1))
    u = np.broadcast_to(u, (realisations, periods, SAMPLES))
    y = nonlinearity(u)
    return tuple(x + noise * rng.standard_normal(x.shape) for x in (u, y))


def distortion_of(u, y):
    return nonlinear_distortion(
        averaged_spectra(Spectrum.of(u, y), ALL), EXCITED, sample_rate_hz=1024.0
    )


def output_deviation(spectra):
    return np.sqrt(spectra.covariance[..., 0, 0, :].real)


def test_equals_the_reference_implementation(shared_data):
    with np.load(shared_data / "oracle" / "nl_odd_random_grid.npz") as data:
        u, y = data["u"].astype(float), data["y"].astype(float)
        spectra = averaged_spectra(Spectrum.of(u, y), np.arange(1, 1201))
        result = nonlinear_distortion(spectra, data["ex"], sample_rate_hz=10e3)
        even, odd = result.even, result.odd
        for mine, theirs in (
            (result.frequency_hz, "fE"),
            (result.output, "YE"),
            (output_deviation(spectra.at(data["ex"])), "sYE"),
            (result.output / spectra.at(data["ex"]).spectra[:, 1], "Gm"),
            (even.frequency_hz, "fev"),
            (even.output, "Yev"),
            (output_deviation(spectra.at(even.harmonics)), "sYev"),
            (even.frequency_hz[even.in_band], "fevin"),
            (even.corrected[:, even.in_band], "Ycev"),
            (odd.frequency_hz, "fod"),
            (odd.output, "Yod"),
            (output_deviation(spectra.at(odd.harmonics)), "sYod"),
            (odd.frequency_hz[odd.in_band], "fodin"),
            (odd.corrected[:, odd.in_band], "Ycod"),
        ):
            assert np.max(np.abs(mine / data[f"fast_{theirs}"] - 1)) < 1e-6, theirs
    assert even.above_noise
    assert odd.above_noise


def test_silverbox_even_output_is_near_minus_48_db(shared_data):
    data = io.loadmat(shared_data / "silverbox" / "SNLS80mV.mat")
    u, y = (
        np.stack([data[name][0][end - 8192 : end] for end in SILVERBOX_ENDS])[:, None, :]
        for name in ("V1", "V2")
    )  # (M, 1, N)
    spectra = averaged_spectra(Spectrum.of(u, y), np.arange(1, 2684))
    result = nonlinear_distortion(spectra, np.arange(1, 2684, 2), sample_rate_hz=1e7 / 2**14)
    assert result.even.rms_output_level_db == pytest.approx(-48, abs=1)
    assert result.even.above_noise is None  # single periods: the noise is not known
    assert not np.any(result.odd.in_band)
    assert np.isnan(result.odd.rms_level_db)
    assert "noise level unknown" in result.summary()
    assert "No odd detection lines" in result.summary()


@pytest.mark.parametrize(
    ("nonlinearity", "even", "odd"),
    [
        (lambda u: u, False, False),
        (lambda u: u + 0.02 * u**2, True, False),
        (lambda u: u + 0.02 * u**3, False, True),
        (lambda u: u + 0.02 * u**2 + 0.02 * u**3, True, True),
    ],
)
def test_parities_are_told_apart(multisine, nonlinearity, even, odd):
    u, y = records(np.random.default_rng(1), multisine, nonlinearity, 1e-3)
    result = distortion_of(u, y)
    assert bool(result.even.above_noise) is even
    assert bool(result.odd.above_noise) is odd
    assert result.summary().count("nothing above noise") == (not even) + (not odd)


def test_level_of_a_square_is_known(multisine):
    """u^2 of a flat multisine: its power is predicted from the spectrum of the true square."""
    rng = np.random.default_rng(2)
    u, y = records(rng, multisine, lambda u: 3 * u + 0.1 * u**2, 0.0, periods=1)
    result = distortion_of(u, y)
    square = np.fft.rfft(0.1 * u[:, 0] ** 2)[:, result.even.harmonics] / SAMPLES
    assert np.allclose(result.even.corrected, square, atol=1e-12, equal_nan=True)
    inside = result.even.in_band
    power = np.mean(np.abs(square[:, inside]) ** 2)
    linear = 9 * (0.15 / 2) ** 2
    assert result.even.rms_level_db == pytest.approx(10 * np.log10(power / linear), abs=1e-6)


def test_distortion_of_the_input_is_no_distortion_of_the_system(multisine):
    """A distorted drive through a linear system: seen at input and output, none left corrected."""
    rng = np.random.default_rng(3)
    drive, _ = records(rng, multisine, lambda u: u, 0.0)
    u = drive + 0.05 * drive**2 + 0.05 * drive**3
    b, a = [0.2], [1, -0.8]  # smooth over the spacing of the lines
    y = np.fft.irfft(
        np.fft.rfft(u) * signal.freqz(b, a, 2 * np.pi * np.arange(SAMPLES // 2 + 1) / SAMPLES)[1],
        SAMPLES,
    )
    u, y = (x + 1e-3 * rng.standard_normal(x.shape) for x in (u, y))
    result = distortion_of(u, y)
    for lines in (result.even, result.odd):
        assert lines.rms_input_level_db > -50
        assert lines.rms_output_level_db > -50
        # what is left comes from interpolating the response between lines
        assert lines.rms_level_db < lines.rms_output_level_db - 20


def test_false_alarms_are_as_rare_as_stated(multisine):
    rng = np.random.default_rng(4)
    alarms = 0
    runs = 300
    for _ in range(runs):
        u, y = records(rng, multisine, lambda u: u, 0.01, realisations=1, periods=2)
        result = distortion_of(u, y)
        alarms += int(result.even.above_noise) + int(result.odd.above_noise)
    # 1 % of 600; eight standard deviations of a Poisson number of 6
    assert alarms < 6 + 8 * np.sqrt(6)


@pytest.mark.parametrize("method", ["average", "local polynomial"])
def test_noise_of_the_actuator_channel_is_no_distortion(method, multisine):
    """Through a resonance it stands on few of the lines, whose variances have a degree of freedom or two."""
    rng, runs = np.random.default_rng(7), 1500
    excited, s = np.arange(81, 120, 2), 2j * np.pi * np.arange(513)
    w0 = 2 * np.pi * 100
    g = 0.1 + 0.04 * w0**2 / (s**2 + 0.04 * w0 * s + w0**2)
    u = multisine(excited, SAMPLES, rng, records=(runs, 1, 1))
    y = np.fft.irfft(np.fft.rfft(u) * g, SAMPLES)
    u, y = (
        np.repeat(x, 2, axis=-2) + noise * rng.standard_normal((runs, 1, 2, SAMPLES))
        for x, noise in ((u, 0.3), (y, 0.01))
    )
    found = estimate_distortion(Spectrum.of(u, y), sample_rate_hz=1024.0, harmonics=excited, method=method)
    assert stats.binom.sf(found.even.above_noise.sum() - 1, runs, 0.015) > 0.005


def test_noise_level_is_that_of_the_mean(multisine):
    rng = np.random.default_rng(5)
    noise, periods = 0.01, 50
    u, y = records(rng, multisine, lambda u: 2 * u, noise, periods=periods)
    level = distortion_of(u, y).even.rms_noise_level_db
    expected = noise**2 * (1 + 4) / (SAMPLES * periods) / (2 * 0.15 / 2) ** 2
    assert level == pytest.approx(10 * np.log10(expected), abs=0.2)


def test_local_polynomial_spectra_serve_as_well(multisine):
    rng = np.random.default_rng(6)
    u, y = records(rng, multisine, lambda u: u + 0.02 * u**2, 1e-3)
    fitted = nonlinear_distortion(
        transient_free_spectra(Spectrum.of(u, y), ALL), EXCITED, sample_rate_hz=1024.0
    )
    plain = distortion_of(u, y)
    assert fitted.even.rms_level_db == pytest.approx(plain.even.rms_level_db, abs=0.05)
    assert bool(fitted.even.above_noise)
    assert not bool(fitted.odd.above_noise)


def test_outside_the_band_nothing_is_corrected(multisine):
    u, y = records(np.random.default_rng(7), multisine, lambda u: u + u**2, 1e-3)
    result = nonlinear_distortion(
        averaged_spectra(Spectrum.of(u, y), np.arange(1, 400)), EXCITED, sample_rate_hz=1024.0
    )
    outside = result.even.harmonics > EXCITED[-1]
    assert np.all(np.isnan(result.even.corrected[:, outside]))
    assert np.all(np.isfinite(result.even.output[:, outside]))
    assert np.array_equal(np.isfinite(result.even.level_db), result.even.in_band)


def test_refusals(multisine):
    u, y = records(np.random.default_rng(8), multisine, lambda u: u, 0.0)
    spectra = averaged_spectra(Spectrum.of(u, y), ALL)
    with pytest.raises(ValueError, match="even ones are among them"):
        nonlinear_distortion(spectra, [1, 2, 3], sample_rate_hz=1.0)
    with pytest.raises(ValueError, match="only excited harmonics"):
        nonlinear_distortion(spectra.at(EXCITED), EXCITED, sample_rate_hz=1.0)
    with pytest.raises(ValueError, match=r"harmonics: \[\d+.*\] are not among the lines"):
        spectra.at([int(ALL[-1]) + 2])
    alone = averaged_spectra(Spectrum.of(u[0], y[0]), ALL)
    with pytest.raises(ValueError, match="with realisations M"):
        nonlinear_distortion(alone, EXCITED, sample_rate_hz=1.0)


@pytest.mark.filterwarnings("error")
def test_of_nothing_there_are_no_decibels():
    assert decibel([1.0, 0.0, 100.0]).tolist() == [0.0, -np.inf, 20.0]
    assert np.isnan(decibel(-1e-20))  # what rounding leaves of a variance of exact data


def drifting(rng, multisine, periods, *, growth=0.02, cubic=0.0, noise=1e-4):
    """Spectra, and the first of one realisation whose response grows steadily."""
    u, y = records(rng, multisine, lambda u: u + cubic * u**3, noise, realisations=1, periods=periods)
    time = np.arange(periods * SAMPLES).reshape(periods, SAMPLES) / SAMPLES
    return Spectrum.of(u, y * (1 + growth * time))


def between(record):
    spectra = spectra_between(record, EXCITED, EXCITED)
    return nonlinear_distortion(spectra, EXCITED, sample_rate_hz=1024.0)


def test_a_response_that_drifts_is_no_distortion(multisine):
    record = drifting(np.random.default_rng(5), multisine, 4)
    as_mean = nonlinear_distortion(
        averaged_spectra(record, ALL, unsettled_periods=1), EXCITED, sample_rate_hz=1024.0
    )
    assert as_mean.even.above_noise
    assert as_mean.odd.above_noise
    found = between(record)
    assert not found.even.above_noise
    assert not found.odd.above_noise
    assert np.abs(found.even.rms_level_db - found.even.rms_noise_level_db) < 2


def test_distortion_of_a_response_that_drifts_has_its_level(multisine):
    level_db = [
        between(drifting(np.random.default_rng(6), multisine, 4, growth=growth, cubic=0.1)).odd
        for growth in (0.0, 0.02)
    ]
    assert level_db[0].above_noise
    np.testing.assert_allclose(level_db[1].rms_level_db, level_db[0].rms_level_db, atol=0.1)


@pytest.mark.parametrize("periods", [3, 4, 6])
def test_drift_that_is_estimated_adds_to_the_variance(multisine, periods):
    """Without drift, noise alone passes for distortion in one of a hundred records, and not in more."""
    rng = np.random.default_rng(periods)
    found = [between(drifting(rng, multisine, periods, growth=0.0)) for _ in range(200)]
    alarms = sum(int(of.even.above_noise) + int(of.odd.above_noise) for of in found)
    assert alarms <= 12  # of 400; four are expected, more than twelve in one of 2000 runs
    power = np.mean([of.even.power[of.even.in_band].mean() for of in found])
    noise = np.mean([of.even.noise_power[of.even.in_band].mean() for of in found])
    assert power / noise == pytest.approx(1, abs=0.05)
