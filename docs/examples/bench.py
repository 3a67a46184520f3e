# SPDX-License-Identifier: Apache-2.0
"""The nodes of mock.launch.py where `ros2 launch` is not installed, with its arguments, until Ctrl-C."""

import signal
import sys
from contextlib import suppress
from pathlib import Path

from tactile_resonance.bringup import plan_bringup
from tactile_resonance.processes import ENDING, NodeProcesses

for number in ENDING:
    signal.signal(number, signal.default_int_handler)
given = dict(argument.split(":=", 1) for argument in sys.argv[1:])  # robot:=ideal, for example
plan = plan_bringup({"use_mock_hardware": "true", **given}, {})
with NodeProcesses(Path("log")) as nodes, suppress(KeyboardInterrupt):
    nodes.bring_up([name for name in plan.nodes if name != "manager_node"], plan.nodes)
    print("nodes are started; Ctrl-C ends them", flush=True)
    signal.pause()
