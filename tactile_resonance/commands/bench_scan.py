# SPDX-License-Identifier: Apache-2.0
"""A scan on the simulated bench with all nodes as processes: what `demo`, `scan` and `resume` share."""

from __future__ import annotations

import argparse
import math
import os
import shutil
import signal
import sys
import time
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_resonance import bringup
from tactile_resonance.bringup import plan_bringup
from tactile_resonance.calibration.file import read_calibration
from tactile_resonance.counted import counted
from tactile_resonance.processes import (
    ENDING,
    NodeProcesses,
    domain_is_free,
    free_domain_id,
    may_take_priority,
)
from tactile_resonance.simulation.plant.defaults import PRIORITY

if TYPE_CHECKING:
    from tactile_resonance.action import Scan
    from tactile_resonance.client import ScanOutcome

NODES = bringup.NODES[:-1]
"""All but the manager."""
# On the wall clock, without real-time priority, what computes gives way to what lives by milliseconds: the
# simulated robot and the control loop.
COMPUTING = ("excitation_node", "frf_node", "poles_node", "pole_map_node", "scan_node")
NICENESS = 10
HUNG_AFTER_S = 60.0
"""A scan_node that is silent for so long hangs; it reports each second, and watches the other nodes itself."""
LOOK_S = 3.0  # nodes in a domain are found within this
START_WITHIN_S = 300.0  # they come up in seconds; a machine with much else to do takes longer
INTERRUPTED = 130


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
    real_time : bool
        On the wall clock; else in simulated time, as fast as this machine computes.
    notes : str
        Of the session, in place of the scene's.
    calibration : Path or None
        Of the sensor, for poles_node.
    """

    scene: Path
    output: Path
    host: str
    seed: int = 1
    resume: bool = False
    real_time: bool = False
    notes: str = ""
    calibration: Path | None = None


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of all three commands."""
    add_robot_host(parser)
    parser.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE",
        help="of `tactile_resonance calibrate`: poles through this sensor where the data do not contradict it",
    )
    parser.add_argument(
        "--real-time",
        action="store_true",
        help="on the wall clock, as with hardware: what this machine is too slow for is late, and repeated "
        "(default: simulated time, in which a slow machine takes longer and nothing else)",
    )


def add_robot_host(parser: argparse.ArgumentParser) -> None:
    """The option ``--robot-host``; empty where it is not given."""
    parser.add_argument(
        "--robot-host",
        default="",
        help="127.x.y.z of the simulated robot (default: one of its own for each ROS domain)",
    )


def take_domain(host: str) -> str:
    """Take a ROS domain of this machine alone; return the address of the simulated robot, given or its own."""
    domain = free_domain_id()
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    return host or f"127.0.2.{domain + 1}"


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
    from tactile_resonance.scan.notes import parse_notes

    parse_notes(options.notes, "--notes")
    if not 1 <= options.seed <= 2**31:
        raise ValueError(f"--seed: {options.seed}, expected 1 to 2^31")
    if options.scene is not None and not options.scene.is_file():
        what = "a folder" if options.scene.is_dir() else "not there"
        raise ValueError(f"--scene: {options.scene} is {what}; accepted is a scene file")
    if options.output is not None and options.output.is_file():
        raise ValueError(f"--output: {options.output} is a file; accepted is a new or empty folder")
    folder = options.output or Path("runs") / time.strftime(f"{output}-%Y%m%d-%H%M%S")
    return Job(
        (options.scene or share_path(f"config/scenes/{scene}")).resolve(),
        folder.resolve(),
        options.robot_host,
        options.seed,
        real_time=options.real_time,
        notes=options.notes,
        calibration=checked_calibration(options.calibration),
    )


def checked_calibration(path: Path | None) -> Path | None:
    """The file, whole; raises ``ValueError`` where it is no calibration."""
    if path is None:
        return None
    read_calibration(path)
    return path.resolve()


