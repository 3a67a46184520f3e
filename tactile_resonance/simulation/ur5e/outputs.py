# SPDX-License-Identifier: Apache-2.0
"""RTDE outputs of the controller: names, types and how each follows from its state.

Names and types: Universal Robots, "Real-Time Data Exchange (RTDE) Guide". Not modelled, and nominal
therefore: temperatures, voltages, execution time, analogue inputs; torques, currents and momentum of the arm,
which are 0. The accelerometer in the tool feels gravity alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from tactile_resonance.contact.vectors import Vector, rotated_back
from tactile_resonance.simulation.ur5e.poses import ZERO, pose_from_transform
from tactile_resonance.simulation.ur5e.registers import REGISTER_COUNT
from tactile_resonance.simulation.ur5e.safety import RobotMode

if TYPE_CHECKING:
    from tactile_resonance.simulation.ur5e.controller import UrController


OutputValue = float | int | list[float] | list[int]

# Of the joints (RTDE guide): running, or without power.
JOINT_RUNNING, JOINT_POWER_OFF = 253, 239
NOMINAL_TEMPERATURE_C = 28.0
MAINS_V, ROBOT_BUS_V = 230.0, 48.0


def _tool_accelerometer(robot: UrController) -> Vector:
    """What an accelerometer at rest in the flange feels [m/s^2]."""
    machine = robot.machine
    x, y, z = rotated_back(machine.posture.flange[0], machine.gravity_m_s2)
    return -x, -y, -z


def _status_bits(robot: UrController) -> int:
    """Power in bit 0, a running program in bit 1."""
    powered = robot.safety.robot_mode is not RobotMode.POWER_OFF
    return int(powered) | int(robot.program is not None) << 1


def _joint_mode(robot: UrController) -> list[int]:
    """Mode of each joint."""
    return [JOINT_RUNNING if robot.safety.powered else JOINT_POWER_OFF] * 6


Reader = Callable[["UrController"], tuple[float, ...] | OutputValue]

_OUTPUTS: dict[str, tuple[str, Reader]] = {
    "timestamp": ("DOUBLE", lambda robot: robot.time_s + robot.stood_still_s),
    "target_q": ("VECTOR6D", lambda robot: robot.machine.target.q),
    "target_qd": ("VECTOR6D", lambda robot: robot.machine.target.qd),
    "target_qdd": ("VECTOR6D", lambda robot: robot.machine.target.qdd),
    "target_current": ("VECTOR6D", lambda robot: ZERO),
    "target_moment": ("VECTOR6D", lambda robot: ZERO),
    "actual_q": ("VECTOR6D", lambda robot: robot.machine.joints.q),
    "actual_qd": ("VECTOR6D", lambda robot: robot.machine.joints.qd),
    "actual_qdd": ("VECTOR6D", lambda robot: robot.machine.joints.qdd),
    "actual_moment": ("VECTOR6D", lambda robot: ZERO),
    "actual_current": ("VECTOR6D", lambda robot: ZERO),
    "actual_current_as_torque": ("VECTOR6D", lambda robot: ZERO),
    "joint_control_output": ("VECTOR6D", lambda robot: ZERO),
    "actual_TCP_pose": ("VECTOR6D", lambda robot: robot.machine.tcp_pose),
    "actual_TCP_speed": ("VECTOR6D", lambda robot: robot.machine.tcp_twist),
    "actual_TCP_force": ("VECTOR6D", lambda robot: robot.machine.tcp_force),
    "target_TCP_pose": ("VECTOR6D", lambda robot: robot.machine.target.pose),
    "target_TCP_speed": ("VECTOR6D", lambda robot: robot.machine.target.twist),
    "actual_digital_input_bits": ("UINT64", lambda robot: robot.ports.digital_inputs),
    "actual_digital_output_bits": ("UINT64", lambda robot: robot.ports.digital_outputs),
    "joint_temperatures": ("VECTOR6D", lambda robot: [NOMINAL_TEMPERATURE_C] * 6),
    "actual_execution_time": ("DOUBLE", lambda robot: 0.0),
    "robot_mode": ("INT32", lambda robot: int(robot.safety.robot_mode)),
    "joint_mode": ("VECTOR6INT32", _joint_mode),
    "safety_mode": ("INT32", lambda robot: int(robot.safety.safety_mode)),
    "actual_tool_accelerometer": ("VECTOR3D", _tool_accelerometer),
    "speed_scaling": (
        "DOUBLE",
        lambda robot: robot.ports.speed_slider if robot.program else 0.0,
    ),
    "target_speed_fraction": ("DOUBLE", lambda robot: robot.ports.speed_slider),
    "actual_momentum": ("DOUBLE", lambda robot: 0.0),
    "actual_main_voltage": ("DOUBLE", lambda robot: MAINS_V),
    "actual_robot_voltage": ("DOUBLE", lambda robot: ROBOT_BUS_V if robot.safety.powered else 0.0),
    "actual_robot_current": ("DOUBLE", lambda robot: 0.0),
    "actual_joint_voltage": ("VECTOR6D", lambda robot: [ROBOT_BUS_V * robot.safety.powered] * 6),
    "runtime_state": ("UINT32", lambda robot: int(robot.runtime_state)),
    "standard_analog_input0": ("DOUBLE", lambda robot: 0.0),
    "standard_analog_input1": ("DOUBLE", lambda robot: 0.0),
    "standard_analog_output0": ("DOUBLE", lambda robot: robot.ports.analog_outputs[0]),
    "standard_analog_output1": ("DOUBLE", lambda robot: robot.ports.analog_outputs[1]),
    "robot_status_bits": ("UINT32", _status_bits),
    "safety_status_bits": ("UINT32", lambda robot: robot.safety.status_bits),
    "ft_raw_wrench": ("VECTOR6D", lambda robot: robot.machine.sensor.raw),
    "payload": ("DOUBLE", lambda robot: robot.machine.payload.mass_kg),
    "payload_cog": ("VECTOR3D", lambda robot: robot.machine.payload.cog_m),
    "payload_inertia": ("VECTOR6D", lambda robot: robot.machine.payload.inertia_kg_m2),
    "tcp_offset": ("VECTOR6D", lambda robot: pose_from_transform(robot.machine.target.tcp)),
    # no program of the model writes boolean registers
    "output_bit_registers0_to_31": ("UINT32", lambda robot: 0),
    "output_bit_registers32_to_63": ("UINT32", lambda robot: 0),
    "tcp_force_scalar": (
        "DOUBLE",
        lambda robot: math.hypot(*robot.machine.tcp_force[:3]),
    ),
}


def _integer(number: int) -> Reader:
    return lambda robot: robot.registers.output_int[number]


def _double(number: int) -> Reader:
    return lambda robot: robot.registers.output_double[number]


for _number in range(REGISTER_COUNT):
    _OUTPUTS[f"output_int_register_{_number}"] = ("INT32", _integer(_number))
    _OUTPUTS[f"output_double_register_{_number}"] = ("DOUBLE", _double(_number))

# RTDE types of all outputs, and what reads them, by name.
OUTPUT_TYPES: dict[str, str] = {name: kind for name, (kind, _) in _OUTPUTS.items()}
READERS: dict[str, Reader] = {name: reader for name, (_, reader) in _OUTPUTS.items()}
