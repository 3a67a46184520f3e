# SPDX-License-Identifier: Apache-2.0
"""The command simulate-cell: it says when it is ready, ends in order, and says what is wrong in one line."""

import signal
import socket
import subprocess
import sys

import pytest

from tactile_resonance.cli import main

HOST = "127.0.6.7"
COMMAND = [sys.executable, "-m", "tactile_resonance.cli", "simulate-cell", "--host", HOST]
PATIENCE_S = 60.0


@pytest.mark.parametrize(
    ("bus", "number"), [("socketcand", signal.SIGINT), ("slcan", signal.SIGTERM)]
)
def test_it_ends_in_order(bus, number):
    process = subprocess.Popen(
        [*COMMAND, "--port", "0", "--bus", bus],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    line = process.stdout.readline()
    assert line.startswith(f"load cell: {bus} {HOST}:")
    socket.create_connection((HOST, int(line.rsplit(":", 1)[1])), PATIENCE_S).close()
    process.send_signal(number)
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert "Traceback" not in errors


def test_lines_that_mean_nothing_are_said():
    process = subprocess.Popen(
        [*COMMAND, "--port", "0"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    process.stdout.readline()
    process.stdin.write("melted 1\nforce\nsilent nan\nforce inf\nlose_second_every 0.5\n")
    process.stdin.flush()
    said = [process.stderr.readline() for _ in range(5)]
    process.terminate()
    process.communicate(timeout=PATIENCE_S)
    assert "fault: got 'melted'; accepted is silent, stuck" in said[0]
    assert "'force': expected a name and a number" in said[1]
    assert "silent: got nan" in said[2]
    assert "force: got inf" in said[3]
    assert "lose_second_every: got 0.5" in said[4]


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--port", "70000"], "--port: got 70000; accepted is 0 to 65535"),
        (["--seed", "-1"], "--seed: got -1"),
        (["--cell", "nowhere.yaml"], "nowhere.yaml"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(capsys, options, reason):
    assert main(["simulate-cell", "--host", HOST, *options]) == 1
    said = capsys.readouterr().err
    assert reason in said
    assert said.count("\n") == 1


def test_others_than_this_machine_are_not_served(capsys):
    assert main(["simulate-cell", "--host", "0.0.0.0"]) == 1
    assert "host: got '0.0.0.0'; accepted is an address 127.x.y.z" in capsys.readouterr().err


def test_a_port_in_use_is_said(capsys):
    with socket.create_server((HOST, 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["simulate-cell", "--host", HOST, "--port", str(port)]) == 1
    said = capsys.readouterr().err
    assert f"port {port} of {HOST}: Address already in use; does another simulation run" in said
    assert said.count("\n") == 1
