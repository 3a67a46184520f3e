# SPDX-License-Identifier: Apache-2.0
"""What the parameters of contact_node say: its arm, its force source, its tip, and the controller's figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node

from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.interfaces import Cell, CommandLimits, NodeArm
from tactile_resonance.contact.parameters import (
    STRICTER_ABOVE,
    STRICTER_BELOW,
    ContactParameters,
    Limits,
    Workspace,
    ranges_of,
    read_contact,
)
from tactile_resonance.drivers.force_config import CanForce, force_source, read_force_config
from tactile_resonance.drivers.twist import TwistConfig
from tactile_resonance.drivers.ur_arm import UrArm
from tactile_resonance.drivers.ur_config import UrArmConfig, read_ur_config
from tactile_resonance.fields import numbers, read_file, read_yaml, require
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.parameters import Fixed, Parameter, file_of, values
from tactile_resonance.nodes.topic_wrench import TopicWrench
from tactile_resonance.nodes.twist_arm import TwistArm
from tactile_resonance.processes import take_priority
from tactile_resonance.sensor import read_sensor

_GROUPS = {"contact": ContactParameters, "limits": Limits}
_DEFAULTS = read_contact()
"""Of both groups; read once: in a contact parsing would hold up the control loop."""
_LOW, _HIGH = "limits.workspace.low_m", "limits.workspace.high_m"
_CORNERS = "Opposite corners of the box in which the tip may be, in the base [m]."
# Last parts of the names of what a launch limits.
_AT_MOST, _AT_LEAST = STRICTER_BELOW | {"high_m"}, STRICTER_ABOVE | {"low_m"}


def _of_controller() -> tuple[Parameter, ...]:
    """Those of the controller: each number and corner, with the defaults from ``config/contact.yaml``."""
    made = []
    for (group, kind), defaults in zip(_GROUPS.items(), _DEFAULTS, strict=True):
        for name, (low, high, description) in ranges_of(kind).items():
            full = f"{group}.{name}"
            # that of the loop which runs
            make = Fixed if full == "contact.period_s" else Parameter
            made.append(make(full, getattr(defaults, name), description, low, high))
    box = _DEFAULTS[1].workspace
    corners = ((_LOW, box.low_m), (_HIGH, box.high_m))
    return (*made, *(Parameter(full, list(corner), _CORNERS) for full, corner in corners))


PARAMETERS = (
    Fixed(
        "robot_config",
        "config/devices/ur5e.yaml",
        "The arm: a file, absolute or in the package's share folder; its kind is ur or twist.",
    ),
    Fixed("robot_host", "", "Name or address of the robot; empty: that of robot_config."),
    Fixed(
        "force_config",
        "can_simulated.yaml",
        "The force source: a file of config/force, or an absolute path.",
    ),
    Fixed(
        "force_host",
        "",
        "Address of the socketcand server of a cell on CAN; empty: that of force_config.",
    ),
    Fixed(
        "realtime_priority",
        20,
        "Priority (SCHED_FIFO) of the control loop and of the robot's client, where the system permits it; "
        "0: none.",
        0,
        99,
    ),
    Fixed(
        "simulated_stalls_s",
        0.0,
        "Of a simulated robot (127.x.y.z) that has no real-time priority: so much longer than hardware robot "
        "and cell may be silent [s].",
        0.0,
        0.2,
    ),
    Fixed(
        "sensor_config",
        "config/sensors/bimorph.yaml",
        "The sensor, for the radius of its tip and the length of its beam.",
    ),
    Fixed(
        "beam_tilt_rad",
        0.17,
        "By which the clamp of the beam lies higher than the ball, seen from the surface [rad].",
        0.0,
        1.0,
    ),
    Fixed(
        "housing_below_m",
        0.006,
        "How far the housing reaches below the beam at the clamp [m].",
        0.0,
        0.9,
    ),
    *_of_controller(),
)

SIMULATED_S = 60.0
"""For a connection to a simulated robot in simulated time, by the machine's clock."""


