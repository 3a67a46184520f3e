# SPDX-License-Identifier: Apache-2.0
"""A scan on the simulated bench with all nodes as processes: what `demo`, `scan` and `resume` share."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from tactile_resonance.processes import NodeProcesses, free_domain_id, may_take_priority
from tactile_resonance.simulation.plant_defaults import (
    HOST,
    PATIENT,
    PATIENT_S,
    PRIORITY,
    TABLE_IN_BASE,
)

if TYPE_CHECKING:
    from tactile_resonance.action import Scan

NODES = (
    *("fake_hardware_node", "excitation_node", "frf_node", "poles_node"),
    *("contact_node", "pole_map_node", "scan_node"),
)
# Without real-time priority what computes gives way to what lives by milliseconds: the simulated robot and
# the control loop.
COMPUTING = ("excitation_node", "frf_node", "poles_node", "pole_map_node", "scan_node")
NICENESS = 10
START_WITHIN_S = 90.0
SCAN_WITHIN_S = 24 * 3600.0


@dataclass(frozen=True)
class Job:
    """What is scanned, and where the run goes.

    Attributes
    ----------
    scene, output : Path
    host : str
        127.x.y.z of the simulated robot.
    seed : int
    resume : bool
    hardware_limits : bool
        Data may be no older than is accepted of hardware.
    notes : str
        Of the session, in place of the scene's.
    """

    scene: Path
    output: Path
    host: str
    seed: int = 1
    resume: bool = False
    hardware_limits: bool = False
    notes: str = ""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of all three commands."""
    parser.add_argument(
        "--robot-host",
        default=HOST,
        help=f"127.x.y.z of the simulated robot (default: {HOST})",
    )
    parser.add_argument(
        "--hardware-limits",
        action="store_true",
        help="let data of the simulated robot and load cell be no older than is accepted of hardware (20 and "
        "10 ms, not 60): on an idle machine with real-time priority",
    )


def add_scene_options(parser: argparse.ArgumentParser, scene: str, output: str) -> None:
    """Options of a new run."""
    parser.add_argument("--scene", type=Path, help=f"scene file (default: the package's {scene})")
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help=f"default: runs/{output}-DATE-TIME"
    )
    parser.add_argument("--seed", type=int, default=1, help="of phases and noise (default: 1)")
    parser.add_argument(
        "--notes",
        default="",
        metavar="YAML",
        help="of the session, for example '{temperature_c: 21.5, tip_wetness: wet, adhesion: none}'",
    )
    add_options(parser)


def new_job(options: argparse.Namespace, scene: str, output: str) -> Job:
    """Job of the options of a new run."""
    from tactile_resonance.configuration import share_path

    if not 1 <= options.seed <= 2**31:
        raise ValueError(f"seed: {options.seed}, expected 1 to 2^31")
    folder = options.output or Path("runs") / time.strftime(f"{output}-%Y%m%d-%H%M%S")
    return Job(
        (options.scene or share_path(f"config/scenes/{scene}")).resolve(),
        folder.resolve(),
        options.robot_host,
        options.seed,
        hardware_limits=options.hardware_limits,
        notes=_checked_notes(options.notes),
    )


def _checked_notes(text: str) -> str:
    from tactile_resonance.scan.notes import parse_notes

    parse_notes(text, "notes")
    return text


