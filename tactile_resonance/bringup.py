# SPDX-License-Identifier: Apache-2.0
"""Which nodes the launch files start, and which parameters each is passed after the user's file.

An argument that is given wins over the file, the file wins over the defaults that the simulated bench needs.
Everything else is left to the nodes.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from tactile_resonance.clock import PORT as TIME_PORT
from tactile_resonance.configuration import parse_yaml
from tactile_resonance.fields import cut, numbers, read_text, require
from tactile_resonance.simulation.plant.defaults import HOST, STALLS_S, TABLE_IN_BASE

NODES = (
    "fake_hardware_node",
    "excitation_node",
    "frf_node",
    "poles_node",
    "contact_node",
    "pole_map_node",
    "scan_node",
    "manager_node",
)
"""All nodes, in the order in which the manager, the last, brings them up."""

WITH_TIP = ("excitation_node", "contact_node", "fake_hardware_node")

ARGUMENTS = {
    "robot_ip": ("robot_host", "contact_node"),
    "robot_config": ("robot_config", "contact_node"),
    "force_config": ("force_config", "contact_node"),
    "base_frame": ("base_frame", "contact_node", "scan_node", "fake_hardware_node"),
    "table_frame": ("table_frame", "scan_node"),
    "tip_frame": ("frame_id", *WITH_TIP),
    "run_folder": ("run_folder", "scan_node"),
    "scene": ("scene", "fake_hardware_node"),
}
"""Arguments that are parameters as they stand: the parameter's name, and the nodes that have it."""

FILES_OF_GOALS = ("scene", "run_directory")
"""Arguments whose files the goals of a scan may name."""

OWN_FRAMES = {
    "frame_id": ("tip", *WITH_TIP),
    "table_frame": ("table", "scan_node"),
    "sensor_frame": ("sensor", "contact_node"),
    "tool_frame": ("tool", "contact_node"),
}
"""Parameters that name a frame of ours: its name, under the nodes' namespace, and the nodes that have it."""

BROADCASTS = {
    "static_transforms": ("scan_node", "contact_node"),
    "tip_transform": ("pole_map_node",),
}
"""Arguments that say whether nodes broadcast their frames."""

IN_BENCH_TIME = ("fake_hardware_node", "excitation_node", "contact_node", "scan_node")
SIMULATED_CELL = "can_simulated.yaml"
BASE_FRAME = "base"
SCENE = "config/scenes/inclusion_scan.yaml"

Parameters = dict[str, Any]


@dataclass(frozen=True)
class Bringup:
    """What is started.

    Attributes
    ----------
    nodes : dict of str to dict
        The nodes to start, and the parameters that each is passed after the file.
    simulated_time : bool
        Whether they live in the time of the simulated bench.
    table_frame : str
    of_others : tuple of str
        Sections of the file that hold for none of `NODES` here: names misspelt, or another namespace's.
    """

    nodes: dict[str, Parameters]
    simulated_time: bool
    table_frame: str
    of_others: tuple[str, ...] = ()


def read_parameter_file(path: str | Path) -> dict[str, Parameters]:
    """Parameters of each section of a ROS 2 parameter file; what was begun twice is one section, as for ROS.

    Raises
    ------
    ValueError
        If it cannot be read, or is no parameter file.
    """
    sections: dict[str, Parameters] = {}
    try:
        # not strict: as ROS reads it, so that both mean the same
        loader = yaml.SafeLoader(read_text(Path(path)))
        for name, parameters in _sections(loader, loader.get_single_node(), ""):
            sections.setdefault(name, {}).update(parameters)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"params_file: {path}: {cut(str(error))}") from error
    return sections


def _sections(loader: yaml.SafeLoader, node: Any, name: str) -> Iterator[tuple[str, Parameters]]:
    mapping = isinstance(node, yaml.MappingNode)
    require(mapping, name or "file", getattr(node, "value", None), "NODE: {ros__parameters: {...}}")
    for key, value in node.value:
        if key.value == "ros__parameters":
            yield name, loader.construct_mapping(value, deep=True)
        else:
            joined = f"{name}/{key.value}" if name else key.value
            yield from _sections(loader, value, joined)


def stated_for(name: str, sections: Mapping[str, Parameters]) -> Parameters:
    """Parameters that a file sets for the node of a full name.

    As rclpy has it: each section whose pattern matches counts, the later over the earlier, whatever
    the patterns are.
    """
    stated: Parameters = {}
    for pattern, parameters in sections.items():
        if _matches(pattern, name):
            stated.update(parameters)
    return stated


def _matches(pattern: str, name: str) -> bool:
    absolute = pattern if pattern.startswith("/") else f"/{pattern}"
    expression = absolute.replace("/*", r"(/\w+)")  # so `/**` is (/\w+)*
    return re.fullmatch(expression, name) is not None


