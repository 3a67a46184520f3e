# SPDX-License-Identifier: Apache-2.0
"""The two devices that contact control needs: an arm and a force sensor.

`drivers/` keeps these contracts on real protocols and in real time, `simulation/` in lockstep virtual
time. The times of their samples are of the monotonic clock, or of the simulation's. What an arm's
configuration allows of a command is checked here for every driver.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Protocol

from tactile_resonance.clock import Clock
from tactile_resonance.contact.payload import Mounting
from tactile_resonance.contact.samples import ArmSample, CellSample, Pose
from tactile_resonance.contact.vectors import Six, six
from tactile_resonance.fields import Checked, Range


@dataclass(frozen=True, kw_only=True)
class CommandLimits(Checked):
    """What the configuration of every arm allows of a command; faster ones are refused.

    Attributes
    ----------
    max_speed_m_s, max_turn_rad_s : float
        Of the tip [m/s], [rad/s].
    max_acceleration_m_s2 : float
        Of a command or a stop [m/s2].
    """

    max_speed_m_s: Annotated[float, Range(1e-4, 1.5)] = 0.25
    max_turn_rad_s: Annotated[float, Range(1e-4, math.pi)] = 1.0
    max_acceleration_m_s2: Annotated[float, Range(1e-3, 20.0)] = 2.0


def checked_twist(twist: Sequence[float], limits: CommandLimits) -> Six:
    """Return a twist [m/s, rad/s] as floats; ``ValueError`` where it is not finite or beyond a limit."""
    if len(twist) != 6 or not math.isfinite(sum(twist)):
        raise ValueError(f"twist: {tuple(twist)}, expected 6 finite numbers")
    values = six(twist)
    speed, turn = math.hypot(*values[:3]), math.hypot(*values[3:])
    if speed > limits.max_speed_m_s:
        raise ValueError(f"speed: {speed:g}, the configuration allows {limits.max_speed_m_s:g}")
    if turn > limits.max_turn_rad_s:
        raise ValueError(f"turn: {turn:g}, the configuration allows {limits.max_turn_rad_s:g}")
    return values


def check_acceleration(value: float, limits: CommandLimits) -> None:
    """Raise ``ValueError`` where an acceleration [m/s2] is not above 0 or beyond the limit."""
    if not 0 < value <= limits.max_acceleration_m_s2:
        raise ValueError(
            f"acceleration: {value:g}, the configuration allows above 0 to "
            f"{limits.max_acceleration_m_s2:g}"
        )


class ForceFault(str, Enum):
    """Why a force source cannot be relied on."""

    SILENT = "silent"
    STUCK = "stuck"
    INVALID = "invalid"  # a value that is not finite or outside of the sensor's range
    JUMP = "jump"  # a step that no contact makes: bias, sign
    OVERLOAD = "overload"
    INCOMPLETE = "incomplete"  # frames of a wrench lost more often than tolerated
    LINK_LOST = "link_lost"
    REFUSED = "refused"  # the sensor answers a command with an error


class ArmFault(str, Enum):
    """Why an arm cannot be relied on."""

    LINK_LOST = "link_lost"
    STALE = "stale"  # the robot's time stamp is too old
    PROTECTIVE_STOP = "protective_stop"
    EMERGENCY_STOP = "emergency_stop"
    PROGRAM_STOPPED = "program_stopped"
    NOT_REMOTE = "not_remote"
    REGISTERS_IN_USE = "registers_in_use"
    PROGRAM_NOT_STARTED = "program_not_started"
    COMMAND_REFUSED = "command_refused"
    CLIENT_DIED = "client_died"
    INVALID = "invalid"  # a state without a time stamp, of another clock or frame
    LATE = "late"  # commands came too seldom
    NOT_FOLLOWED = "not_followed"  # the tip does not move as commanded


class ForceError(Exception):
    """A force source failed.

    Attributes
    ----------
    fault : ForceFault
    """

    def __init__(self, fault: ForceFault, message: str) -> None:
        super().__init__(f"force: {message}")
        self.fault = fault


class ArmError(Exception):
    """An arm failed.

    Attributes
    ----------
    fault : ArmFault
    """

    def __init__(self, fault: ArmFault, message: str) -> None:
        super().__init__(f"arm: {message}")
        self.fault = fault


@dataclass(frozen=True)
class ForceInfo:
    """What a force source can do; figures of one axis of force.

    Attributes
    ----------
    name : str
    rate_hz : float
    noise_rms_n, resolution_n, range_n : float
        Noise of one sample, smallest step, largest force [N].
    """

    name: str
    rate_hz: float
    noise_rms_n: float
    resolution_n: float
    range_n: float


class Cell(Protocol):
    """A force sensor: a stream of wrenches in its own frame."""

    @property
    def info(self) -> ForceInfo:
        """What it can do."""
        ...

    @property
    def mounting(self) -> Mounting:
        """Where it sits and what it carries: of these follow the wrenches at the tip."""
        ...

    def start(self) -> None:
        """Connect and stream, also after a fault has ended. Raises `ForceError`."""
        ...

    def read(self) -> list[CellSample]:
        """Wrenches since the last call, oldest first, without waiting.

        Empty where none came; raises `ForceError` where the source is found faulty. After the fault
        has ended a call to `start` brings it back.
        """
        ...

    def close(self) -> None:
        """Disconnect; never raises."""
        ...


class Arm(Protocol):
    """A six-axis arm that carries the tip. Poses and twists are in the robot's base."""

    def connect(self) -> None:
        """Connect and be ready to move; also after a fault has ended. Raises `ArmError`."""
        ...

    def state(self) -> ArmSample:
        """Newest state, without waiting. Raises `ArmError` where the link is dead or the state old."""
        ...

    def speed(self, twist: Six, acceleration_m_s2: float) -> None:
        """Move the tip with a twist [m/s, rad/s] until the next command, without waiting."""
        ...

    def stop(self, deceleration_m_s2: float) -> None:
        """Stop; works at any time and raises only where the link is dead."""
        ...

    def close(self) -> None:
        """Stop and disconnect; never raises."""
        ...


class LoopClock(Clock, Protocol):
    """Simulated time that a control loop leads: after a wait, what the devices sent until then is here."""

    def ask_ns(self) -> int:
        """Time now [ns], also where it has gone on without the loop; here the loop alone moves it."""
        return self.now_ns()

    def hurry(self) -> None:
        """Make a wait that does not demand time demand it. From any thread."""
        ...

    def close(self) -> None:
        """Lead no more."""
        ...


class NodeArm(Arm, Protocol):
    """An arm as contact_node drives it."""

    @property
    def config(self) -> CommandLimits:
        """What it allows."""
        ...

    @property
    def clock(self) -> Clock:
        """Clock on which its states are dated."""
        ...

    @property
    def tip_in_tool(self) -> Pose:
        """Frame `tip` in that of the robot's tool."""
        ...

    @property
    def waits_for(self) -> str:
        """What holds simulated time up, for people; empty: nothing."""
        ...

    def recent(self) -> ArmSample:
        """As `state`, for calls after it in the same period."""
        ...

    def led_clock(self, cell: Cell, while_waiting: Callable[[], None]) -> LoopClock | None:
        """Simulated time, led from now on by the loop that asks for it; None on the wall clock.

        `while_waiting` is called every tenth of a second of this machine's time while simulated time
        stands; what it raises ends the wait.
        """
        ...
