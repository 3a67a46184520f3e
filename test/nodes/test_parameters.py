# SPDX-License-Identifier: Apache-2.0
"""The configuration file and the declarations agree; what is out of range is refused with a reason."""

import os
import re
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from tactile_resonance.configuration import share_path
from tactile_resonance.nodes import (
    contact_node,
    excitation_node,
    fake_hardware_node,
    frf_node,
    manager_node,
    pole_map_node,
    poles_node,
    scan_goal,
    scan_node,
)
from tactile_resonance.nodes.parameters import declare
from tactile_resonance.nodes.running import initialised
from tactile_resonance.processes import free_domain_id

NODES = {
    "excitation_node": excitation_node.ExcitationNode,
    "frf_node": frf_node.FrfNode,
    "poles_node": poles_node.PolesNode,
    "fake_hardware_node": fake_hardware_node.FakeHardwareNode,
    "manager_node": manager_node.ManagerNode,
    "contact_node": contact_node.ContactNode,
    "scan_node": scan_node.ScanNode,
    "pole_map_node": pole_map_node.PoleMapNode,
}
DECLARED = {
    "excitation_node": excitation_node.PARAMETERS,
    "frf_node": frf_node.PARAMETERS,
    "poles_node": poles_node.PARAMETERS,
    "fake_hardware_node": fake_hardware_node.PARAMETERS,
    "manager_node": manager_node.PARAMETERS,
    # the rest of its parameters is that of config/contact.yaml, where the defaults come from
    "contact_node": [
        p for p in contact_node.PARAMETERS if not p.name.startswith(("contact.", "limits."))
    ],
    "scan_node": scan_node.PARAMETERS,
    "pole_map_node": pole_map_node.PARAMETERS,
}


@pytest.fixture
def ros():
    with initialised(domain_id=free_domain_id(os.environ)):
        yield


def test_file_holds_every_declared_parameter_at_its_default():
    text = share_path("config/nodes.yaml").read_text()
    # those that the launch files decide stand there as comments
    content = yaml.safe_load(re.sub(r"^    # (\w+: )", r"    \1", text, flags=re.MULTILINE))
    for node, parameters in DECLARED.items():
        assert content[f"/**/{node}"]["ros__parameters"] == {p.name: p.default for p in parameters}


def test_every_parameter_is_described():
    for parameters in DECLARED.values():
        for parameter in parameters:
            assert parameter.description.endswith(".")
            if isinstance(parameter.default, float) or type(parameter.default) is int:
                assert parameter.low <= parameter.default <= parameter.high


@pytest.mark.parametrize(
    ("node", "name", "value"),
    [
        ("excitation_node", "level_v", -1.0),
        ("excitation_node", "grid", "even"),
        ("excitation_node", "max_level_v", 10.0),
        ("excitation_node", "periods", 0),
        ("poles_node", "order", 21),
        ("fake_hardware_node", "seed", 0),
    ],
)
def test_what_is_out_of_range_is_refused_with_a_reason(ros, node, name, value):
    made = NODES[node]()
    try:
        before = made.get_parameter(name).value
        (result,) = made.set_parameters([RosParameter(name, value=value)])
        assert not result.successful
        assert name in result.reason
        assert made.get_parameter(name).value == before
    finally:
        made.destroy_node()


@pytest.mark.parametrize(
    ("node", "given"),
    [("excitation_node", "level_v:=0.2"), ("manager_node", "retry_s:=2.0"), ("scan_goal", "resume:=true")],
)
def test_a_name_that_is_misspelt_is_told(monkeypatch, node, given):
    """ROS passes over it without a word, and the default would hold."""
    told = []
    monkeypatch.setattr(Node, "get_logger", lambda _: SimpleNamespace(warning=told.append))
    arguments = ["-p", f"x{given}", "-p", given, "-p", "use_sim_time:=false"]
    with initialised(args=["--ros-args", *arguments], domain_id=free_domain_id(os.environ)):
        if node == "scan_goal":
            made = rclpy.create_node(node)
            declare(made, scan_goal.PARAMETERS)
        else:
            made = NODES[node]()
        made.destroy_node()
    name = given.partition(":")[0]
    assert told == [f"parameters that {node} does not have are given, and ignored: x{name}"]


