# SPDX-License-Identifier: Apache-2.0
"""The map of a run, as it grew, with its frames: a recording for Foxglove and rviz of its own.

It follows from the run's recording, and is kept apart from it: played together with a map node, both would
show a map.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tactile_resonance.contact.samples import Pose
from tactile_resonance.contact.vectors import quaternion_from_vector, vector
from tactile_resonance.report.run_report import scene_of
from tactile_resonance.scan.map_messages import (
    boundary_markers,
    cloud_message,
    legend_message,
    marker_message,
    surface_message,
)
from tactile_resonance.scan.messages import header_message, make_message, to_cdr
from tactile_resonance.scan.point_file import PointFileWriter, offered_qos, read_messages
from tactile_resonance.scan.pole_map import GrowingMap, counts
from tactile_resonance.scan.run_content import RunContent
from tactile_resonance.tissue.classify import UNKNOWN

FILE = "map.mcap"
MOST_STATES, MOST_DRAWN = 100, 100_000
"""So often the map is drawn at most, so many points in all: a state of a map of thousands takes megabytes."""
_PROBABILITY, _CELLS = 0.95, 40  # as of pole_map_node
_POSE, _TF = "geometry_msgs/msg/PoseStamped", "tf2_msgs/msg/TFMessage"
_LATCHED = offered_qos(1, latched=True)
_STREAM = offered_qos(100)
_TIP_FRAME = "tip"


def write_map_recording(run: RunContent) -> Path | None:
    """Write ``map.mcap`` into the folder of a run, in place of the one that is there.

    Topics are those of pole_map_node, after each point or after `MOST_STATES` of them, fewer where there are
    thousands of points, the surface after the last; and ``/tf``, ``/tf_static``. All stamps are times of
    recording, so that the file stands for itself.

    Returns
    -------
    Path or None
        None where the map has no point yet.

    Raises
    ------
    ValueError
        If a file of the run is damaged.
    OSError
        If it cannot be written.
    """
    results = sorted(filter(counts, run.results), key=lambda result: result.time_ns)
    if not results:
        return None
    with TemporaryDirectory(dir=run.path, prefix=".map-") as hidden:
        writer = PointFileWriter(Path(hidden), Path(hidden) / FILE)
        frame_id = _write_frames(writer, run)
        states = min(MOST_STATES, max(1, MOST_DRAWN // len(results)))
        step = -(-len(results) // states)
        last = GrowingMap(results).map
        names = tuple(name for name in last.classes() if name != UNKNOWN)
        scene = scene_of(run)
        adaptive = None if scene is None else scene.adaptive
        grown, latest = GrowingMap(), {}
        for done, result in enumerate(results, start=1):
            grown.take(result)
            latest[result.index] = result
            if (len(results) - done) % step:  # the last one is drawn
                continue
            shown, header, beside = grown.map, header_message(frame_id, result.time_ns), []
            if adaptive is not None:
                beside = boundary_markers(shown, adaptive.boundary(latest.values()), header)
            scale = shown.ellipse_scale(_PROBABILITY)
            for name, message in {
                "": cloud_message(shown, names, header),
                "/markers": marker_message(shown, scale, _PROBABILITY, header, beside),
                "/legend": legend_message(shown, scale, _PROBABILITY, names, header),
            }.items():
                _write(writer, f"/pole_map{name}", result.time_ns, message, _LATCHED)
        ended_ns = results[-1].time_ns
        surface = surface_message(last, _CELLS, header_message(frame_id, ended_ns))
        _write(writer, "/pole_map/surface", ended_ns, surface, _LATCHED)
        writer.finish()
        os.replace(Path(hidden) / FILE, run.path / FILE)
    return run.path / FILE


def _write_frames(writer: PointFileWriter, run: RunContent) -> str:
    """Where the map's frame and the tip stood, as far as the run states it; returns the map's frame."""
    frame_id = next((result.frame_id for result in run.results if result.frame_id), "table")
    node = run.facts.get("scan_node", {})
    place = run.facts.get("frames", {}).get(frame_id, node.get("table_in_base"))
    start_ns = min(file.start_ns for file in run.files)
    base = node.get("base_frame")
    if place is not None and base not in (None, frame_id):
        pose = Pose.from_vector(place)
        turn = quaternion_from_vector(vector(pose.rotation_rad))
        frame = _transform(base, frame_id, start_ns, vector(pose.position_m), turn)
        _write(writer, "/tf_static", start_ns, make_message(_TF, transforms=[frame]), _LATCHED)
    for path in run.paths(_POSE):
        for time_ns, _, message in read_messages(path, _POSE):
            at, turn = message.pose.position, message.pose.orientation
            position, quaternion = (at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w)
            tip = _transform(message.header.frame_id, _TIP_FRAME, time_ns, position, quaternion)
            _write(writer, "/tf", time_ns, make_message(_TF, transforms=[tip]), _STREAM)
    return frame_id


def _transform(
    parent: str, child: str, time_ns: int, place: Sequence[float], turn: Sequence[float]
) -> Any:
    message = make_message(
        "geometry_msgs/msg/TransformStamped",
        header=header_message(parent, time_ns),
        child_frame_id=child,
    )
    to, rotation = message.transform.translation, message.transform.rotation
    to.x, to.y, to.z = place
    rotation.x, rotation.y, rotation.z, rotation.w = turn
    return message


def _write(writer: PointFileWriter, topic: str, time_ns: int, message: Any, qos: Any) -> None:
    writer.write(topic, message.__msgtype__, time_ns, to_cdr(message), qos)
