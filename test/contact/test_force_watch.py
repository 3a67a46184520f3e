# SPDX-License-Identifier: Apache-2.0
"""Mean and rate of the force, kept up one by one, against what all forces together say."""

import numpy as np
import pytest

from tactile_resonance.contact.force_watch import ForceWatch, RunningMean
from tactile_resonance.contact.samples import WrenchSample

ZERO = (0.0, 0.0, 0.0)


def jittered(rng, count, period_ns):
    """Times [ns] that ascend, half a period off either way."""
    return (
        (period_ns * (np.arange(count) + rng.uniform(-0.5, 0.5, count))).astype(np.int64).tolist()
    )


def rate_from_all(times, forces):
    """From the newest three to the three nearest to 10 ms before, sorted by distance."""
    times, forces = np.array(times, float), np.array(forces)
    then = times[-3:].mean() - 10e6
    nearest = np.argsort(np.abs(times[:-3] - then), kind="stable")[:3]
    span = times[-3:].mean() - times[nearest].mean()
    return (forces[-3:].mean() - forces[nearest].mean()) / (span * 1e-9) if span >= 5e6 else None


@pytest.mark.parametrize("period_ns", [250_000, 1_000_000, 2_000_000, 5_000_000])
def test_rate_is_that_of_the_forces_nearest_to_10_ms_before(period_ns):
    rng = np.random.default_rng(1)
    times, forces = jittered(rng, 300, period_ns), rng.normal(0, 1e-3, 300).cumsum()
    watch = ForceWatch(10, 0.05)
    for n, (time_ns, force_n) in enumerate(zip(times, forces.tolist(), strict=True), 1):
        assert watch.add(WrenchSample(time_ns, (0.0, 0.0, force_n), ZERO)) is None
        want = rate_from_all(times[:n], forces[:n]) if n >= 6 else None
        assert watch.rate_n_per_s() == (None if want is None else pytest.approx(want, rel=1e-9))


def test_forces_from_before_a_long_gap_make_no_rate():
    watch = ForceWatch(10, 0.05)
    for n in range(50):
        watch.add(WrenchSample(n * 2_000_000, (0.0, 0.0, 1e-3 * (n % 2)), ZERO))
    watch.add(WrenchSample(10**9, (0.0, 0.0, 0.02), ZERO))
    assert watch.rate_n_per_s() is None
    for n in range(1, 12):
        watch.add(WrenchSample(10**9 + n * 2_000_000, (0.0, 0.0, 0.02 + 1e-3 * n), ZERO))
    assert watch.rate_n_per_s() == pytest.approx(0.5, rel=1e-9)


@pytest.mark.parametrize("window_ns", [1, 10_000_000, 50_000_000, 400_000_000])
def test_running_mean_is_that_of_the_values_of_its_time(window_ns):
    rng = np.random.default_rng(2)
    times, values = jittered(rng, 2000, 1_000_000), rng.normal(0.01, 1e-3, 2000)
    mean = RunningMean(window_ns)
    for n in range(2000):
        mean.add(times[n], values[n])
        since = times[n] - window_ns
        if times[0] > since:
            assert mean.value is None
        else:
            inside = np.array(times[: n + 1]) > since
            assert mean.value == pytest.approx(values[: n + 1][inside].mean(), rel=1e-12)
    mean.clear()
    mean.add(0, 1.0)
    assert mean.value is None


def test_mean_of_the_force_is_less_its_bias_and_begins_anew_with_it():
    watch = ForceWatch(10, 0.01)
    for n in range(20):
        watch.add(WrenchSample(n * 1_000_000, (0.0, 0.0, 0.03 + 1e-6 * n), ZERO))
    assert watch.mean_n == pytest.approx(0.03 + 14.5e-6)
    watch.set_bias((0.0, 0.0, 0.02))
    assert watch.mean_n is None
    for n in range(20, 31):
        watch.add(WrenchSample(n * 1_000_000, (0.0, 0.0, 0.03 + 1e-6 * n), ZERO))
    assert watch.mean_n == pytest.approx(0.01 + 25.5e-6)
