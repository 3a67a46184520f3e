# SPDX-License-Identifier: Apache-2.0
"""Data that say less than they seem to: the status says so, nothing else does, and others are not hurt."""

import warnings

import numpy as np
import pytest
from poles.mode_at_250_hz import (
    BARE,
    LINES_HZ,
    NOISY,
    G,
    S,
    circular,
    frf,
    from_record,
    record,
    spectra,
)
from scipy import stats

from tactile_resonance.frf.result import FRF
from tactile_resonance.poles.estimator import choose_among
from tactile_resonance.poles.identify import (
    identify_batch,
    identify_frf,
    identify_spectra,
)
from tactile_resonance.poles.result import PolesStatus, single
from tactile_resonance.poles.structure import ModelStructure


@pytest.fixture(autouse=True)
def _no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.mark.parametrize("scale", [1e-300, 1e-160, 1e-150, 1e150, 1e160, 1e300])
@pytest.mark.parametrize("variance", [None, 1e-6])
def test_beyond_double_precision_is_right_or_told(scale, variance):
    """Squares of such numbers overflow, or are subnormal."""
    fields = {"variance_noise": None}
    if variance is not None:
        with np.errstate(over="ignore", under="ignore"):
            fields["variance_noise"] = np.full(41, variance * scale * scale)
    poles = identify_frf(frf(g=scale * NOISY, **fields), None, BARE)
    right = poles.f0_hz.size == 1 and abs(poles.f0_hz[0] - 250) < 0.02
    assert right or (poles.status is not PolesStatus.OK and poles.covariance is None)
    u, y = record()
    poles = from_record(u=u * scale, y=y * scale, structure=None)
    right = poles.f0_hz.size == 1 and abs(poles.f0_hz[0] - 250) < 0.02
    assert right or (poles.status is not PolesStatus.OK and poles.covariance is None)


@pytest.mark.parametrize(
    "variance", [np.full(41, np.inf), np.full(41, np.nan), np.full(41, 5e-324), np.zeros(41)]
)
def test_variances_that_say_nothing(variance):
    poles = identify_frf(frf(variance_noise=variance), None, BARE)
    assert poles.status is not PolesStatus.OK
    assert poles.covariance is None


def test_more_parameters_than_smooth_residuals_have_room_for():
    poles = identify_frf(frf(), None, ModelStructure(2, 60))
    assert poles.whiteness < 10 or poles.status is not PolesStatus.OK


