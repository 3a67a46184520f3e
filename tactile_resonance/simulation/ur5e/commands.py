# SPDX-License-Identifier: Apache-2.0
"""Commands of the RTDE client: those that move the arm, and those that set or ask something."""

from __future__ import annotations

from collections.abc import Callable

from tactile_resonance.contact.vectors import NO_TURN, Vector, rotated
from tactile_resonance.simulation.ur5e import motion
from tactile_resonance.simulation.ur5e.forces import ForceTask, ToolPayload
from tactile_resonance.simulation.ur5e.kinematics import Posture
from tactile_resonance.simulation.ur5e.machine import ExternalSensor, Machine
from tactile_resonance.simulation.ur5e.poses import (
    ZERO,
    Six,
    Transform,
    pose_from_transform,
    product,
    transform_from_pose,
)
from tactile_resonance.simulation.ur5e.registers import Script, Thread
from tactile_resonance.simulation.ur5e.target import CYCLE_S, ProtectiveStop, ScriptError, Target

SpeedMotion = Callable[[Target, Six, float, float], Thread]

# Set by the contact thread for the main loop: go back to where the contact began.
CONTACT_FOUND = 254
# Deceleration [m/s^2] of the stop after a contact.
CONTACT_STOP = 3.0
# Defaults of URScript's movel: acceleration [m/s^2] and speed [m/s].
MOVE_ACCELERATION, MOVE_SPEED = 1.2, 0.25


