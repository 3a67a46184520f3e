# SPDX-License-Identifier: Apache-2.0
"""Models that leave something out are detected, complete ones are not called wrong; smooth residuals."""

import numpy as np
import pytest
import scipy.io
import scipy.signal
from scipy import stats

from benchmarks.poles_plant import (
    BAND_HZ,
    HARMONICS,
    SAMPLE_RATE_HZ,
    SAMPLES_PER_PERIOD,
    Plant,
)
from tactile_resonance.frf.result import FRF
from tactile_resonance.poles.estimator import identify_poles_from_records
from tactile_resonance.poles.identify import identify_batch
from tactile_resonance.poles.joint import JointPlan
from tactile_resonance.poles.result import PolesStatus
from tactile_resonance.poles.significance import (
    SMOOTH_RESIDUAL,
    are_smooth,
    correlation_length,
    model_error_factor,
    whiteness,
)
from tactile_resonance.poles.structure import ModelStructure

BARE = ModelStructure(2, 2)
RUNS = 2000
SCORES = 20000


def plan_for(plant, structure, **options):
    return JointPlan(
        SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, plant.periods, HARMONICS, BAND_HZ, structure, **options
    )


def neighbouring_mode(plant, bins, size):
    """What a mode at 330 Hz, settled, adds to Y: `size` of the noise's deviation at 300 Hz."""
    s = 2j * np.pi * bins * SAMPLE_RATE_HZ / SAMPLES_PER_PERIOD / plant.periods
    w = 2 * np.pi * 330
    g = 1 / (s**2 + 0.02 * w * s + w**2)
    y = g * plant.input(bins)
    return y * size * np.sqrt(plant.noise[0]) / np.abs(y[bins % plant.periods == 0][-1])


@pytest.mark.parametrize("structure", [BARE, ModelStructure()], ids=["bare", "default"])
@pytest.mark.parametrize("periods", [1, 2, 8])
def test_noise_alone_raises_the_alarm_no_more_often_than_stated(periods, structure):
    """Two tests, cost and whiteness, of one in a thousand each."""
    plant = Plant(0.02, 40.0, periods)
    u, y = plant.noisy(np.random.default_rng(5), RUNS, plant.bins())
    plan = plan_for(plant, structure, input_noise_ratio=0.01 if periods == 1 else None)
    alarms = plan.from_bins(u, y).has_status(PolesStatus.MODEL_ERROR).sum()
    assert stats.binom.sf(alarms - 1, RUNS, 2e-3) > 0.0005


@pytest.mark.parametrize("ratio", [0.01, None])
def test_one_period_shows_a_model_error_by_its_smoothness(ratio):
    """The level is from the residuals themselves, so that the cost can say nothing."""
    plant = Plant(0.02, 40.0, 1)
    bins = plant.bins()
    u, y = plant.noisy(np.random.default_rng(6), 200, bins)
    y = y + neighbouring_mode(plant, bins, 10.0)
    result = plan_for(plant, BARE, input_noise_ratio=ratio).from_bins(u, y)
    assert np.isnan(result.cost).all()
    assert np.mean(result.has_status(PolesStatus.MODEL_ERROR)) > 0.95
    assert np.median(result.whiteness) > SMOOTH_RESIDUAL
    # residual terms stand for the neighbour
    richer = plan_for(plant, ModelStructure(), input_noise_ratio=ratio).from_bins(u, y)
    assert np.mean(richer.has_status(PolesStatus.MODEL_ERROR)) < 0.02
    # and the total covariance of the bare model covers its bias
    error = np.stack([result.f0_hz[:, 0] - 250, result.damping_ratio[:, 0] - 0.02], -1)
    std = np.sqrt(np.diagonal(result.total_covariance[:, 0], axis1=-2, axis2=-1))
    told = result.has_status(PolesStatus.MODEL_ERROR)
    assert np.mean(np.abs(error / std)[told] < 3) > 0.95


