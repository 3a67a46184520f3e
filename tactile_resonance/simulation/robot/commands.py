# SPDX-License-Identifier: Apache-2.0
"""What each command number of the RTDE client does, and where its arguments are."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.simulation.robot import motion
from tactile_resonance.simulation.robot.compliance import ForceTask
from tactile_resonance.simulation.robot.ft_sensor import STANDARD_GRAVITY_M_S2, Payload
from tactile_resonance.simulation.robot.kinematics import forward
from tactile_resonance.simulation.robot.machine import ExternalSensor
from tactile_resonance.simulation.robot.poses import matrix_from_pose, pose_from_matrix
from tactile_resonance.simulation.robot.target import CYCLE_S, ProtectiveStop, ScriptError

if TYPE_CHECKING:
    from tactile_resonance.simulation.robot.program import Program, Thread

FloatArray = NDArray[np.float64]

# Set by the contact thread for the main loop: go back to where the contact began.
CONTACT_FOUND = 254
# Deceleration [m/s^2] of the stop after a contact, and of the stop that ends force mode.
CONTACT_STOP, FORCE_MODE_STOP = 3.0, 10.0
# Defaults of URScript's movel: acceleration [m/s^2] and speed [m/s].
MOVE_ACCELERATION, MOVE_SPEED = 1.2, 0.25


class Commands:
    """Commands of the client; each is a generator that ends when the command is done."""

    STREAMING = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58})

    def __init__(self, program: Program) -> None:
        self._program = program
        self._machine = program.machine
        self._target = program.machine.target
        # linear or in the joints; the client's program sets this by asynchronous stops alone
        self._stop_linear = False
        self._speed: tuple[bool, FloatArray, float, float] = (True, np.zeros(6), 0.5, 0.5)
        self._servo: tuple[FloatArray, float, float] = (self._target.q, CYCLE_S, 0.1)
        self._jog_twist = np.zeros(6)
        self._contact_steps = 0
        self._do: dict[int, Callable[[], Thread | None]] = {
            1: self._movej, 2: self._movej, 3: self._movel, 4: self._movel,
            6: self._force_mode, 7: self._end_force_mode, 8: self._machine.sensor.zero,
            9: self._speed_to, 10: self._speed_to, 11: self._servo_to, 24: self._servo_to,
            15: self._speed_stop, 16: self._servo_stop, 17: self._set_payload,
            20: self._set_damping, 21: self._set_gain, 25: self._tool_contact,
            26: self._step_time, 27: self._past_joints, 29: self._set_tcp,
            30: self._inverse, 31: self._protective_stop, 33: self._stop, 34: self._stop,
            35: self._set_watchdog, 36: self._pose_within_limits, 37: self._joints_within_limits,
            39: self._pose_trans, 40: self._tcp_offset, 41: self._start_jog, 42: self._stop_jog,
            43: self._actual_forward, 44: self._forward, 46: self._inverse, 47: self._steady,
            51: self._move_until_contact, 56: self._external_sensor, 57: self._external_sensor,
            58: self._flange_pose, 59: self._set_gravity, 60: self._has_inverse,
            61: self._has_inverse, 62: self._start_contact, 63: self._stop_contact,
            64: self._read_contact, 65: self._set_payload, CONTACT_FOUND: self._back_to_contact,
        }  # fmt: skip

    def execute(self, command: int) -> Thread:
        """Do a command.

        Raises
        ------
        ScriptError
            Where the command is not known to the model, or its arguments are not accepted.
        """
        if command not in self._do:
            raise ScriptError(f"command {command}: not modelled")
        self._command = command
        work = self._do[command]()
        if work is not None:
            yield from work

    def _movej(self) -> Thread:
        p = self._program
        goal = p.doubles(0)
        if self._command == 2:
            goal = self._solved(matrix_from_pose(goal))
        return self._move(motion.movej(self._target, goal, p.double(7), p.double(6)))

    def _movel(self) -> Thread:
        p = self._program
        if self._command == 3:
            goal = matrix_from_pose(p.doubles(0))
        else:
            goal = forward(p.doubles(0)) @ self._target.tcp
        return self._move(motion.movel(self._target, goal, p.double(7), p.double(6)))

    def _move(self, move: Thread) -> Thread:
        self._stop_asynchronous_move()
        if self._program.integer(1) == 1:
            self._program.run("move", self._told(move))
        else:
            yield from move

    def _told(self, work: Thread) -> Thread:
        """Run a motion as an asynchronous operation, its begin and end told to the client."""
        self._program.begin_asynchronous()
        yield from work
        self._program.end_asynchronous()

    def _stop_asynchronous_move(self) -> None:
        if self._program.kill("move"):
            self._program.end_asynchronous()

    def _stop(self) -> Thread:
        p = self._program
        if p.kill("stop"):
            p.end_asynchronous()
        else:
            self._stop_asynchronous_move()
        asynchronous = p.integer(1) == 1
        if asynchronous:
            self._stop_linear = True
        stop = motion.stopl if self._stop_linear else motion.stopj
        work = stop(self._target, p.double(0))
        if asynchronous:
            p.run("stop", self._told(work))
        else:
            yield from work

    def _speed_to(self) -> None:
        p = self._program
        self._speed = (self._command == 10, p.doubles(0), p.double(6), p.double(7))
        if "speed" not in p.threads:
            p.run("speed", self._speeding())

    def _speeding(self) -> Thread:
        # A new speed is taken up when the time of the last one is over, not before.
        while True:
            linear, speed, acceleration, time_s = self._speed
            run = motion.speedl if linear else motion.speedj
            yield from run(self._target, speed, acceleration, time_s)

    def _speed_stop(self) -> Thread:
        self._program.kill("speed")
        stop = motion.stopl if self._speed[0] else motion.stopj
        return stop(self._target, self._program.double(0))

    def _servo_to(self) -> None:
        p = self._program
        goal = p.doubles(0)
        if self._command == 24:
            goal = self._solved(matrix_from_pose(goal))
        self._servo = (goal, p.double(8), p.double(9))
        if not 100 <= p.double(10) <= 2000:
            raise ScriptError(f"servoj: gain {p.double(10):g}; accepted is 100 to 2000")
        if "servo" not in p.threads:
            p.run("servo", self._servoing())

    def _servoing(self) -> Thread:
        while True:
            yield from motion.servoj(self._target, *self._servo)

    def _servo_stop(self) -> Thread:
        self._program.kill("servo")
        return motion.stopl(self._target, self._program.double(0))

    def _force_mode(self) -> None:
        p = self._program
        selection = np.array([p.integer(2 + axis) == 1 for axis in range(6)])
        self._machine.force_mode.task = ForceTask(
            p.doubles(0), selection, p.doubles(6), p.integer(1), p.doubles(12)
        )

    def _end_force_mode(self) -> Thread:
        self._machine.force_mode.end()
        return motion.stopl(self._target, FORCE_MODE_STOP)

    def _set_damping(self) -> None:
        damping = self._program.double(0)
        if not 0.0 <= damping <= 1.0:
            raise ScriptError(f"force_mode_set_damping: {damping:g}; accepted is 0 to 1")
        self._machine.force_mode.damping = damping

    def _set_gain(self) -> None:
        scaling = self._program.double(0)
        if not 0.0 <= scaling <= 2.0:
            raise ScriptError(f"force_mode_set_gain_scaling: {scaling:g}; accepted is 0 to 2")
        self._machine.force_mode.gain_scaling = scaling

    def _set_payload(self) -> None:
        p = self._program
        mass, cog = p.double(0), p.doubles(1, 3)
        if not mass >= 0.0:
            raise ScriptError(f"set_payload: mass {mass:g}; accepted is 0 kg or above")
        if not cog.any():  # the client's program keeps the centre of gravity then
            cog = self._machine.payload.cog_m
        inertia = p.doubles(4) if self._command == 65 else self._machine.payload.inertia_kg_m2
        self._machine.payload = Payload(mass, cog, inertia)

    def _set_tcp(self) -> None:
        self._target.tcp = matrix_from_pose(self._program.doubles(0))

    def _set_gravity(self) -> None:
        # the script's vector points against the fall: (0, 0, 9.82) for an arm on the floor
        self._machine.gravity_m_s2 = -self._program.doubles(0, 3)

    def _tool_contact(self) -> None:
        self._program.answer(self._machine.contact_steps(self._program.doubles(0, 3)))

    def _step_time(self) -> None:
        self._program.answer_doubles(np.array([CYCLE_S]))

    def _past_joints(self) -> None:
        steps = self._program.integer(1)
        self._program.answer_doubles(self._machine.past_joints(steps))

    def _flange_pose(self) -> None:
        self._program.answer_doubles(pose_from_matrix(self._machine.flange))

    def _tcp_offset(self) -> None:
        self._program.answer_doubles(pose_from_matrix(self._target.tcp))

    def _pose_trans(self) -> None:
        p = self._program
        product = matrix_from_pose(p.doubles(0)) @ matrix_from_pose(p.doubles(6))
        p.answer_doubles(pose_from_matrix(product))

    def _actual_forward(self) -> None:
        self._program.answer_doubles(pose_from_matrix(self._machine.tcp))

    def _forward(self) -> None:
        p = self._program
        tool = forward(p.doubles(0)) @ matrix_from_pose(p.doubles(6))
        p.answer_doubles(pose_from_matrix(tool))

    def _inverse(self) -> None:
        p = self._program
        near = p.doubles(6) if self._command == 30 else None
        p.answer_doubles(self._solved(matrix_from_pose(p.doubles(0)), near))

    def _has_inverse(self) -> None:
        p = self._program
        near = p.doubles(6) if self._command == 61 else None
        found = self._machine.solve(matrix_from_pose(p.doubles(0)), near)
        p.answer(int(found is not None))

    def _solved(self, tool: FloatArray, near: FloatArray | None = None) -> FloatArray:
        q = self._machine.solve(tool, near)
        if q is None:
            raise ScriptError(
                f"get_inverse_kin: no joint angles reach the position {np.round(tool[:3, 3], 4)} m"
            )
        return q

    def _pose_within_limits(self) -> None:
        q = self._machine.solve(matrix_from_pose(self._program.doubles(0)))
        self._program.answer(int(self._machine.within_limits(q)))

    def _joints_within_limits(self) -> None:
        self._program.answer(int(self._machine.within_limits(self._program.doubles(0))))

    def _steady(self) -> None:
        self._program.answer(int(self._machine.steady))

    def _protective_stop(self) -> None:
        raise ProtectiveStop("asked for by the program")

    def _set_watchdog(self) -> None:
        frequency = self._program.double(0)
        if not frequency > 0.0:
            raise ScriptError(f"rtde_set_watchdog: frequency {frequency:g}; accepted is above 0 Hz")
        self._program.watchdog_s = 1.0 / frequency

    def _external_sensor(self) -> None:
        p = self._program
        if p.integer(1) == 1:
            self._machine.external = ExternalSensor(p.double(0), p.doubles(1, 3), p.doubles(4, 3))
        else:
            self._machine.external = None

    def _move_until_contact(self) -> Thread:
        p = self._program
        speed, direction, acceleration = p.doubles(0), p.doubles(6, 3), p.double(12)
        while (steps := self._machine.contact_steps(direction)) == 0:
            yield from motion.speedl(self._target, speed, acceleration, CYCLE_S)
        yield from self._return(steps)

    def _return(self, steps: int) -> Thread:
        """Stop, and go back to where the arm was some cycles ago."""
        q = self._machine.past_joints(steps)
        yield from motion.stopl(self._target, CONTACT_STOP)
        goal = forward(q) @ self._target.tcp
        yield from motion.movel(self._target, goal, MOVE_ACCELERATION, MOVE_SPEED)

    def _start_contact(self) -> None:
        self._program.kill("contact")
        self._program.run("contact", self._watching(self._program.doubles(0, 3)))

    def _watching(self, direction: FloatArray) -> Thread:
        """Wait until nothing is touched, then for a contact; zero: along the motion."""
        self._contact_steps = 0
        follow = not direction.any()

        def steps() -> int:
            along = self._target.twist[:3] if follow else direction
            return self._machine.contact_steps(along)

        while steps() > 0:
            yield
        while (found := steps()) == 0:
            yield
        self._contact_steps = found
        self._program.internal_command = CONTACT_FOUND

    def _stop_contact(self) -> None:
        self._program.kill("contact")
        self._program.answer(self._contact_steps)

    def _read_contact(self) -> None:
        self._program.answer(self._contact_steps)

    def _back_to_contact(self) -> Thread:
        self._stop_asynchronous_move()
        return self._return(self._contact_steps)

    def _start_jog(self) -> None:
        p = self._program
        axes = [np.eye(3), self._machine.tcp[:3, :3], matrix_from_pose(p.doubles(8))[:3, :3]]
        feature = round(p.double(6))
        if feature not in (0, 1, 2):
            raise ScriptError(f"jog: feature {feature}; accepted are 0 base, 1 tool, 2 custom")
        twist = p.doubles(0)
        self._jog_twist = np.concatenate([axes[feature] @ twist[:3], axes[feature] @ twist[3:]])
        if "jog" not in p.threads:
            p.run("jog", self._jogging(p.double(7)))

    def _jogging(self, acceleration: float) -> Thread:
        while True:
            yield from motion.speedl(self._target, self._jog_twist, acceleration, 5 * CYCLE_S)

    def _stop_jog(self) -> Thread:
        self._program.kill("jog")
        return motion.stopl(self._target, 1.2)
