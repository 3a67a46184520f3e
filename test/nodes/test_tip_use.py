# SPDX-License-Identifier: Apache-2.0
"""A scan asks contact_node how the sensor is used."""

import os
import threading

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.nodes import scan_hands
from tactile_resonance.nodes.contact_node import ContactNode
from tactile_resonance.nodes.contact_parameters import read_parameters
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.running import initialised
from tactile_resonance.nodes.scan_time import ScanTime
from tactile_resonance.processes import free_domain_id

GIVEN = {"beam_tilt_rad": 0.2, "limits.depth_m": 3.5e-3, "contact.standoff_m": 4e-3}
GIVEN_AS = ["--ros-args", *(word for k, v in GIVEN.items() for word in ("-p", f"{k}:={v}"))]


class Asker(ManagedNode):
    def __init__(self):
        super().__init__("scan_node", ())

    def configure(self):
        self.hands = scan_hands.NodeHands(self, "base", True, ScanTime("", 60.0), print)


@pytest.fixture
def ask(monkeypatch):
    """What is told beside a node of a kind."""
    monkeypatch.setattr(scan_hands, "ANSWERED_WITHIN_S", 2.0)
    with initialised(args=GIVEN_AS, domain_id=free_domain_id(os.environ)):
        executor, made = SingleThreadedExecutor(), []

        def told(make):
            made.extend([Asker(), make()])
            made[0].trigger_configure()
            told = []
            thread = threading.Thread(target=lambda: told.append(made[0].hands.tip_use("bimorph")))
            for node in made:
                executor.add_node(node)
            thread.start()
            while thread.is_alive():
                executor.spin_once(0.05)
            return told[0], made[1]

        yield told
        for node in made:
            node.destroy_node()


def test_figures_are_those_of_contact_node(ask):
    use, node = ask(ContactNode)
    parameters, limits = read_parameters(node)
    assert use.tip == TipGeometry(beam_tilt_rad=0.2)
    assert use.limits.depth_m == 3.5e-3
    assert use.parameters.standoff_m == 4e-3
    for name in scan_hands.TIP_LIMITS:
        assert getattr(use.limits, name) == getattr(limits, name)
    for name in scan_hands.TIP_PARAMETERS:
        assert getattr(use.parameters, name) == getattr(parameters, name)


@pytest.mark.parametrize("name", ["contact_node", "another"])
def test_nothing_is_told_by_another_node(ask, name):
    assert ask(lambda: Node(name))[0] is None
