# SPDX-License-Identifier: Apache-2.0
"""The nodes of mock.launch.py where `ros2 launch` is not installed, with arguments as those, until Ctrl-C."""

import signal
import sys
from contextlib import suppress
from pathlib import Path

from tactile_resonance.bringup import (
    ARGUMENTS,
    BROADCASTS,
    plan_bringup,
    read_parameter_file,
    stated_for,
)
from tactile_resonance.processes import ENDING, NodeProcesses

ACCEPTED = {*ARGUMENTS, *BROADCASTS, "robot", "real_time", "table_in_base", "params_file"}

for number in ENDING:
    signal.signal(number, signal.default_int_handler)
if wrong := [argument for argument in sys.argv[1:] if ":=" not in argument]:
    sys.exit(f"{', '.join(wrong)}: expected NAME:=VALUE, robot:=ideal for example")
given = dict(argument.split(":=", 1) for argument in sys.argv[1:])
if unknown := given.keys() - ACCEPTED:
    sys.exit(f"{', '.join(sorted(unknown))}: not among {', '.join(sorted(ACCEPTED))}")
file = given.pop("params_file", "")
try:
    sections = read_parameter_file(file) if file else {}
    plan = plan_bringup({"use_mock_hardware": "true", **given}, sections)
except ValueError as error:
    sys.exit(str(error))
parameters = {name: {**stated_for(f"/{name}", sections), **told} for name, told in plan.nodes.items()}
with NodeProcesses(Path("log")) as nodes, suppress(KeyboardInterrupt):
    nodes.bring_up([name for name in plan.nodes if name != "manager_node"], parameters)
    print("nodes are started, their logs are in log/; Ctrl-C ends them", flush=True)
    signal.pause()
