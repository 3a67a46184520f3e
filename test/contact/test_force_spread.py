# SPDX-License-Identifier: Apache-2.0
"""Force and pose over past intervals, and how the force moved, against closed forms and sums of all samples."""

import math
import threading

import numpy as np
import pytest
from scipy.signal import lfilter

from tactile_resonance.contact import force_spread
from tactile_resonance.contact.force_spread import ForceRecord, joined_spread, spread_of
from tactile_resonance.contact.samples import ArmSample, WrenchSample
from tactile_resonance.contact.vectors import turn_from_quaternion, vector_from_turn
from tactile_resonance.record import ForceSpread

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


ZERO = (0.0, 0.0, 0.0)
MS = 1_000_000
PERIOD_NS, RATE_HZ = 2 * MS, 1000.0
BEGAN_NS = 3_600 * 10**9  # of a clock that has run for an hour


def arm_at(time_ns, place=lambda t: (0.0, 0.0, 0.0), turn=lambda t: (0.0, 0.0, 0.0)):
    t = (time_ns - BEGAN_NS) * 1e-9
    return ArmSample(time_ns, t, place(t), turn(t), (0.0,) * 6)


def filled(
    times_ns,
    forces_n,
    *,
    bias_n=0.0,
    rate_hz=RATE_HZ,
    length_s=30.0,
    bad=(),
    invalid=lambda tick_ns: False,
    until_ns=None,
    arm=arm_at,
    record=None,
):
    """A record of these wrenches, each told by the first period after it."""
    record = record or ForceRecord(rate_hz, PERIOD_NS * 1e-9, length_s)
    waiting = [
        WrenchSample(int(t), (7.0, -7.0, float(f)), ZERO, n in bad)
        for n, (t, f) in enumerate(zip(times_ns, forces_n, strict=True))
    ]
    tick_ns, n = int(times_ns[0]) // PERIOD_NS * PERIOD_NS, 0
    until_ns = int(times_ns[-1]) if until_ns is None else until_ns
    while tick_ns < until_ns:
        tick_ns += PERIOD_NS
        begin = n
        while n < len(waiting) and waiting[n].time_ns <= tick_ns:
            n += 1
        record.add(
            tick_ns,
            waiting[begin:n],
            (1.0, 2.0, bias_n),
            arm(tick_ns),
            valid=not invalid(tick_ns),
        )
    return record


def jittered(duration_s, rng, rate_hz=RATE_HZ):
    """Times that ascend, up to 0.4 periods off either way."""
    period_ns = 1e9 / rate_hz
    count = round(duration_s * rate_hz)
    return BEGAN_NS + (period_ns * (np.arange(count) + rng.uniform(-0.4, 0.4, count))).astype(int)


def seconds(times_ns):
    return (np.asarray(times_ns) - BEGAN_NS) * 1e-9


@pytest.mark.parametrize("length_ns", [1_234_567, 20 * MS, 333_333_333])
def test_mean_of_a_ramp_is_its_value_at_the_middle_wherever_the_interval_lies(length_ns):
    rng = np.random.default_rng(1)
    times = jittered(2.0, rng)
    record = filled(times, 0.01 + 0.3 * seconds(times))
    for begin_ns in rng.integers(10 * MS, 1600 * MS, 50):
        t0 = BEGAN_NS + int(begin_ns)
        over = record.over(t0, t0 + length_ns)
        assert over.reason == ""
        assert over.coverage == pytest.approx(1.0, abs=1e-12)
        assert over.force_n == pytest.approx(
            0.01 + 0.3 * (begin_ns + length_ns / 2) * 1e-9, rel=1e-12
        )


