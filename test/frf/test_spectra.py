# SPDX-License-Identifier: Apache-2.0
"""Transforms of records: what they are, in which precision, and that they are made once."""

import numpy as np
import pytest
import scipy.fft

from tactile_resonance.analysis import analyse
from tactile_resonance.frf.spectra import Spectrum, conditional_variance
from tactile_resonance.multisine import design_multisine
from tactile_resonance.recording.recording import Recording


@pytest.mark.parametrize("samples", [60, 61])
@pytest.mark.parametrize("periods", [1, 2, 7])
def test_equal_those_of_the_whole_record_and_of_each_period(samples, periods):
    u, y = np.random.default_rng(periods).standard_normal((2, 5, periods, samples))
    record = Spectrum.of(u, y)
    for row, x in ((0, y), (1, u)):
        whole = np.fft.rfft(x.reshape(5, -1)) / (periods * samples)
        np.testing.assert_allclose(record.bins[:, row], whole, rtol=0, atol=1e-15)
        each = np.fft.rfft(x) / samples
        np.testing.assert_allclose(record.by_period[:, row], each, rtol=0, atol=1e-15)


def test_single_precision_is_transformed_in_double():
    u, y = np.random.default_rng(0).standard_normal((2, 3, 50)).astype(np.float32)
    single, double = Spectrum.of(u, y), Spectrum.of(u.astype(float), y.astype(float))
    assert np.array_equal(single.bins, double.bins)
    assert np.array_equal(single.by_period, double.by_period)


def test_a_channel_does_not_depend_on_the_other():
    """However large the other is, and whether it is there at all."""
    u, y = np.random.default_rng(1).standard_normal((2, 4, 500))
    expected = Spectrum.of(u, y).bins
    assert np.array_equal(Spectrum.of(1e12 * u, y).bins[0], expected[0])
    assert np.array_equal(Spectrum.of(0 * u, y).bins[0], expected[0])
    missing = u.copy()
    missing[2, 7] = np.inf
    bins = Spectrum.of(missing, y).bins
    assert np.array_equal(bins[0], expected[0])
    assert not np.isfinite(bins[1]).any()


def test_shapes_must_fit():
    x = np.zeros((2, 10))
    with pytest.raises(ValueError, match=r"u, y: shapes \(10,\), \(10,\), expected the same"):
        Spectrum.of(x[0], x[0])
    with pytest.raises(ValueError, match=r"u, y: shapes \(2, 10\), \(1, 10\)"):
        Spectrum.of(x, x[:1])
    with pytest.raises(
        ValueError, match=r"samples: shape \(1, 2, 10\), expected \(\.\.\., 2, P, N\)"
    ):
        Spectrum(x[None])


def test_noise_of_the_generator_is_no_variance_given_the_actuator():
    g, u, own = np.array([2 - 1j, 0.5j, 3.0]), np.array([0.7, 2.0, 0.0]), np.array([0.1, 1.0, 0.2])
    covariance = np.array([[np.abs(g) ** 2 * u + own, g * u], [g.conj() * u, u]])
    np.testing.assert_allclose(conditional_variance(covariance), own, rtol=1e-12)


@pytest.mark.parametrize("harmonics_known", [False, True])
def test_a_record_is_transformed_once(monkeypatch, harmonics_known):
    """From the samples to the poles: once as a whole and once by period, never again."""
    transformed = []

    def counted(x, *args, **kwargs):
        transformed.append(np.shape(x))
        return np.fft.rfft(x, *args, **kwargs)

    rng = np.random.default_rng(1)
    excitation = design_multisine(
        sample_rate_hz=5e3, samples_per_period=2000, band_hz=(180.0, 320.0)
    )
    u = np.tile(excitation.period(), (1, 4, 1))
    u, y = (
        u + 1e-3 * rng.standard_normal(u.shape),
        np.roll(u, 1) + 1e-3 * rng.standard_normal(u.shape),
    )
    harmonics = excitation.harmonics if harmonics_known else None
    monkeypatch.setattr(scipy.fft, "rfft", counted)
    analyse(Recording(u, y, 5e3, harmonics), band_hz=(200.0, 300.0))
    assert sorted(transformed) == [(1, 2, 4, 2000), (1, 2, 8000)]
