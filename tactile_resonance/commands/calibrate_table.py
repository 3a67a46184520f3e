# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance calibrate-table`: where the table stands in the robot's base, by touching it."""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_resonance.commands.bench_scan import (
    START_WITHIN_S,
    Job,
    add_robot_host,
    node_parameters,
    take_domain,
)
from tactile_resonance.commands.options import add_option, require_packages
from tactile_resonance.configuration import parse_yaml
from tactile_resonance.fields import read
from tactile_resonance.processes import NodeProcesses, noting_signals
from tactile_resonance.simulation.plant.defaults import TABLE_IN_BASE

if TYPE_CHECKING:
    from tactile_resonance.client import CalibrationOutcome

NODES = ("fake_hardware_node", "contact_node", "scan_node")
TRUTH = (3e-3, 0.0123, -0.0123)
"""Of the simulated table against where scan_node expects it: height [m], tilts about x and y [rad]; 1 deg."""
SIMULATED_POINTS = "[[-0.015, -0.015], [0.015, -0.015], [0.015, 0.015], [-0.015, 0.015], [0, 0]]"
SIMULATED_SEARCH_M = 5e-3
WITHIN_S = 3600.0
NODE_WITHIN_S = 10.0


ROWS = (("height", "um", 1e6), ("tilt x", "mrad", 1e3), ("tilt y", "mrad", 1e3))


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of the command."""
    parser = commands.add_parser(
        "calibrate-table",
        help="find the table's height and tilts by touching it",
        description="Have a running scan_node touch the table, or a flat plate on it, at three places or more; "
        "print height and tilts with their deviations. x, y and the turn about the normal cannot be found "
        "by touch. The file is for table_in_base:= of the next launch.",
    )
    text = "where to touch, in the table's frame [m]: '[[x, y], [x, y], [x, y]]'"
    add_option(parser, "--points YAML", str, text)
    text = "of the touched surface above the table: a plate's thickness"
    add_option(parser, "--height-m", 0.0, text)
    add_option(parser, "--force-n", 0.01, "that ends each touch")
    add_option(parser, "--search-m", 0.0, "so far above or below its place the surface may lie")
    add_option(parser, "--flatness-m", 0.0, "standard deviation of the surface about a plane")
    add_option(parser, "--most-tilt-rad", 0.05, "largest tilt that is accepted")
    text = "direction of the beam, clamp to tip, from the table's x axis"
    add_option(parser, "--heading-rad", 0.0, text)
    add_option(parser, "--sensor", "bimorph", "of config/sensors")
    add_option(parser, "--output FILE", Path, "new file of the result, in scan_node's run_folder")
    add_option(parser, "--namespace", "", "of scan_node")
    text = "on a simulated bench of its own, whose table is 3 mm and 1 deg off; compares with that truth"
    add_option(parser, "--simulated", False, text)
    add_robot_host(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Touch, and print what was found; status 1 where no table was found."""
    if options.simulated:
        options.points = options.points or SIMULATED_POINTS
        options.search_m = options.search_m or SIMULATED_SEARCH_M
    xys = _points(options.points)
    names = ("force_n", "search_m", "flatness_m", "most_tilt_rad", "heading_rad", "sensor")
    wanted = {name: getattr(options, name) for name in names}
    wanted["file"] = options.output or ""
    if options.simulated:
        with tempfile.TemporaryDirectory() as work:
            outcome = _simulated(options.robot_host, Path(work), xys, options.height_m, wanted)
    else:
        with noting_signals() as check:
            outcome = ask(xys, options.height_m, wanted, check, options.namespace)
    print(report(xys, outcome, TRUTH if options.simulated else None))
    if options.output is not None and not outcome.file:
        raise ValueError(f"calibrate-table: {outcome.message}")
    return 0


def _points(text: str | None) -> list[tuple[float, ...]]:
    try:
        return list(read(tuple[tuple[float, float], ...], parse_yaml(text or ""), "--points"))
    except ValueError as error:
        accepted = "'[[x, y], [x, y], [x, y]]' in metres"
        raise ValueError(f"--points: got {text!r}; accepted is {accepted}") from error


