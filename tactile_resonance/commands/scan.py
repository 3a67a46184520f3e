# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance scan` and `resume`: a scan on the simulated bench, through robot, load cell and nodes."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from importlib.util import find_spec
from pathlib import Path

from tactile_resonance.processes import NodeProcesses, free_domain_id
from tactile_resonance.simulation.plant_defaults import TABLE_IN_BASE

NODES = (
    *("fake_hardware_node", "excitation_node", "frf_node", "poles_node"),
    *("contact_node", "pole_map_node", "scan_node"),
)
START_WITHIN_S = 90.0
SCAN_WITHIN_S = 24 * 3600.0


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of both commands."""
    parser = commands.add_parser(
        "scan",
        help="a scan on the simulated bench, with robot, load cell and map",
        description="Start the nodes, a simulated robot and load cell as processes on loopback; touch every "
        "point of a scene at its force, measure until it is precise enough, record. Nothing here is a "
        "measurement.",
    )
    parser.add_argument("--scene", type=Path, help="default: the package's inclusion_scan.yaml")
    parser.add_argument("--output", type=Path, metavar="RUN", help="default: runs/scan-DATE-TIME")
    parser.add_argument("--seed", type=int, default=1, help="of phases and noise (default: 1)")
    _add_host(parser)
    parser.set_defaults(run=run_scan)
    parser = commands.add_parser(
        "resume",
        help="go on with a scan that was ended or killed",
        description="Go on with the next point of a run on the simulated bench.",
    )
    parser.add_argument("output", type=Path, metavar="RUN", help="folder of the run")
    _add_host(parser)
    parser.set_defaults(run=run_resume)


def _add_host(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--robot-host",
        default="127.0.1.1",
        help="127.x.y.z of the simulated robot (default: 127.0.1.1)",
    )


def run_scan(options: argparse.Namespace) -> int:
    """A new run."""
    from tactile_resonance.configuration import share_path

    scene = (options.scene or share_path("config/scenes/inclusion_scan.yaml")).resolve()
    output = options.output or Path("runs") / time.strftime("scan-%Y%m%d-%H%M%S")
    if options.seed < 1:
        raise ValueError(f"seed: {options.seed}, expected at least 1")
    return _run(output.resolve(), scene, options.robot_host, options.seed, resume=False)


def run_resume(options: argparse.Namespace) -> int:
    """What is left of a run."""
    output = options.output.resolve()
    return _run(output, output / "scene.yaml", options.robot_host, 1, resume=True)


def _run(output: Path, scene: Path, host: str, seed: int, *, resume: bool) -> int:
    for package in ("rclpy", "tactile_resonance.msg", "rtde_control", "can", "rosbags"):
        if find_spec(package) is None:
            raise ValueError(
                f"scan: {package} not found; it needs ROS 2, ur-rtde, python-can, rosbags"
            )
    from tactile_resonance.scan.scene import read_scan_scene

    content = read_scan_scene(scene)  # what is wrong in it is said before anything is started
    os.environ["ROS_DOMAIN_ID"] = str(free_domain_id())
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    work = output.with_name(output.name + ".work")
    table = f"[{','.join(str(value) for value in TABLE_IN_BASE)}]"
    parameters: dict[str, dict[str, object]] = {
        "fake_hardware_node": {
            "scene": scene,
            "robot_host": host,
            "table_in_base": table,
            "seed": seed,
        },
        "excitation_node": {"record_folder": work / "records"},
        "contact_node": {"robot_host": host, "force_host": host},
        "pole_map_node": {"classes_file": scene if content.tissue_classes else "''"},
        "scan_node": {"table_in_base": table},
    }
    with NodeProcesses(work / "log") as nodes:
        nodes.bring_up(NODES, parameters)
        try:
            complete = _scan(nodes, output, scene, seed, resume)
        except RuntimeError as error:
            raise ValueError(f"{error} (logs in {work / 'log'})") from error
    from tactile_resonance.commands import report

    report.run(argparse.Namespace(run_folder=output))
    return 0 if complete else 1


def _scan(nodes: NodeProcesses, output: Path, scene: Path, seed: int, resume: bool) -> bool:
    from tqdm import tqdm

    from tactile_resonance.action import Scan
    from tactile_resonance.nodes.scan_client import ScanClient

    goal = Scan.Goal(scene=str(scene), run_directory=str(output), resume=resume, seed=seed)
    with ScanClient(nodes.check) as client:
        client.wait_until_up(START_WITHIN_S)
        print(
            f"scan of {scene.name}, simulated. To listen: ROS_DOMAIN_ID={os.environ['ROS_DOMAIN_ID']} "
            f"ROS_AUTOMATIC_DISCOVERY_RANGE={os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE']}"
        )
        with tqdm(unit="point", file=sys.stderr, leave=False, disable=None) as bar:

            def show(feedback: Scan.Feedback) -> None:
                bar.total = feedback.points
                bar.update(feedback.finished - bar.n)
                bar.set_description(f"point {feedback.point + 1}: {feedback.phase}")

            result = client.scan(goal, show, SCAN_WITHIN_S)
    if result.outcome == Scan.Result.REFUSED:
        raise ValueError(f"scan: {result.message}")
    print(
        f"{result.message}: {result.done} points with poles, {result.failed} failed, {result.skipped} "
        f"skipped; {result.blocks} blocks, {result.blocks_saved} not needed ({result.saved_s:.1f} s)"
    )
    return result.outcome == Scan.Result.COMPLETE
