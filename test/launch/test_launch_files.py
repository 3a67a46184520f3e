# SPDX-License-Identifier: Apache-2.0
"""What the nodes that the launch files start are told, by the real launch and the real rclpy."""

import os
import re
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import pytest

pytest.importorskip("launch_ros", reason="launch_ros is not here: it comes with a full ROS 2")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

import rclpy
from launch.actions import (
    ExecuteProcess,
    IncludeLaunchDescription,
    LogInfo,
    PushLaunchConfigurations,
)
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_ros.actions import Node, PushRosNamespace

from launch import LaunchContext
from tactile_resonance.processes import free_domain_id

LAUNCH = Path(__file__).resolve().parents[2] / "launch"
DISCOVERY = "ROS_AUTOMATIC_DISCOVERY_RANGE"
REAL = {"force_config": "can_rft40.yaml", "table_in_base": "[0.4, 0, 0.1, 0, 0, 1]"}
TABLE = [1.0, 2.0, 3.0, 0.0, 0.0, 0.5]


@dataclass
class Started:
    """A process as launch would start it."""

    command: list[str]
    discovery: str | None

    def hears(self):
        """The parameters of a node, as rclpy resolves them."""
        arguments = self.command[self.command.index("--ros-args") :]
        context = rclpy.Context()
        rclpy.init(context=context, args=arguments, domain_id=free_domain_id({}))
        node = rclpy.create_node(
            "unnamed", context=context, automatically_declare_parameters_from_overrides=True
        )
        try:
            return {key: value.value for key, value in node.get_parameters_by_prefix("").items()}
        finally:
            node.destroy_node()
            rclpy.shutdown(context=context)


def start(file, *before, argv=(), told=None, **given):
    """The processes that a launch file starts, by the full names of the nodes; `told` takes what is logged."""
    context = LaunchContext(argv=argv)
    source = PythonLaunchDescriptionSource(str(LAUNCH / file))
    started = {}

    def visit(entity):
        if isinstance(entity, Node):
            entity._perform_substitutions(context)
            name = entity.node_name.rpartition("/")[2]
            names = {"name": f"__node:={name}", "ns": f"__ns:={entity.expanded_node_namespace}"}
            context.extend_locals({"ros_specific_arguments": names})
            entity.prepare(context)
            process = entity.process_description
            discovery = (process.final_env or os.environ).get(DISCOVERY)
            started[entity.node_name] = Started(process.final_cmd, discovery)
            return
        if isinstance(entity, LogInfo) and told is not None:
            told.append("".join(part.perform(context) for part in entity.msg))
        if isinstance(entity, ExecuteProcess):
            entity.prepare(context)
            command = entity.process_description.final_cmd
            started[" ".join(command[:3])] = Started(command, None)
            return
        for inner in entity.visit(context) or ():
            visit(inner)

    for entity in (*before, IncludeLaunchDescription(source, launch_arguments=given.items())):
        visit(entity)
    return started


@pytest.fixture(autouse=True)
def alone(monkeypatch, tmp_path):
    monkeypatch.setenv(DISCOVERY, "LOCALHOST")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # launch leaves a file for each node