def run_job(job: Job) -> int:
    """Start the nodes, scan, report; always end the nodes. 0 where every point of the plan is finished."""
    for package in ("rclpy", "tactile_resonance.msg", "rtde_control", "can", "rosbags"):
        if find_spec(package) is None:
            raise ValueError(
                f"{package} not found: a scan needs ROS 2, ur-rtde, python-can and rosbags; use "
                "'make demo', or build the package with colcon in a sourced ROS 2 and source its install folder"
            )
    from tactile_resonance.commands import report
    from tactile_resonance.scan.scene import read_scan_scene

    begun_s = time.monotonic()
    content = read_scan_scene(job.scene)  # what is wrong in it is said before anything is started
    os.environ["ROS_DOMAIN_ID"] = str(free_domain_id())
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    for number in (signal.SIGINT, signal.SIGTERM):
        # both end the nodes in order, even where a shell made this process ignore Ctrl-C
        signal.signal(number, signal.default_int_handler)
    print(
        f"scan of {content.name}, simulated. To listen: ROS_DOMAIN_ID={os.environ['ROS_DOMAIN_ID']} "
        f"ROS_AUTOMATIC_DISCOVERY_RANGE={os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE']}"
    )
    priority = may_take_priority(PRIORITY)
    if not priority:
        print("real-time priority is not permitted here (rtprio): contacts may have to be repeated")
    if not job.hardware_limits:
        print(
            f"data of the simulated robot and load cell may be {1e3 * PATIENT_S:g} ms old, "
            "more than is accepted of hardware (--hardware-limits)"
        )
    work = job.output.with_name(job.output.name + ".work")
    parameters = _parameters(job, bool(content.tissue_classes), work)
    with NodeProcesses(work / "log") as nodes:
        nodes.bring_up(
            NODES, parameters, niceness=dict.fromkeys(() if priority else COMPUTING, NICENESS)
        )
        try:
            result = _scan(nodes, job)
        except RuntimeError as error:
            raise ValueError(f"{error} (logs in {work / 'log'})") from error
    report.run(argparse.Namespace(run_folder=job.output))
    print(f"{result.sensor_health}\n{time.monotonic() - begun_s:.1f} s in all; run in {job.output}")
    return 0 if result.outcome == type(result).COMPLETE else 1


def _parameters(job: Job, classes: bool, work: Path) -> dict[str, dict[str, object]]:
    """Of each node, beside their defaults."""
    table = f"[{','.join(str(value) for value in TABLE_IN_BASE)}]"
    return {
        "fake_hardware_node": {
            "scene": job.scene,
            "robot_host": job.host,
            "table_in_base": table,
            "seed": job.seed,
        },
        "excitation_node": {"record_folder": work / "records"},
        "contact_node": {
            "robot_host": job.host,
            "force_host": job.host,
            **({} if job.hardware_limits else PATIENT),
        },
        "pole_map_node": {"classes_file": job.scene if classes else "''"},
        "scan_node": {"table_in_base": table},
    }


def _scan(nodes: NodeProcesses, job: Job) -> Scan.Result:
    # only here: the command answers --help, and says what is missing, without ROS
    from tqdm import tqdm

    from tactile_resonance.action import Scan
    from tactile_resonance.nodes.scan_client import ScanClient

    goal = Scan.Goal(
        scene=str(job.scene),
        run_directory=str(job.output),
        resume=job.resume,
        seed=job.seed,
        notes=job.notes,
    )
    with ScanClient(nodes.check) as client:
        client.wait_until_up(START_WITHIN_S)
        with tqdm(unit="point", file=sys.stderr, leave=False, disable=None) as bar:

            def show(feedback: Scan.Feedback) -> None:
                bar.total = feedback.points
                bar.set_description(f"point {feedback.point + 1}: {feedback.phase}", refresh=False)
                if feedback.repeats:
                    bar.set_postfix_str(f"{feedback.repeats} repeated", refresh=False)
                bar.update(feedback.finished - bar.n)
                bar.refresh()

            result = client.scan(goal, show, SCAN_WITHIN_S)
        stalls = client.details("fake_hardware_node").get("simulator stalls")
    if result.outcome == Scan.Result.REFUSED:
        raise ValueError(f"scan: {result.message}")
    print(
        f"{result.message}: {result.done} points with poles, {result.failed} failed, {result.skipped} "
        f"skipped; {result.blocks} blocks, {result.blocks_saved} not needed ({result.saved_s:.1f} s)"
    )
    if stalls:
        print(f"the simulation itself stood still for more than 10 ms: {stalls} times")
    return result
