# SPDX-License-Identifier: Apache-2.0
"""Transforms of records: what they are, in which precision, and that they are made once.

Fast local polynomial method: reference answers, exactness, sign convention, edges, refusals.
"""

import numpy as np
import pytest
import scipy.fft
from scipy import signal

from tactile_resonance.analysis import analyse
from tactile_resonance.frf.estimate import frf_of_realisations
from tactile_resonance.frf.result import FrfStatus
from tactile_resonance.frf.spectra import (
    Spectrum,
    averaged_spectra,
    conditional_variance,
    stacked_spectra,
    transient_free_spectra,
)
from tactile_resonance.multisine import design_multisine
from tactile_resonance.poles.compiled import compiled
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
    compiled()  # the first fit of a process has transforms of its own
    monkeypatch.setattr(scipy.fft, "rfft", counted)
    analyse(Recording(u, y, 5e3, harmonics), band_hz=(200.0, 300.0))
    assert sorted(transformed) == [(1, 2, 4, 2000), (1, 2, 8000)]


@pytest.fixture(scope="module")
def oracle(shared_data):
    with np.load(shared_data / "oracle" / "lpm_full.npz") as data:
        return dict(data)


@pytest.mark.parametrize(
    ("key", "harmonics", "order", "dof", "actual_dof"),
    [
        ("order2_dof6", np.arange(4, 4001), 2, 6, 7),
        ("order2_dof2", np.arange(4, 4001), 2, 2, 3),
        ("order4_dof6_h80_120", np.arange(80, 121), 4, 6, 7),
    ],
)
def test_equals_the_reference_implementation(oracle, key, harmonics, order, dof, actual_dof):
    record = Spectrum.of(oracle["u"].reshape(8, 20000), oracle["y"].reshape(8, 20000))
    result = transient_free_spectra(record, harmonics, order=order, dof=dof)
    assert np.max(np.abs(result.spectra / oracle[f"Z_{key}"] - 1)) < 1e-9
    assert np.max(np.abs(result.covariance / oracle[f"CZ_{key}"] - 1)) < 1e-7
    assert result.noise_dof == actual_dof


def test_single_precision_records_give_what_their_double_copies_give(oracle):
    u, y = oracle["u"].reshape(8, 20000), oracle["y"].reshape(8, 20000)
    assert u.dtype == y.dtype == np.float32
    single, double = (
        transient_free_spectra(Spectrum.of(u.astype(kind), y.astype(kind)), oracle["harm"])
        for kind in (np.float32, float)
    )
    assert np.array_equal(single.spectra, double.spectra)
    assert np.array_equal(single.covariance, double.covariance)


