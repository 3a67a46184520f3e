# SPDX-License-Identifier: Apache-2.0
"""Commands of the RTDE client: those that move the arm, those that set something, and those that ask."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import TYPE_CHECKING, Any

from tactile_resonance.contact.vectors import NO_TURN, Vector, rotated
from tactile_resonance.simulation.ur5e import motion
from tactile_resonance.simulation.ur5e.forces import ForceTask, ToolPayload
from tactile_resonance.simulation.ur5e.kinematics import Posture
from tactile_resonance.simulation.ur5e.machine import Machine
from tactile_resonance.simulation.ur5e.poses import ZERO, Six, pose_from_transform, product
from tactile_resonance.simulation.ur5e.target import (
    CYCLE_S,
    ProtectiveStop,
    ScriptError,
    Target,
    Thread,
)

if TYPE_CHECKING:
    from tactile_resonance.simulation.ur5e.program import Program

SpeedMotion = Callable[[Target, Six, float, float], Thread]

# Set by the contact thread for the main loop: go back to where the contact began.
CONTACT_FOUND = 254
# Deceleration [m/s^2] of the stop after a contact.
CONTACT_STOP = 3.0
# Defaults of URScript's movel: acceleration [m/s^2] and speed [m/s].
MOVE_ACCELERATION, MOVE_SPEED = 1.2, 0.25
# Deceleration [m/s^2] of the stop that ends force mode.
FORCE_MODE_STOP = 10.0


class Handlers:
    """What commands do that move the arm or set something; a generator where that takes time."""

    def __init__(self, program: Program, machine: Machine) -> None:
        self._program = program
        self._machine = machine
        self._target = machine.target
        # linear or in the joints; the client's program sets this by asynchronous stops alone
        self._stop_linear = False
        self._speed: tuple[SpeedMotion, Six, float, float] = (motion.speedl, ZERO, 0.5, 0.5)
        self._servo: tuple[Six, float, float] = (self._target.q, CYCLE_S, 0.1)
        self._jog_twist = ZERO
        self._contact_steps = 0

    def move(self, run: Callable[[Target, Any, float, float], Thread], goal: Any) -> Thread:
        """Move to joint angles or a pose, asynchronously where integer 1 says so."""
        program = self._program
        work = run(self._target, goal, program.double(7), program.double(6))
        self._stop_asynchronous_move()
        if program.integer(1) == 1:
            program.run("move", self._told(work))
        else:
            yield from work

    def _told(self, work: Thread) -> Thread:
        """Run a motion as an asynchronous operation, and report its begin and end to the client."""
        self._program.begin_asynchronous()
        yield from work
        self._program.end_asynchronous()

    def _stop_asynchronous_move(self) -> None:
        if self._program.kill("move"):
            self._program.end_asynchronous()

    def stop(self) -> Thread:
        """Stop, asynchronously where integer 1 says so."""
        program = self._program
        if program.kill("stop"):
            program.end_asynchronous()
        else:
            self._stop_asynchronous_move()
        asynchronous = program.integer(1) == 1
        if asynchronous:
            self._stop_linear = True
        stop = motion.stopl if self._stop_linear else motion.stopj
        work = stop(self._target, program.double(0))
        if asynchronous:
            program.run("stop", self._told(work))
        else:
            yield from work

    def speed(self, run: SpeedMotion) -> None:
        """Move the TCP with a twist, or the joints with speeds, until the next command."""
        program = self._program
        self._speed = (run, program.doubles(0), program.double(6), program.double(7))
        if "speed" not in program.threads:
            program.run("speed", self._speeding())

    def _speeding(self) -> Thread:
        # A new speed is taken up when the time of the last one is over, not before.
        while True:
            run, speed, acceleration, time_s = self._speed
            yield from run(self._target, speed, acceleration, time_s)

    def speed_stop(self) -> Thread:
        """End a motion with a speed."""
        self._program.kill("speed")
        stop = motion.stopl if self._speed[0] is motion.speedl else motion.stopj
        return stop(self._target, self._program.double(0))

    def servo(self, goal: Six) -> None:
        """Follow joint angles."""
        program = self._program
        gain = program.double(10)
        if not 100 <= gain <= 2000:
            raise ScriptError(f"servoj: gain {gain:g}; accepted is 100 to 2000")
        self._servo = (goal, program.double(8), program.double(9))
        if "servo" not in program.threads:
            program.run("servo", self._servoing())

    def _servoing(self) -> Thread:
        while True:
            yield from motion.servoj(self._target, *self._servo)

    def servo_stop(self) -> Thread:
        """End following."""
        self._program.kill("servo")
        return motion.stopl(self._target, self._program.double(0))

    def move_until_contact(self) -> Thread:
        """Move with a twist until the tool touches something, and back to where it did."""
        program = self._program
        speed, direction, acceleration = program.doubles(0), program.vector(6), program.double(12)
        while (steps := self._machine.contact_steps(direction)) == 0:
            yield from motion.speedl(self._target, speed, acceleration, CYCLE_S)
        yield from self._return(steps)

    def _return(self, steps: int) -> Thread:
        """Stop, and go back to where the arm was some cycles ago."""
        q = self._machine.past_joints(steps)
        yield from motion.stopl(self._target, CONTACT_STOP)
        goal = Posture(q).tool(self._target.tcp)
        yield from motion.movel(self._target, goal, MOVE_ACCELERATION, MOVE_SPEED)

    def start_contact(self) -> None:
        """Watch for a contact along a direction; zero: along the motion."""
        self._program.kill("contact")
        self._program.run("contact", self._watching(self._program.vector(0)))

    def _watching(self, direction: Vector) -> Thread:
        """Wait until nothing is touched, then for a contact; zero: along the motion."""
        self._contact_steps = 0
        follow = not any(direction)

        def steps() -> int:
            x, y, z = self._target.twist[:3] if follow else direction
            return self._machine.contact_steps((x, y, z))

        while steps() > 0:
            yield
        while (found := steps()) == 0:
            yield
        self._contact_steps = found
        self._program.internal_command = CONTACT_FOUND

    def stop_contact(self) -> None:
        """End watching; how many cycles ago a contact began, 0 for none."""
        self._program.kill("contact")
        self._program.answer(self._contact_steps)

    def read_contact(self) -> None:
        """How many cycles before it was found a contact began, 0 for none."""
        self._program.answer(self._contact_steps)

    def back_to_contact(self) -> Thread:
        """Stop and go back to where the contact began."""
        self._stop_asynchronous_move()
        return self._return(self._contact_steps)

    def start_jog(self) -> None:
        """Move with a twist in the base, the tool or another frame."""
        program = self._program
        axes = [NO_TURN, self._machine.tcp[0], program.pose(8)[0]]
        feature = round(program.double(6))
        if feature not in (0, 1, 2):
            raise ScriptError(f"jog: feature {feature}; accepted are 0 base, 1 tool, 2 custom")
        turn = axes[feature]
        self._jog_twist = (*rotated(turn, program.vector(0)), *rotated(turn, program.vector(3)))
        if "jog" not in program.threads:
            program.run("jog", self._jogging(program.double(7)))

    def _jogging(self, acceleration: float) -> Thread:
        while True:
            yield from motion.speedl(self._target, self._jog_twist, acceleration, 5 * CYCLE_S)

    def stop_jog(self) -> Thread:
        """End jogging."""
        self._program.kill("jog")
        return motion.stopl(self._target, 1.2)

    def force_mode(self) -> None:
        """Give way along chosen axes until pressing with a wrench."""
        program = self._program
        selection = tuple([program.integer(2 + axis) == 1 for axis in range(6)])
        task = ForceTask(
            program.pose(), selection, program.doubles(6), program.integer(1), program.doubles(12)
        )
        self._machine.force_mode.begin(task)

    def end_force_mode(self) -> Thread:
        """End force mode and stop."""
        self._machine.force_mode.end()
        return motion.stopl(self._target, FORCE_MODE_STOP)

    def set_force_mode(self, name: str, most: float) -> None:
        """Set a figure of force mode."""
        value = self._program.double(0)
        if not 0.0 <= value <= most:
            raise ScriptError(f"force_mode_set_{name}: {value:g}; accepted is 0 to {most:g}")
        setattr(self._machine.force_mode, name, value)

    def set_payload(self, inertia: Six) -> None:
        """Set mass and centre of gravity of what the flange carries."""
        mass, cog = self._program.double(0), self._program.vector(1)
        if not mass >= 0.0:
            raise ScriptError(f"set_payload: mass {mass:g}; accepted is 0 kg or above")
        if not any(cog):  # the client's program keeps the centre of gravity then
            cog = self._machine.payload.cog_m
        self._machine.payload = ToolPayload(mass, cog, inertia)

    def set_tcp(self) -> None:
        """Set the TCP in the flange."""
        self._target.tcp = self._program.pose()

    def set_gravity(self) -> None:
        """Set the direction of gravity."""
        # the script's vector points against the fall: (0, 0, 9.82) for an arm on the floor
        x, y, z = self._program.vector(0)
        self._machine.gravity_m_s2 = (-x, -y, -z)

    def protective_stop(self) -> None:
        """Ask for a protective stop."""
        raise ProtectiveStop("asked for by the program")

    def set_watchdog(self) -> None:
        """End the program where the command register is refreshed too seldom."""
        frequency = self._program.double(0)
        if not frequency > 0.0:
            raise ScriptError(f"rtde_set_watchdog: frequency {frequency:g}; accepted is above 0 Hz")
        self._program.watchdog_s = 1.0 / frequency

    def external_sensor(self) -> None:
        """Use the wrench that the client sends, or the built-in sensor again."""
        program = self._program
        if program.integer(1) == 1:
            place_m = program.vector(1)
            self._machine.external = ToolPayload(program.double(0), program.vector(4)), place_m
        else:
            self._machine.external = None


def commands(program: Program, machine: Machine) -> dict[int, Callable[[], Thread | None]]:
    """What the client's program does, by the number of the command."""
    does, target = Handlers(program, machine), machine.target
    pose, doubles = program.pose, program.doubles

    def one(answer: Callable[[], int]) -> Callable[[], None]:
        return lambda: program.answer(answer())

    def many(answer: Callable[[], Iterable[float]]) -> Callable[[], None]:
        return lambda: program.answer_doubles(answer())

    return {
        1: lambda: does.move(motion.movej, doubles(0)),
        2: lambda: does.move(motion.movej, machine.solved(pose())),
        3: lambda: does.move(motion.movel, pose()),
        4: lambda: does.move(motion.movel, Posture(doubles(0)).tool(target.tcp)),
        6: does.force_mode,
        7: does.end_force_mode,
        8: machine.sensor.zero,
        9: partial(does.speed, motion.speedj),
        10: partial(does.speed, motion.speedl),
        11: lambda: does.servo(doubles(0)),
        15: does.speed_stop,
        16: does.servo_stop,
        17: lambda: does.set_payload(machine.payload.inertia_kg_m2),
        20: partial(does.set_force_mode, "damping", 1.0),
        21: partial(does.set_force_mode, "gain_scaling", 2.0),
        # each pose is taken as the joint angles nearest to the actual ones
        24: lambda: does.servo(machine.solved(pose())),
        25: one(lambda: machine.contact_steps(program.vector(0))),
        26: many(lambda: [CYCLE_S]),
        27: many(lambda: machine.past_joints(program.integer(1))),
        29: does.set_tcp,
        # exact, whatever error is allowed
        30: many(lambda: machine.solved(pose(), doubles(6))),
        31: does.protective_stop,
        33: does.stop,
        34: does.stop,
        35: does.set_watchdog,
        36: one(lambda: machine.within_limits(machine.solve(pose()))),
        37: one(lambda: machine.within_limits(doubles(0))),
        # those of outer forces alone: weight and friction of the arm are taken off
        38: many(lambda: machine.outer_torque),
        39: many(lambda: pose_from_transform(product(pose(), pose(6)))),
        40: many(lambda: pose_from_transform(target.tcp)),
        41: does.start_jog,
        42: does.stop_jog,
        43: many(lambda: machine.tcp_pose),
        44: many(lambda: pose_from_transform(Posture(doubles(0)).tool(pose(6)))),
        46: many(lambda: machine.solved(pose())),
        47: one(lambda: machine.steady),
        51: does.move_until_contact,
        56: does.external_sensor,
        57: does.external_sensor,
        58: many(lambda: pose_from_transform(machine.posture.flange)),
        59: does.set_gravity,
        60: one(lambda: machine.solve(pose()) is not None),
        61: one(lambda: machine.solve(pose()) is not None),
        62: does.start_contact,
        63: does.stop_contact,
        64: does.read_contact,
        65: lambda: does.set_payload(doubles(4)),
        CONTACT_FOUND: does.back_to_contact,
    }
