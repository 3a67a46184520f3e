# SPDX-License-Identifier: Apache-2.0
"""An argument wins over the parameter file, the file over what the simulated bench needs."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from tactile_resonance.bringup import NODES, plan_bringup, read_parameter_file, stated_for
from tactile_resonance.processes import free_domain_id
from tactile_resonance.scan.table_calibration import FORMAT

MOCK = {"use_mock_hardware": "true"}
REAL = {
    "use_mock_hardware": "false",
    "force_config": "can_rft40.yaml",
    "table_in_base": "[0.4, 0, 0.1, 0, 0, 1]",
}
ROBOT_PAGE = Path(__file__).resolve().parents[1] / "docs" / "robot.md"
TABLE = [-0.49, -0.13, 0.2, 0.0, 0.0, -math.pi / 2]


def heard(arguments, sections=None, namespace="/"):
    """The plan, and what each node hears: the file, and over it what it is told."""
    sections = sections or {}
    plan = plan_bringup(arguments, sections, namespace)
    prefix = namespace.rstrip("/")
    return plan, {
        node: {**stated_for(f"{prefix}/{node}", sections), **told}
        for node, told in plan.nodes.items()
    }


def test_sections_that_hold_for_no_node_are_named():
    """Misspelt, or without the namespace in which the nodes are: ROS passes them over in silence."""
    names = ["poles_nod", "poles_node", "/**", "/*/scan_node", "/left/frf_node", "/right/frf_node"]
    sections = {name: {"order": 4} for name in names}
    others = ("poles_nod", "/*/scan_node", "/left/frf_node", "/right/frf_node")
    assert plan_bringup(MOCK, sections).of_others == others
    assert plan_bringup(MOCK, sections, "/left").of_others == ("poles_nod", "poles_node", "/right/frf_node")
    known = read_parameter_file(Path(__file__).resolve().parents[1] / "config" / "nodes.yaml")
    assert plan_bringup(MOCK, known, "/left").of_others == ()


@pytest.mark.parametrize(
    ("argument", "given", "parameter", "by_file", "by_default", "nodes"),
    [
        (
            "robot_ip",
            "127.0.91.1",
            "robot_host",
            "127.0.91.2",
            "127.0.1.1",
            ["contact_node", "fake_hardware_node"],
        ),
        ("force_config", "mine.yaml", "force_config", "theirs.yaml", None, ["contact_node"]),
        ("robot_config", "mine.yaml", "robot_config", "theirs.yaml", None, ["contact_node"]),
        (
            "base_frame",
            "arm_base",
            "base_frame",
            "file_base",
            None,
            ["contact_node", "scan_node", "fake_hardware_node"],
        ),
        (
            "table_in_base",
            "[1, 2, 3, 0, 0, 0]",
            "table_in_base",
            [3.0, 2.0, 1.0, 0.0, 0.0, 0.0],
            TABLE,
            ["scan_node", "fake_hardware_node"],
        ),
        ("run_folder", "mine", "run_folder", "theirs", None, ["scan_node"]),
        (
            "scene",
            "mine.yaml",
            "scene",
            "theirs.yaml",
            "config/scenes/inclusion_scan.yaml",
            ["fake_hardware_node"],
        ),
        ("robot", "false", "contact", "robot", "robot", ["scan_node"]),
        ("robot", "true", "contact", "none", "robot", ["scan_node"]),
        ("robot", "ideal", "serve_contact", False, False, ["fake_hardware_node"]),
        ("robot", "true", "contact_source", "tcp_pose", "force_over", ["excitation_node"]),
        ("real_time", "true", "use_sim_time", True, True, NODES),
        ("real_time", "false", "use_sim_time", False, True, NODES),
        (
            "real_time",
            "true",
            "time_server",
            "127.0.91.4:1",
            "127.0.1.1:30021",
            ["scan_node", "excitation_node", "contact_node", "fake_hardware_node"],
        ),
    ],
)
def test_argument_over_file_over_default(argument, given, parameter, by_file, by_default, nodes):
    accepted = {
        "contact": {"false": "none", "true": "robot"},
        "serve_contact": {"ideal": True},
        "contact_source": {"true": "force_over"},
        "use_sim_time": {"true": False, "false": True},
        "time_server": {"true": ""},
        "table_in_base": {given: [1.0, 2.0, 3.0, 0.0, 0.0, 0.0]},
    }
    asked = accepted.get(parameter, {}).get(given, given)
    file = {"/**": {parameter: by_file}}
    for node in nodes:
        assert heard(MOCK)[1][node].get(parameter) == by_default
        assert heard(MOCK | {argument: ""}, file)[1].get(node, file["/**"])[parameter] == by_file
        for with_or_without in (file, {}):
            told = heard(MOCK | {argument: given}, with_or_without)[1]
            assert told[node][parameter] == asked


def test_whatever_the_file_states_holds():
    """All that the launch files told the nodes whatever the file said, and what nobody has an argument for."""
    ours = {
        "excitation_node": {"contact_source": "tcp_pose", "time_server": "127.0.91.3:5", "seed": 3},
        "contact_node": {"force_host": "127.0.91.5", "simulated_stalls_s": 0.03, "time_server": ""},
        "manager_node": {"nodes": ["excitation_node"], "use_sim_time": False},
        "scan_node": {"table_in_base": [1.0] * 6, "time_server": "127.0.91.3:5"},
        "fake_hardware_node": {"table_in_base": [2.0] * 6, "robot_host": "127.0.91.5"},
        "poles_node": {"use_sim_time": False, "order": 4},
    }
    sections = {f"/left/{node}": parameters for node, parameters in ours.items()}
    _, nodes = heard(MOCK, sections, "/left")
    for node, parameters in ours.items():
        assert nodes[node].items() >= parameters.items()


def test_the_simulated_cell_and_time_are_where_the_simulated_robot_is():
    by_argument = MOCK | {"robot_ip": "127.0.91.7"}
    for arguments, file in (
        (by_argument, {}),
        (by_argument, {"/**": {"robot_host": "10.9.9.9"}}),
        (MOCK, {"/**": {"robot_host": "127.0.91.7"}}),
        (MOCK, {"contact_node": {"robot_host": "127.0.91.7"}}),
        (MOCK, {"fake_hardware_node": {"robot_host": "127.0.91.7"}}),
    ):
        _, nodes = heard(arguments, file)
        assert nodes["contact_node"]["force_host"] == "127.0.91.7"
        assert nodes["contact_node"]["robot_host"] == "127.0.91.7"
        assert nodes["fake_hardware_node"]["robot_host"] == "127.0.91.7"
        assert nodes["scan_node"]["time_server"] == "127.0.91.7:30021"
    for arguments, file in (
        (MOCK | {"force_config": "rtde_ur.yaml"}, {}),
        (MOCK, {"contact_node": {"force_config": "rtde_ur.yaml"}}),
    ):
        assert "force_host" not in heard(arguments, file)[1]["contact_node"]


def test_the_clock_follows_the_file_where_the_argument_is_not_given():
    plan, nodes = heard(MOCK, {"/**": {"use_sim_time": False}})
    assert not plan.simulated_time
    assert nodes["scan_node"]["time_server"] == ""
    assert nodes["contact_node"]["simulated_stalls_s"] == 0.05
    assert heard(MOCK)[0].simulated_time


def test_the_table_of_scans_is_that_of_the_bench():
    for arguments, file in (
        (MOCK | {"table_in_base": "[1, 2, 3, 0, 0, 0.5]"}, {}),
        (MOCK, {"scan_node": {"table_in_base": [1.0, 2.0, 3.0, 0.0, 0.0, 0.5]}}),
        (MOCK, {"fake_hardware_node": {"table_in_base": [1.0, 2.0, 3.0, 0.0, 0.0, 0.5]}}),
    ):
        _, nodes = heard(arguments, file)
        for node in ("scan_node", "fake_hardware_node"):
            assert nodes[node]["table_in_base"] == [1.0, 2.0, 3.0, 0.0, 0.0, 0.5]


def test_a_calibrated_table_is_read_from_its_file(tmp_path):
    path, table = tmp_path / "table.yaml", [1.0, 2.0, 3.0, 0.0, 0.0, 0.5]
    content = {"format": FORMAT, "table_in_base": table, "base_frame": "arm"}
    path.write_text(yaml.safe_dump(content | {"covariance": np.eye(3).tolist()}))
    given = REAL | {"table_in_base": str(path)}
    assert heard(given | {"base_frame": "arm"})[1]["scan_node"]["table_in_base"] == table
    with pytest.raises(ValueError, match=r"base_frame: got 'arm'; accepted is 'base'"):
        heard(given)
    nowhere = str(tmp_path / "none.yaml")
    with pytest.raises(ValueError, match=r"table_in_base: got '.*none.yaml'.*file of a calibration"):
        heard(given | {"table_in_base": nowhere})


@pytest.mark.parametrize(
    ("arguments", "file", "without", "contact", "source"),
    [
        (MOCK, {}, [], "robot", "force_over"),
        (MOCK | {"robot": "ideal"}, {}, ["contact_node"], "robot", "force_over"),
        (MOCK, {"/**": {"serve_contact": True}}, ["contact_node"], "robot", "force_over"),
        (MOCK | {"robot": "false"}, {}, ["contact_node"], "none", "force_over"),
        (MOCK, {"/**": {"contact": "none"}}, ["contact_node"], "none", "force_over"),
        (REAL, {}, ["fake_hardware_node"], "robot", "force_over"),
        (REAL, {"/**": {"serve_contact": True}}, ["fake_hardware_node"], "robot", "force_over"),
        (
            REAL | {"robot": "false"},
            {},
            ["fake_hardware_node", "contact_node"],
            "none",
            "tcp_pose",
        ),
    ],
)
def test_what_brings_the_tip_decides_which_nodes_there_are(
    arguments, file, without, contact, source
):
    plan, nodes = heard(arguments, file)
    names = [node for node in NODES if node not in without]
    assert list(plan.nodes) == names
    assert nodes["manager_node"]["nodes"] == names[:-1]
    assert nodes["scan_node"]["contact"] == contact
    assert nodes["excitation_node"]["contact_source"] == source
    if arguments["use_mock_hardware"] == "true":
        robot = "contact_node" not in without
        assert bool(nodes["fake_hardware_node"]["robot_host"]) == robot
        assert nodes["fake_hardware_node"]["serve_contact"] == (not robot and contact == "robot")


def test_without_robot_a_scan_tells_the_bench_places_of_its_scene():
    """There `tcp_pose` of the scan, in the base, is taken to be in the frame of the scene."""
    _, nodes = heard(MOCK | {"robot": "false"})
    for node in ("scan_node", "fake_hardware_node", "pole_map_node"):
        assert nodes[node]["table_in_base"] == [0.0] * 6
    for arguments, file in (
        ({"table_in_base": "[0.1, 0, 0, 0, 0, 0]"}, {}),
        ({}, {"/scan_node": {"table_in_base": [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]}}),
    ):
        with pytest.raises(ValueError, match="table_in_base: .*0.1.* zeros: with robot:=false"):
            heard(MOCK | {"robot": "false"} | arguments, file)


def test_nodes_with_a_robot_are_told_nothing_that_is_simulated():
    plan, nodes = heard(REAL | {"robot_ip": "192.0.2.1"})
    assert not plan.simulated_time
    assert plan.nodes["contact_node"] == {
        "robot_host": "192.0.2.1",
        "force_config": "can_rft40.yaml",
    }
    assert nodes["scan_node"]["table_in_base"] == [0.4, 0.0, 0.1, 0.0, 0.0, 1.0]
    assert not any("time_server" in told or "use_sim_time" in told for told in nodes.values())


@pytest.mark.parametrize(
    ("arguments", "file", "message"),
    [
        (REAL | {"force_config": ""}, {}, "force_config: got None; accepted is"),
        (REAL | {"table_in_base": ""}, {}, "table_in_base: got None; accepted is"),
        ({}, {}, "use_mock_hardware: got None; accepted is true, as mock.launch.py"),
        (REAL | {"robot": "ideal"}, {}, "robot: got 'ideal'; accepted is true or false"),
        (MOCK, {"/**": {"robot_host": "10.9.9.9"}}, "robot_host: got '10.9.9.9'; .* 127.x.y.z"),
        (MOCK | {"robot_ip": "10.9.9.9"}, {}, "robot_host: got '10.9.9.9'; .* 127.x.y.z"),
        (MOCK | {"table_in_base": "[1, 2]"}, {}, r"table_in_base: got '\[1, 2\]'"),
        (MOCK | {"table_in_base": "[1, 2"}, {}, r"table_in_base: got '\[1, 2'"),
        (MOCK, {"/**": {"table_in_base": [0.0] * 5 + [math.nan]}}, "table_in_base: got "),
    ],
)
def test_what_cannot_be_is_refused(arguments, file, message):
    with pytest.raises(ValueError, match=message):
        plan_bringup(arguments, file)


def test_a_real_robot_may_have_all_from_the_file():
    file = {"/**": {"force_config": "can_rft40.yaml", "table_in_base": [0.0] * 6}}
    plan, _ = heard({"use_mock_hardware": "false"}, file)
    assert plan.nodes["contact_node"] == {}


def test_the_file_of_the_page_is_enough_for_a_robot(tmp_path):
    (text,) = re.findall(r"```yaml\n(.*?)```", ROBOT_PAGE.read_text(encoding="utf-8"), re.DOTALL)
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    plan, nodes = heard({"use_mock_hardware": "false"}, read_parameter_file(path), "/left")
    assert plan.nodes["scan_node"] == {"contact": "robot", "table_frame": "left/table"}
    assert nodes["excitation_node"]["device"] == "nidaqmx"
    assert nodes["contact_node"]["robot_config"].endswith("mine.yaml")


def test_a_section_that_would_win_over_an_argument_is_refused():
    """ROS keeps the place of the node's own section; a wildcard behind it would be heard, not the argument."""
    late = {"/contact_node": {"robot_host": "127.0.91.1"}, "/**": {"robot_host": "127.0.91.2"}}
    with pytest.raises(ValueError, match="robot_host of contact_node: .* put the section /cont"):
        plan_bringup(MOCK | {"robot_ip": "127.0.91.3"}, late)
    early = dict(reversed(late.items()))
    _, nodes = heard(MOCK | {"robot_ip": "127.0.91.3"}, early)
    assert nodes["contact_node"]["robot_host"] == "127.0.91.3"


