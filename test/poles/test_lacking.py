# SPDX-License-Identifier: Apache-2.0
"""What a model lacks is told where neither cost nor smoothness of the residuals shows it."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from benchmarks.poles_plant import (
    BAND_HZ,
    HARMONICS,
    SAMPLE_RATE_HZ,
    SAMPLES_PER_PERIOD,
    Plant,
)
from tactile_resonance.frf.result import FRF
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.fit import minimise
from tactile_resonance.poles.identify import identify_frf
from tactile_resonance.poles.joint import JointPlan, PoleEstimator
from tactile_resonance.poles.lacking import DOUBT, FALSE_ALARM, Lack
from tactile_resonance.poles.lines import LinesPlan
from tactile_resonance.poles.result import PolesStatus, single
from tactile_resonance.poles.structure import ModelStructure

BARE = ModelStructure(2, 2)


def plan_for(plant, structure=None, kind=JointPlan):
    return kind(
        *(SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, plant.periods, HARMONICS, BAND_HZ),
        structure or ModelStructure(),
        input_noise_ratio=0.01 if plant.periods == 1 else None,
    )


def with_mode(plant, runs, f0_hz, damping_ratio, size):
    """Bins of the plant and a mode more, settled, of so many times the peak of the first one."""
    bins = plant.bins()
    s = 2j * np.pi * bins * SAMPLE_RATE_HZ / SAMPLES_PER_PERIOD / plant.periods
    w, width = 2 * np.pi * f0_hz, 2 * damping_ratio
    u, y = plant.noisy(np.random.default_rng(3), runs, bins)
    return u, y + size * width * w**2 / (s**2 + width * w * s + w**2) * plant.input(bins)


def errors(result, truths):
    """(runs,) Mahalanobis distance from the nearest truth by the total covariance, else that of noise."""
    total, noise = result.total_covariance[:, 0], result.covariance[:, 0]
    covariance = np.where(np.isfinite(total), total, noise)
    estimate = np.stack([result.f0_hz[:, 0], result.damping_ratio[:, 0]], -1)
    off = estimate - np.array(truths)[:, None]  # (truths, runs, 2)
    solved = np.linalg.solve(covariance, off[..., None])[..., 0]
    return np.sqrt(np.sum(off * solved, axis=-1)).min(axis=0)


def test_a_neighbour_of_a_third_the_size_is_told_and_named():
    """4 Hz away, within the width of 10 Hz: its cost alone shows it in one record of ten."""
    plant = Plant(0.02, 14.0, 2)
    u, y = with_mode(plant, 100, 254.0, 0.02, 0.33)
    plan = plan_for(plant)
    parts = [plan.from_bins(u[k], y[k]) for k in range(100)]
    told = [part for part in parts if part.status() is PolesStatus.MODEL_ERROR]
    assert len(told) > 85
    named = [single(part).message for part in told]
    assert np.mean(["one mode more near 25" in message for message in named]) > 0.9
    assert all("for 4 parameters" in message for message in named)
    # the same in a batch, for those whose cost is above its expectation
    batch = plan.from_bins(u, y)
    assert batch.has_status(PolesStatus.MODEL_ERROR).mean() > 0.4
    told = batch.has_status(PolesStatus.MODEL_ERROR)
    truths = [(250, 0.02), (254, 0.02)]
    assert np.mean(errors(batch, truths)[told] < 2.45) > 0.75
    assert np.mean(errors(batch, truths)[~told] > 10) > 0.9


def test_a_strong_mode_beyond_the_band_is_told():
    """Ten times as strong at 320 Hz: half of the poles are three deviations off, or more."""
    plant = Plant(0.02, 10.0, 2)
    u, y = with_mode(plant, 200, 320.0, 0.01, 10.0)
    result = plan_for(plant).from_bins(u, y)
    told = result.has_status(PolesStatus.MODEL_ERROR)
    assert told.mean() > 0.7
    assert np.mean(errors(result, [(250, 0.02)])[told] < 2.45) > 0.9
    # of residual terms no frequency is named
    terms = result.lacking[:, 1] == 2
    assert terms.any()
    assert np.isnan(result.lacking[terms, 2]).all()
    k = int(np.flatnonzero(terms)[0])
    assert "two residual terms more fit better" in single(result, (k,)).message


def test_one_period_lacks_residual_terms():
    """No level is known, and the residuals are not yet smooth enough to be told by that."""
    plant = Plant(0.02, 40.0, 1)
    bins = plant.bins()
    u, y = with_mode(plant, 100, 330.0, 0.01, 1.0)
    clean = plant.noisy(np.random.default_rng(3), 100, bins)[1]
    error = (y - clean) * 5 * np.sqrt(plant.noise[0]) / np.abs(y - clean).max()
    plan = plan_for(plant, BARE)
    told = [
        plan.from_bins(u[k], clean[k] + error[k]).status() is PolesStatus.MODEL_ERROR
        for k in range(100)
    ]
    richer = plan_for(plant).from_bins(u, clean + error).has_status(PolesStatus.MODEL_ERROR)
    assert np.mean(told) > 0.9
    assert richer.mean() < 0.02


@pytest.mark.parametrize("structure", [BARE, ModelStructure()], ids=["bare", "default"])
@pytest.mark.parametrize(
    "cell", [(0.02, 40.0, 1), (0.005, 10.0, 2), (0.1, 40.0, 8)], ids=["one", "two", "eight"]
)
def test_a_complete_model_lacks_nothing(cell, structure):
    """Of all points, not only those of a batch that are asked: two tests of 2 in 10 000 each."""
    runs, plant = 4000, Plant(*cell)
    bins = plant.bins()
    u, y = plant.noisy(np.random.default_rng(7), runs, bins)
    plan = plan_for(plant, structure)
    fit = plan.from_bins(u, y)
    theta = [fit.fit.denominator[:, :-1], fit.fit.numerator, fit.fit.transient]
    variance_y, variance_u = (np.ascontiguousarray(v) for v in np.split(fit.noise_variance, 2, 1))
    data = BinData.of(
        y[:, None],
        u[:, None],
        plan.order,
        plan.others_at.size,
        rest=variance_y,
        variance_y=variance_y,
        variance_u=variance_u,
    )
    assert_nothing_lacks(plan, data, np.concatenate(theta, axis=1)[:, None])


@pytest.mark.parametrize(("records", "periods"), [(4, 1), (2, 2)])
def test_a_complete_model_of_several_realisations_lacks_nothing(records, periods):
    """Their transients take up a little of every direction, which the tests allow for."""
    plan, u, y = realisations(2000, records, periods, 20.0)
    assert_nothing_lacks(plan, BinData.of(y, u, plan.order, plan.others_at.size))


def test_a_complete_model_of_an_frf_lacks_nothing():
    lines_hz = np.arange(200.0, 300.1, 2.5)
    rng = np.random.default_rng(4)
    noise = rng.standard_normal((2, 4000, lines_hz.size))
    g = response(lines_hz, 250.0, 0.02) + 0.01 * (noise[0] + 1j * noise[1]) / np.sqrt(2)
    plan = LinesPlan.on_lines(lines_hz, ModelStructure(), (200.0, 300.0))
    data = BinData.of(g[:, None], np.ones((1, 1, lines_hz.size)), variance_y=np.full((4000, 1), 1e-4))
    assert_nothing_lacks(plan, data)


def assert_nothing_lacks(plan, data, start=None):
    """False alarms and doubts are as frequent as stated."""
    solution, runs = minimise(plan.problem, data, start), len(data.y)
    lack = Lack.of(plan, data, solution, np.ones(runs, bool))
    alarms = np.isfinite(lack.found[:, 0]).sum()
    assert stats.binom.sf(alarms - 1, runs, 2 * FALSE_ALARM) > 0.0005
    doubts = (lack.chi_square > 0).sum()
    assert 0.0005 < stats.binom.cdf(doubts, runs, DOUBT) < 0.9995
    assert [matrix is not None for matrix in lack.doubt] == (lack.chi_square > 0).tolist()


def response(frequency_hz, f0_hz, damping_ratio):
    """(K,) of a mode of peak 1."""
    s, w = 2j * np.pi * frequency_hz, 2 * np.pi * f0_hz
    width = 2 * damping_ratio * w
    return width * w / (s**2 + width * s + w**2)


def realisations(runs, records, periods, snr_db, beside=()):
    """Plan and bins u, y (runs, M, K) of a mode at 250 Hz and others, from any initial state."""
    kind = JointPlan if records == 1 else PoleEstimator
    plan = kind(5e3, 2000, periods, np.arange(4, 401), (200.0, 300.0))
    hz, rng = plan.frequency_hz, np.random.default_rng(11)
    u = np.zeros((runs, records, hz.size), complex)
    phase = 2 * np.pi * rng.random((runs, records, plan.excited_at.size))
    u[..., plan.excited_at] = np.exp(1j * phase)
    noise = rng.standard_normal((2, *u.shape))
    y = 10 ** (-snr_db / 20) * (noise[0] + 1j * noise[1]) / np.sqrt(2)
    for f0_hz, damping_ratio, size in ((250.0, 0.04, 1.0), *beside):
        started = rng.standard_normal((2, runs, records, 1)) / periods
        transient = (started[0] + 1j * hz / f0_hz * started[1]) / f0_hz * response(hz, f0_hz, 0.04)
        y += size * (response(hz, f0_hz, damping_ratio) * u + transient)
    return plan, u, y


BESIDE = ((120.0, 0.04, 0.5), (400.0, 0.04, 0.5))


@pytest.mark.parametrize(("records", "periods"), [(1, 4), (4, 1), (3, 2)])
def test_doubt_is_what_a_fit_with_two_terms_more_differs_by(records, periods):
    """Its coefficients and their covariance, which one step along these terms finds."""
    runs = 40
    plan, u, y = realisations(runs, records, periods, 60.0, BESIDE)
    richer = replace(plan, structure=ModelStructure.with_residual(2, 8))
    data = BinData.of(y, u, plan.order, plan.others_at.size)
    fit, more = minimise(plan.problem, data), minimise(richer.problem, data)
    lack = Lack.of(plan, data, fit, np.ones(runs, bool))
    rows = np.flatnonzero(lack.chi_square > 12)
    assert rows.size > 10
    moved = (more.theta[:, 0, :2] - fit.theta[:, 0, :2])[rows]
    grown = (more.marginal[:, 0, :2, :2] - fit.marginal[:, 0, :2, :2])[rows]
    level = 2 * (fit.cost - more.cost)[rows] / lack.chi_square[rows]
    expected = 0.5 * level[:, None, None] * grown + moved[:, :, None] * moved[:, None, :]
    found = np.stack([lack.doubt[k][:2, :2] for k in rows])
    assert np.median(np.abs(found / expected - 1)) < 0.05


@pytest.mark.parametrize(("records", "periods"), [(4, 1), (3, 2)])
def test_modes_beyond_the_band_count_where_no_test_finds_them(records, periods, monkeypatch):
    """Half as large, at 120 and 400 Hz: ellipses of noise alone of poles with status ok often miss the mode."""
    plan, u, y = realisations(150, records, periods, 56.0, BESIDE)

    def inside():
        found = [single(plan.from_bins(u[k], y[k])) for k in range(150)]
        off = [
            (p.covariance[0], np.array([p.f0_hz[0] - 250, p.damping_ratio[0] - 0.04]))
            for p in found
            if p.status is PolesStatus.OK
        ]
        return [by @ np.linalg.solve(covariance, by) < 5.991 for covariance, by in off]

    with_doubt = inside()
    assert len(with_doubt) > 30
    assert np.mean(with_doubt) > 0.8
    monkeypatch.setattr(Lack, "only_where", lambda lack, _: replace(lack, doubt=np.full(1, None, object)))
    assert np.mean(inside()) < 0.7


@pytest.mark.parametrize("of_frf", [False, True])
def test_a_wide_mode_in_doubt_is_as_significant_as_before(of_frf, monkeypatch):
    """Doubt widens its ellipse; a mode that noise would not make is still one."""
    plant, found = Plant(0.15, 30.0, 2), []
    u, y = plant.noisy(np.random.default_rng(9), 300, plant.bins())
    plan, lines_hz = plan_for(plant), np.arange(200.0, 300.1, 2.5)
    noise = np.random.default_rng(9).standard_normal((2, 300, lines_hz.size))
    g = response(lines_hz, 250.0, 0.15) + 0.01 * (noise[0] + 1j * noise[1])
    for k in range(300):
        frf = FRF(lines_hz, g[k], variance_noise=np.full(lines_hz.size, 2e-4), noise_dof=4)
        found.append(identify_frf(frf) if of_frf else single(plan.from_bins(u[k], y[k])))
    assert sum("two residual terms" in poles.message for poles in found) > 5
    assert all(poles.status is PolesStatus.OK for poles in found)


@pytest.mark.parametrize("dof", [1, 2, 4])
def test_variances_of_single_lines_from_few_periods_say_nothing_of_the_model(dof):
    """As weights they follow the noise: of sound FRFs up to a quarter would lack a mode."""
    lines_hz, rng = np.arange(200.0, 300.1, 2.5), np.random.default_rng(10)
    true = 1e-4 * (1 + 100 * np.exp(-(((lines_hz - 262) / 4) ** 2)))
    wrong = 0
    for _ in range(200):
        noise = rng.standard_normal((2, lines_hz.size))
        g = response(lines_hz, 250.0, 0.02) + np.sqrt(true / 2) * (noise[0] + 1j * noise[1])
        variance = true * rng.chisquare(2 * dof, lines_hz.size) / (2 * dof)
        frf = FRF(lines_hz, g, variance_noise=variance, noise_dof=dof)
        wrong += bool(re.search("(mode|terms) more", identify_frf(frf).message))
    assert wrong < 6


def test_a_fit_without_degrees_of_freedom_left_lacks_nothing():
    lines_hz, rng = np.linspace(200.0, 300.0, 6), np.random.default_rng(11)
    g = response(lines_hz, 250.0, 0.02) + 0.01 * rng.standard_normal(6)
    assert "residual terms" not in identify_frf(FRF(lines_hz, g)).message
