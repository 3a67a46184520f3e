# SPDX-License-Identifier: Apache-2.0
"""The envelope by itself: whatever is asked for, what it lets through keeps every limit."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tactile_resonance.contact.envelope import WALL_TIME_S, Envelope, ForceWatch, Place
from tactile_resonance.contact.goal import Cause
from tactile_resonance.contact.parameters import (
    ContactParameters,
    Limits,
    Workspace,
    read_contact,
)
from tactile_resonance.contact.samples import ArmSample, WrenchSample
from tactile_resonance.contact.vectors import ZERO, six, vector

LIMITS = Limits(workspace=Workspace((-0.3, -0.3, 0.0), (0.3, 0.3, 0.5)))
ENVELOPE = Envelope(LIMITS)
SLACK = 1 + 1e-9

number = st.floats(-1.0, 1.0)
vectors = st.tuples(number, number, number)
normals = vectors.filter(lambda v: np.linalg.norm(v) > 0.1).map(
    lambda v: vector(v / np.linalg.norm(v))
)
places = st.builds(
    Place,
    normal=normals,
    height_m=st.floats(-0.01, 0.05),
    depth_m=st.none() | st.floats(-1e-3, 6e-3),
    misalignment_rad=st.floats(0, 1),
)
twists = st.tuples(*[number] * 6)
# far from the walls at 0.3 m to the sides, 0 and 0.5 m in height, beyond them, and where they begin to count
near_a_side = st.floats(0.285, 0.301)
sideways = st.floats(-0.4, 0.4) | near_a_side | near_a_side.map(lambda x: -x)
upwards = st.floats(-0.1, 0.6) | st.floats(-0.001, 0.015) | st.floats(0.485, 0.501)
positions = st.tuples(sideways, sideways, upwards)


@settings(max_examples=400, deadline=None)
@given(twists, positions, places)
def test_what_is_let_through_keeps_every_limit(twist, position, place):
    out = np.array(ENVELOPE.bound(twist, position, place))
    velocity, inwards = out[:3], -float(np.dot(place.normal, out[:3]))
    assert np.isfinite(out).all()
    assert np.linalg.norm(velocity) <= LIMITS.free_speed_m_s * SLACK
    assert np.linalg.norm(out[3:]) <= LIMITS.angular_speed_rad_s * SLACK
    if place.height_m < LIMITS.near_m and inwards > 1e-12:
        assert np.linalg.norm(velocity) <= LIMITS.near_speed_m_s * SLACK
    if place.depth_m is not None:
        along = velocity + inwards * np.array(place.normal)
        assert np.linalg.norm(along) <= LIMITS.lateral_speed_m_s * SLACK
        assert inwards <= LIMITS.contact_speed_m_s * SLACK
        if place.depth_m >= LIMITS.depth_m:
            assert inwards <= 1e-12
    for x, v, low, high in zip(
        position, velocity, LIMITS.workspace.low_m, LIMITS.workspace.high_m, strict=True
    ):
        assert v <= max(0.0, high - x) / WALL_TIME_S * SLACK + 1e-15
        assert v >= min(0.0, low - x) / WALL_TIME_S * SLACK - 1e-15


# along the wall that it has passed, where rounding leaves 1e-149 m/s towards it
ALONG_A_WALL = (
    (-1.0, 1.0, 0.0, 0.0, 0.0, 0.0),
    (0.375, 0.0, 0.0),
    Place((1.0, -3.9e-147, 0.0), 0.0, 4e-3, 0.0),
)


# along floor and surface, where rounding turns 1e-133 m/s away from the surface into 1e-299 m/s towards it
ALONG_THE_SURFACE = (
    (1.0, 0.0, -5e-133, 0.0, 0.0, 0.0),
    (0.0, 0.0, 0.0),
    Place((-6e-298, 0.0, -1.0), 0.0, None, 0.0),
)


@example(*ALONG_A_WALL)
@example(*ALONG_THE_SURFACE)
@settings(max_examples=200, deadline=None)
@given(twists, positions, places)
def test_it_never_turns_a_motion_round_and_never_makes_one_faster(twist, position, place):
    out = ENVELOPE.bound(twist, position, place)
    assert np.dot(out[:3], twist[:3]) >= -1e-12
    assert np.linalg.norm(out[:3]) <= np.linalg.norm(twist[:3]) * SLACK + 1e-15
    assert np.dot(out[3:], twist[3:]) >= -1e-12
    again = ENVELOPE.bound(out, position, place)
    np.testing.assert_allclose(again, out, rtol=1e-9, atol=1e-12)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.sampled_from([math.nan, math.inf, -math.inf, 0.1]), min_size=6, max_size=6))
def test_what_is_not_finite_stops_the_tip(values):
    if np.isfinite(values).all():
        return
    place = Place((0.0, 0.0, 1.0), 0.01, None, 0.0)
    np.testing.assert_array_equal(ENVELOPE.bound(tuple(values), (0.0, 0.0, 0.1), place), 0)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.006, 0.05))
def test_a_tip_that_comes_down_as_fast_as_allowed_is_slow_when_it_is_near(height):
    # followed with dead time 4 ms and lag 10 ms, limited in acceleration to 0.5 m/s2
    speed, delayed, line = 0.0, 0.0, [0.0, 0.0]
    for _ in range(1500):
        place = Place((0.0, 0.0, 1.0), height, None, 0.0)
        out = ENVELOPE.bound((0.0, 0.0, -0.1, 0.0, 0.0, 0.0), (0.0, 0.0, 0.2), place)
        delayed += min(1e-3, max(-1e-3, out[2] - delayed))
        line.append(delayed)
        speed += (line.pop(0) - speed) * (1 - math.exp(-0.2))
        height += speed * 0.002
        if height < LIMITS.near_m:
            assert -speed <= 1.5 * LIMITS.near_speed_m_s  # what judge_motion lets pass


def arm(**changes):
    still = ArmSample(1_000_000_000, 1.0, (0.1, 0.0, 0.2), (0.0, 0.0, 0.0), (0.0,) * 6)
    return still._replace(**changes)


@pytest.mark.parametrize(
    ("sample", "cause"),
    [
        (None, Cause.ARM_STALE),
        (arm(time_ns=979_000_000), Cause.ARM_STALE),
        (arm(moving_allowed=False, message="protective stop"), Cause.ARM_STOPPED),
        (arm(position_m=(math.nan, 0.0, 0.2)), Cause.ARM_INVALID),
        (arm(position_m=(0.1, 0.31, 0.2)), Cause.WORKSPACE),
        (arm(position_m=(0.1, 0.0, -0.01)), Cause.WORKSPACE),
        (arm(rotation_rad=(0.0, 0.81, 0.0)), Cause.TILT),
        (arm(rotation_rad=(math.pi, 0.0, 0.0)), Cause.TILT),
    ],
)
def test_state_of_the_arm_is_judged(sample, cause):
    assert ENVELOPE.judge_arm(1_000_000_000, sample).cause is cause


@pytest.mark.parametrize(
    "rotation", [[0, 0, 0], [0, 0, 3.0], [0.5, 0.5, 0], [0, 0.79, 0], [0.2, 0.1, 2.0]]
)
def test_upright_arm_passes(rotation):
    sample = arm(rotation_rad=vector(rotation))
    tilt = math.acos(min(1.0, sample.tip.rotation.as_matrix()[2, 2]))
    breach = ENVELOPE.judge_arm(1_000_000_000, sample)
    assert (breach is None) == (tilt <= LIMITS.tilt_rad)


@pytest.mark.parametrize(
    ("velocity", "place", "cause"),
    [
        ([0, 0, 0], (-0.001, 4.1e-3, 0.0), Cause.DEPTH),
        ([0, 0, -0.008], (0.004, None, 0.0), Cause.SPEED),
        ([0, 0, 0], (0.004, None, 0.06), Cause.MISALIGNED),
        ([0, 0, -0.008], (0.006, None, 0.5), None),
        ([0, 0, 0], (0.05, None, 0.5, 0.9e-4), Cause.HOUSING),
        ([0, 0, 0], (0.05, None, 0.5, 1.1e-4), None),
        ([0, 0, 0.05], (0.001, 1e-3, 0.0), None),
        # a surface that is found higher than what counts as near
        ([0, 0, -0.008], (0.008, 1e-4, 0.0), Cause.SPEED),
        ([0, 0, 0], (0.008, 1e-4, 0.06), Cause.MISALIGNED),
    ],
)
def test_motion_near_the_surface_is_judged(velocity, place, cause):
    sample = arm(velocity=six([*velocity, 0, 0, 0]))
    limits = Envelope(replace(LIMITS, depth_m=4e-3))
    breach = limits.judge_motion(sample, Place((0.0, 0.0, 1.0), *place))
    assert (None if breach is None else breach.cause) is cause


def watched(forces, period_ns=2_000_000, mean_s=0.02):
    watch = ForceWatch(10, mean_s)
    watch.set_bias((0.0, 0.0, 0.0))
    for n, (x, y, z) in enumerate(forces):
        sample = WrenchSample(n * period_ns, (x, y, z + 1e-9 * n), (0.0, 0.0, 0.0))
        assert watch.add(sample) is None
    return watch, (len(forces) - 1) * period_ns


@pytest.mark.parametrize(
    ("forces", "cause"),
    [
        ([[0, 0, 0.0301]], Cause.FORCE_ABORT),
        ([[0, 0, 0.0501]], Cause.FORCE_HARD),
        ([[0, 0, -0.0081]], Cause.FORCE_PULL),
        ([[0, 0, 0.0]] * 3 + [[0, 0, -0.0081]] * 3, Cause.FORCE_PULL),
        ([[0, 0, 0.0]] * 3 + [[0, 0, -0.0081]] * 2, None),  # noise of a cell for 20 mN
        ([[0.011, 0.011, 0.01]], Cause.FORCE_LATERAL),
        ([[0, 0, 0.0]] * 8 + [[0, 0, 0.02]] * 3, Cause.FORCE_RATE),
        ([[0, 0, 0.02]] * 8 + [[0, 0, 0.0]] * 3, Cause.FORCE_RATE),
        ([[0, 0, 0.0012 * n] for n in range(20)], None),  # 0.6 N/s
        ([[0.01, 0, 0.0299]], None),
    ],
)
def test_force_is_judged(forces, cause):
    watch, now = watched(forces)
    breach = ENVELOPE.judge_force(now, watch)
    assert (None if breach is None else breach.cause) is cause


def test_old_force_is_judged():
    watch, now = watched([[0, 0, 0.01]] * 5)
    assert ENVELOPE.judge_force(now + 10_000_000, watch) is None
    assert ENVELOPE.judge_force(now + 10_100_000, watch).cause is Cause.FORCE_STALE
    assert ENVELOPE.judge_force_age(0, ForceWatch(10, 0.05)).cause is Cause.FORCE_STALE


@pytest.mark.parametrize(
    ("sample", "cause"),
    [
        (WrenchSample(10, (0.0, math.nan, 0.0), ZERO), Cause.FORCE_INVALID),
        (WrenchSample(10, (math.inf, 0.0, -math.inf), ZERO), Cause.FORCE_INVALID),
        (WrenchSample(10, ZERO, ZERO, overload=True), Cause.FORCE_OVERLOAD),
        (WrenchSample(0, (1.0, 1.0, 1.0), ZERO), Cause.FORCE_INVALID),
    ],
)
def test_bad_force_is_not_used(sample, cause):
    watch, _ = watched([[0, 0, 0.01]])
    assert watch.add(sample).cause is cause
    assert watch.force_n[2] == 0.01


@pytest.mark.parametrize(
    ("across_n", "reason"),
    [(0.0, "10 equal forces in a row: the sensor is stuck"), (1e-3, "z is stuck, or its noise does not show")],
)
def test_a_force_that_repeats_is_stuck_and_told_from_a_sensor_whose_other_axes_move(across_n, reason):
    watch = ForceWatch(10, 0.05)
    rng = np.random.default_rng(1)
    breaches = [
        watch.add(WrenchSample(n, (*vector(across_n * rng.standard_normal(3))[:2], 0.01), ZERO))
        for n in range(10)
    ]
    assert breaches[:-1] == 9 * [None]
    assert breaches[-1].cause is Cause.FORCE_STUCK
    assert reason in breaches[-1].message


def test_rate_of_a_ramp_is_its_slope():
    rng = np.random.default_rng(0)
    ramp = [[0, 0, 0.5 * 0.002 * n + 1e-4 * rng.standard_normal()] for n in range(50)]
    watch, _ = watched(ramp)
    assert watch.rate_n_per_s() == pytest.approx(0.5, abs=0.05)
    assert watch.mean_n == pytest.approx(0.5 * (0.098 - 0.009), abs=2e-4)
    assert watched(ramp, mean_s=0.2)[0].mean_n is None


def test_configuration_is_read_and_checked(tmp_path):
    parameters, limits = read_contact()
    assert 0 < parameters.approach_speed_m_s <= limits.near_speed_m_s
    assert limits.workspace.high_m == (1.0, 1.0, 1.0)
    bad = tmp_path / "contact.yaml"
    for text, message in [
        ("contact: {approach_speed_m_s: 0.01}\nlimits: {}", "approach_speed_m_s: got 0.01"),
        # 5 mm from the standoff to the end of the search
        ("contact: {approach_speed_m_s: 1.25e-4}\nlimits: {}", "approach_s: got 20.* 40 s or more"),
        ("contact: {}\nlimits: {near_speed_m_s: 0.003}", "at most the limit 0.003"),
        ("contact: {}\nlimits: {hard_force_n: 0.02}", "above 0.03"),
        ("contact: {}\nlimits: {nearness: 1.0}", "nearness"),
        ("contact: {}\nlimits: {workspace: {low_m: [1, 1], high_m: [2, 2, 2]}}", "low_m"),
        ("contact: {standoff_m: 0.001}\nlimits: {}", "above early_m"),
    ]:
        bad.write_text(text)
        with pytest.raises(ValueError, match=message):
            read_contact(bad)


def test_a_tool_that_must_not_be_faster_than_its_limits():
    with pytest.raises(ValueError, match="travel_speed_m_s: got 0.2"):
        Limits().check(ContactParameters(travel_speed_m_s=0.2))


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
def test_mean_is_that_of_the_forces_of_its_time(window_ns):
    rng = np.random.default_rng(2)
    times, values = jittered(rng, 2000, 1_000_000), rng.normal(0.01, 1e-3, 2000)
    watch = ForceWatch(10, window_ns * 1e-9)
    for n in range(2000):
        assert watch.add(WrenchSample(times[n], (0.0, 0.0, values[n]), ZERO)) is None
        since = times[n] - window_ns
        if times[0] > since:
            assert watch.mean_n is None
        else:
            inside = np.array(times[: n + 1]) > since
            assert watch.mean_n == pytest.approx(values[: n + 1][inside].mean(), rel=1e-12)
    watch.set_bias(ZERO)
    watch.add(WrenchSample(times[-1] + 1, (0.0, 0.0, 1.0), ZERO))
    assert watch.mean_n is None


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
