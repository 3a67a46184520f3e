# SPDX-License-Identifier: Apache-2.0
"""RTDE outputs of the controller: names, types and how each follows from its state.

Names and types: Universal Robots, "Real-Time Data Exchange (RTDE) Guide". Not modelled, and nominal
therefore: temperatures, voltages, execution time, analogue inputs; the accelerometer in the tool feels
gravity alone. Currents are torques over an assumed constant, without friction or inertia.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.simulation.robot.dynamics import gravity_torque, momentum
from tactile_resonance.simulation.robot.kinematics import jacobian
from tactile_resonance.simulation.robot.poses import pose_from_matrix
from tactile_resonance.simulation.robot.registers import REGISTER_COUNT

if TYPE_CHECKING:
    from tactile_resonance.simulation.robot.controller import UrController

FloatArray = NDArray[np.float64]

# Joint torque per motor current [N m/A]; the maker publishes none.
TORQUE_PER_CURRENT = 10.0
# Of the joints (RTDE guide): running, or without power.
JOINT_RUNNING, JOINT_POWER_OFF = 253, 239
NOMINAL_TEMPERATURE_C = 28.0
MAINS_V, ROBOT_BUS_V = 230.0, 48.0


def _target_moment(c: UrController) -> FloatArray:
    machine = c.machine
    return gravity_torque(machine.target.frames, machine.gravity_m_s2, machine.payload)


def _actual_moment(c: UrController) -> FloatArray:
    """Torques that hold the arm against gravity and against what pushes the tool."""
    machine = c.machine
    held = gravity_torque(machine.frames, machine.gravity_m_s2, machine.payload)
    return held - jacobian(machine.frames, machine.tcp[:3, 3]).T @ machine.tcp_force


def _tool_accelerometer(c: UrController) -> FloatArray:
    return -(c.machine.flange[:3, :3].T @ c.machine.gravity_m_s2)


def _status_bits(c: UrController) -> int:
    return int(c.robot_mode != 3) | int(c.program is not None) << 1


def _joint_mode(c: UrController) -> list[int]:
    return [JOINT_RUNNING if c.safety.powered else JOINT_POWER_OFF] * 6


Reader = Callable[["UrController"], Any]

_OUTPUTS: dict[str, tuple[str, Reader]] = {
    "timestamp": ("DOUBLE", lambda c: c.time_s),
    "target_q": ("VECTOR6D", lambda c: c.machine.target.q),
    "target_qd": ("VECTOR6D", lambda c: c.machine.target.qd),
    "target_qdd": ("VECTOR6D", lambda c: c.machine.target.qdd),
    "target_current": ("VECTOR6D", lambda c: _target_moment(c) / TORQUE_PER_CURRENT),
    "target_moment": ("VECTOR6D", _target_moment),
    "actual_q": ("VECTOR6D", lambda c: c.machine.joints.q),
    "actual_qd": ("VECTOR6D", lambda c: c.machine.joints.qd),
    "actual_current": ("VECTOR6D", lambda c: _actual_moment(c) / TORQUE_PER_CURRENT),
    "actual_current_as_torque": ("VECTOR6D", _actual_moment),
    "joint_control_output": ("VECTOR6D", lambda c: _actual_moment(c) / TORQUE_PER_CURRENT),
    "actual_TCP_pose": ("VECTOR6D", lambda c: pose_from_matrix(c.machine.tcp)),
    "actual_TCP_speed": ("VECTOR6D", lambda c: c.machine.tcp_twist),
    "actual_TCP_force": ("VECTOR6D", lambda c: c.machine.tcp_force),
    "target_TCP_pose": ("VECTOR6D", lambda c: c.machine.target.pose),
    "target_TCP_speed": ("VECTOR6D", lambda c: c.machine.target.twist),
    "actual_digital_input_bits": ("UINT64", lambda c: c.ports.digital_inputs),
    "actual_digital_output_bits": ("UINT64", lambda c: c.ports.digital_outputs),
    "joint_temperatures": ("VECTOR6D", lambda c: [NOMINAL_TEMPERATURE_C] * 6),
    "actual_execution_time": ("DOUBLE", lambda c: 0.0),
    "robot_mode": ("INT32", lambda c: int(c.robot_mode)),
    "joint_mode": ("VECTOR6INT32", _joint_mode),
    "safety_mode": ("INT32", lambda c: int(c.safety_mode)),
    "actual_tool_accelerometer": ("VECTOR3D", _tool_accelerometer),
    "speed_scaling": ("DOUBLE", lambda c: c.ports.speed_slider if c.program else 0.0),
    "target_speed_fraction": ("DOUBLE", lambda c: c.ports.speed_slider),
    "actual_momentum": (
        "DOUBLE",
        lambda c: momentum(c.machine.frames, c.machine.joints.qd, c.machine.payload),
    ),
    "actual_main_voltage": ("DOUBLE", lambda c: MAINS_V),
    "actual_robot_voltage": ("DOUBLE", lambda c: ROBOT_BUS_V if c.safety.powered else 0.0),
    "actual_robot_current": (
        "DOUBLE",
        lambda c: float(np.abs(_actual_moment(c)).sum()) / TORQUE_PER_CURRENT,
    ),
    "actual_joint_voltage": ("VECTOR6D", lambda c: [ROBOT_BUS_V * c.safety.powered] * 6),
    "runtime_state": ("UINT32", lambda c: int(c.runtime_state)),
    "standard_analog_input0": ("DOUBLE", lambda c: 0.0),
    "standard_analog_input1": ("DOUBLE", lambda c: 0.0),
    "standard_analog_output0": ("DOUBLE", lambda c: c.ports.analog_outputs[0]),
    "standard_analog_output1": ("DOUBLE", lambda c: c.ports.analog_outputs[1]),
    "robot_status_bits": ("UINT32", _status_bits),
    "safety_status_bits": ("UINT32", lambda c: c.safety.status_bits),
    "ft_raw_wrench": ("VECTOR6D", lambda c: c.machine.sensor.raw),
    "payload": ("DOUBLE", lambda c: c.machine.payload.mass_kg),
    "payload_cog": ("VECTOR3D", lambda c: c.machine.payload.cog_m),
    "payload_inertia": ("VECTOR6D", lambda c: c.machine.payload.inertia_kg_m2),
    "tcp_offset": ("VECTOR6D", lambda c: pose_from_matrix(c.machine.target.tcp)),
    "tcp_force_scalar": (
        "DOUBLE",
        lambda c: float(np.linalg.norm(c.machine.tcp_force[:3])),
    ),
}


def _register(kind: str, number: int) -> Reader:
    return lambda c: getattr(c.registers, f"output_{kind}")[number]


for _number in range(REGISTER_COUNT):
    _OUTPUTS[f"output_int_register_{_number}"] = ("INT32", _register("int", _number))
    _OUTPUTS[f"output_double_register_{_number}"] = ("DOUBLE", _register("double", _number))

# RTDE types of all outputs, by name.
OUTPUT_TYPES: dict[str, str] = {name: kind for name, (kind, _) in _OUTPUTS.items()}


def output_value(controller: UrController, name: str) -> Any:
    """Return an output: an int or a float, for vectors a list of them. Raises KeyError."""
    if name not in _OUTPUTS:
        raise KeyError(f"RTDE output {name!r}: not known")
    value = _OUTPUTS[name][1](controller)
    return value.tolist() if isinstance(value, np.ndarray) else value