def realisations(rng, lines, count, runs, size, structure):
    """Fits of FRFs that have `count` realisations: a mode at 69.5 Hz, and what one at 121 Hz adds.

    `size` is what the latter adds at 110 Hz, in standard deviations of one line of the mean, beyond a
    spread over realisations that is three times as large at the resonance.
    """
    frequency_hz = np.linspace(40, 110, lines)
    s, w, far = 2j * np.pi * frequency_hz, 2 * np.pi * 69.5, 2 * np.pi * 121
    g = 0.1 + 0.1 * w**2 / (s**2 + 0.1 * w * s + w**2)
    neighbour = 1 / (s**2 + 0.02 * far * s + far**2)
    std = 0.02 * (1 + 3 * np.abs(g))
    error = rng.standard_normal((runs, count, lines, 2)).view(complex)[..., 0] * std / np.sqrt(2)
    each = g + error + size * std[-1] / np.sqrt(count) * neighbour / np.abs(neighbour[-1])
    frf = FRF(
        frequency_hz,
        each.mean(axis=1),
        variance_total=each.var(axis=1, ddof=1) / count,
        total_dof=count - 1,
        realisations=count,
    )
    return identify_batch(frf, structure=structure)


@pytest.mark.parametrize("structure", [BARE, ModelStructure()], ids=["bare", "default"])
@pytest.mark.parametrize(("lines", "count"), [(41, 4), (41, 10), (470, 10)])
def test_spread_over_realisations_alone_raises_no_more_alarms(lines, count, structure):
    """Two tests here too; smoothness alone keeps to its one in a thousand."""
    result = realisations(np.random.default_rng(8), lines, count, RUNS, 0.0, structure)
    alarms = result.has_status(PolesStatus.MODEL_ERROR).sum()
    assert stats.binom.sf(alarms - 1, RUNS, 2e-3) > 0.0005
    smooth = np.sum(result.whiteness > SMOOTH_RESIDUAL)
    assert stats.binom.sf(smooth - 1, RUNS, 1e-3) > 0.0005


def test_a_model_error_that_the_cost_does_not_show_is_told_by_its_smoothness():
    """Two standard deviations of a line at the end of the band, less elsewhere, over 470 lines."""
    result = realisations(np.random.default_rng(9), 470, 10, 200, 2.0, BARE)
    assert np.mean(result.cost > 1.3 * result.expected_cost) == 0
    assert np.mean(result.has_status(PolesStatus.MODEL_ERROR)) > 0.9
    richer = realisations(np.random.default_rng(9), 470, 10, 200, 2.0, ModelStructure())
    assert np.mean(richer.has_status(PolesStatus.MODEL_ERROR)) < 0.02


@pytest.mark.parametrize(
    ("band", "ends"), [((40, 110), (48946, 57646, 66346, 75046)), ((1, 200), (48946,))]
)
def test_one_realisation_of_a_nonlinear_circuit(shared_data, band, ends):
    """Measured: odd distortion stands far above what the even lines show, and the status says so."""
    data = scipy.io.loadmat(shared_data / "silverbox" / "SNLS80mV.mat")
    for end in ends:
        u, y = (data[name].ravel()[end - 8192 : end][None] for name in ("V1", "V2"))
        poles = identify_poles_from_records(
            u,
            y,
            sample_rate_hz=1e7 / 2**14,
            harmonics=np.arange(1, 2684, 2),
            band_hz=band,
            structure=BARE,
        )
        assert poles.status is PolesStatus.MODEL_ERROR
        std = np.sqrt(np.diag(poles.total_covariance[0]))
        # the best linear approximation of ten realisations
        assert abs(poles.f0_hz[0] - 69.536) < 3 * std[0]
        assert abs(poles.damping_ratio[0] - 0.04877) < 3 * std[1]
        # of which it is a few thousandths, and a few hundredths
        assert std[0] < 0.3
        assert std[1] < 0.004


def test_correlation_of_residuals_has_its_length():
    """``1 + 2 sum rho**k`` of a first-order process; 1 for white ones."""
    rng = np.random.default_rng(10)
    for rho in (0.0, 0.5, 0.9):
        white = rng.standard_normal((400, 2000, 2)).view(complex)[..., 0]
        residual = scipy.signal.lfilter([1.0], [1.0, -rho], white)
        length = np.median(correlation_length(residual))
        assert length == pytest.approx((1 + rho) / (1 - rho), rel=0.15)
        factor = model_error_factor(residual, np.full(400, 6.0), np.full(400, 2.0))
        assert np.median(factor) == pytest.approx(3 * length)


