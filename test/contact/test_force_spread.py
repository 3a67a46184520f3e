# SPDX-License-Identifier: Apache-2.0
"""What a force moves by is told from what its sensor makes of it, against closed forms."""

import math

import numpy as np
import pytest

from tactile_resonance.contact.force_spread import ForceSpread, joined_spread, spread_of

NOISE_N = 1e-3


def times(length_s, rate_hz):
    return (np.arange(round(length_s * rate_hz)) + 0.5) / rate_hz


def told(motion, length_s=4.0, rate_hz=1000.0, noise_n=0.0, seed=1):
    t = times(length_s, rate_hz)
    noise = noise_n * np.random.default_rng(seed).standard_normal(t.size)
    return spread_of(t, 0.01 + motion(t) + noise, length_s)


def share_seen(motion_hz):
    """Of the rms of a sinusoid."""
    steps = np.sinc(0.01 * motion_hz) ** 2 * (1 - math.cos(2 * np.pi * 0.01 * motion_hz))
    return math.sqrt(np.sinc(0.02 * motion_hz) ** 2 - steps / 2)


@pytest.mark.parametrize("rate_hz", [500.0, 1000.0])
@pytest.mark.parametrize("motion_hz", [0.25, 1.2, 2.0, 5.0, 10.0])
def test_rms_and_extremes_of_a_sinusoid(motion_hz, rate_hz):
    """Amplitude over sqrt(2), less the mean over 20 ms and what its steps of 10 ms share with noise."""
    amplitude_n = 5e-4
    found = told(lambda t: amplitude_n * np.sin(2 * np.pi * motion_hz * t), rate_hz=rate_hz)
    assert found.rms_n == pytest.approx(
        share_seen(motion_hz) * amplitude_n / math.sqrt(2), rel=5e-3
    )
    least = {0.25: 0.998, 1.2: 0.998, 2.0: 0.99, 5.0: 0.965, 10.0: 0.87}[motion_hz]
    assert found.rms_n > least * amplitude_n / math.sqrt(2)
    turn, smoothed = 2 * np.pi * motion_hz * 0.02, np.sinc(motion_hz * 0.02)
    # the largest mean is at most half a part off the crest
    crest = smoothed * amplitude_n
    for force_n, sign in ((found.min_n, -1), (found.max_n, 1)):
        assert crest * math.cos(turn / 2) <= sign * (force_n - 0.01) <= crest * (1 + 1e-3)


def test_noise_of_the_sensor_is_no_motion():
    """A block of a still contact at 1 mN of noise: its variance is told without bias, and below 0.1 mN."""
    still = np.array([told(np.zeros_like, 0.4, 1000.0, NOISE_N, seed).rms_n for seed in range(400)])
    assert np.sqrt(np.mean(still**2)) < 1.0e-4
    assert 0.3 < np.mean(still == 0) < 0.7
    # where it moves, noise neither adds nor takes
    amplitude_n = 8e-4
    moving = [
        told(lambda t: amplitude_n * np.sin(2 * np.pi * 1.25 * t), 4.0, 500.0, NOISE_N, seed).rms_n
        for seed in range(200)
    ]
    mean_square = np.mean(np.square(moving))
    expected = (share_seen(1.25) * amplitude_n) ** 2 / 2
    # 200 records; the spread of one is what they show
    assert mean_square == pytest.approx(
        expected, abs=4 * np.std(np.square(moving)) / math.sqrt(200)
    )
    assert np.std(moving) < 4e-5


def test_a_ramp_is_motion():
    """A force that falls evenly by d has d / sqrt(12)."""
    found = told(lambda t: -1e-3 * t / 4.0)
    assert found.rms_n == pytest.approx(1e-3 / math.sqrt(12), rel=2e-3)
    assert found.max_n - found.min_n == pytest.approx(1e-3 * (1 - 0.02 / 4), rel=1e-6)


def test_gaps_are_left_out():
    t = times(0.4, 1000.0)
    force = 0.01 + 1e-3 * (t > 0.2)
    force[100:140] = math.nan
    found = spread_of(t, force, 0.4)
    # 8 parts of the low force, 10 of the high one; one step of 34 over 10 ms counts as noise
    low = 8 / 18
    expected = low * (1 - low) - (1 - 1 / 18) / 34 / 4
    assert found.rms_n == pytest.approx(1e-3 * math.sqrt(expected), rel=1e-6)
    assert (found.min_n, found.max_n) == pytest.approx((0.01, 0.011))


@pytest.mark.parametrize(("length_s", "heard"), [(0.12, 1.0), (0.4, 0.3), (0.4, 0.0)])
def test_too_little_tells_nothing(length_s, heard):
    t = times(length_s, 1000.0)
    force = np.where(t < heard * length_s, 0.01, math.nan)
    found = spread_of(t, force, length_s)
    assert np.isnan([found.rms_n, found.min_n, found.max_n]).all()


def test_blocks_of_a_measurement_join_to_the_spread_of_all():
    """Blocks of a sinusoid: what they have inside, and what their means differ by."""
    amplitude_n, block_s, count = 5e-4, 0.4, 10
    t = times(block_s * count, 1000.0)
    force = 0.01 + amplitude_n * np.sin(2 * np.pi * 0.25 * t)
    blocks = [
        (float(part.mean()), spread_of(times(block_s, 1000.0), part, block_s), block_s)
        for part in np.split(force, count)
    ]
    joined = joined_spread(blocks)
    assert joined.rms_n == pytest.approx(amplitude_n / math.sqrt(2), rel=5e-3)
    assert max(spread.rms_n for _, spread, _ in blocks) < 0.5 * joined.rms_n
    whole = spread_of(t, force, block_s * count)
    assert (joined.min_n, joined.max_n) == pytest.approx((whole.min_n, whole.max_n), rel=1e-9)
    one_unknown = [*blocks[:9], (math.nan, ForceSpread(), block_s)]
    assert joined_spread(one_unknown).rms_n == joined_spread(blocks[:9]).rms_n
    assert math.isnan(joined_spread([*blocks[:7], *3 * [(0.01, ForceSpread(), block_s)]]).rms_n)
    assert math.isnan(joined_spread([]).rms_n)
