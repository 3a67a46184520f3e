# SPDX-License-Identifier: Apache-2.0
"""Power, stops and recovery; what starts a program and what does not; what the outputs say then."""

import numpy as np
import pytest

from tactile_resonance.simulation.ur5e.controller import (
    RefusedError,
    RobotMode,
    RuntimeState,
    SafetyMode,
    UrController,
)
from tactile_resonance.simulation.ur5e.kinematics import JOINT_RANGE_RAD, JOINT_SPEED_RAD_S
from tactile_resonance.simulation.ur5e.variables import OUTPUTS

PROGRAM = """def rtde_control():
  global reg_offset_int = 0
end
"""


def run(controller: UrController, seconds: float) -> None:
    for _ in range(round(seconds / 0.002)):
        controller.step()


@pytest.fixture
def moving(make_client):
    """Return a client whose robot turns joint 1 at 1 rad/s."""
    client = make_client()
    client.stream(9, [1.0, 0, 0, 0, 0, 0, 10.0, 0.0])
    client.run(0.4)
    assert client.output("actual_qd")[0] == pytest.approx(1.0)
    return client


def test_protective_stop_brakes_keeps_power_and_unlocks_after_five_seconds(moving):
    controller = moving.controller
    before = moving.output("target_q")[0]
    controller.protective_stop()
    run(controller, 0.3)
    assert not moving.output("target_qd").any()
    assert moving.output("target_q")[0] - before == pytest.approx(1.0 / (2 * 10.0), rel=0.05)
    assert controller.outputs("safety_mode") == 3
    assert controller.outputs("safety_status_bits") & 0b11111111 == 1 << 2
    assert controller.outputs("robot_mode") == RobotMode.RUNNING
    assert controller.outputs("robot_status_bits") == 1  # powered, no program
    with pytest.raises(RefusedError, match="until 5s after occurrence"):
        controller.unlock_protective_stop()
    with pytest.raises(RefusedError, match="PROTECTIVE_STOP"):
        controller.start_program(PROGRAM)
    run(controller, 5.0)
    controller.unlock_protective_stop()
    assert controller.outputs("safety_status_bits") == 1
    controller.start_program(PROGRAM)
    controller.step()
    assert controller.outputs("runtime_state") == RuntimeState.PLAYING


def test_emergency_stop_removes_power_after_braking_and_recovers_in_order(moving):
    controller = moving.controller
    controller.emergency_stop()
    controller.step()
    assert controller.outputs("safety_status_bits") >> 7 & 1
    assert controller.robot_mode is RobotMode.RUNNING  # still braking
    run(controller, 0.5)
    assert controller.robot_mode is RobotMode.POWER_OFF
    assert controller.outputs("robot_status_bits") == 0
    np.testing.assert_allclose(moving.output("actual_q"), moving.output("target_q"), atol=1e-12)
    stopped = moving.output("actual_q")
    with pytest.raises(RefusedError, match="ROBOT_EMERGENCY_STOP"):
        controller.power_on()
    controller.release_emergency_stop()
    assert controller.safety_mode is SafetyMode.NORMAL
    assert controller.robot_mode is RobotMode.POWER_OFF
    controller.power_on()
    assert controller.robot_mode is RobotMode.POWER_ON
    run(controller, 0.3)
    assert controller.robot_mode is RobotMode.IDLE
    with pytest.raises(RefusedError, match="IDLE"):
        controller.start_program(PROGRAM)
    controller.brake_release()
    run(controller, 0.3)
    assert controller.robot_mode is RobotMode.RUNNING
    np.testing.assert_allclose(moving.output("actual_q"), stopped, atol=1e-12)
    controller.start_program(PROGRAM)


def test_power_off_holds_the_arm_at_once(moving):
    moving.controller.power_off()
    held = moving.output("actual_q")
    run(moving.controller, 0.2)
    assert np.array_equal(moving.output("actual_q"), held)
    assert moving.controller.program is None


def test_a_singular_path_is_a_protective_stop_of_the_robot(make_client):
    client = make_client()
    start = client.output("target_TCP_pose")
    client.write(3, [*(start + [-0.6, 0, 0, 0, 0, 0]), 0.25, 0.5])
    fastest = 0.0
    for _ in range(2000):
        client.controller.step()
        fastest = max(fastest, np.abs(client.output("target_qd")).max())
    assert client.controller.safety_mode is SafetyMode.PROTECTIVE_STOP
    assert fastest <= np.pi * (1 + 1e-6)
    client.run(0.5)
    assert not client.output("target_qd").any()


def test_program_is_refused_in_local_control_and_never_starts_where_told_so():
    controller = UrController()
    controller.remote_control = False
    with pytest.raises(RefusedError, match="remote control"):
        controller.start_program(PROGRAM)
    controller.remote_control = True
    controller.script_starts = False
    controller.start_program(PROGRAM)
    run(controller, 0.1)
    assert controller.outputs("runtime_state") == RuntimeState.STOPPED
    controller.script_starts = True
    controller.start_program(PROGRAM)
    controller.step()
    assert controller.outputs("runtime_state") == RuntimeState.PLAYING


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("def other():\nend\n", "def rtde_control"),
        ("def rtde_control():\n global reg_offset_int = 0\n", "complete program"),
        ("def rtde_control():\n global reg_offset_int = 7\nend\n", "0 and 24"),
        ("def rtde_control():\nend\n", "0 and 24"),
    ],
)
def test_other_programs_are_refused(text, message):
    controller = UrController()
    with pytest.raises(ValueError, match=message):
        controller.start_program(text)
    assert controller.program is None