@pytest.mark.parametrize(
    ("file", "argument", "given", "parameter", "heard", "by_file", "node"),
    [
        (
            "mock",
            "robot_ip",
            "127.0.91.1",
            "robot_host",
            "127.0.91.1",
            "127.0.91.2",
            "contact_node",
        ),
        (
            "mock",
            "robot_ip",
            "127.0.91.1",
            "robot_host",
            "127.0.91.1",
            "127.0.91.2",
            "fake_hardware_node",
        ),
        ("mock", "scene", "a.yaml", "scene", "a.yaml", "b.yaml", "fake_hardware_node"),
        ("mock", "table_in_base", str(TABLE), "table_in_base", TABLE, [0.5] * 6, "scan_node"),
        ("mock", "robot", "ideal", "serve_contact", True, False, "fake_hardware_node"),
        ("mock", "robot", "false", "contact", "none", "robot", "scan_node"),
        ("mock", "real_time", "true", "use_sim_time", False, True, "frf_node"),
        ("ur", "robot_ip", "192.0.2.1", "robot_host", "192.0.2.1", "192.0.2.2", "contact_node"),
        ("ur", "robot_config", "a.yaml", "robot_config", "a.yaml", "b.yaml", "contact_node"),
        ("ur", "force_config", "a.yaml", "force_config", "a.yaml", "b.yaml", "contact_node"),
        ("ur", "base_frame", "arm", "base_frame", "arm", "other", "scan_node"),
        ("ur", "table_in_base", str(TABLE), "table_in_base", TABLE, [0.5] * 6, "scan_node"),
        ("ur", "run_folder", "a", "run_folder", "a", "b", "scan_node"),
        ("ur", "robot", "false", "contact", "none", "robot", "scan_node"),
    ],
)
@pytest.mark.parametrize("section", ["/**", "/left/{node}", "left/{node}", "/**/{node}"])
def test_an_argument_wins_over_the_file_and_one_that_is_not_given_leaves_it_alone(
    tmp_path, file, argument, given, parameter, heard, by_file, node, section
):
    path = tmp_path / "file.yaml"
    path.write_text(
        f"{section.format(node=node)}: {{ros__parameters: {{{parameter}: {by_file}}}}}\n"
    )
    options = {"namespace": "left", "params_file": str(path)}
    if file == "ur":
        options |= {key: value for key, value in REAL.items() if key != argument}
    name = f"/left/{node}"
    with_argument = start(f"{file}.launch.py", **options, **{argument: given})
    assert with_argument[name].hears()[parameter] == heard
    without = start(f"{file}.launch.py", **options)
    assert without[name].hears()[parameter] == by_file


def test_the_file_holds_in_the_namespace_of_the_stack(tmp_path):
    path = tmp_path / "file.yaml"
    path.write_text(
        "/stack/left/scan_node: {ros__parameters: {table_in_base: [1.0, 2.0, 3.0, 4.0, 5.0, 6.5]}}"
    )
    stack = PushLaunchConfigurations(), PushRosNamespace("stack")
    nodes = start("mock.launch.py", *stack, namespace="left", params_file=str(path))
    assert nodes["/stack/left/scan_node"].hears()["table_in_base"] == [1, 2, 3, 4, 5, 6.5]


def test_the_mock_by_default():
    nodes = start("mock.launch.py")
    assert list(nodes)[:8] == [
        "/fake_hardware_node",
        "/excitation_node",
        "/frf_node",
        "/poles_node",
        "/contact_node",
        "/pole_map_node",
        "/scan_node",
        "/manager_node",
    ]
    assert nodes["/manager_node"].hears()["nodes"] == [name[1:] for name in list(nodes)[:7]]
    scan, contact = nodes["/scan_node"].hears(), nodes["/contact_node"].hears()
    assert scan["time_server"] == contact["time_server"] == "127.0.1.1:30021"
    assert scan["use_sim_time"]
    assert contact["force_host"] == contact["robot_host"] == "127.0.1.1"


def test_arguments_of_the_command_line_that_are_misspelt_are_named():
    own = {"scene": "a.yaml", "real_time": "true", "namespace": "left", "notes": "{}"}
    of_stack = {"left_robot_ip": "127.0.1.2", "camera": "none"}
    wrong = {"table_in_bse": "table_in_base", "namespce": "namespace", "robotip": "robot_ip"}
    given, told = own | of_stack | dict.fromkeys(wrong, "x"), []
    start("demo.launch.py", argv=[f"{name}:={value}" for name, value in given.items()], told=told)
    assert [line for line in told if "meant?" in line] == [
        f"{name}: no argument of these nodes, and ignored by them; is {right} meant?"
        for name, right in wrong.items()
    ]


def test_a_robot_must_be_told_its_cell_and_its_table():
    for name in REAL:
        with pytest.raises(ValueError, match=f"{name}: got None"):
            start("ur.launch.py", **(REAL | {name: ""}))


@pytest.mark.parametrize("file", ["mock", "ur", "demo", "example_stack"])
@pytest.mark.parametrize(
    ("by_user", "given", "discovery"),
    [
        (None, {}, "LOCALHOST"),
        ("SUBNET", {}, "SUBNET"),
        (None, {"discovery": "SUBNET"}, "SUBNET"),
        ("SUBNET", {"discovery": "OFF"}, "OFF"),
    ],
)
def test_nodes_are_found_on_this_machine_only_unless_asked(
    monkeypatch, file, by_user, given, discovery
):
    monkeypatch.delenv(DISCOVERY)
    if by_user:
        monkeypatch.setenv(DISCOVERY, by_user)
    nodes = start(f"{file}.launch.py", **(REAL if file == "ur" else {}), **given)
    assert len(nodes) >= 7
    assert {node.discovery for node in nodes.values()} == {discovery}
    assert os.environ.get(DISCOVERY) == by_user  # what else a stack starts keeps its own


