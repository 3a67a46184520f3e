# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy allows each node what it uses in some configuration, and nothing else."""

import time
from collections import defaultdict
from contextlib import suppress
from itertools import product
from xml.etree import ElementTree

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")
pytest.importorskip("rtde_control", reason="ur-rtde is not here")

import rclpy
from rclpy.node import NodeNameNonExistentError
from robot_at_hand import own_host, own_time

from tactile_resonance.bringup import NODES
from tactile_resonance.configuration import share_path
from tactile_resonance.drivers.force_config import read_force_config
from tactile_resonance.nodes.excitation_node import ExcitationNode
from tactile_resonance.nodes.fake_hardware_node import FakeHardwareNode
from tactile_resonance.nodes.pole_map_node import PoleMapNode
from tactile_resonance.nodes.running import initialised
from tactile_resonance.nodes.scan_node import ScanNode
from tactile_resonance.processes import NodeProcesses
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.simulation.plant.defaults import TABLE_IN_BASE

POLICY = share_path("config/security/policy.xml")
INCLUDE = "{http://www.w3.org/2001/XInclude}include"
HOST, TIME = own_host(94), own_time(94)
SCENE = """
name: one point
force_n: 0.01
regions:
  - {name: gelatine 10 %, gelatine_percent: 10.0, disc: {center_m: [0.0, 0.0], radius_m: 0.025}}
positions: {list: [[0.0, 0.0]]}
blocks: {least: 2, most: 2}
"""
RULES = {
    "get_publisher_names_and_types_by_node": ("publish", "execute"),
    "get_subscriber_names_and_types_by_node": ("subscribe", "call"),
    "get_service_names_and_types_by_node": ("reply", "execute"),
    "get_client_names_and_types_by_node": ("request", "call"),
}
"""Question to the graph: the rule of what it lists, and that of an action whose part this is."""


def read_until(done, graph, namespace, nodes, used):
    """Add pairs of a rule and a name until something holds, all were seen and a second told nothing."""
    known, seen, begun_s = (0, 0), set(), time.monotonic()
    news_s = begun_s
    while time.monotonic() < news_s + 1.0 or seen < {*nodes} or not done():
        assert time.monotonic() < begun_s + 180.0, f"only {seen} of {nodes}, or it takes too long"
        time.sleep(0.05)
        names = {name for name, at in graph.get_node_names_and_namespaces() if at == namespace}
        seen |= names & {*nodes}
        for node, (question, (rule, action_rule)) in product(seen & names, RULES.items()):
            with suppress(NodeNameNonExistentError):  # one that has ended meanwhile
                for full, _ in getattr(graph, question)(node, namespace):
                    name = full.removeprefix(namespace.rstrip("/"))
                    action, part, _ = name.partition("/_action/")
                    used[node].add((action_rule, action) if part else (rule, name))
        if known != (known := (len(seen), sum(map(len, used.values())))):
            news_s = time.monotonic()


@pytest.fixture(scope="module")
def used(module_domain, tmp_path_factory):
    """What each node uses: in a scan with a robot, and configured otherwise."""
    folder = tmp_path_factory.mktemp("security")
    scene, run, used = folder / "scene.yaml", folder / "run", defaultdict(set)
    scene.write_text(SCENE)
    table = {"table_in_base": list(TABLE_IN_BASE)}
    bench = {"scene": scene, **table}
    goal = {"scan_goal": {"scene": scene, "run_directory": run}}
    host = {"robot_host": HOST}
    with_robot = {
        "fake_hardware_node": {**bench, **host},
        "excitation_node": {"record_folder": folder / "records"},
        "contact_node": {**host, "force_host": HOST, "touch_from_poles": True},
        "scan_node": {**table, "goal_folders": [str(folder)]},
    }
    for node in with_robot.values():
        node["time_server"] = TIME
    with_robot["manager_node"] = {"nodes": list(NODES[:-1])}

    def scanned():
        return (run / "run.json").exists() and len(read_run(run).results) == 1

    with NodeProcesses(folder / "log") as processes, initialised():
        for node in (*goal, *NODES):
            processes.start(node, {"use_sim_time": True, **{**goal, **with_robot}.get(node, {})})
        reader = rclpy.create_node("graph_reader")
        read_until(scanned, reader, "/", (*goal, *NODES), used)
        reader.destroy_node()
    otherwise = {
        **{**bench, "serve_contact": "true", "contact": "none", "source": "poles"},
        **{"device": "replay", "device_config": run, "contact_source": "tcp_pose"},
    }
    for namespace, kinds, parameters in (
        ("/left", (FakeHardwareNode, ExcitationNode, PoleMapNode, ScanNode), otherwise),
        ("/right", (FakeHardwareNode,), bench),
    ):
        given = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
        with initialised(args=["--ros-args", "-r", f"__ns:={namespace}", *given]):
            nodes = {node.get_name(): node for node in (kind() for kind in kinds)}
            for node in nodes.values():
                node.trigger_configure()
                assert node.state_name() == "inactive"
            read_until(lambda: True, node, namespace, nodes, used)
            for node in nodes.values():
                node.destroy_node()
    # with tf2: frames broadcast, for those who listen, and those of a goal looked up
    used["contact_node"].add(("publish", "/tf_static"))
    used["pole_map_node"] |= {("publish", "/tf"), ("subscribe", "/tcp_pose")}
    used["scan_node"] |= {("publish", "/tf_static"), *product(["subscribe"], ["/tf", "/tf_static"])}
    # a sensor of another driver: its topic is that of the configuration
    topic = read_force_config(share_path("config/force/topic.yaml")).topic
    used["contact_node"].add(("subscribe", f"/{topic}"))
    return used


def allowed_by(file, node):
    """Pairs of a rule and a full name that the profile of a file, or of a node's enclave, allows."""
    profile = ElementTree.parse(POLICY.with_name(file)).getroot()
    if profile.tag == "policy":
        (profile,) = profile.iterfind(f".//enclave[@path='/tactile_resonance/{node}']/*/profile")
        assert profile.attrib == {"ns": "/", "node": node}
    for group in profile:
        if group.tag == INCLUDE:
            yield from allowed_by(group.get("href"), node)
            continue
        for rule, decision in group.items():
            assert decision == "ALLOW"
            for entry in group:
                name = entry.text.replace("~", f"/{node}")
                yield rule, name if name.startswith("/") else f"/{name}"


def test_each_node_has_an_enclave():
    enclaves = ElementTree.parse(POLICY).getroot().iterfind("enclaves/enclave")
    expected = [f"/tactile_resonance/{node}" for node in (*NODES, "scan_goal")]
    assert [enclave.get("path") for enclave in enclaves] == expected


@pytest.mark.parametrize("node", [*NODES, "scan_goal"])
def test_a_node_may_do_what_it_does_and_nothing_else(used, node):
    assert used[node] == set(allowed_by("policy.xml", node))
