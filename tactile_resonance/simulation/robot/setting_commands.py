# SPDX-License-Identifier: Apache-2.0
"""Commands that set or ask something: force mode, tool, sensors, kinematics, limits."""

from __future__ import annotations

from tactile_resonance.simulation.robot import motion
from tactile_resonance.simulation.robot.compliance import ForceTask
from tactile_resonance.simulation.robot.ft_sensor import ToolPayload
from tactile_resonance.simulation.robot.kinematics import Posture
from tactile_resonance.simulation.robot.machine import ExternalSensor, Machine
from tactile_resonance.simulation.robot.poses import (
    Six,
    Transform,
    pose_from_transform,
    product,
    transform_from_pose,
)
from tactile_resonance.simulation.robot.script import Script, Thread
from tactile_resonance.simulation.robot.target import CYCLE_S, ProtectiveStop, ScriptError

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
        self._script.answer_doubles(pose_from_transform(self._machine.tcp))

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