class _Decisions:
    """Parameters that each node is passed after the file."""

    def __init__(
        self, arguments: Mapping[str, str], sections: Mapping[str, Parameters], namespace: str
    ) -> None:
        self.given = {name: value for name, value in arguments.items() if value != ""}
        self._sections = sections
        self._names = {node: re.sub("/+", "/", f"/{namespace}/{node}") for node in NODES}
        self.stated = {node: stated_for(name, sections) for node, name in self._names.items()}
        self.passed: dict[str, Parameters] = {node: {} for node in NODES}

    def pass_on(self, node: str, by: str, **parameters: object) -> None:
        """Pass parameters to a node where an argument of `by` is given, or the file does not set them."""
        given = any(argument in self.given for argument in by.split())
        for name, value in parameters.items():
            if given or name not in {**self.stated[node], **self.passed[node]}:
                self.passed[node][name] = value

    def value(self, node: str, name: str) -> Any:
        """Value that a node receives; None where neither an argument, the file nor a default here sets it."""
        return {**self.stated[node], **self.passed[node]}.get(name)

    def of_others(self) -> tuple[str, ...]:
        """Sections of the file that hold for none of the nodes."""
        names = self._names.values()
        return tuple(s for s in self._sections if not any(_matches(s, name) for name in names))

    def check(self, node: str) -> None:
        """``ValueError`` where a later section of the file would override what a node is passed."""
        passed, name = self.passed[node], self._names[node]
        # ROS merges what is passed into the section of that name, if there is one, at its place in the file
        merged = {**self._sections, name: {**self._sections.get(name, {}), **passed}}
        heard = stated_for(name, merged)
        for parameter, value in passed.items():
            by_file, place = heard[parameter], f"{value!r}: put the section {name} last"
            require(by_file == value, f"params_file: {parameter} of {node}", by_file, place)


def plan_bringup(
    arguments: Mapping[str, str],
    sections: Mapping[str, Parameters],
    namespace: str = "",
    priority: bool = False,
) -> Bringup:
    """Decide what is started.

    Parameters
    ----------
    arguments : mapping of str to str
        Of the launch file; one that is empty is not given.
    sections : mapping
        Of the user's parameter file.
    namespace : str
        Of the nodes, absolute.
    priority : bool
        Whether a simulated robot may run with real-time priority.

    Raises
    ------
    ValueError
        If arguments and file contradict each other, or a robot lacks what has no safe default.
    """
    plan = _Decisions(arguments, sections, namespace)
    given, pass_on, value = plan.given, plan.pass_on, plan.value
    hardware = given.get("use_mock_hardware")
    accepted = "true, as mock.launch.py says, or false, as ur.launch.py"
    require(hardware in ("true", "false"), "use_mock_hardware", hardware, accepted)
    mock = hardware == "true"
    robot = given.get("robot") or _robot(plan.stated, mock)
    require(mock or robot != "ideal", "robot", robot, "true or false without the simulated bench")
    require(robot in ("true", "ideal", "false"), "robot", robot, "one of true, ideal, false")
    for argument, (name, *its_nodes) in ARGUMENTS.items():
        for node in its_nodes if argument in given else ():
            pass_on(node, argument, **{name: given[argument]})
    if "table_in_base" in given:
        base_frame = value("scan_node", "base_frame") or BASE_FRAME
        passed = _table_or_file(given["table_in_base"], base_frame)
        pass_on("scan_node", "table_in_base", table_in_base=passed)
    named = [Path(given[name]).expanduser() for name in FILES_OF_GOALS if name in given]
    if folders := [str(path.parent) for path in named if path.is_absolute()]:
        stated = value("scan_node", "goal_folders") or []
        plan.passed["scan_node"]["goal_folders"] = [*stated, *folders]
    pass_on("scan_node", "robot", contact="none" if robot == "false" else "robot")
    # without robot and bench nobody measures the force
    source = "force_over" if mock or robot == "true" else "tcp_pose"
    pass_on("excitation_node", "robot", contact_source=source)
    left_out = {
        *(() if mock else ("fake_hardware_node",)),
        *(() if robot == "true" else ("contact_node",)),
    }
    nodes = [node for node in NODES if node not in left_out]
    pass_on("manager_node", "", nodes=nodes[:-1])
    simulated_time = _pass_mock(plan, robot, priority) if mock else False
    if not mock and robot == "true":
        for node, name in (("contact_node", "force_config"), ("scan_node", "table_in_base")):
            accepted = "one that argument or params_file states: a robot must not move by a default"
            require(value(node, name) is not None, name, None, accepted)
    _pass_frames(plan, namespace.strip("/"), robot)
    base_frame = value("scan_node", "base_frame") or BASE_FRAME
    table_frame = value("scan_node", "table_frame") or "table"
    if (stands := value("scan_node", "table_in_base")) is not None:
        pass_on("pole_map_node", "base_frame", base_frame=base_frame)
        pass_on("pole_map_node", "table_in_base", table_in_base=_table(stands))
        pass_on("pole_map_node", "table_frame", frame_id=table_frame)
    for node in nodes:
        plan.check(node)
    return Bringup(
        nodes={node: plan.passed[node] for node in nodes},
        simulated_time=simulated_time,
        table_frame=table_frame,
        of_others=plan.of_others(),
    )


