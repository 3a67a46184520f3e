# SPDX-License-Identifier: Apache-2.0
"""A simulated robot as a process of its own, for the benchmarks that meet it on the wall clock."""

from __future__ import annotations

import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from tactile_resonance.processes import end_with_parent
from tactile_resonance.simulation.plant.defaults import READY

START_WITHIN_S = 60.0


@contextmanager
def simulated_robot(host: str, priority: int, *options: str) -> Iterator[subprocess.Popen]:
    """Start ``simulate-ur`` with tissue at an address, and end it.

    Raises
    ------
    ValueError
        If it does not start.
    """
    robot = subprocess.Popen(
        [
            *(sys.executable, "-m", "tactile_resonance.cli", "simulate-ur", "--host", host),
            *("--tissue", "gel12", "--priority", str(priority), *options),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        preexec_fn=end_with_parent if sys.platform == "linux" else None,
    )
    try:
        assert robot.stdout is not None
        ready, _, _ = select.select([robot.stdout], [], [], START_WITHIN_S)
        line = robot.stdout.readline() if ready else f"no answer within {START_WITHIN_S:g} s"
        if not line.startswith(READY):
            raise ValueError(f"the simulated robot does not start: {line.strip()}")
        yield robot
    finally:
        robot.send_signal(signal.SIGTERM)
        robot.communicate(timeout=60)
