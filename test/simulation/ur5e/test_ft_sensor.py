# SPDX-License-Identifier: Apache-2.0
"""The flange sensor: statistics of its errors, weights, offsets, and the place of a wrench."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from tactile_resonance.simulation.ur5e.forces import (
    STANDARD_GRAVITY_M_S2,
    FtSensor,
    ToolPayload,
)
from tactile_resonance.simulation.ur5e.kinematics import _at_origin
from tactile_resonance.simulation.ur5e.machine import MachineConfig, TrackingParameters

sys.path.insert(0, str(Path(__file__).parent))
from matrices import floats

TOOL = ToolPayload(0.5, (0.01, -0.02, 0.06))


def assert_deviation(samples: np.ndarray, sigma: np.ndarray) -> None:
    """Assert standard deviations (6,) of independent samples of known mean 0, each at 1e-5 a side."""
    statistic = np.sum((samples / sigma) ** 2, axis=0)
    low, high = chi2.ppf([1e-5, 1 - 1e-5], len(samples))
    assert np.all((low < statistic) & (statistic < high))


def test_offset_and_repeatability_follow_the_data_sheet_as_read():
    first = []
    for seed in range(400):
        sensor = FtSensor(np.random.default_rng(seed))
        first.append(sensor.error())
    # accuracy 4.0 N, 0.3 N m and precision 3.5 N, 0.2 N m at two standard deviations
    total = np.hypot([2.0] * 3 + [0.15] * 3, [1.75] * 3 + [0.1] * 3)
    assert_deviation(np.array(first), total)


def test_noise_is_white_beside_a_slow_drift():
    sensor = FtSensor(np.random.default_rng(11))
    samples = [sensor.error() for _ in range(4001)]
    # differences of disjoint pairs: twice the white variance, the drift of 2 ms is negligible
    pairs = np.diff(np.array(samples), axis=0)[::2]
    white = np.array([1.75] * 3 + [0.1] * 3) * np.sqrt(0.5)
    assert_deviation(pairs, white * np.sqrt(2))


def test_zeroing_takes_the_offset_and_leaves_the_noise(make_client):
    still = TrackingParameters(jitter_rms_m=0.0)
    client = make_client(machine=MachineConfig(tracking=still), seed=5)
    client.run(0.02)
    client.call(8)
    readings = []
    for _ in range(2000):
        client.controller.step()
        readings.append(client.output("actual_TCP_force"))
    # the zero itself is one noisy sample; within 4 s the drift is a quarter of its variance at most
    white = np.array([1.75] * 3 + [0.1] * 3) * np.sqrt(0.5)
    assert np.all(np.abs(np.mean(readings, axis=0)) < 5 * white)
    assert np.all(np.abs(np.std(readings, axis=0) / white - 1) < 0.25)


def test_a_wrench_about_another_point_does_the_same_work():
    rng = np.random.default_rng(2)
    wrench, twist = rng.standard_normal((2, 6))
    place = rng.standard_normal(3)
    moved_twist = [*(twist[:3] - np.cross(twist[3:], place)), *twist[3:]]
    moved = _at_origin(floats(place), floats(wrench[:3]), floats(wrench[3:]))
    assert np.dot(moved, moved_twist) == pytest.approx(wrench @ twist)


def test_a_tool_known_as_payload_weighs_nothing_in_any_attitude(make_client):
    client = make_client(tool=TOOL)
    for _ in range(3):
        client.call(1, [*(client.output("target_q") + [0, 0.1, -0.2, 0.4, 0.5, 0.7]), 1.5, 3.0])
        client.run(0.2)
        np.testing.assert_allclose(client.output("actual_TCP_force"), 0, atol=1e-12)
        raw = client.output("ft_raw_wrench")
        assert np.linalg.norm(raw[:3]) == pytest.approx(0.5 * STANDARD_GRAVITY_M_S2)
        np.testing.assert_allclose(raw[3:], np.cross(TOOL.cog_m, raw[:3]), atol=1e-12)


def test_a_wrong_payload_shows_as_weight_that_zeroing_hides_in_one_attitude_only(make_client):
    client = make_client(tool=TOOL)
    client.call(17, [0.4, *TOOL.cog_m])
    client.run(0.01)
    missing = 0.1 * STANDARD_GRAVITY_M_S2
    np.testing.assert_allclose(client.output("actual_TCP_force")[:3], [0, 0, -missing], atol=1e-9)
    client.call(8)
    client.run(0.01)
    np.testing.assert_allclose(client.output("actual_TCP_force"), 0, atol=1e-9)
    before = Rotation.from_rotvec(client.output("actual_TCP_pose")[3:])
    client.call(1, [*(client.output("target_q") + [0, 0, 0, 0, 1.0, 0]), 2.0, 4.0])
    client.run(0.3)
    after = Rotation.from_rotvec(client.output("actual_TCP_pose")[3:])
    weight = np.array([0, 0, -missing])
    hidden = after.apply(before.inv().apply(weight))
    np.testing.assert_allclose(client.output("actual_TCP_force")[:3], weight - hidden, atol=1e-6)


def test_gravity_of_a_tilted_base(make_client):
    client = make_client(tool=TOOL)
    client.call(59, [0, 9.82, 0])  # a robot on a wall: up is its y axis
    client.run(0.01)
    flange = Rotation.from_rotvec(client.output("actual_TCP_pose")[3:])
    pulled = flange.apply(client.output("ft_raw_wrench")[:3])
    np.testing.assert_allclose(pulled, [0, -0.5 * 9.82, 0], atol=1e-9)


def test_an_external_sensor_replaces_the_reading_and_its_mass_is_not_compensated_twice(make_client):
    client = make_client(tool=TOOL)
    offset = [0.0, 0.01, 0.04]
    client.call(56, [0.1, *offset, 0.0, 0.0, 0.02], [1])
    wrench = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3])
    client.controller.write_inputs({"external_force_torque": wrench.tolist()})
    client.run(0.01)
    flange = Rotation.from_rotvec(client.output("actual_TCP_pose")[3:])
    fall = flange.inv().apply([0, 0, -STANDARD_GRAVITY_M_S2])
    # below the sensor hangs the payload less the sensor itself
    weight = 0.4 * fall
    moment = np.cross(TOOL.cog_m, 0.5 * fall) - np.cross([0, 0, 0.02], 0.1 * fall)
    expected = [
        *flange.apply(wrench[:3] - weight),
        *flange.apply(wrench[3:] + np.cross(offset, wrench[:3]) - moment),
    ]
    np.testing.assert_allclose(client.output("actual_TCP_force"), expected, atol=1e-9)
    client.call(56, [0.1, *offset, 0.0, 0.0, 0.02], [0])
    client.run(0.01)
    np.testing.assert_allclose(client.output("actual_TCP_force"), 0, atol=1e-12)


def test_one_centinewton_is_far_below_what_the_sensor_shows(make_client):
    client = make_client(machine=MachineConfig())
    client.call(8)
    readings = []
    for _ in range(500):
        client.controller.step()
        readings.append(client.output("actual_TCP_force")[2])
    assert np.std(readings) > 50 * 0.01