@pytest.mark.parametrize("file", ["mock", "ur", "example_stack"])
def test_each_node_has_an_enclave_of_its_own_where_enclaves_are_given(file):
    given = REAL if file == "ur" else {}
    nodes = start(f"{file}.launch.py", **given, enclaves="/tactile_resonance")
    for name, node in nodes.items():
        enclave = node.command[node.command.index("--enclave") + 1]
        assert enclave == f"/tactile_resonance/{name.rpartition('/')[2]}"
        assert node.hears()["use_sim_time"] is (file != "ur")
    assert not any("--enclave" in n.command for n in start(f"{file}.launch.py", **given).values())


def test_frames_have_the_namespace_before_them():
    stack = PushLaunchConfigurations(), PushRosNamespace("stack")
    nodes = start("mock.launch.py", *stack, namespace="left", static_transforms="false")
    scan, contact = nodes["/stack/left/scan_node"], nodes["/stack/left/contact_node"]
    assert scan.hears()["table_frame"] == "stack/left/table"
    assert scan.hears()["broadcast_tf"] is False
    heard = contact.hears()
    assert heard["frame_id"] == "stack/left/tip"
    assert heard["sensor_frame"] == "stack/left/sensor"
    assert nodes["/stack/left/pole_map_node"].hears()["frame_id"] == "stack/left/table"


@pytest.mark.parametrize(
    ("stack", "namespace", "full"),
    [
        ("", "left", "left"),
        ("", "/left", "left"),
        ("stack", "left", "stack/left"),
        ("stack", "", "stack"),
    ],
)
def test_what_is_recorded_is_in_the_namespace_of_the_nodes(monkeypatch, stack, namespace, full):
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    before = (PushLaunchConfigurations(), PushRosNamespace(stack)) if stack else ()
    nodes = start("mock.launch.py", *before, namespace=namespace, record="true")
    assert f"/{full}/poles_node" in nodes
    command = nodes["ros2 bag record"].command
    topics = re.compile(command[command.index("-e") + 1])
    heard = [f"/{full}/record", f"/{full}/pole_map/legend", "/diagnostics", "/tf_static"]
    assert all(topics.search(topic) for topic in heard)
    assert not any(topics.search(topic) for topic in ("/right/record", "/tf", f"/{full}_2/record"))
    folder = command[command.index("-o") + 1]
    assert re.fullmatch(rf"session-\d{{8}}-\d{{6}}-{full.replace('/', '-')}", folder)


@pytest.mark.parametrize("file", ["mock", "ur"])
def test_names_and_broadcasts_of_frames_can_be_given(file):
    given = {"tip_frame": "needle", "table_frame": "bed", "tip_transform": "false"}
    options = given | {"namespace": "left"} | (REAL if file == "ur" else {})
    nodes = start(f"{file}.launch.py", **options)
    assert nodes["/left/contact_node"].hears()["frame_id"] == "needle"
    assert nodes["/left/scan_node"].hears()["table_frame"] == "bed"
    told = nodes["/left/pole_map_node"].hears()
    assert (told["tip_frame"], told["frame_id"]) == ("needle", "bed")
    assert told["broadcast_tf"] is False
    assert "broadcast_tf" not in nodes["/left/scan_node"].hears()


def test_the_demo_scans_what_lies_on_the_table():
    nodes = start("demo.launch.py", namespace="left", scene="/a/scene.yaml")
    assert nodes["/left/scan_goal"].hears()["scene"] == "/a/scene.yaml"
    assert nodes["/left/fake_hardware_node"].hears()["scene"] == "/a/scene.yaml"


def test_the_stack_has_two_robots():
    nodes = start("example_stack.launch.py", right_robot_ip="127.0.91.9")
    assert nodes["/left/contact_node"].hears()["robot_host"] == "127.0.1.2"
    assert nodes["/right/contact_node"].hears()["robot_host"] == "127.0.91.9"
    assert "poles:=/stack/tissue/right/poles" in nodes["/right/poles_node"].command
    map_node = nodes["/right/pole_map_node"].hears()
    assert (map_node["frame_id"], map_node["base_frame"]) == ("right/table", "right_base")
