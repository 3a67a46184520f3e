# SPDX-License-Identifier: Apache-2.0
"""Recording a point: time per message and per point, against writing the same bytes to a plain file.

A record of 40000 samples per channel as floating point, 640 kB serialised, eight of them a point; each
point is finished durably, the plain file is brought to disk too.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import numpy as np

from tactile_resonance.scan.messages import message_types
from tactile_resonance.scan.point_result import PointResult
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.run_directory import RunDirectory

TYPE = "tactile_resonance/msg/Record"
SAMPLES, MESSAGES = 40_000, 8


def run(output: Path, quick: bool) -> str:
    """Measure; return the page."""
    points = 5 if quick else 30
    cdr = _record()
    with tempfile.TemporaryDirectory(dir=output) as folder:
        plain = [_plain(Path(folder) / "plain", cdr) for _ in range(points)]
        write, finish = _recorded(Path(folder) / "run", cdr, points)
    rows = [
        ("message written", write, min(p[0] for p in plain)),
        ("point brought to disk", finish, min(p[1] for p in plain)),
    ]
    lines = [
        "# Recording",
        "",
        "`tools/run.sh tactile_resonance benchmark recording`: " + " ".join(__doc__.split()),
        "",
        "| step | run directory [ms] | plain file [ms] | ratio |",
        "|---|---|---|---|",
        *(f"| {n} | {1e3 * a:.2f} | {1e3 * b:.2f} | {a / b:.1f} |" for n, a, b in rows),
        "",
        f"Least of {points} points; one message is {len(cdr) / 1e3:.0f} kB.",
    ]
    text = "\n".join(lines) + "\n"
    return text


def _record() -> bytes:
    """A serialised record of noise."""
    store = message_types()
    types = store.types
    rng = np.random.default_rng(1)
    zero_time = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    header = types["std_msgs/msg/Header"](stamp=zero_time, frame_id="tip")
    pose = types["geometry_msgs/msg/PoseStamped"](
        header=header,
        pose=types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](x=0.0, y=0.0, z=0.0),
            orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        ),
    )
    given = {
        "header": header,
        "tip_pose": pose,
        "actuator_v": rng.standard_normal(SAMPLES),
        "sensor_v": rng.standard_normal(SAMPLES),
        "actuator_counts": np.zeros(0, np.int32),
        "sensor_counts": np.zeros(0, np.int32),
        "anti_alias_filter": "",
        "contact_reason": "",
        "label": "",
    }
    names = [name for name, _ in store.fielddefs[TYPE][1]]
    return bytes(store.serialize_cdr(types[TYPE](**{n: given.get(n, 0) for n in names}), TYPE))


def _plain(path: Path, cdr: bytes) -> tuple[float, float]:
    """Time per message written, and to bring the file to disk."""
    start = time.perf_counter()
    with path.open("wb") as file:
        for _ in range(MESSAGES):
            file.write(cdr)
        file.flush()
        written = time.perf_counter()
        os.fsync(file.fileno())
    return (written - start) / MESSAGES, time.perf_counter() - written


def _recorded(path: Path, cdr: bytes, points: int) -> tuple[float, float]:
    """Least time per message, and to finish a point."""
    plan = [
        ScanPoint(i, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)) for i in range(points)
    ]
    write, finish = [], []
    with RunDirectory.create(path, "name: benchmark\n", plan, {}) as run:
        for index in range(points):
            with run.begin_point(index) as recording:
                start = time.perf_counter()
                for k in range(MESSAGES):
                    recording.write("/record", TYPE, k, cdr)
                written = time.perf_counter()
                recording.finish(PointResult(index))
                finish.append(time.perf_counter() - written)
                write.append((written - start) / MESSAGES)
    return min(write), min(finish)
