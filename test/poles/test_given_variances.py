# SPDX-License-Identifier: Apache-2.0
"""What is made of the variances that come with an FRF or spectra: ellipses, alarms, lines left out."""

import numpy as np
import pytest
from poles.mode_at_250_hz import BARE, LINES_HZ, NOISY, G, S, circular, frf, spectra
from scipy import stats

from benchmarks.poles_plant import (
    BAND_HZ,
    HARMONICS,
    SAMPLE_RATE_HZ,
    SAMPLES_PER_PERIOD,
    Plant,
    judge,
)
from tactile_resonance.frf.result import FRF
from tactile_resonance.poles.identify import identify_batch, identify_frf, identify_spectra
from tactile_resonance.poles.joint import JointPlan
from tactile_resonance.poles.result import PolesStatus

RUNS = 2000
FEW = slice(12, 29, 2)  # nine lines, 230 to 270 Hz


def errors_of(result):
    return np.stack([result.f0_hz[:, 0] - 250, result.damping_ratio[:, 0] - 0.02], -1)


def variances(covariance):
    return np.diagonal(covariance[:, 0], axis1=-2, axis2=-1)


def test_covariance_from_noise_beside_a_larger_total_one():
    """Distortion is the same in every run: what differs from run to run is noise, and not where that is."""
    rng = np.random.default_rng(1)
    noise = np.where(LINES_HZ < 250, 1e-6, 1e-7)
    distortion = 1e-5
    g = G + circular(rng, (41,), distortion) + circular(rng, (RUNS, 41), noise)
    result = identify_batch(
        frf(
            g=g,
            variance_noise=noise,
            noise_dof=100,
            variance_total=noise + distortion,
            total_dof=100,
        ),
        structure=BARE,
    )
    found = np.var(errors_of(result), axis=0, ddof=1) / variances(result.covariance).mean(axis=0)
    assert np.all(found * RUNS < stats.chi2.ppf(0.9995, RUNS))
    assert np.all(found * RUNS > stats.chi2.ppf(0.0005, RUNS))
    assert np.all(variances(result.total_covariance) > 5 * variances(result.covariance))


@pytest.mark.parametrize("turn", [1, 1j, -1j])
def test_correlated_noise_of_both_channels(turn):
    """Nine tenths of it are one; what of it is the response's own makes no error."""
    rng = np.random.default_rng(2)
    u = np.exp(2j * np.pi * rng.random(41))
    both, own = circular(rng, (RUNS, 41), 1e-6), circular(rng, (RUNS, 41), 1e-6)
    z = np.stack([G * u + turn * (0.9 * both + np.sqrt(0.19) * own), u + both], axis=1)
    covariance = np.zeros((2, 2, 41), complex)
    covariance[0, 0] = covariance[1, 1] = 1e-6
    covariance[0, 1], covariance[1, 0] = 0.9e-6 * turn, 0.9e-6 * np.conj(turn)
    result = identify_spectra(LINES_HZ, z, covariance, 100, structure=BARE)
    inside = RUNS * judge(errors_of(result), result.covariance[:, 0], np.eye(2))[1]
    assert stats.binom.cdf(inside, RUNS, 0.94) > 0.0005
    assert stats.binom.sf(inside - 1, RUNS, 0.96) > 0.0005
    assert result.has_status(PolesStatus.OK).mean() > 0.98


@pytest.mark.parametrize("dof", [3, 7])
def test_a_correlation_that_turns_over_the_band_is_not_taken_from_all_of_it(dof):
    """Variances are flat; the mean of the correlation, about 0, would make ellipses a third too small."""
    rng = np.random.default_rng(8)
    turn = 0.9j * np.exp(2j * np.pi * (LINES_HZ - 250) / 100)

    def noise(*shape):
        u, own = circular(rng, (*shape, 41), 1e-4), circular(rng, (*shape, 41), 1e-4)
        return np.stack([turn * u + np.sqrt(0.19) * own, u], axis=-2)

    samples = noise(dof, RUNS)
    covariance = np.einsum("krif,krjf->rijf", samples, samples.conj()) / dof
    z = np.stack([G, np.ones(41)]) + noise(RUNS)
    result = identify_spectra(LINES_HZ, z, covariance, dof)
    assert (result.variance_model == "per line").all()
    inside = RUNS * judge(errors_of(result), result.covariance[:, 0], np.eye(2))[1]
    assert stats.binom.cdf(inside, RUNS, 0.94) > 0.0005
    assert result.has_status(PolesStatus.OK).mean() > 0.98


