# SPDX-License-Identifier: Apache-2.0
"""Several realisations of the phases: bound, ellipses, distortion and model error told apart."""

import numpy as np
import pytest
from poles.mode_at_250_hz import circular
from scipy import stats

from benchmarks.cubic_resonator import HARMONICS as LINES
from benchmarks.cubic_resonator import SAMPLE_RATE_HZ as RATE_HZ
from benchmarks.cubic_resonator import SAMPLES_PER_PERIOD as SAMPLES
from benchmarks.cubic_resonator import records
from benchmarks.poles_plant import (
    BAND_HZ,
    HARMONICS,
    SAMPLE_RATE_HZ,
    SAMPLES_PER_PERIOD,
    Plant,
    bound_of_realisations,
    judge,
)
from tactile_resonance.poles.estimator import identify_poles_from_records
from tactile_resonance.poles.joint import JointPlan, PoleEstimator
from tactile_resonance.poles.result import PolesStatus, single
from tactile_resonance.poles.structure import ModelStructure

BARE = ModelStructure(2, 2)
RUNS = 600


def plants(damping_ratio, snr_db, periods, realisations):
    return [Plant(damping_ratio, snr_db, periods, seed=10 + m) for m in range(realisations)]


def spectra(plants, rng, runs, distortion=0.0):
    """(runs, M, K) both; distortion is the variance of another error on excited bins."""
    bins = plants[0].bins()
    pairs = [plant.noisy(rng, runs, bins) for plant in plants]
    u, y = (np.stack(channel, axis=1) for channel in zip(*pairs, strict=True))
    if distortion:
        y += circular(rng, y.shape, distortion) * (bins % plants[0].periods == 0)
    return u, y


def plan_of(periods, structure=BARE, kind=PoleEstimator, **options):
    return kind(
        SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, periods, HARMONICS, BAND_HZ, structure, **options
    )


def errors_of(result, damping_ratio):
    return np.stack([result.f0_hz[:, 0] - 250, result.damping_ratio[:, 0] - damping_ratio], -1)


def assert_honest(errors, covariance, bound):
    """Goals fail where the 99.9 % interval of the Monte Carlo excludes them."""
    runs = errors.shape[0]
    ratio, coverage = judge(errors, covariance, bound)
    assert np.all(ratio * runs / stats.chi2.ppf(0.9995, runs) <= 1.05)
    assert np.all(ratio * runs / stats.chi2.ppf(0.0005, runs) >= 0.95)
    assert stats.binom.cdf(coverage * runs, runs, 0.94) > 0.0005
    assert stats.binom.sf(coverage * runs - 1, runs, 0.96) > 0.0005


@pytest.mark.parametrize("damping_ratio", [0.01, 0.05])
@pytest.mark.parametrize(("realisations", "periods"), [(2, 1), (2, 2), (4, 8), (7, 1)])
def test_reaches_the_bound_with_honest_ellipses(realisations, periods, damping_ratio):
    all_plants = plants(damping_ratio, 30.0, periods, realisations)
    u, y = spectra(all_plants, np.random.default_rng(1), RUNS)
    result = plan_of(periods).from_bins(u, y)
    errors = errors_of(result, damping_ratio)
    for covariance in (result.covariance, result.total_covariance):
        assert_honest(errors, covariance[:, 0], bound_of_realisations(all_plants))
    # three tests of one in a thousand each
    alarms = np.sum(result.has_status(PolesStatus.MODEL_ERROR))
    assert stats.binom.sf(alarms - 1, RUNS, 3e-3) > 0.001
    assert np.all(result.has_status(PolesStatus.OK) | result.has_status(PolesStatus.MODEL_ERROR))