FILE = """
/**: {ros__parameters: {a: 1, b: 1, c: 1}}
/**/n: {ros__parameters: {b: 2, i: 1}}
n: {ros__parameters: {c: 3}}
/left/n: {ros__parameters: {a: 4, d: 4}}
left:
  n: {ros__parameters: {e: 5}}
  "**": {ros__parameters: {j: 5}}
/*/n: {ros__parameters: {f: 6}}
/right/**: {ros__parameters: {a: 7}}
/left/**: {ros__parameters: {d: 8}}
/m: {ros__parameters: {a: 9}}
/**: {ros__parameters: {a: 10, g: 10}}
"""


@pytest.mark.parametrize("name", ["/n", "/left/n", "/right/n", "/far/left/n", "/m", "/left/m"])
def test_the_file_is_heard_as_by_rclpy(tmp_path, name):
    rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not here")
    path = tmp_path / "file.yaml"
    path.write_text(FILE)
    context = rclpy.Context()
    arguments = ["--ros-args", "--params-file", str(path)]
    rclpy.init(context=context, args=arguments, domain_id=free_domain_id({}))
    namespace, _, node_name = name.rpartition("/")
    node = rclpy.create_node(
        node_name,
        namespace=namespace,
        context=context,
        automatically_declare_parameters_from_overrides=True,
    )
    try:
        by_ros = {key: p.value for key, p in node.get_parameters_by_prefix("").items()}
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
    of_file = {key: value for key, value in by_ros.items() if len(key) == 1}
    assert stated_for(name, read_parameter_file(path)) == of_file


