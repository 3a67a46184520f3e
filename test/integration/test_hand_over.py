# SPDX-License-Identifier: Apache-2.0
"""contact_node lets go of the robot, another client takes it, and contact_node takes it back."""

from dataclasses import replace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")
pytest.importorskip("rtde_control", reason="ur-rtde is not here")

from lifecycle_msgs.msg import Transition

from tactile_resonance.configuration import share_path
from tactile_resonance.drivers.ur_arm import UrArm
from tactile_resonance.drivers.ur_config import read_ur_config
from tactile_resonance.nodes.client import HANGS_S

UP = (0.0, 0.0, 0.01, 0.0, 0.0, 0.0)


def released(bench, client):
    """Nothing of ours is left at the robot: no connection, no program, no claimed register."""
    client.wait(
        lambda: bench.order("state")["rtde_connections"] == 0, HANGS_S, "the connections to end"
    )
    client.wait(
        lambda: bench.order("state")["runtime_state"] == "STOPPED", HANGS_S, "the program to end"
    )


def test_the_robot_is_released_taken_by_another_client_and_taken_back(bench, client):
    result = client.result(client.start())
    assert result.reached, result.message
    held_m = bench.order("truth")["tip_m"][2]
    client.change_state(Transition.TRANSITION_DEACTIVATE)
    client.wait(
        lambda: bench.order("truth")["tip_m"][2] > held_m + 2e-3, HANGS_S, "the tip to leave"
    )
    assert bench.order("state")["rtde_connections"] > 0  # inactive it only rests
    client.change_state(Transition.TRANSITION_CLEANUP)
    released(bench, client)
    client.wait(
        lambda: client.managed.startswith("held: contact_node"), HANGS_S, "the manager to report it"
    )
    # another client: its program, its registers, its motion
    config = read_ur_config(share_path("config/devices/ur5e.yaml"))
    other = UrArm(
        replace(config, host=bench.host, connect_timeout_s=60.0), bench.parameters["time_server"]
    )
    try:
        other.connect()
        began_m = bench.order("truth")["tip_m"][2]
        other.speed(UP, 0.5)
        client.wait(
            lambda: other.state() and bench.order("truth")["tip_m"][2] > began_m + 1e-3,
            HANGS_S,
            "the other client to move the tip",
        )
    finally:
        other.close()
    released(bench, client)
    # the manager holds the node that somebody deactivated, until it is asked for
    assert bench.order("state")["rtde_connections"] == 0
    assert client.start_all().success
    client.idle()
    again = client.result(client.start(0.006, 0.0))
    assert again.reached, again.message
    client.retract()
    client.idle()
