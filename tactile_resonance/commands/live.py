# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance live`: the page of a scan while it goes on, for a person beside the robot."""

from __future__ import annotations

import argparse
import os
import threading

from tactile_resonance.commands.options import add_option, require_packages
from tactile_resonance.fields import require
from tactile_resonance.processes import noting_signals

PORT = 8765
EACH_S = 0.2
"""Between two events of the page [s]."""


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of the command."""
    parser = commands.add_parser(
        "live",
        help="page of a scan while it goes on: map, force, poles, state",
        description="Listen to the nodes of this ROS_DOMAIN_ID and serve a page that shows what they publish: "
        "the map as it grows, force, poles and state; on 127.0.0.1 only, and to be read only. Ctrl-C ends it.",
    )
    add_option(parser, "--port", int, f"default: {PORT}; 0: any that is free", default=PORT)
    add_option(parser, "--namespace", "", "of the nodes (default: none)")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Listen and serve until interrupted."""
    from tactile_resonance.report.live import LiveRun, LiveServer

    require_packages("rclpy", "tactile_resonance.msg")
    from rclpy.exceptions import InvalidNamespaceException
    from rclpy.validate_namespace import validate_namespace

    try:
        validate_namespace(f"/{options.namespace.strip('/')}")
    except InvalidNamespaceException as error:
        accepted = "a ROS namespace, of letters, digits, _ and /, without a digit at its parts' beginning"
        require(not error, "--namespace", options.namespace, accepted)
    from tactile_resonance.nodes.client import LiveListener

    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    live = LiveRun(lambda name, data: server.publish(name, data))
    server = LiveServer(options.port, live.snapshot)
    ended, failed = threading.Event(), list[Exception]()

    def tick() -> None:
        try:
            while not ended.wait(EACH_S):
                if server.readers:
                    live.tick()
        except Exception as error:  # raised again below: a page that stands still would seem to be live
            failed.append(error)

    with noting_signals() as check, server, LiveListener(live, options.namespace) as listener:
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        print(f"{server.url} shows the nodes of ROS_DOMAIN_ID={domain}; Ctrl-C ends it", flush=True)
        threading.Thread(target=tick, daemon=True).start()
        try:
            while not failed:
                check()
                listener.spin(EACH_S)
            raise failed[0]
        finally:
            ended.set()