class MotionCommands:
    """Handlers of the commands that move the arm; a generator where moving takes time."""

    def __init__(self, script: Script, machine: Machine) -> None:
        self._script = script
        self._machine = machine
        self._target = machine.target
        # linear or in the joints; the client's program sets this by asynchronous stops alone
        self._stop_linear = False
        self._speed: tuple[SpeedMotion, Six, float, float] = (motion.speedl, ZERO, 0.5, 0.5)
        self._servo: tuple[Six, float, float] = (self._target.q, CYCLE_S, 0.1)
        self._jog_twist = ZERO
        self._contact_steps = 0

    def movej(self) -> Thread:
        """Move to joint angles, asynchronously where integer 1 says so."""
        return self._movej(self._script.doubles(0))

    def movej_pose(self) -> Thread:
        """Move the joints to where the TCP has a pose."""
        return self._movej(self._machine.solved(transform_from_pose(self._script.doubles(0))))

    def movel(self) -> Thread:
        """Move straight to a pose."""
        return self._movel(transform_from_pose(self._script.doubles(0)))

    def movel_joints(self) -> Thread:
        """Move straight to the pose of joint angles."""
        return self._movel(Posture(self._script.doubles(0)).tool(self._target.tcp))

    def _movej(self, goal: Six) -> Thread:
        speed, acceleration = self._script.double(6), self._script.double(7)
        return self._move(motion.movej(self._target, goal, acceleration, speed))

    def _movel(self, goal: Transform) -> Thread:
        speed, acceleration = self._script.double(6), self._script.double(7)
        return self._move(motion.movel(self._target, goal, acceleration, speed))

    def _move(self, move: Thread) -> Thread:
        self._stop_asynchronous_move()
        if self._script.integer(1) == 1:
            self._script.run("move", self._told(move))
        else:
            yield from move

    def _told(self, work: Thread) -> Thread:
        """Run a motion as an asynchronous operation, and report its begin and end to the client."""
        self._script.begin_asynchronous()
        yield from work
        self._script.end_asynchronous()

    def _stop_asynchronous_move(self) -> None:
        if self._script.kill("move"):
            self._script.end_asynchronous()

    def stop(self) -> Thread:
        """Stop, asynchronously where integer 1 says so."""
        script = self._script
        if script.kill("stop"):
            script.end_asynchronous()
        else:
            self._stop_asynchronous_move()
        asynchronous = script.integer(1) == 1
        if asynchronous:
            self._stop_linear = True
        stop = motion.stopl if self._stop_linear else motion.stopj
        work = stop(self._target, script.double(0))
        if asynchronous:
            script.run("stop", self._told(work))
        else:
            yield from work

    def speedl(self) -> None:
        """Move the TCP with a twist until the next command."""
        self._speed_to(motion.speedl)

    def speedj(self) -> None:
        """Move the joints with speeds until the next command."""
        self._speed_to(motion.speedj)

    def _speed_to(self, run: SpeedMotion) -> None:
        script = self._script
        self._speed = (run, script.doubles(0), script.double(6), script.double(7))
        if "speed" not in script.threads:
            script.run("speed", self._speeding())

    def _speeding(self) -> Thread:
        # A new speed is taken up when the time of the last one is over, not before.
        while True:
            run, speed, acceleration, time_s = self._speed
            yield from run(self._target, speed, acceleration, time_s)

    def speed_stop(self) -> Thread:
        """End a motion with a speed."""
        self._script.kill("speed")
        stop = motion.stopl if self._speed[0] is motion.speedl else motion.stopj
        return stop(self._target, self._script.double(0))

    def servoj(self) -> None:
        """Follow joint angles."""
        self._servo_to(self._script.doubles(0))

    def servol(self) -> None:
        """Follow poses, each taken as the joint angles nearest to the actual ones."""
        self._servo_to(self._machine.solved(transform_from_pose(self._script.doubles(0))))

    def _servo_to(self, goal: Six) -> None:
        script = self._script
        gain = script.double(10)
        if not 100 <= gain <= 2000:
            raise ScriptError(f"servoj: gain {gain:g}; accepted is 100 to 2000")
        self._servo = (goal, script.double(8), script.double(9))
        if "servo" not in script.threads:
            script.run("servo", self._servoing())

    def _servoing(self) -> Thread:
        while True:
            yield from motion.servoj(self._target, *self._servo)

    def servo_stop(self) -> Thread:
        """End following."""
        self._script.kill("servo")
        return motion.stopl(self._target, self._script.double(0))

    def move_until_contact(self) -> Thread:
        """Move with a twist until the tool touches something, and back to where it did."""
        script = self._script
        speed, direction, acceleration = script.doubles(0), script.vector(6), script.double(12)
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
        self._script.kill("contact")
        self._script.run("contact", self._watching(self._script.vector(0)))

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
        self._script.internal_command = CONTACT_FOUND

    def stop_contact(self) -> None:
        """End watching; how many cycles ago a contact began, 0 for none."""
        self._script.kill("contact")
        self._script.answer(self._contact_steps)

    def read_contact(self) -> None:
        """How many cycles before it was found a contact began, 0 for none."""
        self._script.answer(self._contact_steps)

    def back_to_contact(self) -> Thread:
        """Stop and go back to where the contact began."""
        self._stop_asynchronous_move()
        return self._return(self._contact_steps)

    def start_jog(self) -> None:
        """Move with a twist in the base, the tool or another frame."""
        script = self._script
        axes = [NO_TURN, self._machine.tcp[0], transform_from_pose(script.doubles(8))[0]]
        feature = round(script.double(6))
        if feature not in (0, 1, 2):
            raise ScriptError(f"jog: feature {feature}; accepted are 0 base, 1 tool, 2 custom")
        turn = axes[feature]
        self._jog_twist = (*rotated(turn, script.vector(0)), *rotated(turn, script.vector(3)))
        if "jog" not in script.threads:
            script.run("jog", self._jogging(script.double(7)))

    def _jogging(self, acceleration: float) -> Thread:
        while True:
            yield from motion.speedl(self._target, self._jog_twist, acceleration, 5 * CYCLE_S)

    def stop_jog(self) -> Thread:
        """End jogging."""
        self._script.kill("jog")
        return motion.stopl(self._target, 1.2)


# Deceleration [m/s^2] of the stop that ends force mode.
FORCE_MODE_STOP = 10.0


