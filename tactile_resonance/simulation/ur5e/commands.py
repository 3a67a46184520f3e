# SPDX-License-Identifier: Apache-2.0
"""The program that serves an RTDE client: how it waits for commands, and what each of them does.

The client uploads a URScript program that waits for command numbers in an input register. The
simulated controller does not interpret URScript; it runs this loop, which keeps the same protocol:
command in integer input 0, output 0 says 1 (ready) or 2 (done), results in integer output 1 and double
outputs 0 to 5, progress of asynchronous motions in integer output 2. All numbers are shifted by 24
where the program was made for the upper range.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from tactile_resonance.contact.vectors import (
    NO_TURN,
    Numbers,
    Transform,
    Vector,
    pose_from_transform,
    rotated,
    transform_from_pose,
)
from tactile_resonance.simulation.ur5e import motion
from tactile_resonance.simulation.ur5e.forces import ForceTask, ToolPayload
from tactile_resonance.simulation.ur5e.kinematics import Posture, product
from tactile_resonance.simulation.ur5e.machine import Machine
from tactile_resonance.simulation.ur5e.target import CYCLE_S, ProtectiveStop, ScriptError, Thread
from tactile_resonance.simulation.ur5e.variables import (
    DOUBLE_INPUTS,
    INT_INPUTS,
    LARGEST_FIGURE,
    Registers,
)

# Commands that are done anew in every cycle in which they stand in the command register.
STREAMING = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58})

READY, DONE = 1, 2
STOP_SCRIPT = 255

# An asynchronous motion's progress word: counters of 7 bits, then a flag, then 15 bits of progress.
_COUNTER_SPAN = 128
_RUNNING = 1 << 15


Command = Callable[[], Thread | None]
"""What a command does; a generator where that takes time."""

# Force mode as the client's program sets it when it starts.
_GAIN_SCALING, _DAMPING = 0.5, 0.025
# Set by the contact thread for the main loop: go back to where the contact began.
CONTACT_FOUND = 254
# Deceleration [m/s^2] of the stop after a contact.
CONTACT_STOP = 3.0
# Defaults of URScript's movel: acceleration [m/s^2] and speed [m/s].
MOVE_ACCELERATION, MOVE_SPEED = 1.2, 0.25
# Decelerations [m/s^2] of the stops that end jogging and force mode.
JOG_STOP, FORCE_MODE_STOP = 1.2, 10.0


class Program:
    """The client's program on an arm: its registers, its threads and its loop.

    Parameters
    ----------
    machine : Machine
        The arm that it moves.
    registers : Registers
    offset : int
        Added to all register numbers: 0 or 24.

    Attributes
    ----------
    offset : int
    threads : dict of str to generator
        Running threads by name.
    watchdog_s : float or None
        Longest time without a refresh of the command register; None without a watchdog.
    """

    def __init__(self, machine: Machine, registers: Registers, offset: int) -> None:
        machine.force_mode.gain_scaling = _GAIN_SCALING
        machine.force_mode.damping = _DAMPING
        self.offset = offset
        self.threads: dict[str, Thread] = {}
        self.watchdog_s: float | None = None
        self._machine, self._target, self._registers = machine, machine.target, registers
        self._internal_command = 0  # set by a thread for the main loop, where none of the client waits
        self._progress_writes = self._operation = 0
        # linear or in the joints; the client's program sets this by asynchronous stops alone
        self._stop_linear = False
        # what threads do again and again, as it was asked for last, and with what arguments
        self._asked: dict[str, tuple[Callable[..., Thread], tuple]] = {"speed": (motion.speedl, ())}
        self._contact_steps = 0
        self._commands = self._all_commands()
        self._main = self._loop()

    def step(self) -> bool:
        """Run one cycle, the main loop before the threads; False once the program has ended.

        Raises
        ------
        ScriptError, ProtectiveStop
            See `Target.command`; the program is over then.
        """
        try:
            next(self._main)
        except StopIteration:
            return False
        for name, thread in list(self.threads.items()):
            if self.threads.get(name) is not thread:
                continue  # ended by one that stepped before it
            try:
                next(thread)
            except StopIteration:
                self.kill(name)
        return True

    def _loop(self) -> Thread:
        """Serve commands until the stop command: one look at the command register in each cycle.

        A streaming command is done anew as long as it stands in the register; any other once, until
        the client has taken it away.
        """
        self.tell_asynchronous(begins=False)
        self.status(READY)
        executing = False
        while True:
            command = self.integer(0)
            if command == 0:
                command, self._internal_command = self._internal_command, 0
            if command in STREAMING:
                yield from self._execute(command)
                self.status(READY)
            elif command == 0:
                executing = False
                self.status(READY)
            elif not executing:
                if command == STOP_SCRIPT:
                    return
                yield from self._execute(command)
                self.status(DONE)
                executing = True
            yield

    def _execute(self, command: int) -> Thread:
        """Do a command; raises ScriptError where the model has none such, or refuses its arguments."""
        if command not in self._commands:
            raise ScriptError(f"command {command}: not modelled")
        work = self._commands[command]()
        if work is not None:
            yield from work

    def kill(self, name: str) -> bool:
        """End a thread and say whether it was running."""
        return self.threads.pop(name, None) is not None

    def integer(self, number: int) -> int:
        """Return an integer input register."""
        return self._registers.inputs[INT_INPUTS[number + self.offset]]  # type: ignore[return-value]

    def double(self, number: int) -> float:
        """Return a double input register; raises as `doubles`."""
        return self.doubles(number, 1)[0]

    def vector(self, number: int) -> Vector:
        """Return three double input registers; raises as `doubles`."""
        x, y, z = self.doubles(number, 3)
        return x, y, z

    def pose(self, number: int = 0) -> Transform:
        """Return the transform of a pose in six double input registers; raises as `doubles`."""
        return transform_from_pose(self.doubles(number))

    def doubles(self, number: int = 0, count: int = 6) -> tuple[float, ...]:
        """Return double input registers.

        Raises
        ------
        ScriptError
            If one of them is not finite or beyond +-1e6.
        """
        first, inputs = number + self.offset, self._registers.inputs
        values = tuple([inputs[name] for name in DOUBLE_INPUTS[first : first + count]])
        if not (math.isfinite(sum(values)) and max(map(abs, values)) <= LARGEST_FIGURE):
            raise ScriptError(
                f"input_double_register_{first}...: {list(values)}; accepted are numbers within "
                f"+-{LARGEST_FIGURE:g}"
            )
        return values

    def status(self, value: int) -> None:
        """Write the state of the command loop."""
        self._registers.output_int[self.offset] = value

    def answer(self, value: int) -> None:
        """Write an integer result."""
        self._registers.output_int[1 + self.offset] = int(value)

    def answer_doubles(self, values: Iterable[float]) -> None:
        """Write a vector result."""
        for place, value in enumerate(values):
            self._registers.output_double[place + self.offset] = value

    def tell_asynchronous(self, *, begins: bool) -> None:
        """Tell that an asynchronous operation begins, or that none runs."""
        self._operation = (self._operation + begins) % _COUNTER_SPAN
        self._progress_writes = (self._progress_writes + 1) % _COUNTER_SPAN
        word = (self._operation << 24) + (self._progress_writes << 16) + begins * _RUNNING
        self._registers.output_int[2 + self.offset] = word

    def _move(self, run: Callable[[Any, Any, float, float], Thread], goal: Any) -> Thread:
        """Move to joint angles or a pose."""
        work = run(self._target, goal, self.double(7), self.double(6))
        self._end_move()
        return self._done("move", work)

    def _stop(self) -> Thread:
        """Stop what moves asynchronously, or stops so."""
        if self.kill("stop"):
            self.tell_asynchronous(begins=False)
        else:
            self._end_move()
        self._stop_linear |= self.integer(1) == 1
        stop = motion.stopl if self._stop_linear else motion.stopj
        return self._done("stop", stop(self._target, self.double(0)))

    def _end_move(self) -> None:
        if self.kill("move"):
            self.tell_asynchronous(begins=False)

    def _done(self, name: str, work: Thread) -> Thread:
        """Execute a motion; in a thread if integer 1 is set, whose begin and end are reported to the client."""
        if self.integer(1) == 1:
            self.threads[name] = self._told(work)
        else:
            yield from work

    def _told(self, work: Thread) -> Thread:
        self.tell_asynchronous(begins=True)
        yield from work
        self.tell_asynchronous(begins=False)

    def _keep(self, name: str, run: Callable[..., Thread], *arguments: Any) -> None:
        """Do a motion again and again; a newer one is taken up when the time of the last is over."""
        self._asked[name] = run, arguments
        if name not in self.threads:
            self.threads[name] = self._kept(name)

    def _kept(self, name: str) -> Thread:
        while True:
            run, arguments = self._asked[name]
            yield from run(self._target, *arguments)

    def _ended(self, name: str, deceleration: float, *, linear: bool = True) -> Thread:
        """End what is done again and again, and stop."""
        self.kill(name)
        return (motion.stopl if linear else motion.stopj)(self._target, deceleration)

    def _speed(self, run: Callable[..., Thread]) -> None:
        """Bring joints or TCP to speeds."""
        *speeds, acceleration, time_s = self.doubles(0, 8)
        self._keep("speed", run, tuple(speeds), acceleration, time_s)

    def _servo(self, goal: Numbers) -> None:
        """Follow joint angles."""
        gain = self.double(10)
        if not 100 <= gain <= 2000:
            raise ScriptError(f"servoj: gain {gain:g}; accepted is 100 to 2000")
        self._keep("servo", motion.servoj, goal, self.double(8), self.double(9))

    def _jog(self) -> None:
        """Move with a twist in the base, the tool or another frame."""
        axes = [NO_TURN, self._machine.tcp[0], self.pose(8)[0]]
        feature = round(self.double(6))
        if feature not in (0, 1, 2):
            raise ScriptError(f"jog: feature {feature}; accepted are 0 base, 1 tool, 2 custom")
        turn = axes[feature]
        twist = (*rotated(turn, self.vector(0)), *rotated(turn, self.vector(3)))
        self._keep("jog", motion.speedl, twist, self.double(7), 5 * CYCLE_S)

    def _move_until_contact(self) -> Thread:
        """Move with a twist until the tool touches something, and back to where it did."""
        speed, direction, acceleration = self.doubles(), self.vector(6), self.double(12)
        while (steps := self._machine.contact_steps(direction)) == 0:
            yield from motion.speedl(self._target, speed, acceleration, CYCLE_S)
        yield from self._return(steps)

    def _return(self, steps: int) -> Thread:
        """Stop, and go back to where the arm was some cycles ago."""
        q = self._machine.past_joints(steps)
        yield from motion.stopl(self._target, CONTACT_STOP)
        goal = Posture(q).tool(self._target.tcp)
        yield from motion.movel(self._target, goal, MOVE_ACCELERATION, MOVE_SPEED)

    def _start_contact(self) -> None:
        """Watch for a contact along a direction."""
        self.kill("contact")
        self.threads["contact"] = self._watching(self.vector(0))

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
        self._internal_command = CONTACT_FOUND

    def _stop_contact(self) -> None:
        """End watching; how many cycles ago a contact began, 0 for none."""
        self.kill("contact")
        self.answer(self._contact_steps)

    def _back_to_contact(self) -> Thread:
        """Stop and go back to where the contact began."""
        self._end_move()
        return self._return(self._contact_steps)

    def _force_mode(self) -> None:
        """Give way along chosen axes until pressing with a wrench."""
        selection = tuple([self.integer(2 + axis) == 1 for axis in range(6)])
        task = ForceTask(
            self.pose(), selection, self.doubles(6), self.integer(1), self.doubles(12)
        )
        self._machine.force_mode.begin(task)

    def _end_force_mode(self) -> Thread:
        """End force mode and stop."""
        self._machine.force_mode.end()
        return motion.stopl(self._target, FORCE_MODE_STOP)

    def _set_force_mode(self, name: str, most: float) -> None:
        """Set a figure of force mode."""
        value = self.double(0)
        if not 0.0 <= value <= most:
            raise ScriptError(f"force_mode_set_{name}: {value:g}; accepted is 0 to {most:g}")
        setattr(self._machine.force_mode, name, value)

    def _set_payload(self, inertia: Numbers) -> None:
        """Set mass and centre of gravity of what the flange carries."""
        mass, cog = self.double(0), self.vector(1)
        if not mass >= 0.0:
            raise ScriptError(f"set_payload: mass {mass:g}; accepted is 0 kg or above")
        if not any(cog):  # the client's program keeps the centre of gravity then
            cog = self._machine.payload.cog_m
        self._machine.payload = ToolPayload(mass, cog, inertia)

    def _set_tcp(self) -> None:
        """Set the TCP in the flange."""
        self._target.tcp = self.pose()

    def _set_gravity(self) -> None:
        """Set the direction of gravity."""
        # the script's vector points against the fall: (0, 0, 9.82) for an arm on the floor
        x, y, z = self.vector(0)
        self._machine.gravity_m_s2 = (-x, -y, -z)

    def _protective_stop(self) -> None:
        """Ask for a protective stop."""
        raise ProtectiveStop("asked for by the program")

    def _set_watchdog(self) -> None:
        """End the program where the command register is refreshed too seldom."""
        frequency = self.double(0)
        if not frequency > 0.0:
            raise ScriptError(f"rtde_set_watchdog: frequency {frequency:g}; accepted is above 0 Hz")
        self.watchdog_s = 1.0 / frequency

    def _external_sensor(self) -> None:
        """Use the wrench that the client sends, or the built-in sensor again."""
        if self.integer(1) == 1:
            place_m = self.vector(1)
            self._machine.external = ToolPayload(self.double(0), self.vector(4)), place_m
        else:
            self._machine.external = None

    def _all_commands(self) -> dict[int, Command]:
        """What the client's program does, by the number of the command."""
        machine, target = self._machine, self._target
        pose, double, doubles, ended = self.pose, self.double, self.doubles, self._ended

        def one(answer: Callable[[], int]) -> Callable[[], None]:
            return lambda: self.answer(answer())

        def many(answer: Callable[[], Iterable[float]]) -> Callable[[], None]:
            return lambda: self.answer_doubles(answer())

        return {
            1: lambda: self._move(motion.movej, doubles()),
            2: lambda: self._move(motion.movej, machine.solved(pose())),
            3: lambda: self._move(motion.movel, pose()),
            4: lambda: self._move(motion.movel, Posture(doubles()).tool(target.tcp)),
            6: self._force_mode,
            7: self._end_force_mode,
            8: machine.zero_sensor,
            9: lambda: self._speed(motion.speedj),
            10: lambda: self._speed(motion.speedl),
            11: lambda: self._servo(doubles()),
            15: lambda: ended("speed", double(0), linear=self._asked["speed"][0] is motion.speedl),
            16: lambda: ended("servo", double(0)),
            17: lambda: self._set_payload(machine.payload.inertia_kg_m2),
            20: partial(self._set_force_mode, "damping", 1.0),
            21: partial(self._set_force_mode, "gain_scaling", 2.0),
            # each pose is taken as the joint angles nearest to the actual ones
            24: lambda: self._servo(machine.solved(pose())),
            25: one(lambda: machine.contact_steps(self.vector(0))),
            26: many(lambda: [CYCLE_S]),
            27: many(lambda: machine.past_joints(self.integer(1))),
            29: self._set_tcp,
            # exact, whatever error is allowed
            30: many(lambda: machine.solved(pose(), doubles(6))),
            31: self._protective_stop,
            33: self._stop,
            34: self._stop,
            35: self._set_watchdog,
            36: one(lambda: machine.within_limits(machine.solve(pose()))),
            37: one(lambda: machine.within_limits(doubles())),
            # those of outer forces alone: weight and friction of the arm are taken off
            38: many(lambda: machine.outer_torque),
            39: many(lambda: pose_from_transform(product(pose(), pose(6)))),
            40: many(lambda: pose_from_transform(target.tcp)),
            41: self._jog,
            42: lambda: ended("jog", JOG_STOP),
            43: many(lambda: machine.tcp_pose),
            44: many(lambda: pose_from_transform(Posture(doubles()).tool(pose(6)))),
            46: many(lambda: machine.solved(pose())),
            47: one(lambda: machine.steady),
            51: self._move_until_contact,
            56: self._external_sensor,
            57: self._external_sensor,
            58: many(lambda: pose_from_transform(machine.posture.flange)),
            59: self._set_gravity,
            60: one(lambda: machine.solve(pose()) is not None),
            61: one(lambda: machine.solve(pose()) is not None),
            62: self._start_contact,
            63: self._stop_contact,
            # how many cycles before it was found a contact began, 0 for none
            64: one(lambda: self._contact_steps),
            65: lambda: self._set_payload(doubles(4)),
            CONTACT_FOUND: self._back_to_contact,
        }