@pytest.mark.parametrize(("realisations", "periods"), [(2, 1), (2, 2), (4, 2), (4, 8)])
def test_distortion_is_told_from_noise_and_from_model_error(realisations, periods):
    """Poles are those of the excited lines: what rings between them may be of another system."""
    all_plants = plants(0.01, 40.0, periods, realisations)
    level = 100 * all_plants[0].noise[0]
    u, y = spectra(all_plants, np.random.default_rng(2), RUNS, level)
    result = plan_of(periods).from_bins(u, y)
    errors, total = errors_of(result, 0.01), result.total_covariance[:, 0]
    alarms = np.sum(result.has_status(PolesStatus.MODEL_ERROR))
    assert stats.binom.sf(alarms - 1, RUNS, 3e-3) > 0.001
    if periods == 1:  # noise or distortion: lines are taken to be independent
        assert_honest(errors, result.covariance[:, 0], bound_of_realisations(all_plants, level))
    else:
        alone = plan_of(periods, kind=JointPlan).from_bins(u, y)
        mean = np.stack([alone.f0_hz[..., 0] - 250, alone.damping_ratio[..., 0] - 0.01], -1)
        assert np.all(np.mean(errors**2, axis=0) < 1.1 * np.mean(mean.mean(axis=1) ** 2, axis=0))
        assert np.median(result.noise_variance[:, 0]) == pytest.approx(level / 100, rel=0.05)
    coverage = judge(errors, total, np.eye(2))[1]
    assert stats.binom.cdf(coverage * RUNS, RUNS, 0.94) > 0.0005


OF_DIFFERENT_SYSTEMS = [(m, p, by) for m, p in [(3, 2), (4, 2), (6, 4), (5, 1)] for by in (-1.0, 1.5, 0.0)]


# without a third record nothing tells which of two holds a response
@pytest.mark.parametrize(
    ("realisations", "periods", "factor"), [(2, 2, -1.0), (2, 2, 1.5), *OF_DIFFERENT_SYSTEMS]
)
def test_records_of_different_systems_are_no_certain_result(realisations, periods, factor):
    """Where the polarity of one differs, what is left of the mean is of neither: off by up to 32 deviations."""
    all_plants = plants(0.02, 40.0, periods, realisations)
    u, y = spectra(all_plants, np.random.default_rng(3), 50)
    good = plan_of(periods).from_bins(u, y)
    assert np.mean(good.has_status(PolesStatus.OK)) > 0.9
    error = all_plants[1].noisy(np.random.default_rng(4), 50, all_plants[1].bins())
    y[:, 1] = factor * y[:, 1] if factor else error[1] - np.mean(error[1], axis=0)
    result = plan_of(periods).from_bins(u, y)
    wrong = ~result.has_status(PolesStatus.OK)  # a model error, or even an unstable pole
    assert np.mean(wrong) > 0.9
    assert all("realisation" in remark for remark in result.remark[wrong])
    if factor < 0:
        assert np.isnan(result.total_covariance[wrong]).all()
        assert np.isnan(result.covariance[wrong]).all()
    else:
        errors, total = errors_of(result, 0.02)[wrong], result.total_covariance[wrong, 0]
        assert judge(errors, total, np.eye(2))[1] > 0.9


@pytest.mark.parametrize("realisations", [2, 3, 4, 8])
def test_actuator_and_sensor_of_different_records_are_no_certain_result(realisations):
    """Files in the wrong order: a third of such fits was ok, by up to 17 deviations off."""
    all_plants = plants(0.02, 30.0, 2, realisations)
    u, y = spectra(all_plants, np.random.default_rng(6), 50)
    plan = plan_of(2, ModelStructure())
    result = plan.from_bins(u, np.roll(y, 1, axis=1))
    assert not result.has_status(PolesStatus.OK).any()
    assert np.mean(["nothing in common" in remark for remark in result.remark]) > 0.95
    assert np.isnan(result.total_covariance).all()


def test_strong_distortion_is_no_other_system():
    """6 dB below the response."""
    all_plants = plants(0.02, 40.0, 2, 3)
    clean = all_plants[0].noisy(np.random.default_rng(7), 1, all_plants[0].bins())[1]
    level = float(np.mean(np.abs(clean[0, ::2]) ** 2)) / 4
    u, y = spectra(all_plants, np.random.default_rng(8), RUNS, level)
    found = ["nothing in common" in remark for remark in plan_of(2).from_bins(u, y).remark]
    assert np.mean(found) < 0.005


