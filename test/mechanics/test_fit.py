# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from benchmarks.mechanics import RADIUS_M, errors_of, force_over, relaxation
from tactile_resonance.mechanics.fit import Known, fit_indentation
from tactile_resonance.mechanics.indentation import (
    BallTip,
    IndentationRecord,
    Prony,
    Protocol,
    means_of,
)
from tactile_resonance.simulation.tissue.library import read_tissues

STANDARD = Prony(4e3, np.array([3e3]), np.array([2.0]))


def deviations(fit, truth):
    """Of all constants that are called determined, in their own standard deviations."""
    return [error for name, error in errors_of(fit, truth) if name != "E(t)"]


@pytest.mark.parametrize("stiffness_n_per_m", [np.inf, 14.8])
def test_constants_of_one_and_two_terms_lie_within_their_deviations(stiffness_n_per_m):
    pooled = []
    for seed in range(14):
        rng = np.random.default_rng(seed)
        terms = 1 + seed % 2
        times = rng.uniform(0.8, 1.5) * np.array([1.0, rng.uniform(6, 10)])[:terms]
        einf = rng.uniform(1e3, 2e4)
        truth = Prony(einf, einf * rng.uniform(0.4, 1.2, terms), times)
        test = relaxation(truth, rng, stiffness_n_per_m=stiffness_n_per_m, hold_s=60.0)
        pooled += deviations(fit_indentation(test, most_terms=3), truth)
    pooled = np.abs(pooled)
    assert pooled.size > 30
    assert pooled.max() < 4
    # not significantly below .93 at 99.9 %
    assert binom.cdf((pooled < 1.96).sum(), pooled.size, 0.93) > 1e-3


def test_a_term_that_the_hold_does_not_show_is_in_the_deviation_of_einf():
    """Einf was called determined 9 deviations off."""
    truth, found = Prony(1.5e3, np.array([1e3, 800.0]), np.array([1.0, 60.0])), []
    for seed in range(6):
        test = relaxation(truth, np.random.default_rng(seed), hold_s=5.0, noise_n=1e-3)
        fit = fit_indentation(test, most_terms=2)
        found += [error for name, error in errors_of(fit, truth) if name == "Einf"]
    assert np.max(np.abs(found), initial=0.0) < 4


def walked(test, walk_n_per_sqrt_s, seed):
    """The same with a zero of the force that walks at random."""
    steps = np.sqrt(np.diff(test.time_s, prepend=test.time_s[0]))
    steps *= walk_n_per_sqrt_s * np.random.default_rng([seed, 1]).standard_normal(steps.size)
    return replace(test, force_n=test.force_n + np.cumsum(steps))


def test_a_zero_that_walks_is_in_the_deviations_and_said():
    pooled, said = [], 0
    for seed in range(10):
        still = relaxation(STANDARD, np.random.default_rng(seed), hold_s=30.0)
        fit = fit_indentation(walked(still, 1e-4, seed), most_terms=1)
        said += any("as if the zero walked by" in text for text in fit.status)
        values = np.log([fit.equilibrium_pa, fit.terms[0].modulus_pa, fit.terms[0].time_s])
        off = values - np.log([4e3, 3e3, 2.0])
        pooled.append(off @ np.linalg.solve(fit.covariance, off))
    # chi square of three each: below four standard errors, and by far not of deviations that hold anything
    assert said == 10
    assert 0.3 * 3 < np.mean(pooled) < 3 * (1 + 4 * np.sqrt(2 / 30))
    steady = fit_indentation(relaxation(STANDARD, np.random.default_rng(0), hold_s=30.0), most_terms=1)
    assert steady.status == ()


def test_terms_beyond_ramp_and_hold_are_not_determined():
    tissue = read_tissues()["liver"]
    rng = np.random.default_rng(3)
    fit = fit_indentation(relaxation(tissue.prony, rng, hold_s=20.0))
    truth = tissue.prony
    determined = [term for term in fit.terms if term.known is Known.DETERMINED]
    assert all(fit.ramp_s < term.time_s < fit.hold_s for term in determined)
    assert any(term.known is Known.SLOWER for term in fit.terms)  # 60 s
    assert fit.equilibrium_known is Known.SLOWER
    assert np.all(np.abs(deviations(fit, truth)) < 4)
    # within ramp and hold the modulus itself is known, beyond them it is not stated
    value, std = fit.modulus(5.0)
    assert abs(np.log(value / truth.relaxation_modulus(5.0))) < 4 * std
    assert std < 0.2
    assert np.isnan(fit.modulus(100.0)).all()
    assert np.isnan(fit.modulus(1e-3)).all()


def test_a_record_without_its_ramp_is_refused():
    test = relaxation(STANDARD, np.random.default_rng(5))
    late = test.time_s > 0.25
    cut = {
        name: getattr(test, name)[late & (test.time_s < 30)]
        for name in ("time_s", "force_n", "depth_m")
    }
    with pytest.raises(ValueError, match="depth_m: got .* accepted is .* before the touch"):
        fit_indentation(replace(test, **cut))