def test_every_output_has_the_shape_of_its_type():
    controller = UrController(seed=3)
    run(controller, 0.01)
    lengths = {"VECTOR6D": 6, "VECTOR3D": 3, "VECTOR6INT32": 6}
    for name, (kind, _) in OUTPUTS.items():
        value = controller.outputs(name)
        if kind in lengths:
            assert len(value) == lengths[kind], name
            assert np.all(np.isfinite(value)), name
        else:
            assert isinstance(value, float if kind == "DOUBLE" else int), name
    with pytest.raises(KeyError, match="elbow"):
        controller.outputs("elbow")


def test_inputs_write_what_their_masks_select():
    controller = UrController()
    controller.write_inputs(
        {"standard_digital_output_mask": 0b101, "standard_digital_output": 0b111}
    )
    controller.write_inputs(
        {"configurable_digital_output_mask": 2, "configurable_digital_output": 2}
    )
    controller.write_inputs({"tool_digital_output_mask": 1, "tool_digital_output": 1})
    assert controller.outputs("actual_digital_output_bits") == 0b101 | 2 << 8 | 1 << 16
    controller.write_inputs(
        {
            "standard_analog_output_mask": 2,
            "standard_analog_output_type": 0,
            "standard_analog_output_0": 0.3,
            "standard_analog_output_1": 0.7,
        }
    )
    assert controller.outputs("standard_analog_output0") == 0.0
    assert controller.outputs("standard_analog_output1") == 0.7
    with pytest.raises(KeyError, match="input_int_register_48"):
        controller.write_inputs({"input_int_register_3": 5, "input_int_register_48": 1})
    assert controller.registers.inputs["input_int_register_3"] == 0


def test_speed_slider_slows_a_move(make_client):
    client = make_client()
    client.controller.write_inputs({"speed_slider_mask": 1, "speed_slider_fraction": 0.25})
    assert client.controller.outputs("target_speed_fraction") == 0.25
    client.write(1, [*(client.output("target_q") + 0.2), 0.4, 2.0])
    client.run(1.0)
    assert np.abs(client.output("target_qd")).max() == pytest.approx(0.1)


def test_robot_time_is_steps_of_two_milliseconds():
    controller = UrController()
    run(controller, 0.5)
    assert controller.outputs("timestamp") == 0.5


def test_same_seed_same_robot():
    one, two, other = UrController(seed=5), UrController(seed=5), UrController(seed=6)
    for controller in (one, two, other):
        run(controller, 0.05)
    assert one.outputs("ft_raw_wrench") == two.outputs("ft_raw_wrench")
    assert one.outputs("ft_raw_wrench") != other.outputs("ft_raw_wrench")


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("command", [1, 2, 3, 6, 9, 10, 11, 24, 29, 46])
def test_numbers_that_are_none_end_the_program_and_move_nothing(make_client, command, value):
    client = make_client()
    before = client.output("target_q")
    client.write(command, [0.1, value, 0.1, 0.1, 0.1, 0.1, 1.0, 1.0, 0.1, 0.1, 300])
    client.run(0.02)
    assert client.controller.program is None
    assert "accepted are numbers" in client.controller.log[-1]
    assert np.array_equal(client.output("target_q"), before)


@pytest.mark.parametrize("seed", range(3))
def test_limits_hold_whatever_a_client_sends(make_client, seed):
    rng = np.random.default_rng(seed)
    client = make_client(seed=seed)
    controller = client.controller
    travelled = 0.0
    for _ in range(25):
        command = int(rng.choice([1, 2, 3, 4, 6, 7, 9, 10, 11, 15, 16, 24, 29, 33, 34, 51]))
        values = rng.normal(0, 1, 18) * rng.choice([0.01, 0.3, 2.0])
        if command in (1, 4, 11):
            values[:6] += client.output("target_q")
        if command in (2, 3, 24):
            values[:6] = client.output("target_TCP_pose") + 0.2 * values[:6]
        values[6:11] = [*np.abs(values[6:10]), 300.0]
        client.write(command, values, [int(rng.integers(2)), *rng.integers(0, 2, 6)])
        for _ in range(int(rng.integers(5, 200))):
            before = client.output("target_q")
            controller.step()
            speed = np.abs(client.output("target_qd")).max()
            assert speed <= JOINT_SPEED_RAD_S * (1 + 1e-6)
            assert np.abs(client.output("target_q")).max() <= JOINT_RANGE_RAD
            way = np.abs(client.output("target_q") - before).max()
            travelled += way
            # what the program commands and what force mode adds, each within the limit
            assert way <= 2 * JOINT_SPEED_RAD_S * 0.002 * (1 + 1e-6)
        client.write(0)
        controller.step()
        if controller.program is None:
            client.run(5.2)
            assert not client.output("target_qd").any()
            controller.unlock_protective_stop()
            controller.start_program(PROGRAM)
            controller.step()
    assert travelled > 0.5
