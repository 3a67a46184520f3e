# SPDX-License-Identifier: Apache-2.0
"""An arm that is commanded by twists: its configuration, read from YAML and checked, and its motion.

From the poses of the tool follow the velocity of the tip, and whether it follows what was commanded.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np

from tactile_resonance.contact.interfaces import CommandLimits
from tactile_resonance.contact.samples import PoseOfSix
from tactile_resonance.contact.vectors import (
    ZERO,
    Six,
    Turn,
    Vector,
    difference,
    scaled,
    transposed,
    turn_product,
    vector_from_turn,
)
from tactile_resonance.fields import Range, require

TOPIC = r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*"
"""As in ROS 2, without substitutions (https://design.ros2.org/articles/topic_and_service_names.html)."""


@dataclass(frozen=True)
class TwistConfig(CommandLimits):
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
    lockstep : bool
        Time is that of a simulated controller: each of its steps is answered by one command.
    """

    kind: Literal["twist"]
    command_topic: str
    pose_topic: str
    tip_in_tool: PoseOfSix
    rate_hz: Annotated[float, Range(25.0, 1000.0)] = 500.0
    max_state_age_s: Annotated[float, Range(0.002, 0.2)] = 0.020
    max_command_gap_s: Annotated[float, Range(0.004, 0.5)] = 0.040
    follow_s: Annotated[float, Range(0.005, 0.5)] = 0.100
    follow_m: Annotated[float, Range(1e-4, 0.01)] = 1e-3
    lockstep: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("command_topic", "pose_topic"):
            value = getattr(self, name)
            good = re.fullmatch(TOPIC, value) is not None
            require(good, name, value, "the name of a topic: letters, digits, _ and single /")
        accepted = "another topic than command_topic"
        require(self.pose_topic != self.command_topic, "pose_topic", self.pose_topic, accepted)
        least = 1 / self.rate_hz
        for name in ("max_state_age_s", "max_command_gap_s", "follow_s"):
            value = getattr(self, name)
            require(value > least, name, value, f"above 1/rate_hz = {least:g}")
        offset = self.tip_in_tool.vector
        require(bool(np.all(abs(offset) < 10)), "tip_in_tool", offset.tolist(), "within +-10")


REST: Six = (*ZERO, *ZERO)
VELOCITY_OVER_NS = 7_000_000
"""A velocity is the difference of two poses at least so far apart [ns]."""
FOLLOWED_NS = 1_000_000_000
"""Over so long the way of the tip is compared with what was commanded [ns]."""


class ToolPose(NamedTuple):
    """One pose of the tool, and the tip that it carries."""

    time_ns: int
    tool_m: Vector
    tip_m: Vector
    turn: Turn  # of the tip


class _Way(NamedTuple):
    """Where the tip has been and should have been, at one cycle."""

    time_ns: int
    tip_m: Vector
    commanded_m: Vector
    path_m: float  # length of the commanded way
    slack_m: float  # what of it was commanded within `follow_s`


class Following:
    """Whether the tip is where it was commanded to be within `follow_s`, give or take `follow_m`."""

    def __init__(self, config: TwistConfig) -> None:
        self._config = config
        self.forget()

    def forget(self) -> None:
        """Compare only what comes from now on."""
        self._ways: deque[_Way] = deque()
        self._lag_from = 0  # the oldest of `follow_s`
        self._commanded_m_s = ZERO  # since the last cycle

    def contradiction(self, now_ns: int, tip_m: Vector, commanded_m_s: Vector) -> str:
        """What the place of the tip contradicts, as a sentence; empty where it follows.

        Parameters
        ----------
        now_ns : int
        tip_m : (3,) tuple
        commanded_m_s : (3,) tuple
            Velocity that holds from now on.
        """
        velocity, self._commanded_m_s = self._commanded_m_s, commanded_m_s
        if not self._ways:
            self._ways.append(_Way(now_ns, tip_m, ZERO, 0.0, 0.0))
            return ""
        last = self._ways[-1]
        step_s = (now_ns - last.time_ns) * 1e-9
        if step_s <= 0:
            return ""
        x, y, z = scaled(step_s, velocity)
        a, b, c = last.commanded_m
        path_m = last.path_m + math.hypot(x, y, z)
        oldest_ns = now_ns - 1e9 * self._config.follow_s
        ways = self._ways
        while ways[self._lag_from].time_ns < oldest_ns and self._lag_from < len(ways) - 1:
            self._lag_from += 1
        slack_m = path_m - ways[self._lag_from].path_m
        newest = _Way(now_ns, tip_m, (a + x, b + y, c + z), path_m, slack_m)
        ways.append(newest)
        while ways[1].time_ns < now_ns - FOLLOWED_NS:
            ways.popleft()
            self._lag_from -= 1
        first = ways[0]
        gone_m = difference(tip_m, first.tip_m)
        off_m = math.dist(gone_m, difference(newest.commanded_m, first.commanded_m))
        allowed_m = self._config.follow_m + slack_m + first.slack_m
        if off_m <= allowed_m:
            return ""
        return (
            f"the tip is {1e3 * off_m:.2f} mm from where it was commanded to be, accepted are "
            f"{1e3 * allowed_m:.2f} mm: is the controller active, and the only one?"
        )


def velocity_of(tools: Sequence[ToolPose]) -> Six:
    """Velocity and angular velocity of the tip, from the newest pose and one far enough before it."""
    newest = tools[-1]
    before = newest
    for before in reversed(tools):
        if newest.time_ns - before.time_ns >= VELOCITY_OVER_NS:
            break
    seconds = (newest.time_ns - before.time_ns) * 1e-9
    if seconds <= 0:
        return REST
    x, y, z = scaled(1 / seconds, difference(newest.tip_m, before.tip_m))
    turned = vector_from_turn(turn_product(newest.turn, transposed(before.turn)))
    return x, y, z, *scaled(1 / seconds, turned)