def run_job(job: Job) -> int:
    """Start the nodes, scan, report; always end the nodes.

    Returns 0 where every point of the plan is finished and one at least has poles, else 1.
    """
    require_packages("rclpy", "tactile_resonance.msg", "rtde_control", "can", "rosbags", "plotly")
    from tactile_resonance.client import Ending
    from tactile_resonance.commands import report
    from tactile_resonance.scan.adaptive import WantedBoundary
    from tactile_resonance.scan.run_directory import RunDirectory
    from tactile_resonance.scan.scene import read_scan_scene

    begun_s = time.monotonic()
    # what cannot be scanned is reported before anything is started
    content = read_scan_scene(job.scene)
    if not job.resume:
        RunDirectory.check_new(job.output, 0)
    job = replace(job, host=take_domain(job.host))
    require_own_domain()
    ended = _Ended()
    print(
        f"scan of {content.name}, simulated. To listen: ROS_DOMAIN_ID={os.environ['ROS_DOMAIN_ID']} "
        f"ROS_AUTOMATIC_DISCOVERY_RANGE={os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE']}",
        flush=True,
    )
    priority = may_take_priority(PRIORITY)
    if job.real_time and not priority:
        print("real-time priority is not permitted here (rtprio): contacts may have to be repeated")
    work = job.output.with_name(job.output.name + ".work")
    parameters = node_parameters(job, bool(content.tissue_classes), work, content.frame_id)
    parameters["pole_map_node"]["unknown_level"] = content.unknown_level
    if content.adaptive is not None and isinstance(content.adaptive.wanted, WantedBoundary):
        ends = content.adaptive.wanted.level_set
        finite = [end if math.isfinite(end) else 0.0 for end in (ends.low, ends.high)]
        parameters["pole_map_node"]["boundary_f0_hz"] = finite
    computing = () if priority or not job.real_time else COMPUTING
    with NodeProcesses(work / "log") as nodes:
        nodes.bring_up(NODES, parameters, niceness=dict.fromkeys(computing, NICENESS))
        try:
            result = _scan(nodes, job, ended)
        except (RuntimeError, ValueError) as error:
            text = f"{error} (logs in {work / 'log'}){_way_on(job)}"
            raise ValueError(text) from error
        except KeyboardInterrupt as error:
            raise KeyboardInterrupt(_way_on(job)) from error
    ended.check()
    ended.at_once()  # every file of a report is whole or not there
    if result.ending is Ending.COMPLETE:  # each simulated record that counts is in the run
        shutil.rmtree(work / "records", ignore_errors=True)
    try:
        report.report_run(job.output)
    except OSError as error:
        if result.ending is Ending.COMPLETE:
            raise
        print(f"no report: {error}")  # the disk that ended the scan
    print(f"{result.sensor_health}\n{time.monotonic() - begun_s:.1f} s in all; run in {job.output}")
    if result.ending is not Ending.COMPLETE:
        raise ValueError(f"{result.message}{_way_on(job)}")
    return 0 if result.done else 1


def _way_on(job: Job) -> str:
    """How a person goes on with a run that has ended early; empty where none was begun."""
    if not (job.output / "run.json").exists():
        return ""
    return f"; tactile_resonance resume {job.output} goes on with the run"


def require_own_domain() -> None:
    """``ValueError`` where the ROS domain has nodes of another session: each would take the other's goals."""
    from tactile_resonance.nodes.client import ScanClient

    domain = free_domain_id()
    if domain_is_free(domain):
        return
    with ScanClient(lambda: None) as client:
        if found := client.nodes_there(bringup.NODES, LOOK_S):
            raise ValueError(
                f"ROS_DOMAIN_ID: {domain} has {', '.join(found)} of another session; accepted is a domain "
                "without them, unset it and one is taken"
            )


def require_packages(*packages: str) -> None:
    """``ValueError`` where one is not installed."""
    for package in packages:
        if find_spec(package) is None:
            raise ValueError(
                f"{package} not found: this needs ROS 2, ur-rtde, python-can, rosbags and plotly; use "
                "'make demo', or build the package with colcon in a sourced ROS 2 and source its install folder"
            )


class _Ended:
    """Notes `ENDING` signals, so that they take effect only where they may: see `check` and `at_once`.

    They end the nodes in order, even where a shell made this process ignore Ctrl-C.
    """

    def __init__(self) -> None:
        self._asked = self._at_once = False
        for number in ENDING:
            signal.signal(number, self._note)

    def check(self) -> None:
        """Raise `KeyboardInterrupt` if a signal has come."""
        if self._asked:
            raise KeyboardInterrupt

    def at_once(self) -> None:
        """From now on a signal ends the process at once: no node runs that would have to be ended first."""
        self._at_once = True

    def _note(self, *_: object) -> None:
        self._asked = True
        if self._at_once:
            print("tactile_resonance: interrupted", file=sys.stderr)
            sys.stdout.flush()
            os._exit(INTERRUPTED)