def test_mean_of_a_sine_is_that_of_its_integral():
    rng = np.random.default_rng(2)
    times, w = jittered(2.0, rng), 2 * np.pi * 7
    record = filled(times, 0.01 + 2e-3 * np.sin(w * seconds(times)))
    for begin, length in ((0.1234567, 0.02), (0.3, 0.1), (0.51, 1.0)):
        t0, t1 = (BEGAN_NS + round(1e9 * s) for s in (begin, begin + length))
        want = 0.01 + 2e-3 * (math.cos(w * begin) - math.cos(w * (begin + length))) / (w * length)
        # chords of a sine: (w dt)^2 / 12 of its height, dt up to 1.8 ms
        bound = 2e-3 * (w * 1.8e-3) ** 2 / 12
        assert record.over(t0, t1).force_n == pytest.approx(want, abs=bound)


def test_any_force_is_averaged_as_a_line_through_all_wrenches_is():
    rng = np.random.default_rng(3)
    times = jittered(1.0, rng)
    forces = rng.normal(0.01, 3e-3, len(times))
    record = filled(times, forces)
    for _ in range(20):
        begin = rng.uniform(0.05, 0.9)
        t0, t1 = (
            BEGAN_NS + round(1e9 * begin),
            BEGAN_NS + round(1e9 * rng.uniform(begin + 0.004, 0.99)),
        )
        # the line at a thousand places in each nanosecond-exact interval between wrenches and ends
        corners = np.unique([t0, *times[(times > t0) & (times < t1)], t1])
        at_corners = np.interp((corners - BEGAN_NS).astype(float), times - BEGAN_NS, forces)
        want = np.trapezoid(at_corners, seconds(corners)) / ((t1 - t0) * 1e-9)
        assert record.over(t0, t1).force_n == pytest.approx(want, rel=1e-12)


def test_tare_is_taken_off_and_an_offset_of_1_n_costs_no_digits_over_30_s():
    times = BEGAN_NS + MS * np.arange(30_000)
    small = 1e-3 * np.sin(2 * np.pi * 0.05 * seconds(times))
    record = filled(times, 1.01 + small, bias_n=1.0)
    plain = filled(times, 0.01 + small)
    for begin_ns, length_ns in ((MS, 29_900 * MS), (29_950 * MS + 1, 20 * MS), (7 * MS, 20 * MS)):
        interval = BEGAN_NS + begin_ns, BEGAN_NS + begin_ns + length_ns
        # no worse than the single forces: 1.01 less 1 has lost 1e-16
        assert record.over(*interval).force_n == pytest.approx(
            plain.over(*interval).force_n, abs=3e-16
        )
    interval = BEGAN_NS + MS, BEGAN_NS + 29_900 * MS
    high, over = filled(times, 1.0 + small).over(*interval), filled(times, small).over(*interval)
    assert high.force_n - 1.0 == pytest.approx(over.force_n, abs=5e-16)
    assert high.force_std_n == pytest.approx(over.force_std_n, rel=1e-9)


def test_nothing_outside_of_the_interval_counts():
    times = BEGAN_NS + MS * np.arange(1000)
    forces = np.where((times >= BEGAN_NS + 400 * MS) & (times <= BEGAN_NS + 500 * MS), 0.01, 5.0)
    over = filled(times, forces).over(BEGAN_NS + 400 * MS, BEGAN_NS + 500 * MS)
    assert over.force_n == pytest.approx(0.01, rel=1e-12)
    # equal forces do not show how far off a converter's step leaves them
    assert math.isnan(over.force_std_n)