def _pass_mock(plan: _Decisions, robot: str, priority: bool) -> bool:
    """Pass what the simulated bench needs; return whether the nodes live in its time."""
    given, pass_on, value = plan.given, plan.pass_on, plan.value
    host = value("contact_node", "robot_host") or value("fake_hardware_node", "robot_host") or HOST
    accepted = "127.x.y.z, of a simulated robot; ur.launch.py is for real ones"
    require(str(host).startswith("127."), "robot_host", host, accepted)
    pass_on("contact_node", "", robot_host=host)
    pass_on(
        "fake_hardware_node",
        "robot robot_ip",
        robot_host=host if robot == "true" else "",
        serve_contact=robot == "ideal",
    )
    pass_on("fake_hardware_node", "", scene=SCENE)
    table = value("scan_node", "table_in_base") or value("fake_hardware_node", "table_in_base")
    at = TABLE_IN_BASE
    if robot == "false":
        at = [0.0] * 6
        accepted = "zeros: with robot:=false the bench takes tcp_pose to be in the frame of the scene"
        require(not table or not any(_table(table)), "table_in_base", table, accepted)
    for node in ("scan_node", "fake_hardware_node"):
        pass_on(node, "table_in_base", table_in_base=_table(table or at))
    if value("contact_node", "force_config") in (None, SIMULATED_CELL):
        pass_on("contact_node", "", force_host=host)
    clock = plan.stated["fake_hardware_node"].get("use_sim_time", True)
    real_time = given.get("real_time", "false" if clock else "true")
    require(real_time in ("true", "false"), "real_time", real_time, "true or false")
    simulated_time = real_time == "false"
    for node in NODES:
        pass_on(node, "real_time", use_sim_time=simulated_time)
    for node in IN_BENCH_TIME:
        pass_on(node, "real_time", time_server=f"{host}:{TIME_PORT}" if simulated_time else "")
    if not (simulated_time or priority):
        pass_on("contact_node", "", simulated_stalls_s=STALLS_S)
    return simulated_time


def _pass_frames(plan: _Decisions, namespace: str, robot: str) -> None:
    """Pass the names of our frames, and who broadcasts them."""
    for parameter, (name, *its_nodes) in OWN_FRAMES.items():
        for node in its_nodes if namespace else ():
            plan.pass_on(node, "", **{parameter: f"{namespace}/{name}"})
    tip = plan.value("contact_node", "frame_id") or "tip"
    plan.pass_on("pole_map_node", "tip_frame", tip_frame=tip)
    for argument, broadcasters in BROADCASTS.items():
        for node in broadcasters if argument in plan.given else ():
            plan.pass_on(node, argument, broadcast_tf=plan.given[argument] == "true")
    if robot == "false":  # nobody knows where table and tip are
        for node in ("scan_node", "pole_map_node"):
            plan.pass_on(node, "", broadcast_tf=False)


def _robot(stated: Mapping[str, Parameters], mock: bool) -> str:
    """What brings the tip to the tissue, by the file alone."""
    if stated["scan_node"].get("contact") == "none":
        return "false"
    return "ideal" if mock and stated["fake_hardware_node"].get("serve_contact") else "true"


def _table_or_file(text: str, base_frame: str) -> list[float]:
    """Six numbers as they stand, or of a file that `calibrate_table` wrote."""
    path = Path(text).expanduser()
    if not path.is_file():
        return _table(text)
    # only here: a launch file without one loads no scans
    from tactile_resonance.scan.table_calibration import read_table

    return read_table(path, base_frame)


def _table(value: object) -> list[float]:
    """Six finite numbers."""
    accepted = "[x, y, z, rx, ry, rz] in m and rad, or (launch argument) the file of a calibration"
    try:
        given = parse_yaml(value) if isinstance(value, str) else value
        return list(numbers(given, "table_in_base", 6))
    except ValueError as error:
        raise ValueError(f"table_in_base: got {value!r}; accepted is {accepted}") from error
