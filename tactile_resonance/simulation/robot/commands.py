# SPDX-License-Identifier: Apache-2.0
"""Command numbers of the RTDE client."""

from __future__ import annotations

from collections.abc import Callable

from tactile_resonance.simulation.robot.machine import Machine
from tactile_resonance.simulation.robot.motion_commands import CONTACT_FOUND, MotionCommands
from tactile_resonance.simulation.robot.script import Script, Thread
from tactile_resonance.simulation.robot.setting_commands import SettingCommands
from tactile_resonance.simulation.robot.target import ScriptError


class Commands:
    """Commands by number."""

    # Done anew in every cycle in which they stand in the command register.
    STREAMING = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58})

    def __init__(self, script: Script, machine: Machine) -> None:
        moves = MotionCommands(script, machine)
        settings = SettingCommands(script, machine)
        self._do: dict[int, Callable[[], Thread | None]] = {
            1: moves.movej, 2: moves.movej_pose, 3: moves.movel, 4: moves.movel_joints,
            6: settings.force_mode, 7: settings.end_force_mode, 8: machine.sensor.zero,
            9: moves.speedj, 10: moves.speedl, 11: moves.servoj, 15: moves.speed_stop,
            16: moves.servo_stop, 17: settings.set_payload, 20: settings.set_damping,
            21: settings.set_gain, 24: moves.servol, 25: settings.tool_contact,
            26: settings.step_time, 27: settings.past_joints, 29: settings.set_tcp,
            30: settings.inverse_near, 31: settings.protective_stop, 33: moves.stop,
            34: moves.stop, 35: settings.set_watchdog, 36: settings.pose_within_limits,
            37: settings.joints_within_limits, 38: settings.joint_torques,
            39: settings.pose_trans, 40: settings.tcp_offset, 41: moves.start_jog,
            42: moves.stop_jog, 43: settings.actual_forward, 44: settings.forward,
            46: settings.inverse, 47: settings.steady, 51: moves.move_until_contact,
            56: settings.external_sensor, 57: settings.external_sensor,
            58: settings.flange_pose, 59: settings.set_gravity, 60: settings.has_inverse,
            61: settings.has_inverse, 62: moves.start_contact, 63: moves.stop_contact,
            64: moves.read_contact, 65: settings.set_target_payload,
            CONTACT_FOUND: moves.back_to_contact,
        }  # fmt: skip

    def execute(self, command: int) -> Thread:
        """Do a command; a generator that ends when it is done.

        Raises
        ------
        ScriptError
            Where the command is not known to the model, or its arguments are not accepted.
        """
        if command not in self._do:
            raise ScriptError(f"command {command}: not modelled")
        work = self._do[command]()
        if work is not None:
            yield from work
