# SPDX-License-Identifier: Apache-2.0
"""Which controller moves the tip by twists, and how it may be used: read from YAML and checked."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from tactile_resonance.contact.samples import PoseOfSix
from tactile_resonance.fields import check_within, read_file, require

TOPIC = r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*"
"""As in ROS 2, without substitutions (https://design.ros2.org/articles/topic_and_service_names.html)."""

RANGES: dict[str, tuple[float, float]] = {
    "rate_hz": (25.0, 1000.0),
    "max_state_age_s": (0.002, 0.2),
    "max_command_gap_s": (0.004, 0.5),
    "follow_s": (0.005, 0.5),
    "follow_m": (1e-4, 0.01),
    "max_speed_m_s": (1e-4, 1.5),
    "max_turn_rad_s": (1e-4, math.pi),
    "max_acceleration_m_s2": (1e-3, 20.0),
}
"""Accepted range of each number of `TwistConfig`, ends included."""


@dataclass(frozen=True)
class TwistConfig:
    """What `TwistArm` needs to know; see ``config/devices/twist.yaml``.

    Attributes
    ----------
    kind : str
        Distinguishes the file from those of other arms.
    command_topic, pose_topic : str
        geometry_msgs/TwistStamped to the controller, geometry_msgs/PoseStamped of the tool.
    tip_in_tool : Pose, in files six numbers
        Frame `tip` in the frame whose poses come.
    rate_hz : float
        Of the poses.
    max_state_age_s : float
        An older pose is a missed deadline.
    max_command_gap_s : float
        So is a longer time between two commands while the tip moves.
    follow_s, follow_m : float
        The tip is where it was commanded to be within `follow_s`, give or take `follow_m`, over the last
        second.
    max_speed_m_s, max_turn_rad_s, max_acceleration_m_s2 : float
        Faster commands are refused.
    lockstep : bool
        Time is that of a simulated controller: each of its steps is answered by one command.
    """

    kind: Literal["twist"]
    command_topic: str
    pose_topic: str
    tip_in_tool: PoseOfSix
    rate_hz: float = 500.0
    max_state_age_s: float = 0.020
    max_command_gap_s: float = 0.040
    follow_s: float = 0.100
    follow_m: float = 1e-3
    max_speed_m_s: float = 0.25
    max_turn_rad_s: float = 1.0
    max_acceleration_m_s2: float = 2.0
    lockstep: bool = False

    def __post_init__(self) -> None:
        for name in ("command_topic", "pose_topic"):
            value = getattr(self, name)
            good = re.fullmatch(TOPIC, value) is not None
            require(good, name, value, "the name of a topic: letters, digits, _ and single /")
        accepted = "another topic than command_topic"
        require(self.pose_topic != self.command_topic, "pose_topic", self.pose_topic, accepted)
        check_within(self, **RANGES)
        least = 1 / self.rate_hz
        for name in ("max_state_age_s", "max_command_gap_s", "follow_s"):
            value = getattr(self, name)
            require(value > least, name, value, f"above 1/rate_hz = {least:g}")
        offset = self.tip_in_tool.vector
        require(bool(np.all(abs(offset) < 10)), "tip_in_tool", offset.tolist(), "within +-10")


def read_twist_config(path: Path) -> TwistConfig:
    """Read a YAML file.

    Raises
    ------
    ValueError
        Names the field that is unknown, missing or not accepted, its value and what is.
    """
    return read_file(TwistConfig, path)
