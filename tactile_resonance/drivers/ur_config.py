# SPDX-License-Identifier: Apache-2.0
"""Which Universal Robots arm carries the tip, and how it may be used: read from YAML and checked."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tactile_resonance.contact.interfaces import CommandLimits
from tactile_resonance.contact.samples import Pose, PoseOfSix
from tactile_resonance.fields import Range, read_file, require


@dataclass(frozen=True)
class UrArmConfig(CommandLimits):
    """What `UrArm` needs to know; see ``config/devices/ur5e.yaml``.

    Attributes
    ----------
    host : str
        Name or address of the robot.
    tip_in_flange : Pose, in files six numbers
        Frame `tip` in the tool flange: what the robot gets as its TCP.
    payload_kg : float or None
        Mass on the flange; None leaves what is set on the pendant.
    payload_cog_m : (3,) tuple
        Its centre of gravity in the flange.
    rate_hz : float
        Of the robot's states; 500 is what an e-series sends.
    watchdog_hz : float
        The robot stops by itself where commands come less often; at least 25, for a simulated robot
        (127.x.y.z) at least 5.
    max_state_age_s : float
        An older state is refused as stale.
    owner_timeout_s : float
        While the arm moves, whoever moves it must call at least this often, else the robot is left to
        its watchdog.
    connect_timeout_s : float
        For the whole of `UrArm.connect`.
    check_dashboard : bool
        Ask the dashboard server for remote control and modes; PolyScope X has none.
    realtime_priority : int
        SCHED_FIFO priority of the client process, 1 to 99; 0: none.
    kind : str
        Distinguishes the file from those of other arms.
    """

    host: str
    tip_in_flange: PoseOfSix = field(default_factory=Pose.at_origin)
    payload_kg: Annotated[float, Range(0.0, 50.0)] | None = None
    payload_cog_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rate_hz: Annotated[float, Range(25.0, 500.0)] = 500.0
    watchdog_hz: float = 25.0
    max_state_age_s: Annotated[float, Range(0.004, 1.0)] = 0.020
    owner_timeout_s: Annotated[float, Range(0.005, 1.0)] = 0.100
    connect_timeout_s: Annotated[float, Range(1.0, 120.0)] = 15.0
    check_dashboard: bool = True
    realtime_priority: Annotated[int, Range(0, 99)] = 0
    kind: Literal["ur"] = "ur"

    def __post_init__(self) -> None:
        super().__post_init__()
        require(bool(self.host), "host", self.host, "a name or an address")
        least = 5.0 if self.simulated else 25.0
        good = least <= self.watchdog_hz <= 125.0
        require(good, "watchdog_hz", self.watchdog_hz, f"{least:g} to 125")
        for name, values in (
            ("payload_cog_m", self.payload_cog_m),
            ("tip_in_flange", self.tip_in_flange.vector.tolist()),
        ):
            require(all(abs(v) < 10 for v in values), name, values, "numbers within +-10")

    @property
    def simulated(self) -> bool:
        """Whether the robot is at an address (127.x.y.z) where no real one is."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:  # a name may be anybody's
            return False


def read_ur_config(path: Path) -> UrArmConfig:
    """Read a YAML file.

    Raises
    ------
    ValueError
        Names file and field.
    """
    return read_file(UrArmConfig, path)