def test_creep_at_constant_force_gives_the_same_constants():
    ball = BallTip(RADIUS_M)
    time = np.concatenate([np.linspace(0, 0.2, 101)[:-1], np.arange(0.2, 40, 0.01)])
    force = 0.01 * np.minimum(time / 0.2, 1.0)
    # the way that keeps the force, by bisection of the course itself
    depth = np.zeros_like(time)
    rng = np.random.default_rng(2)
    compliance = STANDARD.creep_compliance
    rises = np.diff(force, prepend=0.0)
    ramp = slice(0, 101)
    for i, t in enumerate(time):
        passed = compliance(np.maximum(t - time[ramp], 0.0)) * rises[ramp] * (time[ramp] <= t)
        depth[i] = (passed.sum() / ball.factor) ** (2 / 3)
    noisy = force + 2e-4 * rng.standard_normal(time.size)
    test = IndentationRecord(
        Protocol.CREEP, time, noisy, depth, ball, force_std_n=0.0, depth_std_m=0.0
    )
    fit = fit_indentation(test, most_terms=2)
    assert fit.equilibrium_known is Known.DETERMINED
    assert np.all(np.abs(deviations(fit, STANDARD)) < 4)


def test_load_and_unload_give_the_constants_too():
    ball = BallTip(RADIUS_M)
    time = np.arange(0.0, 24.0, 0.01)
    depth = np.interp(time, [0, 2, 20, 24], [0, 1e-3, 1e-3, -1e-3])
    turn = int(np.flatnonzero(depth >= 1e-3 - 1e-12)[-1])
    force, _ = force_over(ball, time, depth, Prony(4e3, np.array([3e3]), np.array([5.0])), turn)
    noisy = force + 1e-4 * np.random.default_rng(4).standard_normal(time.size)
    test = IndentationRecord(Protocol.INDENTATION, time, noisy, depth, ball, force_std_n=0.0)
    fit = fit_indentation(test, most_terms=2)
    assert fit.time_s[-1] > 21
    assert fit.chi_square / fit.dof < 1.5
    truth = Prony(4e3, np.array([3e3]), np.array([5.0]))
    assert np.all(np.abs(deviations(fit, truth)) < 4)


def test_what_hertz_leaves_out_is_said():
    soft = Prony(500.0, np.array([500.0]), np.array([2.0]))
    fit = fit_indentation(
        relaxation(soft, np.random.default_rng(1)), most_terms=1, thickness_m=5e-3
    )
    assert fit.contact_ratio > 0.7
    assert any("a/R" in text for text in fit.status)
    assert any("thin" in text for text in fit.status)


def test_a_way_that_goes_back_is_refused():
    test = relaxation(STANDARD, np.random.default_rng(1))
    depth = test.depth_m.copy()
    depth[(test.time_s > 5) & (test.time_s < 6)] *= 0.5
    with pytest.raises(ValueError, match="depth_m: got .* back.*; accepted is"):
        fit_indentation(replace(test, depth_m=depth))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda test: {"force_n": -test.force_n}, "force_n: got .* N at most, .* accepted is a largest"),
        (lambda test: {"force_n": 0 * test.force_n}, "force_n: got '0 N at most"),
        (lambda test: {"force_n": np.full(test.time_s.size, 0.01)}, "0.01 N at most, 0.01 N before"),
        (lambda test: {"force_n": np.where(test.time_s > 1, np.nan, test.force_n)}, "nan at sample"),
        (lambda test: {"time_s": test.time_s[::-1]}, "time_s: got '.* s after .* s'; accepted is asc"),
        (lambda test: {"ball": BallTip(np.inf)}, "radius_m: got inf; accepted is a number above 0"),
        # tissue that came up under a tip that kept its place, as before a contact is given up
        (lambda test: {"force_n": test.force_n + 0.3 * (test.time_s > 2.4)}, "without a contact.; accepted is"),
    ],
)
def test_what_is_no_contact_is_refused_by_field(change, message):
    test = relaxation(STANDARD, np.random.default_rng(1), hold_s=3.0)
    with pytest.raises(ValueError, match=message):
        fit_indentation(replace(test, **change(test)))


@pytest.mark.parametrize("seed", range(12))
def test_a_way_that_met_nothing_has_no_modulus(seed):
    rng = np.random.default_rng(seed)
    test = relaxation(STANDARD, rng, hold_s=3.0)
    noise = 2e-4 * rng.standard_normal(test.time_s.size)
    with pytest.raises(ValueError, match="force_n: got .*; accepted is"):
        fit_indentation(replace(test, force_n=noise))


