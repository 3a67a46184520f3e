# SPDX-License-Identifier: Apache-2.0
"""The map of a run in files of its own: ``boundary.json``, ``pole_map.png``, ``map.mcap``.

The boundary is what an adaptive scan was to find, in words and as JSON, beside its truth where that is known.
The figure shows what rviz does, for people without it. The recording, for Foxglove and rviz, is the map as it
grew, with its frames; it is kept apart from the run's recording, from which it follows: played together with a
map node, both would show a map.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from scipy.interpolate import RegularGridInterpolator

from tactile_resonance.contact.samples import Pose
from tactile_resonance.contact.vectors import quaternion_from_vector, vector
from tactile_resonance.fields import counted, known
from tactile_resonance.poles.result import ellipse
from tactile_resonance.report.drawing import PROBABILITY, SIMULATED, new_figure
from tactile_resonance.report.page import MM
from tactile_resonance.scan.adaptive import Adaptive, known_points
from tactile_resonance.scan.kriging import LEAST_POINTS
from tactile_resonance.scan.level_set import PROBABILITY as LINE_PROBABILITY
from tactile_resonance.scan.level_set import Boundary, Lines, difference_m2
from tactile_resonance.scan.map_messages import (
    boundary_markers,
    cloud_message,
    legend_message,
    marker_message,
    surface_message,
)
from tactile_resonance.scan.messages import header_message, make_message, to_cdr
from tactile_resonance.scan.point_file import PointFileWriter, offered_qos, read_messages
from tactile_resonance.scan.pole_map import (
    HIGH_RGB,
    LOW_RGB,
    GrowingMap,
    MapSurface,
    PoleMap,
    counts,
)
from tactile_resonance.scan.run_content import RunContent, file_of
from tactile_resonance.scan.scene import scene_of
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.sensor.experiments import truth_over
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.simulation.tissue.scene import Box, PhantomScene, read_scene
from tactile_resonance.tissue.classify import UNKNOWN

BOUNDARY, RECORDING = "boundary.json", "map.mcap"
_TRUTH_CELLS = 16  # along each side; between them the truth is interpolated
_EVERYWHERE = Box((-math.inf, -math.inf), (math.inf, math.inf))
COLOURS = LinearSegmentedColormap.from_list(
    "pole_map", [np.array(LOW_RGB) / 255, np.array(HIGH_RGB) / 255]
)
_MARKS = "osD^vP*X"
MOST_STATES, MOST_DRAWN = 100, 100_000
"""So often the map is drawn at most, so many points in all: a state of a map of thousands takes megabytes."""
_NODE_PROBABILITY, _NODE_CELLS = 0.95, 40  # as of pole_map_node
_POSE, _TF = "geometry_msgs/msg/PoseStamped", "tf2_msgs/msg/TFMessage"
_LATCHED, _STREAM = offered_qos(1, latched=True), offered_qos(100)


@dataclass(frozen=True, eq=False)
class RunBoundary:
    """The boundary of a run.

    Attributes
    ----------
    boundary : Boundary
    wanted_m2 : float
        Expected area on its wrong side that was asked for.
    touches : int
    frame_id : str
        Of its coordinates.
    true_outline_m : lines (k, 2)
        What the simulated bench knew, at its nominal age of contact; none for hardware.
    off_m2 : float
        Area between boundary and truth; NaN for hardware.
    """

    boundary: Boundary
    wanted_m2: float
    touches: int
    frame_id: str
    true_outline_m: Lines = ()
    off_m2: float = math.nan

    @property
    def met(self) -> bool:
        """Whether it is known as well as it was asked for."""
        return self.boundary.wrong_area_m2 <= self.wanted_m2

    def as_json(self) -> str:
        """Content of ``boundary.json``: metres, hertz."""
        off_m2 = known(self.off_m2)
        outline = None if off_m2 is None else [line.tolist() for line in self.true_outline_m]
        content = {
            **self.boundary.as_json(),
            "wanted_wrong_area_m2": self.wanted_m2,
            "met": self.met,
            "touches": self.touches,
            "frame_id": self.frame_id,
            "true_outline_m": outline,
            "off_truth_m2": off_m2,
        }
        return json.dumps(content, indent=1, allow_nan=False) + "\n"

    def sentences(self) -> list[str]:
        """What is known of it, for people."""
        found = self.boundary
        levels = " and ".join(f"{level:.2f}" for level in found.level_set.levels)
        lines = [
            f"Boundary at {levels} Hz after {counted(self.touches, 'touch', 'touches')}: "
            f"{1e6 * found.area_m2:.1f} mm2 {found.level_set.side} (+- {1e6 * found.area_std_m2:.2g} at most), "
            f"{1e6 * found.wrong_area_m2:.3g} mm2 expected on its wrong side, "
            f"{1e6 * self.wanted_m2:.3g} mm2 asked for{'' if self.met else ': not met'}."
        ]
        if not math.isnan(self.off_m2):
            lines.append(f"Off the simulation's truth by {1e6 * self.off_m2:.2g} mm2.")
        return lines


def boundary_of_run(run: RunContent) -> RunBoundary | None:
    """Boundary as far as a run has come; None where none is wanted, or too few points have a pole."""
    scene = scene_of(run.path)
    asked = None if scene is None else scene.adaptive
    boundary = None if asked is None else asked.boundary(run.latest)
    if scene is None or asked is None or boundary is None:
        return None
    frame_id = run.latest[0].frame_id or scene.frame_id
    found = RunBoundary(boundary, asked.most_loss, len(run.latest), frame_id)
    if not any(result.simulated for result in run.latest):
        return found
    try:
        phantoms = read_scene(read_tissues(), run.path / "scene.yaml")
    except ValueError:  # simulated without a scene of the bench
        return found
    hold_s, nominal = 1.0, scene.nominal_contact
    # as `known_points` takes poles
    if nominal is not None and any(np.isfinite(result.nominal_f0_std_hz) for result in run.latest):
        phantoms, hold_s = replace(phantoms, force_n=nominal.force_n), nominal.age_s
    truth = true_f0_hz(phantoms, asked, boundary.level_set.levels[0], hold_s)
    surface = asked.krige(known_points(run.latest))
    assert surface is not None  # else there were no boundary
    return replace(
        found,
        true_outline_m=asked.raster.lines(boundary.level_set.depth(truth)),
        off_m2=difference_m2(surface, boundary.level_set, asked.raster, truth),
    )


def true_f0_hz(
    phantoms: PhantomScene, asked: Adaptive, near_hz: float, hold_time_s: float
) -> np.ndarray:
    """(r, c) true f0 of the mode near a frequency over the raster of a region [Hz]; NaN where nothing lies.

    Each region of the phantoms is interpolated as if it were everywhere, so that edges stay sharp.
    """
    xy_m = asked.raster.xy_m
    low, high = asked.polygon_m.min(axis=0), asked.polygon_m.max(axis=0)
    axes = [np.linspace(low[k], high[k], _TRUTH_CELLS + 1) for k in range(2)]
    at = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    bench, there = SimulatedBench.from_configuration(), phantoms.region_index(xy_m)
    found = np.full(there.shape, math.nan)
    for index in np.unique(there[there >= 0]):
        alone = replace(phantoms, regions=(replace(phantoms.regions[index], shape=_EVERYWHERE),))
        felt = truth_over(bench, alone, at, hold_time_s=hold_time_s)
        sensors: list[Any] = felt.ravel().tolist()
        values = np.reshape([each.mode_near(near_hz).f0_hz for each in sensors], felt.shape)
        here = there == index
        found[here] = RegularGridInterpolator(axes, values, method="cubic")(xy_m[here])
    return found


def draw_pole_map(pole_map: PoleMap, title: str, boundary: RunBoundary | None = None) -> Figure:
    """Map of f0 with ellipses and failures, its uncertainty between the points, and the poles.

    Parameters
    ----------
    pole_map : PoleMap
        With one point or more.
    title : str
    boundary : RunBoundary, optional
        Drawn with its band, and its truth where that is known.
    """
    figure = new_figure(16, 6.2, title + (f" ({SIMULATED})" if pole_map.simulated else ""))
    above, unsure, plane = figure.subplots(1, 3, width_ratios=(1.1, 1.1, 1))
    if not pole_map.estimated:
        _draw_failures(above, pole_map)
        _label(above, "no point has a pole")
        for axes in (unsure, plane):
            axes.set_axis_off()
        return figure
    f0 = pole_map.f0_hz
    colour = Normalize(f0.min(), f0.max() if np.ptp(f0) else f0.min() + 1)
    surface = pole_map.surface(80)
    if surface is not None:
        _draw_surface(above, surface, surface.f0_hz, colour)
    where = np.array([point.position_m for point in pole_map.estimated]) * MM
    dots = above.scatter(
        *where.T[:2],
        c=f0,
        cmap=COLOURS,
        norm=colour,
        s=60,
        edgecolors="white",
        linewidths=0.8,
        zorder=3,
    )
    figure.colorbar(dots, ax=above, label="natural frequency f0 [Hz]", shrink=0.9)
    scale = pole_map.ellipse_scale(PROBABILITY)
    lines = pole_map.ellipses(scale, PROBABILITY)[..., :2] * MM  # (e, segments, 2, 2)
    above.add_collection(
        LineCollection(list(lines.reshape(-1, 2, 2)), colors="black", linewidths=0.9, zorder=4)
    )
    if boundary is not None:
        _draw_boundary(above, boundary)
    _draw_failures(above, pole_map)
    _label(
        above,
        f"f0 and {100 * PROBABILITY:g} % ellipses: 1 mm along x = {1e-3 / scale.m_per_hz:.2g} Hz of f0,\n"
        f"along y = {1e-3 / scale.m_per_damping:.2g} of the damping ratio",
    )
    if surface is None:
        unsure.set_axis_off()
        why = f"no surface: {LEAST_POINTS} points with a standard deviation, not on one line, are needed"
        unsure.text(0.5, 0.5, why, ha="center", transform=unsure.transAxes)
    else:
        shown = _draw_surface(unsure, surface, surface.f0_std_hz, None)
        figure.colorbar(shown, ax=unsure, label="standard deviation of f0 [Hz]", shrink=0.9)
        unsure.plot(*where.T[:2], ".", color="white", ms=4)
        _label(unsure, "uncertainty of f0 between the points")
        unsure.set(xlim=above.get_xlim(), ylim=above.get_ylim())
    _draw_plane(plane, pole_map)
    return figure


def _draw_surface(
    axes: Axes, surface: MapSurface, values: np.ndarray, colour: Normalize | None
) -> QuadMesh:
    x, y = surface.position_m[0, :, 0] * MM, surface.position_m[:, 0, 1] * MM
    cmap = "viridis" if colour is None else COLOURS
    return axes.pcolormesh(x, y, values, cmap=cmap, norm=colour, shading="nearest", rasterized=True)


def _draw_failures(axes: Axes, pole_map: PoleMap) -> None:
    if pole_map.failures:
        where = np.array([point.position_m for point in pole_map.failures]) * MM
        axes.plot(*where.T[:2], "x", color="red", ms=9, mew=2, label="failed", zorder=5)
        axes.legend(loc="upper right")


def _draw_boundary(axes: Axes, found: RunBoundary) -> None:
    """Outline, the band that holds it, and its truth."""
    band = f"{100 * LINE_PROBABILITY:g} % band"
    styles: tuple[tuple[Lines, dict[str, Any], str], ...] = (
        (found.boundary.outline_m, {"color": "black", "lw": 2}, "boundary"),
        (found.boundary.inner_m, {"color": "black", "ls": "--", "lw": 1}, band),
        (found.boundary.outer_m, {"color": "black", "ls": "--", "lw": 1}, band),
        (found.true_outline_m, {"color": "red", "lw": 1.2}, "truth of the simulation"),
    )
    for lines, style, label in styles:
        for line in lines:
            named = label in axes.get_legend_handles_labels()[1]
            axes.plot(*(line.T * MM), **style, zorder=5, label=None if named else label)
    axes.legend(loc="upper right", fontsize="small")


def _draw_plane(axes: Axes, pole_map: PoleMap) -> None:
    """Poles by tissue class."""
    groups = pole_map.classes() or ("",)
    for k, name in enumerate(groups):
        points = [p.result for p in pole_map.estimated if p.result.tissue_class == name]
        x = np.array([p.estimate for p in points])
        axes.plot(*x.T, _MARKS[k % len(_MARKS)], color=f"C{k}", ms=4, label=name or "poles")
        loops = [
            (p.estimate[:, None] + ellipse(p.covariance, 100, PROBABILITY)).T
            for p in points
            if np.all(np.isfinite(p.covariance))
        ]
        axes.add_collection(LineCollection(loops, colors=f"C{k}", linewidths=0.8, zorder=2))
    axes.set(xlabel="f0 [Hz]", ylabel="damping ratio")
    axes.set_title(f"measured poles, {100 * PROBABILITY:g} % ellipses", fontsize="medium")
    axes.ticklabel_format(useOffset=False)
    axes.legend(loc="upper left")


def _label(axes: Axes, title: str) -> None:
    axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    axes.set_title(title, fontsize="medium")


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
    # as they were finished, whatever the clock showed: of two attempts at a point the later one counts
    place = {file.name: number for number, file in enumerate(run.files)}
    results = sorted(
        filter(counts, run.results), key=lambda result: place[file_of(run.path, result).name]
    )
    if not results:
        return None
    with TemporaryDirectory(dir=run.path, prefix=".map-") as hidden:
        writer = PointFileWriter(Path(hidden), Path(hidden) / RECORDING)
        frame_id = _write_frames(writer, run)
        states = min(MOST_STATES, max(1, MOST_DRAWN // len(results)))
        step = -(-len(results) // states)
        last, scene = GrowingMap(results).map, scene_of(run.path)
        names = tuple(name for name in last.classes() if name != UNKNOWN)
        if scene is not None:  # by number as pole_map_node has them, whichever were called
            names = tuple(tissue.name for tissue in scene.tissue_classes)
        adaptive = None if scene is None else scene.adaptive
        grown, latest, now_ns = GrowingMap(), {}, 0
        for done, result in enumerate(results, start=1):
            grown.take(result)
            latest[result.index] = result
            now_ns = max(now_ns, result.time_ns)  # a clock that was set back would play them in another order
            if (len(results) - done) % step:  # the last one is drawn
                continue
            shown, header, beside = grown.map, header_message(frame_id, now_ns), []
            if adaptive is not None:
                beside = boundary_markers(shown, adaptive.boundary(latest.values()), header)
            scale = shown.ellipse_scale(_NODE_PROBABILITY)
            for name, message in {
                "": cloud_message(shown, names, header),
                "/markers": marker_message(shown, scale, _NODE_PROBABILITY, header, beside),
                "/legend": legend_message(shown, scale, _NODE_PROBABILITY, names, header),
            }.items():
                _write(writer, f"/pole_map{name}", now_ns, message, _LATCHED)
        surface = surface_message(last, _NODE_CELLS, header_message(frame_id, now_ns))
        _write(writer, "/pole_map/surface", now_ns, surface, _LATCHED)
        writer.complete()
        os.replace(Path(hidden) / RECORDING, run.path / RECORDING)
    return run.path / RECORDING


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
            tip = _transform(message.header.frame_id, "tip", time_ns, position, quaternion)
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
