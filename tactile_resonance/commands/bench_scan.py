# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance demo`, `scan` and `resume`: scans on the simulated bench, with all nodes as processes."""

from __future__ import annotations

import argparse
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_resonance import bringup
from tactile_resonance.bringup import plan_bringup
from tactile_resonance.calibration.model import read_calibration
from tactile_resonance.commands.options import ProgressBar, add_option, require_packages
from tactile_resonance.fields import counted, require
from tactile_resonance.processes import (
    NodeProcesses,
    domain_is_free,
    free_domain_id,
    may_take_priority,
    noting_signals,
)
from tactile_resonance.simulation.plant.defaults import PRIORITY

if TYPE_CHECKING:
    from tactile_resonance.action import Scan
    from tactile_resonance.client import ScanOutcome

NODES = bringup.NODES[:-1]
"""All but the manager."""
# On the wall clock, without real-time priority, what computes gives way to what lives by milliseconds: the
# simulated robot and the control loop. Each node is a session of its own: where the scheduler groups processes
# by session (autogroup, not within a cgroup that shares out processors), niceness has no effect between them.
COMPUTING = ("excitation_node", "frf_node", "poles_node", "pole_map_node", "scan_node")
NICENESS = 10
HUNG_AFTER_S = 60.0
"""A scan_node that is silent for so long hangs; it reports each second, and watches the other nodes itself."""
LOOK_S = 3.0  # where one node of a domain is found, the others are within this
START_WITHIN_S = 300.0  # they come up in seconds; a machine with much else to do takes longer


