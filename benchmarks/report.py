# SPDX-License-Identifier: Apache-2.0
"""The pages: how long one takes to write and how large it is, and what the live page costs while a demo runs.

The time of writing is that of reading details and making the page, without the pictures, as a ratio to the
time that this machine takes for a loop (`benchmarks.processor`). The live page is followed by one reader; its
share is the processor time of all its threads over time, of one core. Its delay is from when another program on
this machine hears the result of a point to when the reader has it.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.processor import cpu_s, loop_s
from tactile_resonance.commands.options import require_packages
from tactile_resonance.processes import free_domain_id
from tactile_resonance.report.point_details import detailed, details_of, truths_of
from tactile_resonance.report.run_report import as_page, pole_maps_of
from tactile_resonance.scan.point_result import PointKind
from tactile_resonance.scan.run_content import RunContent, read_run

WITHIN_S = 600.0
PAGE_MB, PAGE_LOOPS, SHARE, DELAY_S = 8.0, 4.2, 0.05, 1.0
"""Goals: 2 s where the loop takes 0.48 s."""
MANY = 10_000
_QUIET: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
_COMMAND = (sys.executable, "-m", "tactile_resonance.cli")


def run(output: Path, quick: bool) -> str:
    """Measure; return the page.

    Raises
    ------
    ValueError
        Where what a scan needs is not there.
    """
    require_packages("rclpy", "tactile_resonance.msg", "rtde_control", "can", "plotly")
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ["ROS_DOMAIN_ID"] = str(free_domain_id())
    speed_s = loop_s()
    with tempfile.TemporaryDirectory() as folder:
        scan = ("demo",) if quick else ("scan",)
        watched = _watch(Path(folder), scan)
        content = read_run(Path(folder) / "run")
        rows = [_written(content, speed_s)]
        if not quick:
            rows.append(_written(_many(content), speed_s, content))
    text = _page(rows, watched, speed_s, scan[0])
    return text


def _written(
    content: RunContent, speed_s: float, details_from: RunContent | None = None
) -> tuple[int, float, float]:
    """Points, loops of writing, and size [MB] of a run's page."""
    begun_s = time.process_time()
    details = details_of(details_from or content)
    if details_from is None:
        truths = truths_of(content, details)
    else:
        each = list(details.values())
        chosen = detailed(content.latest)
        details = {r.index: each[k % len(each)] for k, r in enumerate(chosen)}
        truths = {}
    page = as_page(content, pole_maps_of(content), [], details, truths).encode()
    return len(content.latest), (time.process_time() - begun_s) / speed_s, len(page) / 1e6


def _many(content: RunContent) -> RunContent:
    """A run of ten thousand points, on a square grid, each like one of the given ones."""
    rng, side = np.random.default_rng(1), round(MANY**0.5)
    results = []
    for k in range(MANY):
        like = content.latest[k % len(content.latest)]
        place = {"x_m": 1e-3 * (k % side), "y_m": 1e-3 * (k // side)}
        f0_hz = like.f0_hz + rng.normal(0, 0.3)
        results.append(replace(like, index=k, measurement_id=k + 1, f0_hz=f0_hz, **place))
    points = tuple(replace(content.points[0], index=k) for k in range(MANY))
    return replace(content, results=tuple(results), points=points)


def _watch(folder: Path, scan: tuple[str, ...]) -> dict[str, Any]:
    """A scan, the live page, one reader of it, and a listener of its own."""
    from tactile_resonance import msg
    from tactile_resonance.nodes.client import NodeClient
    from tactile_resonance.nodes.running import POINT_RESULTS

    class Listener(NodeClient):
        def join(self) -> None:
            self.heard: dict[int, float] = {}
            self._node.create_subscription(msg.PointResult, "point_result", self._on, POINT_RESULTS)

        def _on(self, message: Any) -> None:
            if message.kind == PointKind.TISSUE.value:
                self.heard.setdefault(message.index, time.monotonic())

    live = subprocess.Popen([*_COMMAND, "live", "--port", "0"], **_QUIET)
    demo: subprocess.Popen | None = None
    try:
        assert live.stdout is not None
        url = live.stdout.readline().split()[0]
        shown: dict[int, float] = {}
        threading.Thread(target=_read, args=(url, shown), daemon=True).start()
        command = [*_COMMAND, *scan, "--output", str(folder / "run")]
        with Listener("listener", lambda: None) as listener:
            demo = subprocess.Popen(command, **_QUIET)
            shares, last = [], (time.monotonic(), cpu_s(live.pid))
            while demo.poll() is None:
                listener.spin(0.01)
                if time.monotonic() > last[0] + 2.0:
                    now = time.monotonic(), cpu_s(live.pid)
                    if listener.heard:
                        shares.append((now[1] - last[1]) / (now[0] - last[0]))
                    last = now
            printed = demo.communicate()[0]
        delays = [shown[k] - heard_s for k, heard_s in listener.heard.items() if k in shown]
        missing = len(listener.heard) - len(delays)
        return {"shares": shares, "delays": delays, "missing": missing, "printed": printed}
    finally:
        if demo is not None and demo.poll() is None:
            demo.send_signal(signal.SIGINT)
            demo.wait(WITHIN_S)
        live.send_signal(signal.SIGINT)
        live.wait(30)


def _read(url: str, shown: dict[int, float]) -> None:
    """Note when each point comes."""
    name = ""
    with urllib.request.urlopen(f"{url}events", timeout=WITHIN_S) as answer:
        for line in answer:
            if line.startswith(b"event: "):
                name = line[7:].strip().decode()
            elif line.startswith(b"data: ") and name == "point":
                now_s = time.monotonic()
                shown.setdefault(json.loads(line[6:])["bands"][0]["index"], now_s)


def _page(
    rows: list[tuple[int, float, float]], watched: dict[str, Any], speed_s: float, scan: str
) -> str:
    whole_s = re.search(r"([\d.]+) s in all", watched["printed"])
    shares, delays = np.array(watched["shares"]), np.array(watched["delays"])
    lines = [
        "# The pages",
        "",
        "`tools/run.sh tactile_resonance benchmark report`, simulated; what is measured stands in "
        "[benchmarks/report.py](../../benchmarks/report.py).",
        f"The loop that times are ratios to took {speed_s:.2f} s here.",
        "",
        "| points | writing the page [loops] | goal | size [MB] | goal |",
        "|---|---|---|---|---|",
    ]
    for points, loops, size in rows:
        goals = (f"{PAGE_LOOPS:g}", f"{PAGE_MB:g}") if points < MANY else ("-", "-")
        lines.append(f"| {points} | {loops:.1f} | {goals[0]} | {size:.1f} | {goals[1]} |")
    lines += [
        "",
        f"`tactile_resonance live` beside `{scan}` ({whole_s[1] if whole_s else '?'} s in all), one reader:",
        "",
        "| figure | mean | largest | goal |",
        "|---|---|---|---|",
        f"| share of a core, over 2 s each | {100 * shares.mean():.1f} % | {100 * shares.max():.1f} % | "
        f"{100 * SHARE:g} % |",
        f"| delay of a point [s] | {delays.mean():.3f} | {delays.max():.3f} | {DELAY_S:g} |",
        "",
        f"{len(delays)} points were shown, {watched['missing']} missed.",
        "",
    ]
    return "\n".join(lines)