@pytest.mark.parametrize(("gap_ms", "covered"), [(3, 1.0), (4, 0.96), (15, 0.85), (37, None)])
def test_gap_of_more_than_three_periods_is_not_covered_and_does_not_count(gap_ms, covered):
    times = BEGAN_NS + MS * np.arange(300)
    kept = (times <= BEGAN_NS + 120 * MS) | (times >= BEGAN_NS + (120 + gap_ms) * MS)
    forces = np.where(times <= BEGAN_NS + 120 * MS, 0.01, 0.02)
    record = filled(times[kept], forces[kept])
    over = record.over(BEGAN_NS + 100 * MS, BEGAN_NS + 200 * MS)
    if covered is None:
        assert over.coverage == pytest.approx(0.63)
        assert over.reason == "forces cover 63 % of the block, at least 80 % are accepted"
        assert np.isnan([over.force_n, over.force_std_n]).all()
        assert over.position_m == (0.0, 0.0, 0.0)  # the arm was seen all the time
        return
    assert over.coverage == pytest.approx(covered)
    # 20 ms of 10 mN, then of 20 mN; a gap of three periods is bridged by a line
    low, high = 20 + (3 if gap_ms == 3 else 0) / 2, 80 - gap_ms + (3 if gap_ms == 3 else 0) / 2
    assert over.force_n == pytest.approx((0.01 * low + 0.02 * high) / (low + high), rel=1e-12)


@pytest.mark.parametrize("why", ["invalid", "overload"])
def test_wrenches_that_are_no_forces_are_not_heard(why):
    times = BEGAN_NS + MS * np.arange(400)
    wrong = (times > BEGAN_NS + 150 * MS) & (times <= BEGAN_NS + 160 * MS)
    forces = np.where(wrong, 1.0, 0.01)
    if why == "invalid":
        record = filled(times, forces, invalid=lambda t: 150 * MS < t - BEGAN_NS <= 160 * MS)
    else:
        record = filled(times, forces, bad=set(np.flatnonzero(wrong)))
    over = record.over(BEGAN_NS + 100 * MS, BEGAN_NS + 200 * MS)
    assert over.force_n == pytest.approx(0.01, rel=1e-12)
    assert over.coverage == pytest.approx(0.89)  # from the last good one to the next
    # one that is wrong breaks the line too
    one = filled(times, np.where(times == BEGAN_NS + 150 * MS, 1.0, 0.01), bad={150})
    assert one.over(BEGAN_NS + 149 * MS, BEGAN_NS + 159 * MS).force_n == pytest.approx(
        0.01, rel=1e-12
    )


def test_forces_before_a_tare_are_none():
    times = BEGAN_NS + MS * np.arange(1000)
    record = filled(times[:500], np.full(500, 0.3))
    record.restart()
    filled(times[500:], np.full(500, 0.01), record=record)
    after = record.over(BEGAN_NS + 510 * MS, BEGAN_NS + 900 * MS)
    assert after.force_n == pytest.approx(0.01, rel=1e-12)
    over = record.over(BEGAN_NS + 400 * MS, BEGAN_NS + 600 * MS)
    assert over.reason == "forces cover 50 % of the block, at least 80 % are accepted"
    assert math.isnan(over.force_n)


def test_what_is_not_kept_any_more_or_not_there_yet_is_said():
    times = BEGAN_NS + MS * np.arange(12_000)
    record = filled(times, np.full(12_000, 0.01), length_s=5.0)
    now_ns = BEGAN_NS + 12_000 * MS
    assert record.over(now_ns - 4_900 * MS, now_ns - MS).force_n == pytest.approx(0.01, rel=1e-12)
    for back_ns in (5_100 * MS, 11_000 * MS):
        early = record.over(now_ns - back_ns, now_ns - back_ns + 20 * MS)
        assert math.isnan(early.force_n)
        assert (
            early.reason == f"the block begins {back_ns * 1e-9:.1f} s ago, forces are kept for 5 s"
        )
    late = record.over(now_ns - 20 * MS, now_ns + 3 * MS)
    assert math.isnan(late.force_n)
    assert late.reason == "the block ends 3.0 ms in the future"
    never = ForceRecord(RATE_HZ, 0.002).over(BEGAN_NS, BEGAN_NS + MS)
    assert math.isnan(never.force_n)
    assert never.reason