def test_a_relaxation_without_a_hold_says_nothing_of_the_equilibrium():
    test = relaxation(STANDARD, np.random.default_rng(1), hold_s=3.0)
    short = test.time_s < 0.21
    columns = {name: getattr(test, name)[short] for name in ("time_s", "force_n", "depth_m")}
    with pytest.raises(ValueError, match="hold: got .*; accepted is one as long as the ramp, 0.1"):
        fit_indentation(replace(test, **columns))


def test_a_drift_that_the_record_does_not_show_is_noted():
    """Without the air at its end a drift of the zero passes for relaxation."""
    test = relaxation(STANDARD, np.random.default_rng(1), hold_s=10.0)
    assert fit_indentation(test).status == ()
    held = test.time_s < 10.0
    columns = {name: getattr(test, name)[held] for name in ("time_s", "force_n", "depth_m")}
    assert any("taken not to drift" in note for note in fit_indentation(replace(test, **columns)).status)


def part_of(test, kept, offset_n=0.0, delay_s=0.0):
    columns = {name: getattr(test, name)[kept] for name in ("time_s", "force_n", "depth_m")}
    columns["force_n"] = columns["force_n"] + offset_n
    return replace(test, **{**columns, "time_s": columns["time_s"] + delay_s})


def test_air_at_the_end_alone_shows_the_zero_of_the_force():
    test = relaxation(STANDARD, np.random.default_rng(1))
    from_touch = test.time_s >= -0.002
    fits = [fit_indentation(part_of(test, from_touch, offset_n)) for offset_n in (0.0, 1e-3)]
    assert not any("no force in air" in note for note in fits[1].status)
    assert abs(fits[1].prony.moduli_pa / fits[0].prony.moduli_pa - 1).max() < 1e-3


def test_a_zero_of_the_force_that_nothing_shows_is_said_to_be_taken_as_exact():
    test = relaxation(STANDARD, np.random.default_rng(1))
    pressed = (test.time_s >= -0.002) & (test.time_s < 30.0)
    assert any("no force in air" in note for note in fit_indentation(part_of(test, pressed)).status)
    stated = replace(part_of(test, pressed), force_std_n=1e-4)
    assert not any("no force in air" in note for note in fit_indentation(stated).status)


def test_a_drift_that_is_not_shown_is_left_out_whatever_the_clock_says():
    """Also where the zero of the clock is the end of the hold."""
    test = relaxation(STANDARD, np.random.default_rng(1), hold_s=10.0)
    held = test.time_s < 10.0
    end_s = means_of(part_of(test, held)).end_s
    found = [
        fit_indentation(part_of(test, held, delay_s=delay_s)).equilibrium_pa
        for delay_s in (0.0, -end_s, 1e6)
    ]
    assert np.ptp(found) < 1e-3 * found[0]


@pytest.mark.parametrize("rate_hz", [200.0, 500.0])
def test_means_of_a_hold_do_not_begin_to_draw_back_before_it_ends(rate_hz):
    """Of exact forces nothing is left by the means but a fraction of the deviations of usual noise."""
    ball = BallTip(RADIUS_M)
    truth = Prony(4e3, np.array([3e3, 2e3]), np.array([0.5, 4.0]))
    time = np.arange(-0.5, 23.0, 1 / rate_hz)
    depth = np.interp(time, [-0.5, 0.3, 20.3, 22.3], [-5e-4 / 0.3, 1e-3, 1e-3, -1e-3])
    turn = int(np.flatnonzero(depth >= 1e-3 * (1 - 1e-9))[-1])
    force, _ = force_over(ball, time, depth, truth, turn)
    test = IndentationRecord(Protocol.INDENTATION, time, force, depth, ball, noise_n=2e-4)
    fit = fit_indentation(test, most_terms=2)
    assert fit.chi_square < 5
    assert np.abs(deviations(fit, truth)).max() < 0.3
    assert abs(np.log(fit.modulus(5.0)[0] / truth.relaxation_modulus(5.0))) < 1e-3


@pytest.mark.parametrize("digit_n", [1e-3, 5e-4])
def test_the_last_digit_of_the_forces_is_an_error_that_no_mean_averages(digit_n):
    """Of forces whose noise is a tenth of it: neighbours are equal, and say nothing of noise."""
    pooled = []
    for seed in range(8):
        test = relaxation(STANDARD, np.random.default_rng(seed), noise_n=5e-5)
        rounded = replace(test, force_n=digit_n * np.round(test.force_n / digit_n))
        fit = fit_indentation(rounded, most_terms=2)
        assert fit.chi_square / fit.dof < 2
        pooled += deviations(fit, STANDARD)
    assert np.abs(pooled).max() < 4
    assert np.mean(np.abs(pooled) < 1.96) > 0.8


@pytest.mark.parametrize("thickness_m", [0.0, -1e-3, np.inf])
def test_a_thickness_is_above_zero(thickness_m):
    test = relaxation(STANDARD, np.random.default_rng(1), hold_s=3.0)
    with pytest.raises(ValueError, match="thickness_m: got .*; accepted is a number above 0"):
        fit_indentation(test, thickness_m=thickness_m)