@pytest.mark.parametrize("periods", [2, 3, 5, 8])
@pytest.mark.parametrize("samples", [400, 401])
@pytest.mark.parametrize("order", [0, 2, 3])
def test_polynomial_transient_is_removed_exactly(periods, samples, order):
    """A spectrum that is a polynomial in the bin number leaves no trace, up to the edges."""
    rng = np.random.default_rng(periods)
    harmonics = np.arange(1, (samples - 1) // 2 + 1)
    bins = np.arange(periods * samples // 2 + 1)
    coefficients = rng.standard_normal((2, order + 1)) + 1j * rng.standard_normal((2, order + 1))
    transient = np.polynomial.polynomial.polyval(bins / bins[-1], coefficients.T)  # (2, K)
    lines = rng.standard_normal((2, harmonics.size)) + 1j
    spectrum = transient.copy()
    spectrum[:, harmonics * periods] += lines
    record = np.fft.irfft(spectrum, periods * samples, norm="forward")  # (2, P N)
    record = Spectrum(record.reshape(2, periods, samples))
    result = transient_free_spectra(record, harmonics, order=order, dof=4)
    assert np.allclose(result.spectra, lines, atol=1e-8 * np.abs(transient).max())
    assert np.max(np.abs(result.covariance)) < 1e-16 * np.abs(transient).max() ** 2


def test_what_stands_at_other_harmonics_does_not_matter(multisine):
    rng = np.random.default_rng(1)
    odd = np.arange(1, 200, 2)
    u = np.tile(multisine(odd, 1000, rng), (3, 1)) + 0.01 * rng.standard_normal((3, 1000))
    even = np.tile(multisine(np.arange(2, 200, 2), 1000, rng), (3, 1))
    quiet, distorted = (transient_free_spectra(Spectrum.of(x, x), odd) for x in (u, u + even))
    assert np.allclose(quiet.spectra, distorted.spectra, rtol=0, atol=1e-12)
    assert np.allclose(quiet.covariance, distorted.covariance, rtol=1e-9, atol=0)


def test_lines_do_not_depend_on_which_others_are_wanted():
    rng = np.random.default_rng(2)
    u, y = rng.standard_normal((2, 4, 3, 500))  # (M, P, N) each
    full = transient_free_spectra(Spectrum.of(u, y), np.arange(1, 250))
    some = np.array([1, 2, 7, 50, 51, 60, 249])
    part = transient_free_spectra(Spectrum.of(u, y), some)
    assert part.spectra.shape == (4, 2, 7)
    assert part.covariance.shape == (4, 2, 2, 7)
    assert np.allclose(part.spectra, full.spectra[..., some - 1], rtol=1e-12, atol=0)
    assert np.allclose(part.covariance, full.covariance[..., some - 1], rtol=1e-10, atol=0)
    one = transient_free_spectra(Spectrum.of(u[2], y[2]), some)
    assert np.allclose(one.covariance, part.covariance[2], rtol=1e-10, atol=0)


def test_covariance_is_hermitian_and_positive():
    rng = np.random.default_rng(3)
    u, y = rng.standard_normal((2, 2, 300))
    c = transient_free_spectra(Spectrum.of(u, y), np.arange(1, 150)).covariance
    assert np.array_equal(c[0, 1], c[1, 0].conj())
    assert np.all(np.linalg.eigvalsh(np.moveaxis(c, -1, 0)) > 0)


def _pure_delay(f, rate):
    return np.exp(-2j * np.pi * f * 3.7 / rate)


def _rc_low_pass(f, rate):
    return 1 / (1 + 1j * f / (0.05 * rate))


@pytest.mark.parametrize("system", [_pure_delay, _rc_low_pass])
@pytest.mark.parametrize("method", ["fast", "averaged"])
def test_response_is_not_conjugated(multisine, system, method):
    """exp(+j omega t): a delay and a low-pass have negative phase."""
    rng = np.random.default_rng(4)
    samples, rate = 1000, 5000.0
    lines = np.arange(1, 60)
    u = multisine(lines, samples, rng)
    f_all = np.fft.rfftfreq(samples, 1 / rate)
    y = np.fft.irfft(np.fft.rfft(u) * system(f_all, rate), samples)
    u, y = np.tile(u, (3, 1)), np.tile(y, (3, 1))
    estimate = transient_free_spectra if method == "fast" else averaged_spectra
    frf = frf_of_realisations(estimate(Spectrum.of(u[None], y[None]), lines), sample_rate_hz=rate)
    assert np.allclose(frf.frequency_hz, lines * 5.0)
    assert np.allclose(frf.g, system(frf.frequency_hz, rate), atol=1e-12)
    assert np.all(np.angle(frf.g[:20]) < 0)


def test_a_cosine_of_peak_a_gives_half_a():
    t = np.arange(400) / 100
    u = 0.6 * np.cos(2 * np.pi * 7 * t + 0.4).reshape(4, 100)
    y = 3 * np.cos(2 * np.pi * 7 * t - 0.2).reshape(4, 100)
    spectra = transient_free_spectra(Spectrum.of(u, y), [7]).spectra[:, 0]
    assert np.allclose(spectra, [1.5 * np.exp(-0.2j), 0.3 * np.exp(0.4j)], atol=1e-12)


def test_transient_of_a_resonance_from_rest(multisine):
    """Without noise the error falls with the order, far below that of averaging all periods."""
    rng = np.random.default_rng(5)
    samples, periods = 2000, 4
    lines = np.arange(2, 300)
    b, a = [0.1, 0.05], [1, -2 * 0.995 * np.cos(0.3), 0.995**2]
    u = np.tile(multisine(lines, samples, rng), periods)
    y = signal.lfilter(b, a, u)
    u, y = u.reshape(periods, samples), y.reshape(periods, samples)
    truth = signal.freqz(b, a, 2 * np.pi * lines / samples)[1]

    def error(spectra):
        g = frf_of_realisations(stacked_spectra([spectra]), sample_rate_hz=1.0).g
        return np.sqrt(np.mean(np.abs(g / truth - 1) ** 2))

    plain = error(averaged_spectra(Spectrum.of(u, y), lines))
    order = {
        r: error(transient_free_spectra(Spectrum.of(u, y), lines, order=r, dof=2))
        for r in (0, 2, 4)
    }
    assert plain > 30 * order[2]
    assert order[0] > 3 * order[2] > 9 * order[4]


def test_weak_input_is_suspect():
    rng = np.random.default_rng(6)
    u, y = rng.standard_normal((2, 1, 4, 200))
    spectra = transient_free_spectra(Spectrum.of(u, y), np.arange(3, 40))
    frf = frf_of_realisations(spectra, sample_rate_hz=200.0)
    assert frf.status is FrfStatus.SUSPECT
    assert "10 dB above its noise" in frf.message


def test_a_single_period_has_no_covariance(multisine):
    u = multisine([3, 5], 100, np.random.default_rng(7))[None, None]
    spectra = averaged_spectra(Spectrum.of(u, 2 * u), [3, 5])
    frf = frf_of_realisations(spectra, sample_rate_hz=100.0)
    assert frf.status is FrfStatus.NO_COVARIANCE
    assert frf.variance is None
    assert frf.sensor_variance_given_actuator is None
    assert np.allclose(frf.g, 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"periods": 1}, "a record of 1 x 50 samples has 0; lower either or record more"),
        ({"order": -1}, "order: -1"),
        ({"dof": 0}, "dof: 0"),
        ({"dof": 90}, "dof: 2, 90 need 94 bins between harmonics, .* has 50; lower either"),
        ({"harmonics": np.array([0, 1])}, r"harmonics: got '0\.\.1'; .* within 1\.\.24"),
        ({"harmonics": np.array([3, 25])}, r"harmonics: got '3\.\.25'; .* within 1\.\.24"),
        ({"harmonics": np.array([3, 3])}, "harmonics: .* ascending"),
        ({"harmonics": np.array([1.5])}, "harmonics: got 'float64 of shape"),
        ({"harmonics": np.array([], int)}, "harmonics: .* F >= 1"),
    ],
)
def test_what_is_impossible_is_refused(change, message):
    def run(periods=3, harmonics=(3, 4), **options):
        silent = Spectrum(np.zeros((2, periods, 50)))
        transient_free_spectra(silent, np.array(harmonics), **{"dof": 2, **options})

    run()
    with pytest.raises(ValueError, match=message):
        run(**change)


def test_bad_records_are_named():
    good = np.zeros((3, 50))
    gap = good.copy()
    gap[1, 7] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        transient_free_spectra(Spectrum.of(gap, good), [3, 4], dof=2)
