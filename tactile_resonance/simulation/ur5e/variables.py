# SPDX-License-Identifier: Apache-2.0
"""RTDE variables of the controller: its inputs, and the outputs with how each follows from its state.

Names and types: Universal Robots, "Real-Time Data Exchange (RTDE) Guide". Not modelled, and nominal
therefore: temperatures, voltages, execution time, analogue inputs; torques, currents and momentum of the arm,
which are 0. The accelerometer in the tool feels gravity alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from tactile_resonance.contact.vectors import ZEROS, Vector, pose_from_transform, rotated_back

if TYPE_CHECKING:
    from tactile_resonance.simulation.ur5e.controller import UrController

# Numbers 0 to 23 are the lower range, 24 to 47 the upper one.
_REGISTER_COUNT = 48
# Larger figures are refused: sums and squares of them would not be finite.
LARGEST_FIGURE = 1e6

# RTDE names of the inputs, by number.
INT_INPUTS = tuple(f"input_int_register_{n}" for n in range(_REGISTER_COUNT))
DOUBLE_INPUTS = tuple(f"input_double_register_{n}" for n in range(_REGISTER_COUNT))
_REGISTERS = frozenset({*INT_INPUTS, *DOUBLE_INPUTS})

# Groups of digital outputs and their first bit in the word of all.
_DIGITAL = {"standard": 0, "configurable": 8, "tool": 16}

# Types of all inputs, as the RTDE guide names them.
INPUT_TYPES: dict[str, str] = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    **dict.fromkeys((f"{group}_digital_output_mask" for group in _DIGITAL), "UINT8"),
    **dict.fromkeys((f"{group}_digital_output" for group in _DIGITAL), "UINT8"),
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    "external_force_torque": "VECTOR6D",
    **dict.fromkeys(INT_INPUTS, "INT32"),
    **dict.fromkeys(DOUBLE_INPUTS, "DOUBLE"),
}

InputValue = float | int | Sequence[float]


class Registers:
    """Registers of a controller, its digital and analogue outputs and its speed slider.

    Attributes
    ----------
    inputs : dict
        Written by clients, by their RTDE names: of `INT_INPUTS` integers, of `DOUBLE_INPUTS` floats.
    output_int, output_double : lists of 48
        Written by the program.
    refreshed : set of str
        Names of inputs written since the last cycle, with whatever value: what a watchdog watches.
    digital_outputs : int
        Bits 0-7 standard, 8-15 configurable, 16-17 tool.
    analog_outputs : list of 2 floats
        As written, 0 to 1 of the range.
    speed_slider : float
        Above 0 to 1.
    """

    def __init__(self) -> None:
        self.inputs: dict[str, float] = dict.fromkeys(INT_INPUTS, 0)
        self.inputs.update(dict.fromkeys(DOUBLE_INPUTS, 0.0))
        self.output_int = [0] * _REGISTER_COUNT
        self.output_double = [0.0] * _REGISTER_COUNT
        self.refreshed: set[str] = set()
        self.digital_outputs = 0
        self.analog_outputs = [0.0, 0.0]
        self.speed_slider = 1.0

    def write(self, values: Mapping[str, InputValue]) -> None:
        """Take the inputs of one package; of outputs and slider only what its masks select is written.

        Raises
        ------
        KeyError
            Where an input is not known; nothing is written then.
        """
        own = values
        if not _REGISTERS.issuperset(values):
            if unknown := [name for name in values if name not in INPUT_TYPES]:
                raise KeyError(f"RTDE input {unknown[0]!r}: not known")
            own = {name: value for name, value in values.items() if name in _REGISTERS}
            self._write_ports(values)
        self.inputs.update(own)  # type: ignore[arg-type]
        self.refreshed.update(own)

    def _write_ports(self, values: Mapping[str, InputValue]) -> None:
        def number(name: str) -> float:
            value = values.get(name, 0)
            assert not isinstance(value, Sequence)
            return value

        for group, first in _DIGITAL.items():
            mask = int(number(f"{group}_digital_output_mask")) << first
            bits = int(number(f"{group}_digital_output")) << first
            self.digital_outputs = (self.digital_outputs & ~mask) | (bits & mask)
        for channel in range(2):
            if int(number("standard_analog_output_mask")) >> channel & 1:
                self.analog_outputs[channel] = number(f"standard_analog_output_{channel}")
        if int(number("speed_slider_mask")):
            self.speed_slider = min(1.0, max(0.0, number("speed_slider_fraction")))


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


def _joint_mode(robot: UrController) -> list[int]:
    """Mode of each joint."""
    return [JOINT_RUNNING if robot.powered else JOINT_POWER_OFF] * 6


Reader = Callable[["UrController"], tuple[float, ...] | OutputValue]


def _integer(number: int) -> Reader:
    return lambda robot: robot.registers.output_int[number]


def _double(number: int) -> Reader:
    return lambda robot: robot.registers.output_double[number]


# RTDE type of each output, and what reads it.
OUTPUTS: dict[str, tuple[str, Reader]] = {
    "timestamp": ("DOUBLE", lambda robot: robot.time_s + robot.stood_still_s),
    "target_q": ("VECTOR6D", lambda robot: robot.machine.target.q),
    "target_qd": ("VECTOR6D", lambda robot: robot.machine.target.qd),
    "target_qdd": ("VECTOR6D", lambda robot: robot.machine.target.qdd),
    "actual_q": ("VECTOR6D", lambda robot: robot.machine.q),
    "actual_qd": ("VECTOR6D", lambda robot: robot.machine.qd),
    "actual_qdd": ("VECTOR6D", lambda robot: robot.machine.qdd),
    "actual_TCP_pose": ("VECTOR6D", lambda robot: robot.machine.tcp_pose),
    "actual_TCP_speed": ("VECTOR6D", lambda robot: robot.machine.tcp_twist),
    "actual_TCP_force": ("VECTOR6D", lambda robot: robot.machine.tcp_force),
    "target_TCP_pose": ("VECTOR6D", lambda robot: robot.machine.target.pose),
    "target_TCP_speed": ("VECTOR6D", lambda robot: robot.machine.target.twist),
    "actual_digital_input_bits": ("UINT64", lambda robot: 0),
    "actual_digital_output_bits": ("UINT64", lambda robot: robot.registers.digital_outputs),
    "joint_temperatures": ("VECTOR6D", lambda robot: [NOMINAL_TEMPERATURE_C] * 6),
    "robot_mode": ("INT32", lambda robot: int(robot.robot_mode)),
    "joint_mode": ("VECTOR6INT32", _joint_mode),
    "safety_mode": ("INT32", lambda robot: int(robot.safety_mode)),
    "actual_tool_accelerometer": ("VECTOR3D", _tool_accelerometer),
    "speed_scaling": (
        "DOUBLE",
        lambda robot: robot.registers.speed_slider if robot.program else 0.0,
    ),
    "target_speed_fraction": ("DOUBLE", lambda robot: robot.registers.speed_slider),
    "actual_main_voltage": ("DOUBLE", lambda robot: MAINS_V),
    "actual_robot_voltage": ("DOUBLE", lambda robot: ROBOT_BUS_V if robot.powered else 0.0),
    "actual_joint_voltage": ("VECTOR6D", lambda robot: [ROBOT_BUS_V * robot.powered] * 6),
    "runtime_state": ("UINT32", lambda robot: int(robot.runtime_state)),
    "standard_analog_output0": ("DOUBLE", lambda robot: robot.registers.analog_outputs[0]),
    "standard_analog_output1": ("DOUBLE", lambda robot: robot.registers.analog_outputs[1]),
    "robot_status_bits": ("UINT32", lambda robot: robot.status_bits),
    "safety_status_bits": ("UINT32", lambda robot: robot.safety_status_bits),
    "ft_raw_wrench": ("VECTOR6D", lambda robot: robot.machine.raw_wrench),
    "payload": ("DOUBLE", lambda robot: robot.machine.payload.mass_kg),
    "payload_cog": ("VECTOR3D", lambda robot: robot.machine.payload.cog_m),
    "payload_inertia": ("VECTOR6D", lambda robot: robot.machine.payload.inertia_kg_m2),
    "tcp_offset": ("VECTOR6D", lambda robot: pose_from_transform(robot.machine.target.tcp)),
    "tcp_force_scalar": ("DOUBLE", lambda robot: math.hypot(*robot.machine.tcp_force[:3])),
    **dict.fromkeys(
        (
            *("target_current", "target_moment", "actual_moment", "actual_current"),
            *("actual_current_as_torque", "joint_control_output"),
        ),
        ("VECTOR6D", lambda robot: ZEROS),
    ),
    **dict.fromkeys(
        (
            *("actual_execution_time", "actual_momentum", "actual_robot_current"),
            *("standard_analog_input0", "standard_analog_input1"),
        ),
        ("DOUBLE", lambda robot: 0.0),
    ),
    # no program of the model writes boolean registers
    **dict.fromkeys(
        ("output_bit_registers0_to_31", "output_bit_registers32_to_63"),
        ("UINT32", lambda robot: 0),
    ),
    **{f"output_int_register_{n}": ("INT32", _integer(n)) for n in range(_REGISTER_COUNT)},
    **{f"output_double_register_{n}": ("DOUBLE", _double(n)) for n in range(_REGISTER_COUNT)},
}