NEW_RUNS = {
    "demo": (
        "demo.yaml",
        "a short scan over a hidden inclusion, on the simulated bench",
        "What `scan` does, on a scene that takes a minute or less: a simulated robot brings the "
        "sensor to 1 cN at up to 16 points of a gelatine phantom, chosen for the boundary of something stiffer "
        "hidden in it; boundary, poles, map and table follow, beside the simulation's truth. Nothing here is a "
        "measurement.",
    ),
    "scan": (
        "inclusion_scan.yaml",
        "a scan on the simulated bench, with robot, load cell and map",
        "Start the nodes, a simulated robot and load cell as processes on loopback; touch every point of a "
        "scene at its force, measure until it is precise enough, record. Nothing here is a measurement.",
    ),
}
"""Scene, help and description of the commands that begin a run."""


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


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of the three commands."""
    for name, (scene, text, description) in NEW_RUNS.items():
        parser = commands.add_parser(name, help=text, description=description)
        add_option(parser, "--scene", Path, f"scene file (default: the package's {scene})")
        add_option(parser, "--output DIR", Path, f"default: runs/{name}-DATE-TIME")
        add_option(parser, "--seed", 1, "of phases and noise")
        example = "{temperature_c: 21.5, tip_wetness: wet, adhesion: none}"
        add_option(parser, "--notes YAML", "", f"of the session, for example '{example}'")
        _add_options(parser)
        parser.set_defaults(job=partial(_new_job, scene=scene, name=name))
    parser = commands.add_parser(
        "resume",
        help="go on with a scan that was ended or killed",
        description="Go on with the next point of a run on the simulated bench.",
    )
    add_option(parser, "output RUN", Path, "folder of the run")
    _add_options(parser)
    parser.set_defaults(job=_resumed_job)


def _add_options(parser: argparse.ArgumentParser) -> None:
    add_robot_host(parser)
    text = "of `tactile_resonance calibrate`: poles through this sensor where the data do not contradict it"
    add_option(parser, "--calibration FILE", Path, text)
    add_option(
        parser, "--real-time", False,
        "on the wall clock, as with hardware: what this machine is too slow for is late, and repeated "
        "(default: simulated time, in which a slow machine takes longer and nothing else)",
    )
    parser.set_defaults(run=lambda options: run_job(options.job(options)))


def add_robot_host(parser: argparse.ArgumentParser) -> None:
    """The option ``--robot-host``; empty where it is not given."""
    text = "127.x.y.z of the simulated robot (default: one of its own for each ROS domain)"
    add_option(parser, "--robot-host", "", text)


def take_domain(host: str) -> str:
    """Take a ROS domain of this machine alone; return the address of the simulated robot, given or its own."""
    domain = free_domain_id()
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    return host or f"127.0.2.{domain + 1}"


def _new_job(options: argparse.Namespace, scene: str, name: str) -> Job:
    from tactile_resonance.configuration import share_path
    from tactile_resonance.scan.scene import parse_notes

    parse_notes(options.notes, "--notes")
    require(1 <= options.seed <= 2**31, "--seed", options.seed, "1 to 2^31")
    if options.scene is not None and not options.scene.is_file():
        what = "a folder" if options.scene.is_dir() else "not there"
        raise ValueError(f"--scene: {options.scene} is {what}; accepted is a scene file")
    if options.output is not None and options.output.is_file():
        raise ValueError(f"--output: {options.output} is a file; accepted is a new or empty folder")
    folder = options.output or Path("runs") / time.strftime(f"{name}-%Y%m%d-%H%M%S")
    return Job(
        (options.scene or share_path(f"config/scenes/{scene}")).resolve(),
        folder.resolve(),
        options.robot_host,
        options.seed,
        real_time=options.real_time,
        notes=options.notes,
        calibration=_checked_calibration(options.calibration),
    )


def _resumed_job(options: argparse.Namespace) -> Job:
    from tactile_resonance.scan.goal import ScanGoal, resumed_run
    from tactile_resonance.scan.run_content import read_plan

    run = resumed_run(ScanGoal(run_directory=str(options.output.resolve()), resume=True))
    return Job(
        run / "scene.yaml",
        run,
        options.robot_host,
        int(read_plan(run).facts.get("seed", 1)),
        resume=True,
        real_time=options.real_time,
        calibration=_checked_calibration(options.calibration),
    )


def _checked_calibration(path: Path | None) -> Path | None:
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
    from tactile_resonance.commands.plan import read_phantoms
    from tactile_resonance.scan.level_set import LevelSet
    from tactile_resonance.scan.plan import make_plan
    from tactile_resonance.scan.point_outcome import AFTER, is_calibrated
    from tactile_resonance.scan.point_result import PointOutcome
    from tactile_resonance.scan.run_directory import RunDirectory
    from tactile_resonance.scan.scene import read_scan_scene

    begun_s = time.monotonic()
    # what cannot be scanned is reported before anything is started
    if not job.resume:
        RunDirectory.check_new(job.output, 0)
    else:
        with RunDirectory.open(job.output) as run:
            so_far = run.content
        if so_far.next_point is None and so_far.paths(reference=AFTER):
            print(f"{job.output} is complete: nothing is left to measure")
            report.report_run(job.output)
            return 0 if any(of.outcome is PointOutcome.DONE for of in so_far.latest) else 1
        # poles of one run are to be of one estimator
        given, began = job.calibration is not None, is_calibrated(so_far)
        accepted = "the file with which the run began" if began else "none: the run began without"
        require(began in (None, given), "--calibration", str(job.calibration or "none"), accepted)
    content = read_scan_scene(job.scene)
    make_plan(content)
    touched = read_phantoms(job.scene) is not None
    require(touched, f"{job.scene.name}: regions", None, "what the simulated bench touches")
    job = replace(job, host=take_domain(job.host))
    require_own_domain()
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
    if content.adaptive is not None and isinstance(content.adaptive.wanted, LevelSet):
        parameters["pole_map_node"]["adaptive_scene"] = str(job.scene)
    computing = () if priority or not job.real_time else COMPUTING
    try:
        with noting_signals() as check_signals, NodeProcesses(work / "log") as nodes:
            nodes.bring_up(NODES, parameters, niceness=dict.fromkeys(computing, NICENESS))
            result = _scan(nodes, job, check_signals)
    # the nodes have ended: whether a run was begun is certain now
    except (RuntimeError, ValueError) as error:
        # a resumption that was refused would be refused again
        way_on = "" if job.resume and isinstance(error, ScanRefused) else _way_on(job)
        raise ValueError(f"{error} (logs in {work / 'log'}){way_on}") from error
    except OSError as error:  # the terminal was closed, which may be seen before SIGHUP comes
        raise OSError(error.errno, f"{error.strerror or error}{_way_on(job)}", error.filename) from error
    except KeyboardInterrupt as error:
        raise KeyboardInterrupt(_way_on(job)) from error
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


class ScanRefused(ValueError):
    """scan_node did not take the goal."""


def _way_on(job: Job) -> str:
    """How a person goes on with a run that has ended early; empty where none was begun."""
    if not (job.output / "run.json").exists():
        return ""
    command = os.environ.get("TACTILE_RESONANCE_COMMAND", "tactile_resonance")  # as a person calls it
    return f"; {command} resume {job.output} goes on with the run"


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


def _scan(nodes: NodeProcesses, job: Job, check_signals: Callable[[], None]) -> ScanOutcome:
    # only here: the command answers --help, and reports what is missing, without ROS
    from tactile_resonance.client import Ending
    from tactile_resonance.nodes.client import ScanClient

    goal: dict[str, Any] = {"run_directory": job.output, "resume": job.resume}
    if not job.resume:
        goal |= {"scene": job.scene, "seed": job.seed, "notes": job.notes}
    up = False
    silence = Silence()

    def check() -> None:
        check_signals()
        nodes.check()
        if up and silence.lasts_s(client.reports["scan_node"]) > HUNG_AFTER_S:
            raise RuntimeError(f"scan_node hangs: it is silent for {HUNG_AFTER_S:g} s")
        state, _, reason = client.states.get("fake_hardware_node", "").partition(": ")
        if not up and state == "unconfigured" and reason:
            raise ValueError(f"the simulated bench does not start: {reason}")

    with ScanClient(check) as client:
        client.wait_until_up(START_WITHIN_S)
        up = True
        with ProgressBar() as bar:
            result = client.scan(**goal, on_feedback=_shown_by(bar))
        stalls = client.details("fake_hardware_node").get("simulator stalls")
    if result.ending in (Ending.REJECTED, Ending.REFUSED):
        raise ScanRefused(f"scan: {result.message}")
    if result.ending is Ending.LOST:
        raise ValueError(f"scan: {result.message}")
    print(
        f"{result.message}: {result.done} points with poles, {result.failed} failed, {result.skipped} "
        f"skipped; {counted(result.blocks, 'block')}, {result.blocks_saved} not taken ({result.saved_s:.1f} s)"
    )
    if stalls:
        print(f"the simulation itself stood still for more than 10 ms: {stalls} times")
    return result


def _shown_by(bar: ProgressBar) -> Callable[[Scan.Feedback], None]:
    """What shows the feedback of a scan."""
    begun_s, waiting_for = time.monotonic(), ""

    def show(feedback: Scan.Feedback) -> None:
        nonlocal waiting_for
        if feedback.waiting_for and feedback.waiting_for != waiting_for:
            bar.say(f"waiting: {feedback.waiting_for}")
        waiting_for = feedback.waiting_for
        done, of = feedback.finished, feedback.points
        line = f"{done} of {of} points after {time.monotonic() - begun_s:.0f} s"
        what = f"point {feedback.point + 1}: {feedback.phase}"
        repeated = f"{feedback.repeats} repeated" if feedback.repeats else ""
        bar.show(what, done, of, done, line, repeated)

    return show


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