def test_compressed_phases_for_one_realisation_only(ros):
    from tactile_resonance.action import Measure

    node = excitation_node.ExcitationNode()
    try:
        node.set_parameters([RosParameter("compression_passes", value=300)])
        goal = Measure.Goal(f_max_hz=500.0)
        (compressed,) = excitation_node.design(node, goal, 0)
        assert not compressed.random_phases
        assert compressed.crest_factor() < 2.2
        with pytest.raises(ValueError, match="realisations: 1000000, accepted is up to 1000"):
            excitation_node.design(node, Measure.Goal(realisations=10**6), 0)
        with pytest.raises(ValueError, match="compressed phases are not random"):
            excitation_node.design(node, Measure.Goal(realisations=2), 0)
    finally:
        node.destroy_node()


def test_a_sweep_keeps_its_phases(ros):
    from tactile_resonance.action import Measure

    node = excitation_node.ExcitationNode()
    try:
        node.set_parameters([RosParameter("compression_passes", value=300)])
        goal = Measure.Goal(f_max_hz=500.0, sweep=True, periods=2)
        first, second = (excitation_node.design(node, goal, n)[0] for n in range(2))
        assert not first.random_phases
        np.testing.assert_array_equal(first.period(), second.period())
        with pytest.raises(ValueError, match="realisations: got 2; accepted is 1 with sweep"):
            excitation_node.design(node, Measure.Goal(realisations=2, sweep=True), 0)
    finally:
        node.destroy_node()


def test_a_silent_measurement_plays_nothing(ros):
    from tactile_resonance.action import Measure

    node = excitation_node.ExcitationNode()
    try:
        node.set_parameters([RosParameter("compression_passes", value=300)])
        (silent,) = excitation_node.design(node, Measure.Goal(silent=True), 0)
        assert not np.any(silent.period())
        excitation_node.check_output([silent], SimpleNamespace(name="none", output_peak_v=0.0))
        with pytest.raises(ValueError, match="level_v: 1, a silent measurement plays nothing"):
            excitation_node.design(node, Measure.Goal(silent=True, level_v=1.0), 0)
    finally:
        node.destroy_node()


def test_lines_of_the_mains_are_left_out_where_the_laboratory_says_so(ros):
    from tactile_resonance.action import Measure

    node = excitation_node.ExcitationNode()
    goal = Measure.Goal(f_min_hz=190.0, f_max_hz=310.0)
    try:
        (whole,) = excitation_node.design(node, goal, 0)
        node.set_parameters([RosParameter("mains_hz", value=50.0)])
        (left,) = excitation_node.design(node, goal, 0)
        assert sorted({*whole.frequency_hz} - {*left.frequency_hz}) == [
            *(197.5, 200.0, 202.5, 247.5, 250.0, 252.5, 297.5, 300.0, 302.5)
        ]
        assert left.level_v == pytest.approx(whole.level_v)
        node.set_parameters([RosParameter("mains_hz", value=5.0)])
        with pytest.raises(ValueError, match="mains_hz: got 5.0; accepted is above 7.5 Hz"):
            excitation_node.design(node, goal, 0)
    finally:
        node.destroy_node()


def test_scan_goal_that_is_interrupted_does_not_end_as_if_every_point_were_finished(monkeypatch):
    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(scan_goal.ScanRequest, "__enter__", interrupt)
    monkeypatch.setattr(scan_goal, "noting_signals", lambda: nullcontext(None))
    with pytest.raises(SystemExit) as ended:
        scan_goal.main()
    assert ended.value.code == 130