@pytest.mark.parametrize(
    "text", ["", "a: 1", "[1]", "n: {ros__parameters: 3}", "n: {", "{n: null}"]
)
def test_what_is_no_parameter_file_is_refused_by_name(tmp_path, text):
    path = tmp_path / "file.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"params_file: {path}: ") as error:
        read_parameter_file(path)
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="params_file: absent.yaml: "):
        read_parameter_file("absent.yaml")


def test_a_goal_may_name_the_files_that_the_launch_names():
    given = MOCK | {"scene": "/a/dish.yaml", "run_directory": "/b/c"}
    _, nodes = heard(given, {"/scan_node": {"goal_folders": ["/mine"]}})
    assert nodes["scan_node"]["goal_folders"] == ["/mine", "/a", "/b"]
    # these are relative to the package's share folder, and to run_folder
    _, nodes = heard(MOCK | {"scene": "config/scenes/demo.yaml", "run_directory": "c"})
    assert "goal_folders" not in nodes["scan_node"]


@pytest.mark.parametrize("own", [MOCK, REAL])
def test_the_map_lies_on_the_table_where_the_scan_has_it(own):
    given = own | {"table_frame": "left_table", "base_frame": "left_base"}
    _, nodes = heard(given, namespace="/left")
    told = nodes["pole_map_node"]
    assert (told["frame_id"], told["base_frame"]) == ("left_table", "left_base")
    assert told["table_in_base"] == nodes["scan_node"]["table_in_base"]
    assert nodes["scan_node"]["table_frame"] == "left_table"
    del given["table_frame"]
    _, nodes = heard(given, {"/left/scan_node": {"table_frame": "bed"}}, "/left")
    assert nodes["pole_map_node"]["frame_id"] == "bed"
    _, nodes = heard(given, {"/left/pole_map_node": {"frame_id": "bed"}}, "/left")
    assert nodes["pole_map_node"]["frame_id"] == "bed"
    _, nodes = heard({"use_mock_hardware": "false", "robot": "false"})
    assert "frame_id" not in nodes["pole_map_node"]


