# SPDX-License-Identifier: Apache-2.0
"""The unmodified ur_rtde on the simulated robot: client_calls.py says what each name asserts."""

import pytest

SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("flags", "refused")]


@pytest.mark.parametrize(
    "name", ["connect", "moves", "streams", "settings", "watchdog", "stops", *SLOW]
)
def test_calls(robot, run_calls, name):
    run_calls(name, robot.host)


def test_force_and_contact(start_robots, run_calls):
    (robot,) = start_robots("--simulated-time", "--tissue", "gel12", "--rigid-tip")
    run_calls("force", robot.host)


@pytest.mark.parametrize("count", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_robots_side_by_side(start_robots, run_calls, count):
    robots = start_robots("--simulated-time", count=count)
    run_calls("side_by_side", *(robot.host for robot in robots))