class SettingCommands:
    """Handlers of the commands that set something or answer."""

    def __init__(self, script: Script, machine: Machine) -> None:
        self._script = script
        self._machine = machine
        self._target = machine.target

    def force_mode(self) -> None:
        """Give way along chosen axes until pressing with a wrench."""
        script = self._script
        selection = tuple([script.integer(2 + axis) == 1 for axis in range(6)])
        task = ForceTask(
            self._pose(), selection, script.doubles(6), script.integer(1), script.doubles(12)
        )
        self._machine.force_mode.begin(task)

    def end_force_mode(self) -> Thread:
        """End force mode and stop."""
        self._machine.force_mode.end()
        return motion.stopl(self._target, FORCE_MODE_STOP)

    def set_damping(self) -> None:
        """Set the damping of force mode."""
        damping = self._script.double(0)
        if not 0.0 <= damping <= 1.0:
            raise ScriptError(f"force_mode_set_damping: {damping:g}; accepted is 0 to 1")
        self._machine.force_mode.damping = damping

    def set_gain(self) -> None:
        """Set the gain scaling of force mode."""
        scaling = self._script.double(0)
        if not 0.0 <= scaling <= 2.0:
            raise ScriptError(f"force_mode_set_gain_scaling: {scaling:g}; accepted is 0 to 2")
        self._machine.force_mode.gain_scaling = scaling

    def set_payload(self) -> None:
        """Set mass and centre of gravity of what the flange carries."""
        self._set_payload(self._machine.payload.inertia_kg_m2)

    def set_target_payload(self) -> None:
        """Set the payload with its inertia."""
        self._set_payload(self._script.doubles(4))

    def _set_payload(self, inertia: Six) -> None:
        mass, cog = self._script.double(0), self._script.vector(1)
        if not mass >= 0.0:
            raise ScriptError(f"set_payload: mass {mass:g}; accepted is 0 kg or above")
        if not any(cog):  # the client's program keeps the centre of gravity then
            cog = self._machine.payload.cog_m
        self._machine.payload = ToolPayload(mass, cog, inertia)

    def set_tcp(self) -> None:
        """Set the TCP in the flange."""
        self._target.tcp = self._pose()

    def set_gravity(self) -> None:
        """Set the direction of gravity."""
        # the script's vector points against the fall: (0, 0, 9.82) for an arm on the floor
        x, y, z = self._script.vector(0)
        self._machine.gravity_m_s2 = (-x, -y, -z)

    def tool_contact(self) -> None:
        """How many cycles ago a contact began, 0 without contact."""
        self._script.answer(self._machine.contact_steps(self._script.vector(0)))

    def step_time(self) -> None:
        """The control period."""
        self._script.answer_doubles([CYCLE_S])

    def past_joints(self) -> None:
        """Joint angles of some cycles ago."""
        steps = self._script.integer(1)
        self._script.answer_doubles(self._machine.past_joints(steps))

    def joint_torques(self) -> None:
        """Torques of the joints against outer forces."""
        # those of outer forces alone: weight and friction of the arm are taken off
        self._script.answer_doubles(self._machine.outer_torque)

    def flange_pose(self) -> None:
        """Actual pose of the flange."""
        self._script.answer_doubles(pose_from_transform(self._machine.posture.flange))

    def tcp_offset(self) -> None:
        """Pose of the TCP in the flange."""
        self._script.answer_doubles(pose_from_transform(self._target.tcp))

    def pose_trans(self) -> None:
        """Product of two poses."""
        second = transform_from_pose(self._script.doubles(6))
        self._script.answer_doubles(pose_from_transform(product(self._pose(), second)))

    def actual_forward(self) -> None:
        """Actual pose of the TCP."""
        self._script.answer_doubles(self._machine.tcp_pose)

    def forward(self) -> None:
        """Pose of a TCP at joint angles."""
        script = self._script
        tool = Posture(script.doubles(0)).tool(transform_from_pose(script.doubles(6)))
        script.answer_doubles(pose_from_transform(tool))

    def inverse(self) -> None:
        """Joint angles for a pose, nearest to the actual ones."""
        self._script.answer_doubles(self._machine.solved(self._pose()))

    def inverse_near(self) -> None:
        """Joint angles for a pose, nearest to given ones; exact, whatever error is allowed."""
        self._script.answer_doubles(self._machine.solved(self._pose(), self._script.doubles(6)))

    def has_inverse(self) -> None:
        """Whether a pose can be reached."""
        self._script.answer(int(self._machine.solve(self._pose()) is not None))

    def _pose(self) -> Transform:
        return transform_from_pose(self._script.doubles(0))

    def pose_within_limits(self) -> None:
        """Whether a pose is reachable within the limits of the joints."""
        q = self._machine.solve(self._pose())
        self._script.answer(int(self._machine.within_limits(q)))

    def joints_within_limits(self) -> None:
        """Whether joint angles are within their limits."""
        self._script.answer(int(self._machine.within_limits(self._script.doubles(0))))

    def steady(self) -> None:
        """Whether the arm has been at rest for half a second."""
        self._script.answer(int(self._machine.steady))

    def protective_stop(self) -> None:
        """Ask for a protective stop."""
        raise ProtectiveStop("asked for by the program")

    def set_watchdog(self) -> None:
        """End the program where the command register is refreshed too seldom."""
        frequency = self._script.double(0)
        if not frequency > 0.0:
            raise ScriptError(f"rtde_set_watchdog: frequency {frequency:g}; accepted is above 0 Hz")
        self._script.watchdog_s = 1.0 / frequency

    def external_sensor(self) -> None:
        """Use the wrench that the client sends, or the built-in sensor again."""
        script = self._script
        if script.integer(1) == 1:
            self._machine.external = ExternalSensor(
                script.double(0), script.vector(1), script.vector(4)
            )
        else:
            self._machine.external = None