def test_source_that_is_faster_than_it_states_is_kept_for_less_and_says_so():
    times = BEGAN_NS + MS * np.arange(6_000)
    record = filled(times, np.full(6_000, 0.01), length_s=5.0, rate_hz=500.0)
    now_ns = BEGAN_NS + 6_000 * MS
    assert record.over(now_ns - 2_700 * MS, now_ns - MS).force_n == pytest.approx(0.01, rel=1e-12)
    # 5 s of 500 Hz and a tenth more are 2751 wrenches, and now is 1 ms after the newest
    kept = "forces are kept for 2.8 s, since they come faster than the rate_hz of their source"
    reason = record.over(now_ns - 2_800 * MS, now_ns - MS).reason
    assert reason == f"the block begins 2.8 s ago, {kept}"


def test_source_that_falls_silent_covers_no_more():
    times = BEGAN_NS + MS * np.arange(200)
    record = filled(times, np.full(200, 0.01), until_ns=BEGAN_NS + 1000 * MS)
    assert record.over(BEGAN_NS + 110 * MS, BEGAN_NS + 210 * MS).coverage == pytest.approx(0.89)
    silent = record.over(BEGAN_NS + 300 * MS, BEGAN_NS + 400 * MS)
    assert silent.coverage == 0.0
    assert silent.reason == "forces cover 0 % of the block, at least 80 % are accepted"


def mean_variance(pole, count):
    """Of the mean of so many values with correlation pole^k, each of variance 1."""
    k = np.arange(1, count)
    return (1 + 2 * np.sum((1 - k / count) * pole**k)) / count


@pytest.mark.parametrize("pole", [0.0, 0.8])
def test_stated_uncertainty_is_that_of_the_mean_of_correlated_noise(pole):
    rng = np.random.default_rng(5)
    times = BEGAN_NS + MS * np.arange(300)
    errors, stated = [], []
    for _ in range(400):
        noise = lfilter([1 - pole], [1, -pole], 1e-3 * rng.standard_normal(500))[200:]
        over = filled(times, 0.01 + noise).over(BEGAN_NS + 40 * MS, BEGAN_NS + 240 * MS)
        errors.append(over.force_n - 0.01)
        stated.append(over.force_std_n)
    # means of 25 that are correlated with each other scatter less than means of 200 say
    of_batch, of_all = mean_variance(pole, 25), mean_variance(pole, 200)
    expected = (of_batch - of_all) / (7 * of_all)
    assert expected > 0.8
    # the variance of 400 means is known to sqrt(2/400) = 7 %; three of them
    assert np.mean(np.square(stated)) / np.var(errors) == pytest.approx(expected, rel=0.21)


def test_slow_change_counts_as_uncertainty():
    times = BEGAN_NS + MS * np.arange(1000)
    over = filled(times, 0.02 - 0.01 * seconds(times)).over(
        BEGAN_NS + 100 * MS, BEGAN_NS + 900 * MS
    )
    # batch means at 0.1 s: 0 to 7 mN; their standard deviation is sqrt(6) mN
    assert over.force_std_n == pytest.approx(1e-3 * math.sqrt(6 / 8), rel=1e-9)


def test_few_wrenches_have_no_stated_uncertainty():
    times = BEGAN_NS + MS * np.arange(200)
    record = filled(times, 0.01 + 1e-6 * (-1.0) ** np.arange(200))
    assert math.isnan(record.over(BEGAN_NS + 50 * MS, BEGAN_NS + 80 * MS).force_std_n)
    assert record.over(BEGAN_NS + 50 * MS, BEGAN_NS + 81 * MS).force_std_n < 1e-6
    assert record.over(BEGAN_NS + 50 * MS, BEGAN_NS + 80 * MS).force_n == pytest.approx(0.01)