def test_transients_do_not_hide_that_records_are_of_different_systems():
    """Of a narrow mode and one period they take up what differs: off by up to eleven deviations."""
    all_plants = plants(0.005, 40.0, 1, 7)
    u, y = spectra(all_plants, np.random.default_rng(5), 50)
    y[:, 1] *= -1
    result = plan_of(1).from_bins(u, y)
    assert not result.has_status(PolesStatus.OK).any()
    assert all("realisation 2" in remark for remark in result.remark)


NOT_LINEAR = (RATE_HZ, SAMPLES, 2, LINES, (200.0, 300.0), BARE)


@pytest.fixture(scope="module", params=[(2.8e-5, 40.0), (2.5e-4, 60.0)])
def not_linear(request):
    """Records u, y (960, 2, samples) of a resonator that is not linear, and (960, 2) poles of each alone."""
    u, y = records(np.random.default_rng(14), 960, 2, *request.param)
    alone = JointPlan(*NOT_LINEAR)(u, y)
    return u, y, np.stack([alone.f0_hz[:, 0], alone.damping_ratio[:, 0]], axis=-1)


@pytest.mark.parametrize("realisations", [2, 4, 8])
def test_ellipse_holds_the_linear_approximation_of_a_resonator_that_is_not_linear(
    realisations, not_linear
):
    """Each realisation is another system: 3 to 40 % of ellipses from the scatter on lines would hold it."""
    groups = 120
    truth = not_linear[2].mean(axis=0)
    u, y, each = (
        v[: groups * realisations].reshape(groups, realisations, *v.shape[1:]) for v in not_linear
    )
    result = PoleEstimator(*NOT_LINEAR)(u, y)
    errors = np.stack([result.f0_hz[:, 0], result.damping_ratio[:, 0]], axis=-1) - truth
    coverage = judge(errors, result.total_covariance[:, 0], np.eye(2))[1]
    assert stats.binom.cdf(coverage * groups, groups, 0.94) > 0.0005
    of_singles = np.mean((each.mean(axis=1) - truth) ** 2, axis=0)
    assert np.all(np.mean(errors**2, axis=0) < 1.2 * of_singles)
    # usable: not all is flagged, and ellipses are no wider than so few realisations need
    assert result.has_status(PolesStatus.OK).mean() > 0.75
    if realisations == 8:
        stated = np.sqrt(np.median(result.total_covariance[:, 0, 0, 0]))
        assert stated < 1.6 * np.std(errors[:, 0])


@pytest.mark.parametrize("odd", [0, 2])
def test_one_realisation_that_departs_from_all_others_is_named(odd):
    """A contact that was lost in one of four, or a tip that slid."""
    rng = np.random.default_rng(15)
    all_plants = plants(0.02, 40.0, 2, 4)
    all_plants[odd] = Plant(0.0205, 40.0, 2, seed=10 + odd)
    result = plan_of(2).from_bins(*spectra(all_plants, rng, 50))
    assert result.has_status(PolesStatus.MODEL_ERROR).all()
    named = [
        f"realisation {odd + 1} departs from the other 3, which agree" in r for r in result.remark
    ]
    assert np.mean(named) > 0.7  # the others differ as much by chance in half of the cases at most
    agreeing = plan_of(2).from_bins(*spectra(plants(0.02, 40.0, 2, 4), rng, RUNS))
    wrongly = sum("departs" in remark for remark in agreeing.remark)
    assert stats.binom.sf(wrongly - 1, RUNS, 1e-3) > 0.001


class NoisyOutput(Plant):
    """Ten times the noise of the sensor, as where somebody walks by during one realisation."""

    @property
    def noise(self):
        return 100 * super().noise[0], super().noise[1]


