# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance demo`: gelatine phantoms told apart on the simulated bench, through real ROS 2 nodes."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from tactile_resonance.processes import NodeProcesses, free_domain_id

if TYPE_CHECKING:
    from tactile_resonance.identification.result import Poles
    from tactile_resonance.simulation.scene import PhantomScene

NODES = ("fake_hardware_node", "excitation_node", "frf_node", "poles_node")
START_TIMEOUT_S = 30.0


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of the command."""
    parser = commands.add_parser(
        "demo",
        help="gelatine phantoms told apart on the simulated bench",
        description="Start the nodes as processes on loopback, measure gelatine phantoms at several points, "
        "compare the poles with the simulation's truth. Nothing here is a measurement.",
    )
    parser.add_argument("--scene", type=Path, help="phantoms and points (default: the package's)")
    parser.add_argument("--output", type=Path, metavar="DIR", help="default: runs/demo-DATE-TIME")
    parser.add_argument("--points", type=int, metavar="N", help="only the first N of each phantom")
    parser.add_argument("--periods", type=int, default=8, help="per point (default: 8)")
    parser.add_argument("--level", type=float, default=1.0, help="[V rms] (default: 1)")
    parser.add_argument("--seed", type=int, default=1, help="of phases and noise (default: 1)")
    parser.add_argument(
        "--real-time",
        action="store_true",
        help="at the pace of the signals instead of as fast as the simulation runs",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Start nodes, measure all points, report; always end the nodes."""
    from tactile_resonance.configuration import share_path
    from tactile_resonance.simulation.library import read_tissues
    from tactile_resonance.simulation.scene import read_scene

    _check(options)
    scene_path = (options.scene or share_path("config/scenes/gelatine_phantoms.yaml")).resolve()
    scene = read_scene(read_tissues(), scene_path)
    places = _places(scene, options.points)
    output = options.output or Path("runs") / time.strftime("demo-%Y%m%d-%H%M%S")
    output.mkdir(parents=True, exist_ok=True)
    os.environ["ROS_DOMAIN_ID"] = str(free_domain_id())
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    for number in (signal.SIGINT, signal.SIGTERM):
        # both end the nodes in order, even where a shell made this process ignore Ctrl-C
        signal.signal(number, signal.default_int_handler)
    print(
        f"{len(places)} points on {scene.name}, simulated. To listen: "
        f"ROS_DOMAIN_ID={os.environ['ROS_DOMAIN_ID']} "
        f"ROS_AUTOMATIC_DISCOVERY_RANGE={os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE']}"
    )
    start = time.monotonic()
    parameters = {
        "excitation_node": {"record_folder": (output / "records").resolve()},
        "fake_hardware_node": {
            "scene": str(scene_path),
            "speed": 1.0 if options.real_time else 0.0,
            "seed": options.seed,
        },
    }
    with NodeProcesses(output / "log") as nodes:
        nodes.bring_up(NODES, parameters)
        try:
            points = _measure(nodes, places, options)
        except RuntimeError as error:
            raise ValueError(f"{error} (logs in {output / 'log'})") from error
    _report(points, output)
    print(f"{time.monotonic() - start:.1f} s; results and figure in {output}")
    return 0


def _check(options: argparse.Namespace) -> None:
    for package in ("rclpy", "tactile_resonance.msg"):
        if find_spec(package) is None:
            raise ValueError(
                f"demo: {package} not found; use 'make demo', or build the package with colcon in a "
                "sourced ROS 2 and source its install folder"
            )
    for name, least in (("points", 1), ("periods", 3), ("seed", 1)):
        value = getattr(options, name)
        if value is not None and value < least:
            raise ValueError(f"{name}: {value}, expected at least {least}")
    if not 0 < options.level <= 4:
        raise ValueError(f"level: {options.level:g}, the simulated sensor bears up to 4 V rms")
    if options.seed > 2**62:
        raise ValueError(f"seed: {options.seed}, expected at most 2^62")


def _places(
    scene: PhantomScene, most: int | None
) -> list[tuple[str, int, tuple[float, float, float]]]:
    """(phantom, index in it, position) of every point to measure."""
    counts: dict[str, int] = {}
    places = []
    for point in scene.scan_points_m:
        region = scene.region_at(point)
        name = "air" if region is None else region.name
        index = counts.get(name, 0)
        counts[name] = index + 1
        if most is None or index < most:
            x_m, y_m, z_m = (*point, 0.0)[:3]
            places.append((name, index, (x_m, y_m, z_m)))
    return places


def _measure(nodes: NodeProcesses, places: list, options: argparse.Namespace) -> list:
    # only here: the command answers --help, and says what is missing, without ROS
    from tqdm import tqdm

    from tactile_resonance.action import Measure
    from tactile_resonance.nodes.scan_session import ScanSession
    from tactile_resonance.report.phantoms import MeasuredPoint

    points = []
    with ScanSession(nodes.check) as session:
        session.wait_for_nodes(START_TIMEOUT_S)
        session.warm_up(places[0][2], START_TIMEOUT_S)
        with tqdm(
            total=len(places) * options.periods,
            unit="block",
            file=sys.stderr,
            leave=False,
            disable=None,
        ) as bar:
            for number, (phantom, index, position) in enumerate(places):
                bar.set_description(f"{phantom}, point {index + 1}")
                goal = Measure.Goal(
                    label=f"{phantom}, point {index + 1}",
                    level_v=options.level,
                    periods=options.periods,
                    seed=options.seed + number,
                )
                first = number * options.periods

                def show(blocks: int, _: int, first: int = first) -> None:
                    bar.update(first + blocks - bar.n)

                result = session.measure(position, goal, show)
                show(options.periods, options.periods)
                true_f0, true_damping = _nearest(result.truth, result.poles)
                points.append(
                    MeasuredPoint(
                        phantom,
                        index,
                        result.origin,
                        result.frf,
                        result.poles,
                        true_f0,
                        true_damping,
                    )
                )
    return points


def _nearest(truth: Poles, poles: Poles) -> tuple[float, float]:
    """True mode inside the band of the fit."""
    low_hz, high_hz = poles.band_hz
    inside = (truth.f0_hz >= low_hz) & (truth.f0_hz <= high_hz)
    if inside.sum() != 1:
        return float("nan"), float("nan")
    return float(truth.f0_hz[inside][0]), float(truth.damping_ratio[inside][0])


def _report(points: list, output: Path) -> None:
    from tactile_resonance.analysis import write_whole
    from tactile_resonance.report.drawing import save_figure
    from tactile_resonance.report.phantoms import as_csv, as_table, draw_phantoms

    write_whole(output / "results.csv", as_csv(points).encode())
    save_figure(draw_phantoms(points, points[0].poles.band_hz), output / "phantoms.png")
    print(as_table(points))