def test_pose_is_the_mean_place_and_the_orientation_at_the_middle():
    times = BEGAN_NS + MS * np.arange(1000)
    record = filled(
        times,
        np.full(1000, 0.01),
        arm=lambda t: arm_at(t, lambda s: (0.3, -0.1 * s, 5.0 + s), lambda s: (s, 0.0, 3.0)),
    )
    over = record.over(BEGAN_NS + 201_500_000, BEGAN_NS + 620 * MS)
    middle = (0.2015 + 0.62) / 2
    np.testing.assert_allclose(over.position_m, [0.3, -0.1 * middle, 5.0 + middle], rtol=1e-12)
    turned = vector_from_turn(turn_from_quaternion(*over.orientation_xyzw))
    assert turned == pytest.approx((middle, 0.0, 3.0), abs=1.001e-3)


def test_pose_that_was_not_seen_is_not_known():
    times = BEGAN_NS + MS * np.arange(1000)
    record = filled(
        times,
        np.full(1000, 0.01),
        arm=lambda t: arm_at(t) if t < BEGAN_NS + 500 * MS else None,
    )
    over = record.over(BEGAN_NS + 600 * MS, BEGAN_NS + 800 * MS)
    assert over.force_n == pytest.approx(0.01)
    assert over.position_m is None


def test_interval_must_end_after_it_begins():
    with pytest.raises(ValueError, match=r"t1_ns: got 5; accepted is above t0_ns = 5"):
        ForceRecord(RATE_HZ, 0.002).over(5, 5)
    with pytest.raises(ValueError, match="rate_hz: got 0"):
        ForceRecord(0, 0.002)


def test_what_is_told_again_does_not_count_again():
    times = BEGAN_NS + MS * np.arange(200)
    still = arm_at(BEGAN_NS, lambda t: (0.1, 0.2, 0.3))
    record = filled(times, np.full(200, 0.01), arm=lambda t: still)
    again = [WrenchSample(int(times[n]), (0.0, 0.0, 5.0), ZERO) for n in (-50, -1)]
    record.add(BEGAN_NS + 200 * MS, again, ZERO, still, valid=True)
    over = record.over(BEGAN_NS + 100 * MS, BEGAN_NS + 200 * MS)
    assert over.force_n == pytest.approx(0.01, rel=1e-12)
    # a state of the arm that is never new says nothing of where it is now
    assert over.position_m is None


def test_arm_that_is_seen_in_every_other_period_is_seen():
    times = BEGAN_NS + MS * np.arange(400)
    record = filled(
        times,
        np.full(400, 0.01),
        arm=lambda t: arm_at(t, lambda s: (s, 0.0, 0.0)) if t % (2 * PERIOD_NS) else None,
    )
    over = record.over(BEGAN_NS + 101 * MS, BEGAN_NS + 301 * MS)
    assert over.position_m[0] == pytest.approx(0.201, rel=1e-12)


def test_nothing_is_added_while_another_thread_asks(monkeypatch):
    times = BEGAN_NS + MS * np.arange(400)
    record = filled(times, np.full(400, 0.01))
    sample = WrenchSample(int(times[-1]) + MS, (0.0, 0.0, 5.0), ZERO)
    adding = threading.Thread(
        target=record.add, args=(sample.time_ns, [sample], ZERO, None), kwargs={"valid": True}
    )
    cut = force_spread._cut

    def asked(rows, *interval):
        if rows is record._forces:
            adding.start()
            adding.join(0.2)
            assert adding.is_alive()
        return cut(rows, *interval)

    columns = force_spread._columns

    def made(rows, width):
        assert not record._lock.locked()  # the control loop waits for it
        return columns(rows, width)

    monkeypatch.setattr(force_spread, "_cut", asked)
    monkeypatch.setattr(force_spread, "_columns", made)
    assert record.over(BEGAN_NS + 100 * MS, int(times[-1])).force_n == pytest.approx(
        0.01, rel=1e-12
    )
    adding.join()
    monkeypatch.undo()
    # what was being added meanwhile is there now
    over = record.over(int(times[-1]), sample.time_ns)
    assert over.force_n == pytest.approx((0.01 + 5.0) / 2, rel=1e-12)
