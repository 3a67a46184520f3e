# SPDX-License-Identifier: Apache-2.0
"""`UrArm`: a Universal Robots arm behind the contract of `contact.interfaces.Arm`, over ur_rtde."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.contact.samples import ArmSample, Pose
from tactile_resonance.contact.vectors import six, vector
from tactile_resonance.drivers.ur_client_process import ClientProcess
from tactile_resonance.drivers.ur_config import UrArmConfig
from tactile_resonance.drivers.ur_exchange import ClientState
from tactile_resonance.drivers.ur_safety import motion_fault, stop_fault

# An answer to a command takes a few cycles of the robot; longer, and the library hangs.
ANSWER_S = 1.0


class UrArm:
    """An arm whose client library runs in a process of its own.

    A hang or an abort of the library ends that process and is reported here; the process ends with this
    one. Whether the link is alive is judged by the age of the robot's time stamp and by the library's
    ``isConnected`` together: after a loss each alone may look well.

    While the arm moves, some method must be called at least every `UrArmConfig.owner_timeout_s`:
    otherwise the robot's watchdog is no longer fed and stops it.

    Parameters
    ----------
    config : UrArmConfig
    """

    def __init__(self, config: UrArmConfig) -> None:
        self.config = config
        self._client: ClientProcess | None = None
        self._number = 0
        self._sent: dict[int, tuple[str, float]] = {}  # name and time [s] of what has no answer yet
        self._refused = 0
        self._move = 0

    @property
    def clock_uncertainty_s(self) -> float:
        """Standard deviation of `ArmSample.time_ns` against this machine's clock [s]."""
        return self._fresh().clock_std_s

    @property
    def rate_hz(self) -> float:
        """States received in the last second."""
        return self._fresh().rate_hz

    @property
    def client_pid(self) -> int | None:
        """Of the client's process; None while there is none."""
        return None if self._client is None else self._client.pid

    def connect(self) -> None:
        """Connect, set TCP and payload, start the control program and its watchdog.

        After a stop that was released at the robot, the program is started again over the same
        connection; after anything else the client process is replaced.

        Raises
        ------
        ArmError
            LINK_LOST, NOT_REMOTE, REGISTERS_IN_USE, PROGRAM_NOT_STARTED, PROTECTIVE_STOP,
            EMERGENCY_STOP, PROGRAM_STOPPED (not powered), COMMAND_REFUSED, CLIENT_DIED.
        """
        if self._client is not None:
            try:
                state = self._fresh()
            except ArmError:
                self.close()
            else:
                if motion_fault(state.safety_bits, state.robot_mode, state.runtime_state) is None:
                    self._forget_commands()
                    return
                stop = stop_fault(state.safety_bits, state.robot_mode)
                if stop is not None:  # not released yet; the connection is good
                    raise ArmError(*stop)
                self._ask({"name": "restart"})
                self._forget_commands()
                return
        self._client = ClientProcess(self.config)
        self._ask({"name": "connect", "config": self.config.to_dict()})
        self._forget_commands()

    def state(self) -> ArmSample:
        """Newest state, without waiting.

        Raises
        ------
        ArmError
            LINK_LOST, STALE, CLIENT_DIED; COMMAND_REFUSED once for each command that the robot
            refused, or where the client does not answer.
        """
        client = self._fresh()
        self._check_commands(client)
        fault = motion_fault(client.safety_bits, client.robot_mode, client.runtime_state)
        # the wall clock may be set; how long ago the state held is known by the monotonic one
        age_ns = time.monotonic_ns() - client.state_ns
        return ArmSample(
            time_ns=time.time_ns() - age_ns,
            robot_time_s=client.robot_time_s,
            position_m=vector(client.tip_pose[:3]),
            rotation_rad=vector(client.tip_pose[3:]),
            velocity=six(client.tip_speed),
            moving_allowed=fault is None,
            message="" if fault is None else fault[1],
            tool_wrench=six(client.tip_force),
        )

    def speed(self, twist: NDArray[np.float64], acceleration_m_s2: float) -> None:
        """Move the tip with a twist (6,) in the base [m/s, rad/s] until the next command.

        Raises
        ------
        ArmError
            As `state`; also PROTECTIVE_STOP, EMERGENCY_STOP, PROGRAM_STOPPED where the arm cannot move.
        ValueError
            Where a figure is beyond the limits of the configuration; nothing is sent then.
        """
        twist = np.asarray(twist, dtype=float)
        if twist.shape != (6,) or not np.all(np.isfinite(twist)):
            raise ValueError(f"twist: {twist}, expected 6 finite numbers")
        for name, value, most in (
            ("speed", float(np.linalg.norm(twist[:3])), self.config.max_speed_m_s),
            ("turn", float(np.linalg.norm(twist[3:])), self.config.max_turn_rad_s),
        ):
            if value > most:
                raise ValueError(f"{name}: {value:g}, the configuration allows {most:g}")
        self._check_acceleration(acceleration_m_s2)
        self._command("speed", [twist.tolist(), float(acceleration_m_s2)])

    def move(self, pose: Pose, speed_m_s: float, acceleration_m_s2: float) -> None:
        """Begin a straight move of the tip to a pose in the base. Raises as `speed`."""
        vector = pose.vector
        if not np.all(np.isfinite(vector)):
            raise ValueError(f"pose: {vector}, expected 6 finite numbers")
        if not 0 < speed_m_s <= self.config.max_speed_m_s:
            raise ValueError(
                f"speed: {speed_m_s:g}, the configuration allows {self.config.max_speed_m_s:g}"
            )
        self._check_acceleration(acceleration_m_s2)
        self._move = self._command(
            "move", [vector.tolist(), float(speed_m_s), float(acceleration_m_s2)]
        )

    def moving(self) -> bool:
        """Whether the last `move` is still under way. Raises as `state`."""
        client = self._fresh()
        self._check_commands(client)
        return client.moving or client.done < self._move

    def stop(self, deceleration_m_s2: float) -> None:
        """Stop; works at any time and raises only where the link is dead, or for a wrong figure.

        Where states are stale the client still takes it, and tells the robot as soon as it may.
        """
        self._check_acceleration(deceleration_m_s2)
        try:
            self._fresh()
        except ArmError as error:
            if error.fault is not ArmFault.STALE:
                raise
        self._send("stop", [float(deceleration_m_s2)])

    def close(self) -> None:
        """Stop the arm and its program and end the client; never raises."""
        if self._client is not None:
            self._client.end()
            self._client = None

    def _ask(self, request: dict) -> None:
        assert self._client is not None
        try:
            self._client.ask(request)
        except ArmError:  # it has ended
            self._client = None
            raise

    def _command(self, name: str, values: list) -> int:
        client = self._fresh()
        self._check_commands(client)
        fault = motion_fault(client.safety_bits, client.robot_mode, client.runtime_state)
        if fault is not None:
            raise ArmError(*fault)
        return self._send(name, values)

    def _send(self, name: str, values: list) -> int:
        assert self._client is not None
        self._number += 1
        self._client.send({"name": name, "number": self._number, "values": values})
        self._sent[self._number] = (name, time.monotonic())
        return self._number

    def _fresh(self) -> ClientState:
        """Return the newest state, and show the client that its owner lives."""
        if self._client is None:
            raise ArmError(ArmFault.LINK_LOST, "not connected")
        client = self._client.state()
        if client is None or not client.connected:
            raise ArmError(ArmFault.LINK_LOST, f"the connection to {self.config.host} is lost")
        age_s = (time.monotonic_ns() - min(client.state_ns, client.received_ns)) * 1e-9
        if age_s > self.config.max_state_age_s:
            raise ArmError(
                ArmFault.STALE,
                f"the newest state of {self.config.host} is {age_s * 1e3:.0f} ms old, accepted are "
                f"{self.config.max_state_age_s * 1e3:.0f} ms",
            )
        return client

    def _check_commands(self, client: ClientState) -> None:
        sent = self._sent
        self._sent = {number: each for number, each in sent.items() if number > client.done}
        if client.refused > self._refused:
            self._refused = client.refused
            if (
                motion_fault(client.safety_bits, client.robot_mode, client.runtime_state)
                is not None
            ):
                return  # a stop is why; the state tells it
            name = sent[client.refused][0] if client.refused in sent else "an earlier command"
            said = "" if self._client is None else self._client.last_error()
            raise ArmError(ArmFault.COMMAND_REFUSED, f"the robot refused: {name}. {said}")
        for name, sent_s in self._sent.values():
            if time.monotonic() - sent_s > ANSWER_S:
                raise ArmError(
                    ArmFault.COMMAND_REFUSED, f"no answer to {name} after {ANSWER_S:g} s"
                )

    def _forget_commands(self) -> None:
        self._sent.clear()
        self._refused, self._move = self._number, 0
        if self._client is not None:
            self._client.beat()

    def _check_acceleration(self, value: float) -> None:
        if not 0 < value <= self.config.max_acceleration_m_s2:
            raise ValueError(
                f"acceleration: {value:g}, the configuration allows above 0 to "
                f"{self.config.max_acceleration_m_s2:g}"
            )