@pytest.mark.parametrize(("realisations", "periods"), [(2, 8), (3, 2), (8, 2)])
def test_a_noisy_realisation_counts_by_its_noise(realisations, periods):
    """Counted like the others variances were 15 to 20 times the bound, and of eight it departed in 8 %."""
    all_plants = plants(0.02, 40.0, periods, realisations)
    all_plants[1] = NoisyOutput(0.02, 40.0, periods, seed=11)
    result = plan_of(periods).from_bins(*spectra(all_plants, np.random.default_rng(23), RUNS))
    errors, bound = errors_of(result, 0.02), bound_of_realisations(all_plants)
    # in one record of a hundred noise looks like distortion, and all count alike: medians leave these out
    ratio = np.median(errors**2, axis=0) / np.diag(bound) / stats.chi2.median(1)
    stated = np.median(result.total_covariance[:, 0][:, [0, 1], [0, 1]], axis=0) / np.diag(bound)
    assert np.all(ratio < 1.3)
    assert np.all(stated < 1.3)
    for covariance in (result.covariance, result.total_covariance):
        inside = RUNS * judge(errors, covariance[:, 0], bound)[1]
        assert stats.binom.cdf(inside, RUNS, 0.94) > 0.0005
    assert result.has_status(PolesStatus.OK).mean() > 0.99
    assert np.mean(["departs" in remark for remark in result.remark]) < 0.005
    # transients and levels are those of the records as they are
    noise = np.mean([plant.noise[0] for plant in all_plants])
    assert np.median(result.noise_variance[:, 0]) == pytest.approx(noise, rel=0.2)
    bins, own = all_plants[0].bins(), result.fit.transient.shape[-1] // realisations
    of_a = plan_of(periods).denominator_basis.values @ result.fit.denominator[0]
    for m, plant in enumerate(all_plants):
        c = plan_of(periods).transient_on_bins @ result.fit.transient[0, m * own : (m + 1) * own]
        between = bins % periods != 0
        off = np.mean(np.abs((c / of_a - plant.output(bins))[between]) ** 2)
        assert off < plant.noise[0]


def test_where_lines_are_distorted_a_noisy_realisation_counts_like_the_others():
    """How much distortion is in each nobody knows: of two the quieter one's would be a model error."""
    all_plants = [Plant(0.02, 40.0, 2, seed=10), NoisyOutput(0.02, 40.0, 2, seed=11)]
    level = 10 * all_plants[0].noise[0]
    result = plan_of(2).from_bins(*spectra(all_plants, np.random.default_rng(24), RUNS, level))
    assert result.has_status(PolesStatus.OK).mean() > 0.99
    inside = RUNS * judge(errors_of(result, 0.02), result.total_covariance[:, 0], np.eye(2))[1]
    assert stats.binom.cdf(inside, RUNS, 0.94) > 0.0005


def test_covariance_from_noise_is_what_repeated_noise_makes():
    """Distortion stays the same from run to run: it is the system's, only noise is another."""
    all_plants = plants(0.02, 40.0, 2, 3)
    rng = np.random.default_rng(3)
    u, y = spectra(all_plants, rng, RUNS)
    fixed = circular(rng, y.shape[1:], 100 * all_plants[0].noise[0])
    result = plan_of(2).from_bins(u, y + fixed * (all_plants[0].bins() % 2 == 0))
    found = np.var(errors_of(result, 0.02), axis=0, ddof=1)
    stated = np.mean(np.diagonal(result.covariance[:, 0], axis1=-2, axis2=-1), axis=0)
    assert np.all(found / stated * RUNS < stats.chi2.ppf(0.9995, RUNS))
    assert np.all(found / stated * RUNS > stats.chi2.ppf(0.0005, RUNS))
    total = np.mean(result.total_covariance[:, 0, 0, 0])
    assert total > 1.5 * stated[0]


def test_input_noise_that_nobody_knows_is_weighted_by_what_realisations_differ_by():
    all_plants = plants(0.01, 40.0, 1, 4)
    u, y = spectra(all_plants, np.random.default_rng(4), RUNS)
    result = plan_of(1).from_bins(u, y)
    errors = errors_of(result, 0.01)
    assert_honest(errors, result.covariance[:, 0], bound_of_realisations(all_plants))


class QuietOutput(Plant):
    """All but all of the noise is that of U."""

    @property
    def noise(self):
        return super().noise[0], 1e6 * super().noise[0]


