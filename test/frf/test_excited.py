# SPDX-License-Identifier: Apache-2.0
"""Excited lines are found exactly, whatever noise and distortion the input carries."""

import numpy as np
import pytest
from scipy import io, signal

from tactile_resonance.frf import excited
from tactile_resonance.frf.spectra import Spectrum

SILVERBOX_ENDS = (48946, 57646, 66346, 75046, 83746, 92396, 101096, 109796, 118496, 127196)


def find_excited_harmonics(u):
    """Of records of the input; what the sensor holds does not matter."""
    return excited.find_excited_harmonics(Spectrum.of(u, np.full_like(u, np.nan)))


def multisine(harmonics, samples, rng, amplitude=0.05):
    spectrum = np.zeros(samples // 2 + 1, complex)
    spectrum[harmonics] = amplitude * np.exp(2j * np.pi * rng.random(len(harmonics)))
    return np.fft.irfft(spectrum * samples / 2, samples)


@pytest.mark.parametrize("periods", [1, 2, 3, 8])
def test_full_grid_of_a_record_from_rest(shared_data, periods):
    data = np.load(shared_data / "oracle" / "lpm_full.npz")
    u = data["u"].reshape(8, 20000)[:periods]
    assert np.array_equal(find_excited_harmonics(u), data["harm"])


@pytest.mark.parametrize("periods", [1, 2, 4])
def test_odd_random_grid(shared_data, periods):
    data = np.load(shared_data / "oracle" / "nl_odd_random_grid.npz")
    assert np.array_equal(find_excited_harmonics(data["u"][:, :periods]), data["ex"])
    assert np.array_equal(find_excited_harmonics(data["u"][0, :periods]), data["ex"])


def test_measured_odd_multisine_with_mains_hum(shared_data):
    samples = io.loadmat(shared_data / "silverbox" / "SNLS80mV.mat")["V1"][0]
    u = np.stack([samples[end - 8192 : end] for end in SILVERBOX_ENDS])[:, None, :]
    expected = np.arange(1, 2684, 2)
    assert np.array_equal(find_excited_harmonics(u), expected)
    for single in u:
        assert np.array_equal(find_excited_harmonics(single), expected)


@pytest.mark.parametrize("periods", [1, 2, 5])
@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_input_distortion_is_not_excitation(periods, noise):
    rng = np.random.default_rng(1)
    odd = np.arange(1, 800, 2)
    clean = multisine(odd, 4096, rng)
    u = np.tile(clean + 0.004 * clean**2 + 0.001 * clean**3, (periods, 1))
    u = u + noise * rng.standard_normal(u.shape)
    assert np.array_equal(find_excited_harmonics(u), odd)


def test_every_line_up_to_nyquist_and_odd_period_length():
    rng = np.random.default_rng(2)
    for samples in (400, 401):
        lines = np.arange(1, (samples - 1) // 2 + 1)
        u = np.tile(multisine(lines, samples, rng), (3, 1))
        u = u + 0.01 * rng.standard_normal(u.shape)
        assert np.array_equal(find_excited_harmonics(u), lines)


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("step", [1, 2])
def test_most_lines_of_a_single_period(noise, step):
    rng = np.random.default_rng(6)
    lines = np.arange(11, 960, step)  # of 1023
    u = multisine(lines, 2048, rng) + noise * rng.standard_normal((3, 1, 2048))
    assert np.array_equal(find_excited_harmonics(u), lines)
    assert np.array_equal(find_excited_harmonics(u[0]), lines)


def test_coloured_noise_and_shaped_amplitude():
    rng = np.random.default_rng(3)
    lines = np.arange(2, 300)
    u = np.tile(multisine(lines, 2000, rng, amplitude=10.0 / lines), (6, 1))  # 43 dB of range
    noise = 0.01 * np.cumsum(rng.standard_normal(u.size)).reshape(u.shape)
    assert np.array_equal(find_excited_harmonics(u + noise), lines)


@pytest.mark.parametrize("periods", [2, 3, 8])
@pytest.mark.parametrize("pole", [0.0, 0.98, 0.999 * np.exp(0.05j), 0.9999 * np.exp(0.05j)])
def test_strong_coloured_noise_makes_no_line(pole, periods):
    """6 dB below the multisine, white, red or of a resonance: lines may be missed, hardly one is false."""
    rng = np.random.default_rng(7)
    denominator = np.real(np.poly([pole, np.conj(pole)]))
    with_false = 0
    for lines in (np.arange(11, 251), np.arange(11, 491, 2)):
        for _ in range(20):
            clean = multisine(lines, 2000, rng)
            noise = signal.lfilter([1.0], denominator, rng.standard_normal(periods * 2000))
            noise *= 0.5 * clean.std() / noise.std()
            found = find_excited_harmonics(
                np.tile(clean, (periods, 1)) + noise.reshape(periods, -1)
            )
            with_false += np.setdiff1d(found, lines).size > 0
    assert with_false <= 1  # of 40 records


def test_a_single_tone():
    u = np.tile(np.cos(2 * np.pi * 7 * np.arange(500) / 500), (2, 1))
    u = u + 1e-3 * np.random.default_rng(4).standard_normal(u.shape)
    assert find_excited_harmonics(u).tolist() == [7]


@pytest.mark.parametrize("periods", [1, 4])
def test_noise_alone_is_refused(periods):
    rng = np.random.default_rng(5)
    for _ in range(100):
        with pytest.raises(ValueError, match="u: "):
            find_excited_harmonics(rng.standard_normal((periods, 1000)))


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="u: 3 samples in a period, expected 4 or more"):
        find_excited_harmonics(np.zeros((2, 3)))
    with pytest.raises(ValueError, match="not finite"):
        find_excited_harmonics(np.full((2, 10), np.nan))