@pytest.mark.parametrize("distance_hz", [2.0, 5.0, 20.0])
@pytest.mark.parametrize("share", [1.0, 0.1])
@pytest.mark.parametrize("structure", [BARE, ModelStructure()], ids=["bare", "default"])
def test_two_modes_taken_for_one_are_within_the_total_covariance(distance_hz, share, structure):
    """Nearer than their width of 10 Hz one mode between fits so well that residuals tell little."""
    plant = Plant(0.02, 40.0, 8)
    bins = plant.bins()
    s = 2j * np.pi * bins * SAMPLE_RATE_HZ / SAMPLES_PER_PERIOD / plant.periods

    def mode(f0_hz):
        w = 2 * np.pi * f0_hz
        return 0.04 * w**2 / (s**2 + 0.04 * w * s + w**2)

    g = 0.1 + mode(250.0) + share * mode(250.0 + distance_hz)
    rng = np.random.default_rng(3)
    u, noise = plant.noisy(rng, 20, bins)
    y = g * plant.input(bins) + noise - plant.output(bins)
    result = plan_for(plant, structure).from_bins(u, y)
    assert result.has_status(PolesStatus.MODEL_ERROR).all()
    std = np.sqrt(np.diagonal(result.total_covariance[:, 0], axis1=-2, axis2=-1))
    estimate = np.stack([result.f0_hz[:, 0], result.damping_ratio[:, 0]], -1)
    truths = np.array([[250.0, 0.02], [250.0 + distance_hz, 0.02]])
    error = np.abs(estimate - truths[:, None]) / std  # (2 modes, runs, 2)
    nearest = error.max(axis=-1).min(axis=0)
    assert np.mean(nearest < 3) > 0.8
    assert np.median(nearest) > 0.3  # nor is everything within it


def test_a_richer_model_that_determines_nothing_does_not_make_the_total_covariance():
    """Two modes 2 Hz apart: of 30 model errors, one had a deviation of f0 of up to hundreds of hertz."""
    lines_hz = np.linspace(200, 300, 41)
    s, w0 = 2j * np.pi * lines_hz, 2 * np.pi * np.array([[250.0], [252.0]])
    g = 0.1 + np.sum(0.04 * w0**2 / (s**2 + 0.04 * w0 * s + w0**2), axis=0)
    g = g + 0.01 * np.random.default_rng(2).standard_normal((400, 41, 2)).view(complex)[..., 0] / np.sqrt(2)
    result = identify_batch(FRF(lines_hz, g, variance_noise=np.full(41, 1e-4), noise_dof=50))
    told = result.has_status(PolesStatus.MODEL_ERROR)
    assert told.sum() > 40
    std_hz = np.sqrt(result.total_covariance[told, 0, 0, 0])
    half_width_hz = np.abs(result.poles_rad_s[told, 0].real) / (2 * np.pi)
    assert np.all(std_hz < 2 * half_width_hz)
    off_hz = np.abs(result.f0_hz[told] - [250.0, 252.0]).min(axis=-1)
    assert np.mean(off_hz < 1.96 * std_hz) > 0.95


def test_a_point_has_the_total_covariance_alone_that_it_has_in_a_batch():
    """False alarms: two of 59 had a fiftieth of the deviation alone, of a richer model with a mode on noise."""
    lines_hz, runs, rng = np.linspace(200, 300, 41), 40000, np.random.default_rng(5)
    s, w0 = 2j * np.pi * lines_hz, 2 * np.pi * 250.0
    g = 0.1 + 0.04 * w0**2 / (s**2 + 0.04 * w0 * s + w0**2)
    g = g + 0.01 * (rng.standard_normal((runs, 41)) + 1j * rng.standard_normal((runs, 41))) / np.sqrt(2)
    variance = 1e-4 * rng.gamma(8, 1 / 8, g.shape)

    def poles(points):
        frf = FRF(lines_hz, g[points], variance_noise=variance[points], noise_dof=8, periods=8)
        return identify_batch(frf, structure=BARE)

    batch = poles(np.arange(runs))
    told = np.flatnonzero(batch.has_status(PolesStatus.MODEL_ERROR))
    assert told.size > 40
    alone = np.concatenate([poles([k]).total_covariance for k in told])
    assert alone[:, 0, 0, 0] == pytest.approx(batch.total_covariance[told, 0, 0, 0], rel=0.1)