@pytest.mark.parametrize(("realisations", "periods"), [(3, 2), (2, 8)])
def test_noise_of_the_input_far_above_that_of_the_output_is_no_distortion(realisations, periods):
    """Start values hide how small the latter is: variances of the poles were 108 and 5 times the bound."""
    all_plants = [QuietOutput(0.02, 100.0, periods, seed=10 + m) for m in range(realisations)]
    u, y = spectra(all_plants, np.random.default_rng(22), RUNS)
    result = plan_of(periods).from_bins(u, y)
    errors = errors_of(result, 0.02)
    assert_honest(errors, result.covariance[:, 0], bound_of_realisations(all_plants))


@pytest.mark.parametrize(("realisations", "periods"), [(2, 1), (3, 4)])
@pytest.mark.parametrize("distorted", [False, True])
def test_a_neighbouring_mode_is_a_model_error(realisations, periods, distorted):
    all_plants = plants(0.02, 60.0, periods, realisations)
    bins = all_plants[0].bins()
    level = 100 * all_plants[0].noise[0] if distorted else 0.0
    u, y = spectra(all_plants, np.random.default_rng(5), 20, level)
    s, w0 = 2j * np.pi * bins * 2.5 / periods, 2 * np.pi * 280
    size = 0.005 if distorted else 0.002
    second = size * w0**2 / (s**2 + 2 * 0.01 * w0 * s + w0**2)
    steady = np.stack([plant.input(bins) for plant in all_plants])
    result = plan_of(periods).from_bins(u, y + second * steady)
    assert result.has_status(PolesStatus.MODEL_ERROR).all()
    total = np.sqrt(np.diagonal(result.total_covariance[:, 0], axis1=-2, axis2=-1))
    noise = np.sqrt(np.diagonal(result.covariance[:, 0], axis1=-2, axis2=-1))
    assert np.all(np.abs(errors_of(result, 0.02)) < 3 * total)
    assert np.all(total > 2 * noise)


@pytest.mark.parametrize("periods", [1, 4])
def test_one_realisation_is_what_it_always_was(periods):
    plant = Plant(0.02, 40.0, periods)
    u, y = plant.noisy(np.random.default_rng(7), 4, plant.bins())
    options = {"input_noise_ratio": 0.3} if periods == 1 else {}
    alone = plan_of(periods, kind=JointPlan, **options).from_bins(u, y)
    plan = plan_of(periods, **options)
    result = plan.from_bins(u[:, None], y[:, None])
    for name in ("f0_hz", "damping_ratio", "covariance", "cost", "residual", "status_code"):
        assert getattr(result, name) == pytest.approx(getattr(alone, name), rel=1e-9, nan_ok=True)


@pytest.mark.parametrize("periods", [1, 2])
def test_exact_records_from_rest_give_the_exact_pole(periods):
    all_plants = plants(0.02, 40.0, periods, 3)
    bins = all_plants[0].bins()
    u, y = (
        np.stack([getattr(plant, name)(bins) for plant in all_plants])
        for name in ("input", "output")
    )
    result = plan_of(periods).from_bins(u, y)
    assert result.status() is PolesStatus.OK
    assert result.f0_hz[0] == pytest.approx(250, rel=1e-7)
    assert result.damping_ratio[0] == pytest.approx(0.02, rel=1e-5)


