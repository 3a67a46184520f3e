# SPDX-License-Identifier: Apache-2.0
"""After each period the stream gives what the whole record so far would give."""

import numpy as np
import pytest

from tactile_resonance.frf.fast import fast_frf
from tactile_resonance.frf.local_polynomial import LocalPolynomialPlan
from tactile_resonance.frf.result import FrfStatus
from tactile_resonance.frf.robust import robust_frf
from tactile_resonance.frf.spectra import averaged_spectra
from tactile_resonance.frf.streaming import FrfStream


def assert_equal(frf, expected):
    assert np.array_equal(frf.frequency_hz, expected.frequency_hz)
    for name in ("g", "spectra", "variance_noise", "spectra_covariance"):
        mine, theirs = getattr(frf, name), getattr(expected, name)
        assert np.max(np.abs(mine / theirs - 1)) < 1e-9, name
    assert frf.noise_dof == expected.noise_dof
    assert frf.periods == expected.periods


@pytest.mark.parametrize("band", [(200.0, 300.0), (10.0, 15.0), (9990.0, 10000.0), None])
def test_equals_the_whole_record(shared_data, band):
    with np.load(shared_data / "oracle" / "lpm_full.npz") as data:
        u, y = (data[name].reshape(8, 20000).astype(float) for name in "uy")
        harmonics = data["harm"]
    stream = FrfStream(harmonics, 20000, sample_rate_hz=50e3, band_hz=band)
    for period in range(8):
        frf = stream.add_period(u[period], y[period])
        if period:
            plan = LocalPolynomialPlan(stream.harmonics, 20000, period + 1)
            assert_equal(frf, fast_frf(plan(u[: period + 1], y[: period + 1]), sample_rate_hz=50e3))
    assert frf.frequency_hz[0] >= (band or (0, 0))[0]


@pytest.mark.parametrize("samples", [300, 301])
@pytest.mark.parametrize(("order", "dof"), [(2, 6), (0, 1), (5, 3)])
def test_edges_of_the_spectrum_in_a_band(samples, order, dof):
    """Lines next to zero and next to the Nyquist frequency have neighbours on one side only."""
    rng = np.random.default_rng(samples)
    last = (samples - 1) // 2
    harmonics = np.arange(1, last + 1)
    u, y = rng.standard_normal((2, 5, samples))
    u *= 100.0  # nothing here presumes that noise is weak
    for band in ((0.0, 3.0), (last - 3.0, samples / 2), (0.0, samples / 2)):
        stream = FrfStream(
            harmonics, samples, sample_rate_hz=samples, band_hz=band, order=order, dof=dof
        )
        for period in range(5):
            frf = stream.add_period(u[period], y[period])
            if period:
                plan = LocalPolynomialPlan(stream.harmonics, samples, period + 1, order, dof)
                whole = plan(u[: period + 1], y[: period + 1])
                scale = np.abs(whole.spectra).max(axis=-1, keepdims=True)
                assert np.max(np.abs(frf.spectra - whole.spectra) / scale) < 1e-11
                assert np.allclose(
                    frf.variance_noise,
                    fast_frf(whole, sample_rate_hz=samples).variance_noise,
                    rtol=1e-7,
                )


@pytest.mark.parametrize("band", [(50.0, 90.0), None])
def test_realisations_in_sequence(multisine, band):
    rng = np.random.default_rng(1)
    lines = np.arange(1, 120, 2)
    u = multisine(lines, 512, rng, records=(3, 1)) + 0.1 * rng.standard_normal((3, 4, 512))
    y = 2 * u + 0.1 * u**3 + 0.1 * rng.standard_normal(u.shape)
    stream = FrfStream(lines, 512, sample_rate_hz=512.0, band_hz=band)
    for m in range(3):
        if m:
            stream.next_realisation()
        for p in range(4):
            stream.add_period(u[m, p], y[m, p])
    result = stream.robust()
    plan = LocalPolynomialPlan(stream.harmonics, 512, 4)
    expected = robust_frf(plan(u, y), sample_rate_hz=512.0)
    assert np.allclose(result.frf.g, expected.frf.g, rtol=1e-10)
    assert np.allclose(result.frf.variance_noise, expected.frf.variance_noise, rtol=1e-9)
    assert np.allclose(result.frf.variance_total, expected.frf.variance_total, rtol=1e-9)
    assert result.frf.noise_dof == expected.frf.noise_dof == 3 * plan.noise_dof
    assert result.frf.realisations == 3


def test_first_period_has_no_covariance(multisine):
    rng = np.random.default_rng(2)
    u = multisine([3, 5, 7], 200, rng)
    stream = FrfStream(np.array([3, 5, 7]), 200, sample_rate_hz=200.0)
    frf = stream.add_period(u, 3 * u)
    assert frf.status is FrfStatus.NO_COVARIANCE
    assert frf.variance_noise is None
    assert np.allclose(
        frf.g,
        averaged_spectra(u[None], 3 * u[None], [3, 5, 7]).spectra[0]
        / np.fft.rfft(u)[[3, 5, 7]]
        * 200,
    )
    stream.next_realisation()
    stream.add_period(u, 3 * u)
    assert stream.robust().frf.variance_noise is None  # single periods


def test_memory_is_bounded(multisine):
    u = multisine([3, 5, 7], 200, np.random.default_rng(3))
    for band in (None, (0.0, 10.0)):
        stream = FrfStream([3, 5, 7], 200, sample_rate_hz=200.0, band_hz=band, max_periods=3)
        for _ in range(3):
            stream.add_period(u, u)
        with pytest.raises(ValueError, match="periods: already 3, the most that max_periods"):
            stream.add_period(u, u)
        stream.next_realisation()
        assert stream.add_period(u, u).periods == 1


def test_a_bad_period_is_not_taken(multisine):
    rng = np.random.default_rng(4)
    u = multisine([3, 5, 7], 200, rng) + 0.01 * rng.standard_normal((2, 200))
    stream = FrfStream([3, 5, 7], 200, sample_rate_hz=200.0)
    stream.add_period(u[0], u[0])
    bad = u[1].copy()
    bad[10] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        stream.add_period(u[1], bad)
    with pytest.raises(ValueError, match=r"shape \(199,\), expected \(200,\)"):
        stream.add_period(u[1, :-1], u[1, :-1])
    assert stream.add_period(u[1], u[1]).periods == 2


def test_refusals():
    with pytest.raises(ValueError, match=r"band_hz: 300\.\.400 holds no excited line"):
        FrfStream([3, 5, 7], 200, sample_rate_hz=200.0, band_hz=(300.0, 400.0))
    with pytest.raises(ValueError, match="order, dof: 2, 300 need"):
        FrfStream([3, 5, 7], 200, sample_rate_hz=200.0, dof=300)
    with pytest.raises(ValueError, match="max_periods: 0"):
        FrfStream([3, 5, 7], 200, sample_rate_hz=200.0, max_periods=0)
    stream = FrfStream([3, 5, 7], 200, sample_rate_hz=200.0)
    with pytest.raises(ValueError, match="realisations: 0, expected at least 2"):
        stream.robust()
    with pytest.raises(ValueError, match="periods: 0"):
        stream.next_realisation()