def test_one_wild_line_is_within_the_total_covariance():
    """Any one line of the band, three thousand deviations off: a cost beyond noise widens the ellipse."""
    plant = Plant(0.02, 60.0, 2)
    bins = plant.bins()
    wild = np.flatnonzero(bins % 2 == 0)
    u, y = plant.noisy(np.random.default_rng(4), wild.size, bins)
    y[np.arange(wild.size), wild] += 3000 * np.sqrt(plant.noise[0])
    result = plan_for(plant, BARE).from_bins(u, y)
    assert result.has_status(PolesStatus.MODEL_ERROR).all()
    std = np.sqrt(np.diagonal(result.total_covariance[:, 0], axis1=-2, axis2=-1))
    off = np.abs(np.stack([result.f0_hz[:, 0] - 250, result.damping_ratio[:, 0] - 0.02], -1))
    assert np.all(off < 3 * std)


def white(rng, lines, runs=SCORES):
    return rng.standard_normal((runs, lines, 2)).view(complex)[..., 0]


@pytest.mark.parametrize("lines", [5, 41, 300])
@pytest.mark.parametrize("left_out", [0, 0.2])
def test_noise_exceeds_a_score_no_more_often_than_a_normal_variable(lines, left_out):
    rng = np.random.default_rng(lines)
    residual = white(rng, lines)
    residual[:, rng.random(lines) < left_out] = 0
    score = whiteness(residual, 5)
    for limit in (stats.norm.isf(0.05), SMOOTH_RESIDUAL):
        beyond = np.sum(score > limit)
        assert stats.binom.sf(beyond - 1, SCORES, stats.norm.sf(limit)) > 0.0005
    # nor is the test asleep: levels share their coefficients, no more than that makes it rarer
    if not left_out:
        assert np.mean(score > stats.norm.isf(0.05)) > 0.02


def test_score_does_not_depend_on_level_or_phase():
    residual = white(np.random.default_rng(1), 60, 50)
    changed = residual * (1e-100 * np.exp(1j))
    assert whiteness(changed, 7) == pytest.approx(whiteness(residual, 7), abs=1e-9)


@pytest.mark.parametrize(("waves", "share"), [(2, 0.08), (10, 0.1), (40, 0.25)])
def test_a_smooth_part_far_below_the_noise_is_seen(waves, share):
    """The smoother, the smaller; alternating from line to line it is the contrary of smooth."""
    line = np.arange(500)
    smooth = np.sqrt(2 * share) * np.exp(2j * np.pi * waves * line / 500)
    residual = white(np.random.default_rng(2), 500, 200)
    assert np.mean(whiteness(residual + smooth, 5) > SMOOTH_RESIDUAL) > 0.95
    assert np.mean(whiteness(residual + smooth * (-1) ** line, 5) > 2) < 0.05


@pytest.mark.parametrize("lines", [5, 41, 300])
def test_limit_of_the_best_level_is_that_of_the_score(lines):
    rng = np.random.default_rng(lines)
    residual = white(rng, lines, 4000) + 2 * rng.random((4000, 1))
    smooth = are_smooth(residual, 5)
    assert 0 < smooth.sum() < 4000
    np.testing.assert_array_equal(smooth, whiteness(residual, 5) > SMOOTH_RESIDUAL)


def test_fewer_than_three_lines_tell_nothing():
    assert np.isnan(whiteness(np.ones((4, 2), complex), 1)).all()
    assert not are_smooth(np.ones((4, 2), complex), 1).any()
