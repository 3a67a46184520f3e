# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance report` of runs, and `live` of a scan under way: their pages."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from pathlib import Path

from tactile_resonance.commands.options import add_option, add_output, require_packages
from tactile_resonance.fields import require
from tactile_resonance.files import write_whole
from tactile_resonance.front import read_run
from tactile_resonance.processes import noting_signals

COMPARISON = Path("comparison.html")
PORT = 8765
EACH_S = 0.2
"""Between two events of the page of a scan under way [s]."""


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of both commands."""
    parser = commands.add_parser(
        "report",
        help="page and picture of a scan's run; comparison of several",
        description="Of one run, also of one that is going on, write into its folder: report.html, a page to "
        "look into that needs nothing else, pole_map.png, map.mcap, the map as it grew for Foxglove and rviz, "
        "and boundary.json, where the scene wants a boundary. Of several runs write one page that compares the "
        "others with the first.",
    )
    text = "folder of a run; several: a comparison"
    add_option(parser, "run_folders RUN", Path, text, nargs="+")
    text = f"of a comparison (default: {COMPARISON}); the files of one run are in its folder"
    add_output(parser, "--output FILE", text, ".html")
    parser.set_defaults(run=run)
    parser = commands.add_parser(
        "live",
        help="page of a scan while it goes on: map, force, poles, state",
        description="Listen to the nodes of this ROS_DOMAIN_ID and serve a page that shows what they publish: "
        "the map as it grows, force, poles and state; on 127.0.0.1 only, and to be read only. Ctrl-C ends it.",
    )
    add_option(parser, "--port", int, f"default: {PORT}; 0: any that is free", default=PORT)
    add_option(parser, "--namespace", "", "of the nodes (default: none)")
    parser.set_defaults(run=listen)


def run(options: argparse.Namespace) -> int:
    """Read, draw, write each file whole."""
    if len(options.run_folders) > 1:
        return _compare(options.run_folders, options.output or COMPARISON)
    output = options.output and str(options.output)
    require(output is None, "--output", output, "none with one run, whose files are in its folder")
    return report_run(options.run_folders[0])


def _compare(folders: Sequence[Path], output: Path) -> int:
    # only here: the command answers --help without the library for recordings
    from tactile_resonance.report.comparison import as_comparison, differences, sentence, unlike

    runs = [read_run(folder) for folder in folders]
    write_whole(output, as_comparison(runs).encode())
    for folder, content in zip(folders[1:], runs[1:], strict=True):
        found, apart = differences(runs[0], content), unlike(runs[0], content)
        print(sentence(str(folder), str(folders[0]), found, apart))
    print(output)
    return 0


def report_run(folder: Path) -> int:
    """Write page, pictures, map and boundary of a run into its folder, and print its table."""
    content = read_run(folder)
    # only here: the command answers --help without the library for recordings
    from tactile_resonance.report.drawing import figure_bytes
    from tactile_resonance.report.point_details import details_of, truths_of
    from tactile_resonance.report.run_map import (
        BOUNDARY,
        RECORDING,
        boundary_of_run,
        draw_pole_map,
        write_map_recording,
    )
    from tactile_resonance.report.run_report import (
        as_page,
        pole_maps_of,
        silent_lines,
        skipped_lines,
        summary,
    )
    from tactile_resonance.report.run_tables import point_table, table_notes
    from tactile_resonance.scan.plan import map_names
    from tactile_resonance.scan.run_content import not_checked

    details, boundary = details_of(content), boundary_of_run(content)
    truths = truths_of(content, details)
    pole_maps, pictures = pole_maps_of(content), []
    name = folder.resolve().name
    for band, pole_map in enumerate(pole_maps):
        title = f"Pole map, {name}" + (f", band {band + 1}" if len(pole_maps) > 1 else "")
        pictures.append(
            figure_bytes(draw_pole_map(pole_map, title, None if band else boundary), ".png")
        )
        write_whole(folder / map_names(band + 1)[-1], pictures[-1])
    page = as_page(content, pole_maps, pictures, details, truths, boundary)
    write_whole(folder / "report.html", page.encode())
    if boundary is not None:
        write_whole(folder / BOUNDARY, boundary.as_json().encode())
    if content.latest:
        print(point_table(content.latest, truths))
        print("\n".join(table_notes(content.latest, truths)))
    told = [] if boundary is None else boundary.sentences()
    told = [*summary(content), *told, *(f"silent record: {line}" for line in silent_lines(content))]
    for line in (*told, *(f"left out: {line}" for line in skipped_lines(content))):
        print(line)
    for problem in content.problems:
        print(f"damaged: {problem}")
    if content.unchecked:
        print(not_checked(content.unchecked))
    drawn = ["report.html", *map_names(len(pole_maps))]
    drawn += [] if boundary is None else [BOUNDARY]
    if pole_maps:
        write_map_recording(content)  # last: the page and the table do not wait for it
        drawn.append(RECORDING)
    print(f"{', '.join(drawn)} in {folder}")
    return 0


def listen(options: argparse.Namespace) -> int:
    """Serve the page of what the nodes publish until interrupted."""
    from tactile_resonance.report.live import LiveRun, LiveServer

    require_packages("rclpy", "tactile_resonance.msg")
    from rclpy.exceptions import InvalidNamespaceException
    from rclpy.validate_namespace import validate_namespace

    try:
        validate_namespace(f"/{options.namespace.strip('/')}")
    except InvalidNamespaceException:
        accepted = "a ROS namespace: letters, digits, _ and /, no digit at the beginning of a part"
        require(False, "--namespace", options.namespace, accepted)
    from tactile_resonance.nodes.client import LiveListener

    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    live = LiveRun(lambda name, data: server.publish(name, data))
    server = LiveServer(options.port, live.snapshot)
    told_s = 0.0
    with noting_signals() as check, server, LiveListener(live, options.namespace) as listener:
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        print(f"{server.url} shows the nodes of ROS_DOMAIN_ID={domain}; Ctrl-C ends it", flush=True)
        while True:
            check()
            listener.spin(EACH_S)
            if server.readers and time.monotonic() - told_s > EACH_S:
                live.tick()
                told_s = time.monotonic()