def node_parameters(
    job: Job, classes: bool, work: Path, table_frame: str = "table"
) -> dict[str, dict[str, object]]:
    """Parameters of each node that differ from their defaults, as `mock.launch.py` passes them."""
    arguments = {
        "use_mock_hardware": "true",
        "robot": "true",
        "robot_ip": job.host,
        "scene": str(job.scene),
        "run_directory": str(job.output),
        "table_frame": table_frame,
        "real_time": str(job.real_time).lower(),
    }
    nodes = plan_bringup(arguments, {}, priority=may_take_priority(PRIORITY)).nodes
    nodes["fake_hardware_node"]["seed"] = job.seed
    nodes["excitation_node"]["record_folder"] = work / "records"
    if job.calibration is not None:
        nodes["poles_node"]["calibration"] = str(job.calibration)
    if classes:
        nodes["pole_map_node"]["classes_file"] = job.scene
    return nodes


def _scan(nodes: NodeProcesses, job: Job, ended: _Ended) -> ScanOutcome:
    # only here: the command answers --help, and reports what is missing, without ROS
    from tactile_resonance.client import Ending
    from tactile_resonance.nodes.client import ScanClient

    goal: dict[str, Any] = {"run_directory": job.output, "resume": job.resume}
    if not job.resume:
        goal |= {"scene": job.scene, "seed": job.seed, "notes": job.notes}
    up = False
    silence = Silence()

    def check() -> None:
        ended.check()
        nodes.check()
        if up and silence.lasts_s(client.reports["scan_node"]) > HUNG_AFTER_S:
            raise RuntimeError(f"scan_node hangs: it is silent for {HUNG_AFTER_S:g} s")
        state, _, reason = client.states.get("fake_hardware_node", "").partition(": ")
        if not up and state == "unconfigured" and reason:
            raise ValueError(f"the simulated bench does not start: {reason}")

    with ScanClient(check) as client:
        client.wait_until_up(START_WITHIN_S)
        up = True
        with _Bar() as bar:
            result = client.scan(**goal, on_feedback=bar.show)
        stalls = client.details("fake_hardware_node").get("simulator stalls")
    if result.ending in (Ending.REJECTED, Ending.REFUSED, Ending.LOST):
        raise ValueError(f"scan: {result.message}")
    print(
        f"{result.message}: {result.done} points with poles, {result.failed} failed, {result.skipped} "
        f"skipped; {counted(result.blocks, 'block')}, {result.blocks_saved} not needed ({result.saved_s:.1f} s)"
    )
    if stalls:
        print(f"the simulation itself stood still for more than 10 ms: {stalls} times")
    return result


class Silence:
    """How long a count has stood still, by time in which this process ran."""

    def __init__(self) -> None:
        self._count, self._stood_s, self._looked_s = -1, 0.0, time.monotonic()

    def lasts_s(self, count: int) -> float:
        """To be asked several times a second."""
        now_s = time.monotonic()
        step_s = min(now_s - self._looked_s, 1.0)  # more: this process was stopped
        self._stood_s = self._stood_s + step_s if count == self._count else 0.0
        self._count, self._looked_s = count, now_s
        return self._stood_s


class _Bar:
    """How far a scan is: a bar on a terminal, a line for each point elsewhere."""

    def __init__(self) -> None:
        from tqdm import tqdm

        self._bar = tqdm(unit="point", file=sys.stderr, leave=False, disable=None)
        self._begun_s, self._finished = time.monotonic(), -1
        self._waiting_for = ""

    def __enter__(self) -> _Bar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def show(self, feedback: Scan.Feedback) -> None:
        """Take the feedback of the scan."""
        bar = self._bar
        if feedback.waiting_for and feedback.waiting_for != self._waiting_for:
            bar.write(f"waiting: {feedback.waiting_for}", file=sys.stdout)
        self._waiting_for = feedback.waiting_for
        if bar.disable:
            if feedback.finished != self._finished:
                self._finished = feedback.finished
                seconds = time.monotonic() - self._begun_s
                print(f"{feedback.finished} of {feedback.points} points after {seconds:.0f} s")
            sys.stdout.flush()
            return
        bar.total = feedback.points
        bar.set_description(f"point {feedback.point + 1}: {feedback.phase}", refresh=False)
        if feedback.repeats:
            bar.set_postfix_str(f"{feedback.repeats} repeated", refresh=False)
        bar.update(feedback.finished - bar.n)
        bar.refresh()