def ask(
    xys: Sequence[Sequence[float]],
    height_m: float,
    wanted: dict[str, Any],
    check: Callable[[], None],
    namespace: str | None = None,
) -> CalibrationOutcome:
    """Outcome of a calibration by a scan_node that runs in a namespace, or by nodes that were started."""
    require_packages("rclpy", "tactile_resonance.msg")
    # only here: the command answers --help without ROS
    from geometry_msgs.msg import Point

    from tactile_resonance.client import Ending
    from tactile_resonance.nodes.client import ScanClient

    said = [-1]

    def tell(feedback: Any) -> None:
        if feedback.point == said[0]:
            return
        said[0] = feedback.point
        before = f"; the one before at {1e3 * feedback.height_m:+.3f} mm"
        known = math.isfinite(feedback.height_m)
        print(
            f"touch {feedback.point + 1} of {feedback.points}{before if known else ''}", flush=True
        )

    points = [Point(x=x, y=y, z=height_m) for x, y in xys]
    with ScanClient(check, namespace=namespace or "") as client:
        if namespace is None:
            client.wait_until_up(START_WITHIN_S)
        outcome = client.calibrate_table(
            WITHIN_S, points=points, **wanted, on_feedback=tell, wait_s=NODE_WITHIN_S
        )
    if outcome.ending is not Ending.COMPLETE:
        raise ValueError(f"calibrate-table: {outcome.message}")
    return outcome


def _simulated(
    host: str, work: Path, xys: Sequence[Sequence[float]], height_m: float, wanted: dict[str, Any]
) -> CalibrationOutcome:
    """Outcome on a bench whose table stands elsewhere than scan_node expects it."""
    from tactile_resonance.configuration import share_path

    require_packages("rclpy", "tactile_resonance.msg", "rtde_control", "can")
    job = Job(share_path("config/scenes/inclusion_scan.yaml"), work / "run", take_domain(host))
    parameters = node_parameters(job, False, work)
    parameters["fake_hardware_node"]["table_in_base"] = true_table()
    if wanted["file"]:
        wanted["file"] = Path(wanted["file"]).absolute()
        parameters["scan_node"]["goal_folders"] = [str(wanted["file"].parent)]
    with noting_signals() as check_signals, NodeProcesses(work / "log") as nodes:

        def check() -> None:
            check_signals()
            nodes.check()

        nodes.bring_up(NODES, parameters)
        try:
            return ask(xys, height_m, wanted, check)
        except RuntimeError as error:  # a node ended, or did not come up
            raise ValueError(str(error)) from error


def true_table() -> list[float]:
    """Where the simulated table stands: position [m] and rotation vector [rad] in the base."""
    from scipy.spatial.transform import Rotation

    height, tilt_x, tilt_y = TRUTH
    known = np.array(TABLE_IN_BASE)
    turn = Rotation.from_rotvec(known[3:])
    place = known[:3] + turn.apply([0.0, 0.0, height])
    tilted = turn * Rotation.from_rotvec([tilt_x, tilt_y, 0.0])
    return [*place.tolist(), *tilted.as_rotvec().tolist()]


def report(
    xys: Sequence[Sequence[float]],
    outcome: CalibrationOutcome,
    truth: Sequence[float] | None = None,
) -> str:
    """Tables of residuals and correction; with the truth, what is off it, also in standard deviations."""
    lines = ["touch     x [mm]    y [mm]  residual [um]  std [um]"]
    touches = zip(xys, outcome.residuals_m, outcome.std_m, strict=True)
    for index, ((x, y), residual, std) in enumerate(touches):
        lines.append(
            f"{index + 1:5d} {1e3 * x:10.2f}{1e3 * y:10.2f}{1e6 * residual:15.1f}{1e6 * std:10.1f}"
        )
    lines.append("correction              std")
    lines[-1] += "" if truth is None else "      truth   error / std"
    found = (outcome.height_m, outcome.tilt_x_rad, outcome.tilt_y_rad)
    stds = np.sqrt(np.diag(np.reshape(outcome.covariance, (3, 3)))).tolist()
    for index, ((name, unit, scale), value, std) in enumerate(zip(ROWS, found, stds, strict=True)):
        line = f"{name:7s}{scale * value:+10.2f}{scale * std:10.2f}"
        if truth is not None:
            line += f"{scale * truth[index]:+11.2f}{(value - truth[index]) / std:+14.1f}"
        lines.append(f"{line} {unit}")
    lines.append("x, y and the turn about the normal: not estimated, they are as they were known")
    if math.isfinite(outcome.reduced_chi_square):
        lines.append(f"reduced chi-square of the residuals: {outcome.reduced_chi_square:.2f}")
    else:
        lines.append("three touches: no residual checks them")
    lines.append(f"table_in_base: [{', '.join(f'{v:.7g}' for v in outcome.table_in_base)}]")
    if outcome.file:
        lines.append(f"written: {outcome.file}; table_in_base:={outcome.file} of a launch takes it")
    return "\n".join(lines)