def take_realtime(node: ManagedNode) -> int:
    """Priority that this thread, and those it starts, has from now on; 0 where it is not permitted.

    In simulated time nothing is late, and none is taken.
    """
    (priority,) = values(node, "realtime_priority")
    if node.time_server or not priority:
        return 0
    try:
        take_priority(priority)
    except ValueError:
        node.get_logger().warning(
            f"realtime_priority: {priority} is not permitted here (rtprio limit); on a busy machine the "
            "control loop will be late, and stop"
        )
        return 0
    return priority


def make_arm(node: ManagedNode, priority: int) -> NodeArm:
    """The arm that the parameters name, not connected yet; ValueError where they are wrong."""
    names = ("robot_config", "robot_host", "simulated_stalls_s", "base_frame")
    name, host, stalls_s, base_frame = values(node, *names)
    path = file_of(name)
    kind = read_yaml(path).get("kind", "ur")
    require(kind in ("ur", "twist"), f"{path}: kind", kind, "ur or twist")
    if kind == "ur":
        config = read_ur_config(path)
        return _ur_arm(node, replace(config, host=host or config.host), stalls_s, priority)
    for field, value, accepted in (
        ("robot_host", host, "empty"),
        ("simulated_stalls_s", stalls_s, "0"),
        ("time_server", node.time_server, "empty"),
    ):
        require(not value, field, value, f"{accepted} for an arm of kind twist")
    return TwistArm(node, read_file(TwistConfig, path), base_frame)


def _ur_arm(node: ManagedNode, config: UrArmConfig, stalls_s: float, priority: int) -> UrArm:
    if stalls_s:
        good = config.simulated
        require(good, "simulated_stalls_s", stalls_s, f"0 for the robot at {config.host}")
        config = replace(
            config,
            max_state_age_s=config.max_state_age_s + stalls_s,
            watchdog_hz=1 / (1 / config.watchdog_hz + stalls_s),
        )
    if node.time_server:
        # it costs nothing there, and what a slow machine needs to connect is no fault
        config = replace(config, connect_timeout_s=max(config.connect_timeout_s, SIMULATED_S))
        return UrArm(replace(config, realtime_priority=0), node.time_server)
    return UrArm(replace(config, realtime_priority=config.realtime_priority or priority))


def require_arm_allows(
    config: CommandLimits, parameters: ContactParameters, limits: Limits
) -> None:
    """Raise ``ValueError`` where the arm's driver would refuse what the controller may command."""
    for owner, name, field in (
        (limits, "free_speed_m_s", "max_speed_m_s"),
        (limits, "angular_speed_rad_s", "max_turn_rad_s"),
        (limits, "stop_deceleration_m_s2", "max_acceleration_m_s2"),
        (parameters, "acceleration_m_s2", "max_acceleration_m_s2"),
        (parameters, "relief_acceleration_m_s2", "max_acceleration_m_s2"),
    ):
        value, most = getattr(owner, name), getattr(config, field)
        require(value <= most, name, value, f"at most {field} = {most:g} of robot_config")
    if isinstance(config, TwistConfig):
        least = (1 - 1e-9) / config.rate_hz
        value = parameters.period_s
        require(value >= least, "period_s", value, f"1/rate_hz = {least:g} of robot_config or more")