@pytest.mark.parametrize(("dof", "larger"), [(1, 10.0), (3, 2.0), (9, 1.5)])
@pytest.mark.parametrize("given", ["frf", "spectra"])
def test_noise_at_the_mode_is_seen_where_no_test_of_all_lines_sees_it(given, dof, larger):
    """Ellipses from a variance pooled over the band held the mode in 70 to 91 %."""
    rng = np.random.default_rng(9)
    variance = 1e-5 * (1 + larger * np.abs(G - 0.1) ** 2)
    samples = circular(rng, (dof + 1, RUNS, 41), variance)
    g = G + samples[0]
    if given == "frf":
        sample = np.mean(np.abs(samples[1:]) ** 2, axis=0)
        result = identify_batch(frf(g=g, variance_noise=sample, noise_dof=dof), structure=BARE)
    else:
        of_u = circular(rng, (dof + 1, RUNS, 41), 1e-9)
        noise = np.stack([samples, of_u], axis=-2)[1:]
        covariance = np.einsum("krif,krjf->rijf", noise, noise.conj()) / dof
        z = np.stack([g, 1 + of_u[0]], axis=-2)
        result = identify_spectra(LINES_HZ, z, covariance, dof, structure=BARE)
    flat = result.variance_model == "flat"
    inside = judge(errors_of(result)[flat], result.covariance[flat, 0], np.eye(2))[1]
    assert stats.binom.cdf(inside * flat.sum(), flat.sum(), 0.94) > 0.0005


def test_level_from_the_residuals_of_few_lines_is_not_too_small():
    """Five parameters take 2.5 of nine complex residuals: ignored, the level is 28 % low.

    Errors over a level of the 6.5 that are left are Student distributed, of variance 6.5 / 5.5.
    """
    g = G[FEW] + circular(np.random.default_rng(3), (RUNS, 9), 1e-6)
    unknown = identify_batch(FRF(LINES_HZ[FEW], g), structure=BARE)
    exact = FRF(LINES_HZ[FEW], G[None, FEW], variance_noise=np.full((1, 9), 1e-6), noise_dof=10**6)
    known = identify_batch(exact, structure=BARE)
    ratio = variances(unknown.total_covariance) / variances(known.covariance) * 5.5 / 6.5
    assert ratio.mean(axis=0) == pytest.approx(1, abs=4 / np.sqrt(6.5 * RUNS))


def test_a_pooled_level_of_few_degrees_of_freedom_widens_the_ellipse():
    """Nine lines of one degree each: errors are Student distributed, of variance 9/8 if that were ignored.

    Chance makes the samples at the mode larger than the others, too, which adds up to a tenth.
    """
    rng, runs = np.random.default_rng(4), 6000
    g = G[FEW] + circular(rng, (runs, 9), 1e-6)
    sample = 1e-6 * rng.gamma(1, 1, (runs, 9))
    result = identify_batch(
        FRF(LINES_HZ[FEW], g, variance_noise=sample, noise_dof=1), structure=BARE
    )
    flat = result.variance_model == "flat"
    assert flat.mean() > 0.999
    squared = (errors_of(result) ** 2 / variances(result.covariance))[flat]
    scatter = 4 * np.sqrt(2.6 / squared.size)
    assert 0.9 - scatter < squared.mean() < 1 + scatter


def assert_rate(alarms, rate):
    """Smooth residuals are another alarm of one in a thousand."""
    runs = alarms.size
    assert stats.binom.cdf(alarms.sum(), runs, 0.97 * rate) > 0.0005
    assert stats.binom.sf(alarms.sum() - 1, runs, min(1.03 * rate + 1e-3, 1)) > 0.0005