@pytest.mark.parametrize("where", ["u", "y"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_samples_without_a_value_are_told(where, value):
    channels = dict(zip("uy", record(), strict=True))
    channels[where][1, 5] = value
    poles = from_record(**channels)
    assert poles.status is PolesStatus.TOO_FEW_LINES
    assert "0 lines with finite values" in poles.message


def test_a_point_without_variance_leaves_its_batch_alone():
    alone = identify_batch(frf(), structure=BARE)
    for bad in (np.zeros(41), np.full(41, np.nan), np.full(41, np.inf)):
        variance = np.stack([np.full(41, 1e-6), bad])
        both = identify_batch(frf(g=np.stack([NOISY] * 2), variance_noise=variance), structure=BARE)
        assert both.status(0) is PolesStatus.OK
        assert both.covariance[0] == pytest.approx(alone.covariance, rel=1e-6)
        assert both.cost[0] == pytest.approx(alone.cost, rel=1e-6)
        assert both.status(1) is not PolesStatus.OK
        assert np.isnan(both.covariance[1]).all()


def test_a_line_without_variance_is_left_out_alone():
    for bad in (0.0, -1e-6, np.nan):
        variance = np.where(np.arange(41) == 5, bad, 1e-6)
        poles = identify_frf(frf(variance_noise=variance), None, BARE)
        assert poles.status is PolesStatus.OK
        assert poles.lines == 40
        assert "1 lines without" in poles.message


@pytest.mark.parametrize("dof", [1, 2])
def test_weights_without_second_moment_have_no_covariance_in_batches_either(dof):
    steps = np.where(np.arange(41) % 2, 1e-4, 1e-6)
    batch = identify_batch(frf(variance_noise=steps, noise_dof=dof), structure=BARE)
    assert str(batch.variance_model) == "per line"
    assert batch.status() is PolesStatus.NO_COVARIANCE
    assert "degrees of freedom" in single(batch).message
    assert "independently" not in single(batch).message


def second_mode(size):
    w = 2 * np.pi * 280
    return size * 0.02 * w**2 / (S**2 + 0.02 * w * S + w**2)


def test_a_smooth_error_is_told_without_a_variance():
    noise = circular(np.random.default_rng(3), (41,), 1e-10)
    clean = identify_frf(FRF(LINES_HZ, G + noise), None, BARE)
    assert clean.status is PolesStatus.NO_COVARIANCE
    poles = identify_frf(FRF(LINES_HZ, G + second_mode(0.1) + noise), None, BARE)
    assert poles.status is PolesStatus.MODEL_ERROR
    std = np.sqrt(np.diagonal(poles.total_covariance[0]))
    assert abs(poles.f0_hz[0] - 250) < 3 * std[0]
    assert abs(poles.damping_ratio[0] - 0.02) < 3 * std[1]
    assert identify_frf(FRF(LINES_HZ, G), None, BARE).status is PolesStatus.NO_COVARIANCE


def coverage(result):
    errors = np.stack([result.f0_hz[:, 0] - 250, result.damping_ratio[:, 0] - 0.02], -1)
    solved = np.linalg.solve(result.covariance[:, 0], errors[..., None])[..., 0]
    inside = int(np.sum(np.sum(errors * solved, -1) < -2 * np.log(0.05)))
    return inside, errors.shape[0]


@pytest.mark.parametrize("sloped", ["output", "input"])
@pytest.mark.parametrize("dof", [2, 7])
def test_a_slope_of_one_channel_is_seen_beside_a_flat_other(sloped, dof):
    """Noise that falls over the band by 35 dB on one channel, and is flat on the other."""
    rng = np.random.default_rng(4)
    runs = 1500
    slope = np.exp(np.linspace(4, -4, 41))
    u = np.exp(2j * np.pi * rng.random(41))
    variances = {"output": np.full(41, 1e-7), "input": np.full(41, 1e-7)}
    variances[sloped] = variances[sloped] * slope
    truth = np.array([variances["output"], variances["input"]])
    z = np.stack([G * u, u]) + circular(rng, (runs, 2, 41), truth)
    covariance = np.zeros((runs, 2, 2, 41), complex)
    for k in (0, 1):
        covariance[:, k, k] = truth[k] * rng.gamma(dof, 1 / dof, (runs, 41))
    result = identify_spectra(LINES_HZ, z, covariance, dof, structure=BARE)
    assert np.mean(result.variance_model == "sloped") > 0.99
    inside, runs = coverage(result)
    assert stats.binom.cdf(inside, runs, 0.94) > 0.0005
    assert stats.binom.sf(inside - 1, runs, 0.96) > 0.0005
    assert result.has_status(PolesStatus.OK).mean() > 0.98


def test_all_noise_in_the_input():
    rng = np.random.default_rng(5)
    u = np.exp(2j * np.pi * rng.random(41))
    z = np.stack([np.tile(G * u, (500, 1)), u + circular(rng, (500, 41), 1e-6)], axis=1)
    covariance = np.zeros((2, 2, 41), complex)
    covariance[1, 1] = 1e-6
    result = identify_spectra(LINES_HZ, z, covariance, 0, structure=BARE)
    inside, runs = coverage(result)
    assert stats.binom.cdf(inside, runs, 0.94) > 0.0005
    assert stats.binom.sf(inside - 1, runs, 0.96) > 0.0005


def test_spectra_without_any_covariance_are_fitted_and_said_so():
    arguments = spectra(covariance=np.zeros((2, 2, 41)))
    result = identify_spectra(**arguments)
    assert result.status() is PolesStatus.NO_COVARIANCE
    assert abs(result.f0_hz[0] - 250) < 0.02
    assert np.isfinite(result.total_covariance).all()


def test_orders_of_exact_data_are_compared():
    """Modes too many leave nothing to determine them by: each candidate still has an answer."""
    best = choose_among(lambda structure: identify_frf(frf(g=G), None, structure))
    assert best.f0_hz[0] == pytest.approx(250, rel=1e-9)
    assert best.message.endswith("chosen by description length from 9")


def test_two_modes_that_are_certain_only_together():
    """Half a width apart, in noise that leaves neither residue alone beyond chance."""
    lines_hz = np.linspace(240, 260, 81)
    s = 2j * np.pi * lines_hz
    g = np.zeros(81, complex)
    for f0 in (250.0, 250.25):
        w = 2 * np.pi * f0
        g += 2e-3 * w**2 / (s**2 + 2e-3 * w * s + w**2)
    rng = np.random.default_rng(6)
    batch = identify_batch(
        FRF(
            lines_hz,
            g + circular(rng, (40, 81), 1e-3),
            variance_noise=np.full(81, 1e-3),
            noise_dof=20,
        ),
        structure=ModelStructure(4, 4),
    )
    points = [single(batch, (k,)) for k in range(40)]
    assert np.mean([p.status is PolesStatus.NO_RESONANCE for p in points]) < 0.1


def test_a_mode_that_noise_made_is_left_out_and_said_so():
    """Of two modes asked for there is one; the other is somewhere, stable or not."""
    rng = np.random.default_rng(7)
    told = 0
    for _ in range(20):
        noisy = frf(g=G + circular(rng, (41,), 1e-6))
        poles = identify_frf(noisy, None, ModelStructure(4, 4))
        assert poles.f0_hz.size < 2 or "noise makes" not in poles.message
        if poles.f0_hz.size == 1 and "noise makes" in poles.message:
            told += 1
            assert abs(poles.f0_hz[0] - 250) < 5 * np.sqrt(poles.covariance[0, 0, 0])
    assert told > 5


def test_noise_alone_has_no_resonance():
    rng = np.random.default_rng(8)
    for _ in range(50):
        poles = identify_frf(frf(g=0.1 + circular(rng, (41,), 1e-6)), None, BARE)
        assert poles.f0_hz.size == 0
        assert poles.status is not PolesStatus.OK


def test_a_response_of_the_wrong_sign_of_phase_is_unstable():
    assert identify_frf(frf(g=NOISY.conj()), None, BARE).status is PolesStatus.UNSTABLE_POLE


def test_a_constant_response_determines_no_pole():
    poles = identify_frf(frf(g=np.full(41, 0.3 + 0j)), None, BARE)
    assert poles.status is PolesStatus.ILL_CONDITIONED
    assert poles.f0_hz.size == 0


@pytest.mark.parametrize("structure", [BARE, ModelStructure()], ids=["bare", "default"])
def test_what_rounding_leaves_of_an_exact_record_is_no_model_error(structure):
    u, y = record(noise=0.0)
    poles = from_record(u=u, y=y, structure=structure)
    assert poles.status is PolesStatus.OK
    assert poles.f0_hz == pytest.approx([250], rel=1e-9)


def test_near_modes_in_a_batch_are_as_exact_as_alone():
    """Normal equations square the condition number: such points are solved by themselves."""
    lines_hz = np.linspace(249, 251.25, 181)
    s = 2j * np.pi * lines_hz
    points = []
    for second in (250.25, 250.3, 250.35):
        w = 2 * np.pi * np.array([250.0, second])[:, None]
        points.append(np.sum(w**2 / (s**2 + 0.02 * w * s + w**2), axis=0))
    batch = identify_batch(FRF(lines_hz, np.stack(points)), structure=ModelStructure(4, 4))
    assert batch.f0_hz[:, 0] == pytest.approx(250, rel=1e-7)
    assert batch.f0_hz[:, 1] == pytest.approx([250.25, 250.3, 250.35], rel=1e-7)


def test_delay_beside_correlated_noise_is_at_the_least_cost():
    rng = np.random.default_rng(9)
    u = np.exp(2j * np.pi * rng.random(41))
    y = G * u * np.exp(-2e-3 * S)
    correlation, variance = 0.8 * np.exp(0.7j), 1e-4
    both = circular(rng, (41,), variance)
    own = circular(rng, (41,), variance * (1 - 0.64))
    z = np.stack([y + correlation * both + own, u + both])
    covariance = np.zeros((2, 2, 41), complex)
    covariance[0, 0] = covariance[1, 1] = variance
    covariance[0, 1], covariance[1, 0] = correlation * variance, np.conj(correlation) * variance
    structure = ModelStructure(2, 2, delay=True)
    result = identify_spectra(LINES_HZ, z, covariance, 0, structure=structure)
    model = result.fit.at(())

    def cost(more_delay_s):
        g = model.response(LINES_HZ) * np.exp(-more_delay_s * S)
        spread = variance * (1 + np.abs(g) ** 2 - 2 * np.real(correlation * g.conj()))
        return np.sum(np.abs(z[0] - g * z[1]) ** 2 / spread)

    assert cost(0.0) == pytest.approx(float(result.cost), rel=1e-9)
    step_s = 1e-7
    slope, bend = (
        (cost(step_s) - cost(-step_s)) / (2 * step_s),
        (cost(step_s) - 2 * cost(0.0) + cost(-step_s)) / step_s**2,
    )
    # nearer to the minimum than a hundredth of the standard deviation at fixed coefficients
    assert abs(slope / bend) < 0.01 * np.sqrt(2 / bend)


@pytest.mark.parametrize("delay", [False, True])
def test_noise_covariance_beside_a_total_variance(delay):
    # Of the least squares of all coefficients, the delay's among them, weighted by the total variance.
    structure = ModelStructure(2, 2, delay=delay)
    rng = np.random.default_rng(3)
    total = 1e-6 * rng.uniform(0.5, 2.0, LINES_HZ.size)
    noise = total * rng.uniform(0.1, 0.9, LINES_HZ.size)
    g = G * np.exp(-1e-3 * S * delay)

    def std_of(spread, weights):
        """Standard deviations of f0 and damping ratio over fits to 400 draws."""
        error = circular(np.random.default_rng(4), (400, LINES_HZ.size), 1.0) * np.sqrt(spread)
        batch = identify_batch(
            FRF(LINES_HZ, g + error, variance_total=np.tile(weights, (400, 1)), total_dof=1000),
            structure=structure,
        )
        return np.std([batch.f0_hz[:, 0], batch.damping_ratio[:, 0]], axis=1)

    batch = identify_batch(
        FRF(LINES_HZ, g[None], noise[None], total[None], noise_dof=1000, total_dof=1000),
        structure=structure,
    )
    for covariance, spread in ((batch.covariance, noise), (batch.total_covariance, total)):
        stated = np.sqrt(np.diagonal(covariance[0, 0]))
        # 400 draws tell a deviation to 3.5 %: four of these
        assert stated == pytest.approx(std_of(spread, total), rel=0.15)