def make_force_source(node: ManagedNode, arm: NodeArm) -> Cell:
    """The force source that the parameters name, not started yet; ValueError where they are wrong."""
    name, host, stalls_s = values(node, "force_config", "force_host", "simulated_stalls_s")
    config = read_force_config(Path(name).expanduser())
    silent_s = config.limits.silent_s + stalls_s
    config = replace(config, limits=replace(config.limits, silent_s=silent_s))
    if host:
        if not isinstance(config, CanForce):
            raise ValueError(f"force_host: {host!r}, expected empty for a force source without CAN")
        config = replace(config, bus={**config.bus, "host": host})
    if config.kind == "topic" and node.time_server:
        raise ValueError(
            f"force_config: {name!r} is a topic, accepted in simulated time is a cell on CAN"
        )
    if config.kind == "rtde" and isinstance(arm, TwistArm):
        raise ValueError(
            f"force_config: {name!r} is of kind rtde, accepted for an arm of kind twist are can, topic"
        )
    # a retraction while the node goes down needs both
    listens = arm.listener.node if isinstance(arm, TwistArm) else node
    return force_source(config, arm, lambda asked: TopicWrench(listens, asked, arm.clock))


def tip_geometry(node: ManagedNode) -> TipGeometry:
    """Ball, beam and housing; ValueError where a figure is wrong."""
    name, tilt, below = values(node, "sensor_config", "beam_tilt_rad", "housing_below_m")
    sensor = read_sensor(file_of(name))
    return TipGeometry(sensor.tip.radius_m, sensor.beam.free_length_m, tilt, below)


class ContactSettings:
    """Parameters and limits of a node, as they are set while it runs: limits no laxer than at the launch.

    Parameters
    ----------
    node : Node
        Just made, with `PARAMETERS` declared.
    take : callable
        Receives what is new; raises ``ValueError`` where arm or loop cannot take it.

    Attributes
    ----------
    parameters, limits : ContactParameters, Limits
        As `read` last.
    """

    def __init__(self, node: Node, take: Callable[[ContactParameters, Limits], None]) -> None:
        self._node, self._take = node, take
        names = [p.name for p in PARAMETERS if _last(p.name) in _AT_MOST | _AT_LEAST]
        self._launched = {name: node.get_parameter(name).value for name in names}
        node.add_on_set_parameters_callback(self._on_change)

    def read(self, **changed: Any) -> None:
        """Read all, some with values about to be set (``**{"contact.x": 1}``).

        Raises
        ------
        ValueError
            If a value is out of range or beyond the limits.
        """

        def value(full: str) -> Any:
            return changed.get(full, self._node.get_parameter(full).value)

        read = []
        for (group, kind), defaults in zip(_GROUPS.items(), _DEFAULTS, strict=True):
            given = {name: value(f"{group}.{name}") for name in ranges_of(kind)}
            read.append(replace(defaults, **given))
        parameters, limits = read
        corners = (numbers(list(value(full)), full, 3) for full in (_LOW, _HIGH))
        limits = replace(limits, workspace=Workspace(*corners))
        limits.check(parameters)
        (longer_s,) = values(self._node, "simulated_stalls_s")
        ages_s = {name: getattr(limits, name) + longer_s for name in ("force_age_s", "arm_age_s")}
        limits = replace(limits, **ages_s)
        self._take(parameters, limits)
        self.parameters, self.limits = parameters, limits

    def _on_change(self, changes: Sequence) -> SetParametersResult:
        """Take what is in range, and of limits what is stricter than the launch's."""
        changed = {c.name: c.value for c in changes if c.name.startswith(("contact.", "limits."))}
        if not changed:
            return SetParametersResult(successful=True)
        try:
            self._require_stricter(changed)
            self.read(**changed)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _require_stricter(self, changed: Mapping[str, Any]) -> None:
        """Raise ``ValueError`` where what protects the tissue would admit more than at the launch."""
        for name in changed.keys() & self._launched.keys():
            value, limit = np.array(changed[name]), np.array(self._launched[name])
            at_most = _last(name) in _AT_MOST
            stricter = value.shape == limit.shape and (
                value <= limit if at_most else value >= limit
            )
            accepted = (
                f"at {'most' if at_most else 'least'} {limit.tolist()}, as launched: it may be "
            )
            accepted += "made stricter here, and laxer by a new launch only"
            require(bool(np.all(stricter)), name, value.tolist(), accepted)


def _last(name: str) -> str:
    return name.rpartition(".")[2]