@pytest.mark.parametrize("larger", [1.0, 1.4, 1.8])
def test_errors_larger_than_their_variance_raise_the_alarm_as_often_as_they_must(larger):
    """The cost is gamma distributed with one degree of freedom a line less half the parameters."""
    g = G + circular(np.random.default_rng(5), (RUNS, 41), larger * 1e-6)
    result = identify_batch(
        frf(g=g, variance_noise=np.full(41, 1e-6), noise_dof=10**5), structure=BARE
    )
    cost = stats.gamma(41 - 2.5)
    assert_rate(result.has_status(PolesStatus.MODEL_ERROR), cost.sf(cost.isf(1e-3) / larger))


@pytest.mark.parametrize("larger", [1.4, 1.8])
def test_errors_larger_than_between_harmonics_raise_the_alarm_as_often_as_they_must(larger):
    """Over the level of the bins between, of which the transient takes some: F distributed."""
    plant = Plant(0.02, 60.0, 2)
    bins, rng = plant.bins(), np.random.default_rng(6)
    u, y = plant.noisy(rng, RUNS, bins)
    _, variance = plant.derivatives()
    y = y + circular(rng, y.shape, (larger - 1) * variance * (bins % 2 == 0))
    plan = JointPlan(SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, 2, HARMONICS, BAND_HZ, BARE)
    result = plan.from_bins(u, y)
    # seven parameters, two of them of the transient: half of each goes to either kind of bins
    cost = stats.f(2 * 41 - 6, 2 * 40 - 1)
    assert_rate(result.has_status(PolesStatus.MODEL_ERROR), cost.sf(cost.isf(1e-3) / larger))


@pytest.mark.parametrize("channel", [0, 1])
def test_a_line_on_which_one_channel_has_no_variance_is_left_out(channel):
    covariance = spectra()["covariance"].copy()
    covariance[channel, channel, 20] = 0.0
    given = spectra(covariance=covariance)
    given["spectra"][:, 20] += 0.1
    result = identify_spectra(**given)
    assert result.lines == 40
    assert result.status() is PolesStatus.OK
    assert result.residual[20] == 0


@pytest.mark.parametrize("distance_hz", [2.0, 5.0])
def test_two_modes_taken_for_one_are_within_the_total_covariance(distance_hz):
    """One between them fits so well that residuals and halves of the lines tell little; two tell."""
    w = 2 * np.pi * (250 + distance_hz)
    second = 0.04 * w**2 / (S**2 + 0.04 * w * S + w**2)
    g = G + second + circular(np.random.default_rng(7), (40, 41), 1e-7)
    result = identify_batch(frf(g=g, variance_noise=np.full(41, 1e-7), noise_dof=50))
    told = result.has_status(PolesStatus.MODEL_ERROR)
    assert told.mean() > 0.9
    std = np.sqrt(result.total_covariance[told, 0, 0, 0])
    off = np.abs(result.f0_hz[told] - [250, 250 + distance_hz]).min(axis=-1)
    assert np.mean(off < 3 * std) > 0.8


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, -1e-7])
def test_lines_without_a_variance_of_noise_are_left_out(value):
    """Beside a variance in total the covariance of the whole point was NaN, for too few degrees of freedom."""
    noise, total = np.full(41, 5e-7), np.full(41, 1e-6)
    given = {"variance_total": total, "total_dof": 7}
    keep = np.arange(41) != 7
    noise[7] = value
    poles = identify_frf(frf(variance_noise=noise, **given), structure=BARE)
    assert poles.status is PolesStatus.OK
    assert "1 lines without" in poles.message
    lines = {"frequency_hz": LINES_HZ[keep], "g": NOISY[keep], "variance_noise": noise[keep]}
    without = identify_frf(frf(**lines, variance_total=total[keep], total_dof=7), (200, 300), BARE)
    np.testing.assert_allclose(poles.covariance, without.covariance, rtol=1e-4)
    np.testing.assert_allclose(poles.total_covariance, without.total_covariance, rtol=1e-4)


def test_total_variances_without_any_of_noise():
    given = {"variance_total": np.full(41, 1e-6), "total_dof": 7}
    poles = identify_frf(frf(variance_noise=np.full(41, np.nan), **given), structure=BARE)
    assert poles.status is PolesStatus.NO_COVARIANCE
    assert poles.covariance is None
    assert poles.total_covariance is not None
    assert "noise alone" in poles.message
