# SPDX-License-Identifier: Apache-2.0
"""A tip that follows: limits kept, dead time and lag as in closed form, vibration as stated."""

import numpy as np
import pytest

from tactile_resonance.contact.samples import Pose
from tactile_resonance.simulation.cell.transducer import CellParameters
from tactile_resonance.simulation.noise import Jitter
from tactile_resonance.simulation.plant.contact_bench import ContactBench, TipMotion
from tactile_resonance.simulation.plant.surfaces import PlantSurface
from tactile_resonance.simulation.ur5e.machine import Lag, TrackingParameters
from test.contact.contacts import SOFT

STILL = TrackingParameters(jitter_rms_m=0.0)
START = Pose(np.array([0.3, 0.1, 0.2]), np.array([0.0, 0.0, 0.0]))


@pytest.mark.parametrize("dead_time_s", [0.0, 0.004, 0.005])
def test_ramp_is_followed_behind_dead_time_and_lag(dead_time_s):
    # x = r t through exp(-s T) / (1 + s tau): r (t - T - tau + tau exp(-(t - T) / tau))
    lag = Lag(TrackingParameters(dead_time_s=dead_time_s, lag_s=0.01), np.zeros(2), 0.002)
    rate, time = np.array([1.0, -3.0]), 0.002 * np.arange(1, 101)
    got = np.array([lag.step(rate * t) for t in time])
    since = np.maximum(time - dead_time_s, 0)
    want = rate * (since - 0.01 * (1 - np.exp(-since / 0.01)))[:, None]
    tolerance = 1e-12 if dead_time_s != 0.005 else 2e-4  # interpolation of the corner at t = T
    np.testing.assert_allclose(got, want, atol=tolerance)


def test_no_dead_time_and_no_lag_is_no_change():
    lag = Lag(TrackingParameters(dead_time_s=0, lag_s=0), np.zeros(1), 0.002)
    assert [float(lag.step(np.array([x]))[0]) for x in (1.0, 5.0, -2.0)] == [1.0, 5.0, -2.0]


def test_speed_is_reached_under_the_acceleration_limit_and_the_way_is_its_integral():
    tip = TipMotion(STILL, START)
    twist = np.array([0.03, -0.04, 0.0, 0.0, 0.0, 0.2])
    tip.speed(twist, 0.5)
    places, twists = [], []
    for _ in range(300):
        tip.step()
        places.append(tip.reported.position_m)
        twists.append(tip.twist)
    change = np.diff(np.array(twists)[:, :3], axis=0) / 0.002
    assert np.linalg.norm(change, axis=1).max() <= 0.5 * (1 + 1e-9)
    np.testing.assert_allclose(twists[-1], twist, rtol=1e-9)
    # ramp of 0.05 / 0.5 s costs half its time, dead time and lag theirs
    late = 0.05 / 0.5 / 2 + 0.004 + 0.010
    want = START.position_m + twist[:3] * (0.6 - late)
    np.testing.assert_allclose(places[-1], want, atol=1e-9)
    angle = np.linalg.norm(tip.pose.rotation_rad)
    assert angle == pytest.approx(0.2 * (0.6 - late), rel=1e-6)


def test_vibration_has_its_rms_and_its_correlation():
    jitter = Jitter(3e-6, 50.0, 0.002, seed=1)
    x = np.array([jitter.step() for _ in range(100_000)])  # 200 s, about 2500 free values per axis
    assert x.std() == pytest.approx(3e-6, rel=0.05)
    for lag in (5, 10, 20):
        t = 50.0 * 0.002 * lag
        want = (1 + t) * np.exp(-t)
        got = np.mean(x[lag:] * x[:-lag]) / np.mean(x * x)
        assert got == pytest.approx(want, abs=0.05)
    again = Jitter(3e-6, 50.0, 0.002, seed=1)
    np.testing.assert_array_equal(x[:3], [again.step() for _ in range(3)])


def test_vibration_is_not_reported_by_the_encoders():
    tip = TipMotion(TrackingParameters(), START, seed=3)
    for _ in range(10):
        tip.step()
    np.testing.assert_array_equal(tip.reported.position_m, START.position_m)
    assert 0 < np.abs(tip.pose.position_m - START.position_m).max() < 3e-5


@pytest.mark.parametrize("seed", [0, 1])
def test_noise_of_the_cell_is_not_what_shakes_the_arm(seed):
    rig = ContactBench(SOFT, PlantSurface.tilted(0.0, 0.0), START, seed=seed)
    places, forces, count = [], [], 2000
    for _ in range(count):
        rig.wait_until(rig.time_ns + 2_000_000)
        places.append(rig.motion.pose.position_m)
        forces.extend(sample.wrench[:3] for sample in rig.cell.read())
    # what drives the vibration is in its acceleration; the cell's noise is white
    driven = np.diff(places, 2, axis=0)
    noise = np.array(forces)[: count - 2]
    driven, noise = (x - x.mean(axis=0) for x in (driven, noise))
    for lag in range(-4, 5):
        with_lag = np.roll(noise, lag, axis=0)
        r = np.sum(driven * with_lag, axis=0) / np.sqrt(np.sum(driven**2, 0) * np.sum(noise**2, 0))
        assert np.abs(r).max() < 5 * np.sqrt(1.5 / count)


def test_bias_of_the_cell_drifts_by_the_stated_rate_whatever_its_period():
    drifting = CellParameters("drifts", 1e4, 1e4, 0.0, 0.0, 5.0, 0.3, force_drift_n_per_s=0.2)
    for period_s in (0.001, 0.002, 0.004):
        rig = ContactBench(
            SOFT, PlantSurface.tilted(0.0, 0.0), START, cell_parameters=drifting, period_s=period_s
        )
        rig.wait_until(1_004_000_000)
        samples = rig.cell.read()
        first, last = samples[0], samples[-1]
        elapsed_s = (last.time_ns - first.time_ns) * 1e-9
        assert last.wrench[2] - first.wrench[2] == pytest.approx(0.2 * elapsed_s, abs=2e-4)


def test_bad_parameters_are_named():
    with pytest.raises(ValueError, match="lag_s: got -1"):
        TrackingParameters(lag_s=-1)
