# SPDX-License-Identifier: Apache-2.0
"""The simulated robot's control port: faults to order, the truth, and what comes that is no order."""

import json
import socket
import time

import pytest

from tactile_resonance.sensor import read_sensor
from tactile_resonance.simulation.plant.defaults import CONTROL_PORT
from tactile_resonance.simulation.plant.tabletop import TIP_IN_FLANGE


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"command": "explode"}, "command: expected one of state"),
        ({"command": "freeze"}, "seconds: got None"),
        ({"command": "freeze", "seconds": 1, "part": "cable"}, "part: got 'cable'"),
        ({"command": "script_starts", "value": 1}, "value: got 1"),
        ({"command": "place_surface", "height_m": 7}, "surface_height_m"),
        ({"command": "place_tissue", "name": "granite"}, "tissue: .*'granite'"),
        ({"command": "move_surface", "breath_m": 0.5}, "breath_m: got 0.5; accepted is 0 to 0.02"),
        ({"command": "move_surface", "breath": 1e-3}, "breath.*one of"),
        ({"command": "cell_fault", "fault": "hungry", "value": 1}, "hungry"),
    ],
)
def test_control_port_says_what_it_accepts(robot, fields, message):
    command = fields.pop("command")
    with pytest.raises(ValueError, match=message):
        robot.order(command, **fields)


def test_control_port_survives_what_is_no_json(robot):
    with socket.create_connection((robot.host, CONTROL_PORT), 5) as channel:
        channel.sendall(b"{\n[1]\n")
        lines = channel.makefile()
        assert [json.loads(lines.readline())["ok"] for _ in range(2)] == [False, False]


def test_controller_that_stands_still_stops_its_clock(robot):
    robot.order("freeze", seconds=0.5, part="controller")
    first = robot.order("state")["time_s"]
    assert robot.order("state")["time_s"] == first
    robot.until(robot_mode="RUNNING")
    start = robot.order("state")["time_s"]
    while robot.order("state")["time_s"] < start + 0.1:
        pass


def test_table_and_truth(robot):
    flange_z = robot.order("state")["tcp_pose"][
        2
    ]  # no client has set a TCP, and the flange points down
    lowest_z = flange_z - TIP_IN_FLANGE.position_m[2] - read_sensor().tip.radius_m
    assert robot.order("truth")["in_contact"] is False
    robot.order("place_surface", height_m=lowest_z + 0.0005)
    end = time.monotonic() + 5
    while not (truth := robot.order("truth"))["in_contact"]:
        assert time.monotonic() < end
    assert truth["force_n"][2] > 0
    assert truth["depth_m"] > 0
    robot.order("place_surface", height_m=0.2)
    while robot.order("truth")["in_contact"]:
        assert time.monotonic() < end


@pytest.mark.parametrize(
    "line",
    [
        b'{"command": []}',
        b"[" * 20000,
        b'{"command": {"a": 1}}',
        b'{"command": "freeze", "seconds": 1, "part": []}',
        b'{"command": "history", "after_s": 1' + b"0" * 400 + b"}",
        b'{"command": "cell_fault", "fault": "stuck", "value": 1' + b"0" * 400 + b"}",
        b'{"command": "cell_fault", "fault": "lose_second_every", "value": -1}',
    ],
)
def test_control_port_answers_whatever_comes(robot, line):
    with socket.create_connection((robot.host, CONTROL_PORT), 5) as channel:
        channel.sendall(line + b"\n")
        assert not json.loads(channel.makefile().readline())["ok"]
    assert robot.order("state")["robot_mode"] == "RUNNING"
