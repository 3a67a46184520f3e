# SPDX-License-Identifier: Apache-2.0
"""The tare and what is measured with it: stated uncertainties against Monte Carlo; what a tare refuses."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tactile_resonance.contact.contact_filter import RIGID, hertz_force
from tactile_resonance.contact.goal import Breach, Cause
from tactile_resonance.contact.observer import Observer, TareError, tare
from tactile_resonance.contact.outcome import Outcome
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.samples import WrenchSample
from tactile_resonance.contact.vectors import vector

LIMITS = ContactParameters(
    cell_noise_n=1e-3, tare_std_n=1e-3, tare_drift_n_per_s=2e-3, tare_offset_n=0.05
)
ZERO_N = np.array([0.02, -0.01, 0.03])


def samples(n=200, *, rms=1e-3, drift=0.0, seed=0, keep=0.0):
    """Readings at 1 kHz; `keep` is the correlation of successive samples."""
    rng = np.random.default_rng(seed)
    noise = np.zeros((n, 3))
    now = rng.standard_normal(3)
    for i in range(n):
        now = keep * now + math.sqrt(1 - keep**2) * rng.standard_normal(3)
        noise[i] = rms * now
    t = np.arange(n) * 1e-3
    force = ZERO_N + noise + drift * t[:, None]
    return [
        WrenchSample(round(s * 1e9), vector(f), (1e-4, 1e-4, 1e-4))
        for s, f in zip(t, force, strict=True)
    ]


@pytest.mark.parametrize(("keep", "n"), [(0.0, 400), (0.9, 400), (0.9, 200)])
def test_the_stated_uncertainty_is_that_of_the_mean(keep, n):
    z = []
    for seed in range(300):
        limits = replace(LIMITS, tare_drift_n_per_s=1.0, tare_std_n=1.0)
        zero, _ = tare(samples(n, seed=seed, keep=keep), limits, 0)
        z.append((zero.force_n - ZERO_N) / zero.std_n)
    # chi square over 900 values, five standard errors; the correlation is estimated too: one more tenth
    assert np.mean(np.square(z)) == pytest.approx(1.0, abs=0.1 + 5 * math.sqrt(2 / 900))


def test_it_is_the_mean_of_what_was_read():
    readings = samples()
    zero, noise_n = tare(readings, LIMITS, 7)
    np.testing.assert_allclose(zero.force_n, np.mean([s.force_n for s in readings], axis=0))
    assert noise_n == pytest.approx(1e-3, rel=0.2)
    assert zero.time_ns == 7


def test_noise_beyond_the_stated_is_refused_with_the_figures():
    with pytest.raises(TareError, match=r"noise of Fx .* mN rms, the source states 1 mN"):
        tare(samples(rms=2e-3), LIMITS, 0)


def test_drift_is_refused():
    with pytest.raises(TareError, match=r"Fx drifts by 10.* mN/s, accepted are 2 mN/s"):
        tare(samples(drift=0.010, rms=1e-4), LIMITS, 0)


def test_what_is_noise_is_not_called_drift():
    refused = 0
    for seed in range(200):
        try:
            tare(samples(100, seed=seed), LIMITS, 0)
        except TareError:
            refused += 1
    # 0.1 s of 1 mN noise has a slope of 3.5 mN/s rms
    assert refused <= 3


def test_too_few_samples_for_the_zero_asked_for_are_refused():
    with pytest.raises(TareError, match="take more samples"):
        tare(samples(30), replace(LIMITS, tare_std_n=5e-5), 0)


def test_too_few_samples_are_refused():
    with pytest.raises(TareError, match="5 samples, expected at least 20"):
        tare(samples(5), LIMITS, 0)


def test_an_offset_that_no_bias_explains_is_refused():
    with pytest.raises(TareError, match=r"Fx reads .* without contact, accepted are up to 15 mN"):
        tare(samples(), replace(LIMITS, tare_offset_n=0.015), 0)


C, SPEED_M_S, ABOVE_M, PRESSED_M = 800.0, 4e-3, 8e-4, 4e-4


def pressed(seed, keep):
    """Observer of a tip that came down on still tissue whose surface is at 0, and rests there."""
    parameters = ContactParameters(beam_stiffness_n_per_m=0.0)
    observer = Observer(parameters, Limits())
    rng, noise, t_ns, height = np.random.default_rng(seed), 0.0, 0, ABOVE_M
    # such that means of many scatter as those of white noise of 1 mN
    rms = 1e-3 * math.sqrt((1 - keep) / (1 + keep))

    def take(count):
        nonlocal noise, t_ns, height
        noise = noise or rng.standard_normal()
        for _ in range(count):
            height = max(-PRESSED_M, height - (0.0 if observer.taring else SPEED_M_S * 2e-3))
            noise = keep * noise + math.sqrt(1 - keep**2) * rng.standard_normal()
            force = hertz_force(-height, C, RIGID)[0] + rms * noise
            wrench = (*(1e-4 * rng.standard_normal(2)), force)
            t_ns += 2_000_000
            assert (
                observer.take([WrenchSample(t_ns, wrench, (0.0,) * 3, False)], t_ns, height) is None
            )

    observer.begin_tare()
    take(200)
    assert observer.end_tare(t_ns) is None
    take(330)
    observer.begin_mean()
    take(40)
    return observer


@pytest.mark.parametrize("keep", [0.0, 0.8])
def test_what_is_stated_of_a_contact_is_as_uncertain_as_stated_also_behind_a_filter(keep):
    z = []
    for seed in range(120):
        observer = pressed(seed, keep)
        estimate, (mean_n, mean_std_n) = observer.model.estimate(-PRESSED_M), observer.mean_force()
        true_n = hertz_force(PRESSED_M, C, RIGID)[0]
        std_n = math.hypot(estimate.force_std_n, observer.bias_std_n)
        z.append(
            [
                (mean_n - true_n) / mean_std_n,
                (estimate.force_n - true_n) / std_n,
                estimate.surface_m / estimate.depth_std_m,
            ]
        )
    # chi square over 120: within four standard errors, and no less certain than half of it
    square = np.mean(np.square(z), axis=0)
    assert np.all(square < 1 + 4 * math.sqrt(2 / 120)), square
    assert np.all(square > 0.4), square


@pytest.mark.parametrize("rate_hz", [200, 500, 1000])
def test_a_zero_has_moved_beyond_four_deviations_of_the_forces_that_came(rate_hz):
    rng, observer = np.random.default_rng(rate_hz), Observer(ContactParameters(), Limits())
    every_ns = round(1e9 / rate_hz)

    def take(first, last):
        for n in range(first, last):
            wrench = vector(1e-3 * rng.standard_normal(3))
            sample = WrenchSample(n * every_ns, wrench, (0.0,) * 3, False)
            assert observer.take([sample], n * every_ns, 0.0) is None

    observer.begin_tare()
    take(1, 400)
    assert observer.end_tare(400 * every_ns) is None
    take(400, 500)
    # a mean over 50 ms
    std_n = math.hypot(observer.bias_std_n, observer.scatter_n / math.sqrt(0.05 * rate_hz))
    for share, moved in ((3.9, False), (4.1, True)):
        outcome = Outcome(observer, 0)
        outcome.ended(Breach(Cause.CANCELLED, ""), 500 * every_ns, None, holding=False)
        outcome.drawn_back(share * std_n)
        assert (outcome.result(holding=False).zero_change_n != 0.0) == moved


def test_the_force_of_the_moment_when_it_is_reached_holds_the_vibration_of_the_arm():
    """A tip that shakes by s about its reported height, on a slope of k, changes the force by k s."""
    observer = pressed(0, 0.0)
    estimate = replace(observer.model.estimate(-PRESSED_M), force_std_n=0.0, stiffness_n_per_m=60.0)
    outcome = Outcome(observer, 0)
    outcome.reached(1, 0, estimate, None)
    variance = outcome.result(holding=False).force_std_n ** 2 - observer.bias_std_n**2
    assert math.sqrt(variance) == pytest.approx(60.0 * observer.parameters.arm_vibration_m)