def frames_of(nodes):
    """Names of our frames, with the nodes that hear them."""
    return {
        "tip": {nodes[n].get("frame_id") for n in ("excitation_node", "contact_node")}
        | {nodes["fake_hardware_node"].get("frame_id"), nodes["pole_map_node"].get("tip_frame")},
        "table": {nodes["scan_node"].get("table_frame"), nodes["pole_map_node"].get("frame_id")},
        "sensor": {nodes["contact_node"].get("sensor_frame")},
        "tool": {nodes["contact_node"].get("tool_frame")},
    }


@pytest.mark.parametrize("namespace", ["/left", "/stack/left"])
def test_frames_have_the_namespace_before_them(namespace):
    plan, nodes = heard(MOCK, namespace=namespace)
    prefix = namespace[1:]
    names = {name: {f"{prefix}/{name}"} for name in ("tip", "table", "sensor", "tool")}
    assert frames_of(nodes) == names
    assert plan.table_frame == f"{prefix}/table"
    assert nodes["pole_map_node"]["base_frame"] == "base"  # the driver's
    given = MOCK | {"tip_frame": "needle", "table_frame": "bed"}
    _, nodes = heard(given, namespace=namespace)
    assert frames_of(nodes) == {**names, "tip": {"needle"}, "table": {"bed"}}
    _, nodes = heard(MOCK, {"/**": {"frame_id": "needle", "tool_frame": "gripper"}}, namespace)
    assert frames_of(nodes)["tip"] == {"needle"}
    assert frames_of(nodes)["tool"] == {"gripper"}


def test_without_a_namespace_frames_are_those_of_the_nodes():
    plan, nodes = heard(MOCK)
    assert plan.table_frame == "table"
    assert nodes["pole_map_node"]["tip_frame"] == "tip"
    assert not any(told.keys() & {"sensor_frame", "tool_frame"} for told in nodes.values())


@pytest.mark.parametrize(
    ("given", "file", "table", "sensor", "tip"),
    [
        ({}, {}, True, True, True),
        ({"static_transforms": "false"}, {}, False, False, True),
        ({"tip_transform": "false"}, {}, True, True, False),
        ({"tip_transform": "true"}, {"/**": {"broadcast_tf": False}}, False, False, True),
        # nobody knows where tip and table are
        ({"robot": "false"}, {}, False, True, False),
        ({"robot": "false", "static_transforms": "true"}, {}, True, True, False),
    ],
)
def test_who_broadcasts(given, file, table, sensor, tip):
    _, nodes = heard(MOCK | given, file)
    names = ("scan_node", "contact_node", "pole_map_node")
    # without the argument, the file and a reason the nodes do
    told = [nodes.get(n, {}).get("broadcast_tf", True) for n in names]
    assert told == [table, sensor, tip]