@pytest.mark.parametrize("periods", [1, 2, 4])
def test_what_rounding_leaves_of_settled_records_contradicts_nothing_but_a_wrong_model_does(periods):
    """The pole, right to the last digit, had a deviation of 5 Hz."""
    rng = np.random.default_rng(12)
    phases = np.exp(2j * np.pi * rng.random((3, 1, HARMONICS.size)))
    spectrum = np.zeros((3, 1, SAMPLES_PER_PERIOD // 2 + 1), complex)
    spectrum[..., HARMONICS] = phases
    s = 2j * np.pi * np.arange(spectrum.shape[-1]) * (SAMPLE_RATE_HZ / SAMPLES_PER_PERIOD)
    response = 0.1 + 0.04 * 1571**2 / (s**2 + 0.04 * 1571 * s + 1571**2)
    beside = 0.01 * 1600**2 / (s**2 + 0.04 * 1600 * s + 1600**2)
    u = np.repeat(np.fft.irfft(spectrum), periods, axis=1)
    for g, status in ((response, PolesStatus.OK), (response + beside, PolesStatus.MODEL_ERROR)):
        y = np.repeat(np.fft.irfft(spectrum * g), periods, axis=1)
        result = plan_of(periods, ModelStructure())(u, y)
        assert result.status() is status
        off_hz = abs(result.f0_hz[0] - 1571 / (2 * np.pi))
        if status is PolesStatus.OK:
            assert off_hz < 1e-9
            assert result.total_covariance[0, 0, 0] < 1e-18
        else:
            assert off_hz < 3 * result.total_covariance[0, 0, 0] ** 0.5


def test_even_distortion_of_an_odd_grid_is_no_noise():
    """What even harmonics carry would be taken for noise of the bins between excited lines."""
    rng = np.random.default_rng(8)
    plant = Plant(0.02, 40.0, 2)
    bins = plant.bins()
    odd = HARMONICS[HARMONICS % 2 == 1]
    excited = np.isin(bins, odd * 2)
    even = (bins % 2 == 0) & ~excited
    u, y = spectra(plants(0.02, 40.0, 2, 3), rng, 200)
    keep = np.where(excited | (bins % 2 == 1), 1.0, 0.0)
    y = y * keep + circular(rng, y.shape, 1e4 * plant.noise[0]) * even
    plan = PoleEstimator(SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, 2, odd, BAND_HZ, BARE)
    result = plan.from_bins(u * excited, y)
    # of half the lines the input is gone, their share of the transient stays
    assert np.median(result.noise_variance[:, 0]) == pytest.approx(plant.noise[0], rel=0.1)
    assert np.mean(result.variance_model == "flat") > 0.98


def test_leading_axes_samples_and_nan():
    rng = np.random.default_rng(9)
    u, y = spectra(plants(0.02, 40.0, 2, 2), rng, 6)
    plan = plan_of(2)
    batch = plan.from_bins(u.reshape(2, 3, 2, -1), y.reshape(2, 3, 2, -1))
    assert batch.shape == (2, 3)
    assert plan.from_bins(u[:0], y[:0]).f0_hz.shape == (0, 1)
    assert plan.from_bins(u[4], y[4]).f0_hz == pytest.approx(batch.f0_hz[1, 1], rel=1e-9)
    y[1, 1, 7] = np.nan
    result = plan.from_bins(u, y)
    assert [result.status(k) is PolesStatus.OK for k in range(6)] == [True, False] + 4 * [True]
    with pytest.raises(ValueError, match="expected"):
        plan.from_bins(u[0, 0], y[0, 0])
    samples = np.cumsum(rng.standard_normal((2, 2, 2, SAMPLES_PER_PERIOD)), axis=-1)
    one = identify_poles_from_records(
        *samples, sample_rate_hz=SAMPLE_RATE_HZ, harmonics=HARMONICS, band_hz=BAND_HZ
    )
    assert one.method == "joint maximum likelihood of poles and transients, 2 realisations"


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_scaled_data_scale_nothing(scale):
    u, y = spectra(plants(0.02, 40.0, 2, 2), np.random.default_rng(10), 3)
    first, other = (plan_of(2).from_bins(u, factor * y) for factor in (1.0, scale))
    assert other.f0_hz == pytest.approx(first.f0_hz, rel=1e-9)
    assert other.total_covariance == pytest.approx(first.total_covariance, rel=1e-3)


@pytest.mark.parametrize("snr_db", [60.0, 80.0])
def test_an_ellipse_beside_a_mode_too_many_is_not_made_by_rounding(snr_db):
    """A factor 3 of the output is only another unit: deviations were up to 200 times as large in it."""
    u, y = spectra(plants(0.02, snr_db, 2, 4), np.random.default_rng(10), 20)
    plan = plan_of(2, ModelStructure.with_residual(4))
    first, other = (plan.from_bins(u, factor * y) for factor in (1.0, 3.0))
    assert np.array_equal(first.significant, other.significant)
    here = first.significant & first.has_status(PolesStatus.OK)[:, None]
    assert here.sum() > 15
    one, two = (np.sqrt(result.total_covariance[here][:, 0, 0]) for result in (first, other))
    assert two == pytest.approx(one, rel=0.05)


def test_a_system_that_changes_between_realisations_is_told():
    """Noise and distortion would differ from line to line; a mode that moves does not."""
    rng = np.random.default_rng(11)
    moved = [Plant(0.02 + 0.0002 * m, 40.0, 2, seed=10 + m) for m in range(3)]
    u, y = spectra(moved, rng, 20)
    result = plan_of(2).from_bins(u, y)
    assert all("each is another system" in remark for remark in result.remark)
    total = np.sqrt(result.total_covariance[:, 0, 1, 1])
    assert np.all(np.abs(result.damping_ratio[:, 0] - 0.0202) < 2 * total)
    assert np.all(total > 1e-4)
    assert result.remark[0] in single(plan_of(2).from_bins(u[0], y[0])).message


@pytest.mark.parametrize(
    ("kind", "realisations", "periods"),
    [("generator", 3, 8), ("common", 3, 8), ("sloped", 3, 8), ("steps", 3, 8), ("sloped", 6, 1)],
)
def test_ellipse_is_honest_whatever_the_noise(kind, realisations, periods):
    """Noise of the generator, which the plant answers; noise on both channels; coloured noise."""
    all_plants = plants(0.02, 40.0, periods, realisations)
    rng = np.random.default_rng(12)
    bins = all_plants[0].bins()
    variance_y, variance_u = all_plants[0].noise
    s, w0 = 2j * np.pi * bins * 2.5 / periods, 2 * np.pi * 250
    g = 0.1 + 0.04 * w0**2 / (s**2 + 0.04 * w0 * s + w0**2)
    u, y = (
        np.stack([getattr(plant, name)(bins) for plant in all_plants]) + np.zeros((400, 1, 1))
        for name in ("input", "output")
    )
    position = np.linspace(-1, 1, bins.size)
    factor = 1.0
    if kind == "generator":
        disturbance = circular(rng, u.shape, 100 * variance_u)
        u, y = u + disturbance, y + g * disturbance
    elif kind == "common":
        disturbance = circular(rng, u.shape, variance_y)
        u, y = u + disturbance, y - 2 * disturbance
    else:
        u += circular(rng, u.shape, variance_u)
        factor = np.exp(2 * position) if kind == "sloped" else np.where(position > 0.05, 16.0, 1.0)
    result = plan_of(periods).from_bins(u, y + circular(rng, y.shape, variance_y * factor))
    inside = 400 * judge(errors_of(result, 0.02), result.total_covariance[:, 0], np.eye(2))[1]
    assert stats.binom.cdf(inside, 400, 0.94) > 0.0005
    # with what poles scatter by: of flat noise it holds 98 %
    assert stats.binom.sf(inside - 1, 400, 0.98) > 0.0005
    assert result.has_status(PolesStatus.OK).mean() > 0.98


@pytest.mark.parametrize(("realisations", "periods"), [(2, 2), (4, 2), (2, 8)])
def test_noise_through_a_narrow_mode_is_not_averaged_away(realisations, periods):
    """As of vibration: of two periods covariances from noise held the mode in 72 and 84 %."""
    all_plants = plants(0.01, 40.0, periods, realisations)
    bins, rng = all_plants[0].bins(), np.random.default_rng(21)
    s, w0 = 2j * np.pi * bins * 2.5 / periods, 2 * np.pi * 250
    through = 0.01 + np.abs(0.02 * w0**2 / (s**2 + 0.02 * w0 * s + w0**2)) ** 2
    u, y = (
        np.stack([getattr(plant, name)(bins) for plant in all_plants]) + np.zeros((RUNS, 1, 1))
        for name in ("input", "output")
    )
    result = plan_of(periods).from_bins(u, y + circular(rng, y.shape, 10 * all_plants[0].noise[0] * through))
    for covariance, lowest in ((result.covariance, 0.925), (result.total_covariance, 0.95)):
        inside = RUNS * judge(errors_of(result, 0.01), covariance[:, 0], np.eye(2))[1]
        assert stats.binom.cdf(inside, RUNS, lowest) > 0.0005
