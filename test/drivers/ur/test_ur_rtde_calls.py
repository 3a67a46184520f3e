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
    (robot,) = start_robots("--tissue", "gel12", "--rigid-tip")
    run_calls("force", robot.host)


def test_four_robots_side_by_side(start_robots, run_calls):
    run_calls("four", *(robot.host for robot in start_robots(count=4)))
