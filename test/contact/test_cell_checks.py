# SPDX-License-Identifier: Apache-2.0
"""Which sources of force are refused; what is called a fault of a force sensor, and what is not."""

import numpy as np
import pytest

from tactile_resonance.contact.cell_checks import (
    CellChecks,
    CellLimits,
    repeat_probability,
    require_fit,
    samples_until_stuck,
)
from tactile_resonance.contact.interfaces import ForceError, ForceFault, ForceInfo
from tactile_resonance.contact.vectors import six


def info(noise_n=1e-3, step_n=2e-4):
    return ForceInfo("cell", 1000.0, noise_n, step_n, 5.0)


def checks(noise_n=1e-3, step_n=2e-4, **limits):
    return CellChecks(info(noise_n, step_n), 0.3, CellLimits(**limits))


def noisy(rng, noise_n=1e-3, step_n=2e-4, n=1):
    counts = np.rint(noise_n * rng.standard_normal((n, 6)) / step_n)
    return [six(wrench) for wrench in counts * step_n]


def fault_of(action):
    with pytest.raises(ForceError) as caught:
        action()
    return caught.value.fault


@pytest.mark.parametrize("ratio", [0.3, 1.0, 3.0, 20.0])
def test_repeat_probability_is_that_of_drawn_noise(ratio):
    rng = np.random.default_rng(1)
    n = 200_000
    counts = np.rint(ratio * rng.standard_normal(n))
    p = repeat_probability(ratio, 1.0)
    seen = np.mean(counts[0::2] == counts[1::2])
    assert seen == pytest.approx(p, abs=5 * np.sqrt(p * (1 - p) / (n / 2)) + 1e-9)


def test_fine_steps_against_noise_have_the_density_of_the_difference():
    # chance of a difference of N(0, 2 sigma^2) within one step: step / (2 sigma sqrt(pi))
    assert repeat_probability(1.0, 0.01) == pytest.approx(0.01 / (2 * np.sqrt(np.pi)), rel=1e-4)


def test_a_cell_whose_step_hides_its_noise_cannot_be_called_stuck():
    assert samples_until_stuck(info(1e-4, 0.02)) is None
    quiet = checks(1e-4, 0.02)
    for _ in range(5000):
        quiet.check((0.0,) * 6)


def test_noise_alone_is_never_a_fault():
    rng = np.random.default_rng(2)
    watch = checks(jump_n=0.015)
    for wrench in noisy(rng, n=20_000):
        assert watch.check(wrench) is False


def test_coarse_noise_repeats_often_and_is_no_fault():
    rng = np.random.default_rng(3)
    noise_n, step_n = 0.6e-3, 1e-3
    watch = checks(noise_n, step_n)
    for wrench in noisy(rng, noise_n, step_n, 50_000):
        watch.check(wrench)


def test_a_stuck_cell_is_found_at_the_stated_sample():
    watch = checks()
    n = samples_until_stuck(info())
    assert n == 10
    wrench = (0.01,) * 6
    for _ in range(n - 1):
        watch.check(wrench)
    assert fault_of(lambda: watch.check(wrench)) is ForceFault.STUCK


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_value_that_is_not_finite(value):
    assert fault_of(lambda: checks().check((0.0, 0.0, value, 0.0, 0.0, 0.0))) is ForceFault.INVALID


@pytest.mark.parametrize("axis", range(6))
def test_beyond_the_range_is_told_at_once_and_a_fault_on_the_third(axis):
    watch = checks(jump_n=0.015)
    wrench = six(np.eye(6)[axis] * (-5.01 if axis < 3 else -0.301))
    assert watch.check((0.0,) * 6) is False
    assert watch.check(wrench) is True
    assert watch.check(wrench) is True
    assert fault_of(lambda: watch.check(wrench)) is ForceFault.OVERLOAD


def test_the_sensors_own_overload_bits_count():
    watch = checks()
    rng = np.random.default_rng(4)
    first, second, third = noisy(rng, n=3)
    assert watch.check(first, overload=True) is True
    assert watch.check(second, overload=True) is True
    assert fault_of(lambda: watch.check(third, overload=True)) is ForceFault.OVERLOAD
    with pytest.raises(ForceError, match="4 samples beyond the range; as the sensor reports"):
        watch.check(first, overload=True)  # no figure shows it


def test_a_change_of_sign_and_a_step_of_bias_are_jumps_a_contact_is_not():
    rng = np.random.default_rng(5)
    watch = checks(jump_n=0.015)
    force_n = 0.0
    for wrench in noisy(rng, n=400):  # 80 N/m at 5 mm/s: 0.4 mN each millisecond
        force_n += 0.0004 if force_n < 0.02 else 0.0
        watch.check(six(np.add(wrench, [0, 0, force_n, 0, 0, 0])))
    flipped = six(np.subtract(noisy(rng)[0], [0, 0, force_n, 0, 0, 0]))
    assert fault_of(lambda: watch.check(flipped)) is ForceFault.JUMP


def test_few_lost_wrenches_are_tolerated_many_are_not():
    rng = np.random.default_rng(6)
    watch = checks(lost_tolerated=3)
    for i, wrench in enumerate(noisy(rng, n=1000)):
        if i % 34 == 33:  # never more than 3 among the last 100
            watch.lost()
        watch.check(wrench)
    for wrench in noisy(rng, n=100):
        watch.check(wrench)
    for _ in range(3):
        watch.lost()
    assert fault_of(watch.lost) is ForceFault.INCOMPLETE


@pytest.mark.parametrize(
    "limits",
    [
        {"silent_s": 0.0},
        {"stuck_samples": 1},
        {"jump_n": 0.0},
        {"overload_samples": 0},
        {"lost_tolerated": 100},
    ],
)
def test_limits_are_checked(limits):
    with pytest.raises(ValueError, match=next(iter(limits))):
        CellLimits(**limits)


def test_the_required_cell_serves_1_cn_and_those_in_the_page_do_not():
    require_fit(ForceInfo("required", 500.0, 1e-3, 3e-4, 5.0), 0.01)
    robotous = ForceInfo("RFT40", 1000.0, 0.17, 0.02, 100.0)
    with pytest.raises(
        ValueError,
        match=r"RFT40 cannot control 10 mN: its noise is 120 mN rms \(at 500 Hz\), at most 1 mN serve; "
        "its smallest step is 20 mN, at most 0.3 mN serve",
    ):
        require_fit(robotous, 0.01)
    e_series = ForceInfo("UR e-series", 500.0, 4.0, 0.1, 100.0)
    with pytest.raises(ValueError, match="its noise is [^;]*; its smallest step is [^;]*$"):
        require_fit(e_series, 0.01)
    require_fit(robotous, 2.0)


def test_noise_is_compared_by_its_density():
    fast = ForceInfo("fast", 2000.0, 2e-3, 1e-4, 1.0)
    slow = ForceInfo("slow", 250.0, 0.8e-3, 1e-4, 1.0)
    require_fit(fast, 0.01)
    with pytest.raises(ValueError, match=r"1\.13 mN rms"):
        require_fit(slow, 0.01)


def test_rate_and_range_are_asked_for_too():
    poor = ForceInfo("poor", 100.0, 1e-5, 1e-5, 0.02)
    reasons = "it gives 100 Hz, at least 200 Hz serve; its range is 20 mN, at least 50 mN serve"
    with pytest.raises(ValueError, match=f"^force source poor cannot control 10 mN: {reasons}$"):
        require_fit(poor, 0.01)
    with pytest.raises(ValueError, match="force_n: 0"):
        require_fit(poor, 0)
