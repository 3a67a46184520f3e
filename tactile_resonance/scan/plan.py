# SPDX-License-Identifier: Apache-2.0
"""From a scene to the points that a scan touches, in order, with poses and the time it takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from tactile_resonance.scan.clearance import TipUse, clear_points
from tactile_resonance.scan.measurement import MeasurementDesign, Skipped, design_measurement
from tactile_resonance.scan.scan_point import LeftOut, ScanPoint
from tactile_resonance.scan.scene import ScanScene
from tactile_resonance.scan.surface import Plane, Surface, TouchRequest

FloatArray = npt.NDArray[np.float64]
STEEPEST_RAD = np.pi / 3


@dataclass(frozen=True)
class Timing:
    """How long the steps of a point take, measured or supposed.

    Attributes
    ----------
    travel_m_s : float
        Speed between points.
    approach_s, settle_s, retract_s : float
        From above the surface to contact, until the force is held, and back.
    """

    travel_m_s: float = 0.05
    approach_s: float = 1.5
    settle_s: float = 0.5
    retract_s: float = 0.5


@dataclass(frozen=True)
class Plan:
    """What a scan will do.

    Attributes
    ----------
    points : tuple of ScanPoint
    measurement : MeasurementDesign
    skipped : tuple of Skipped
        Points and work left out, with the time saved.
    shortest_s, longest_s : float
        With the fewest and the most blocks at every point.
    """

    points: tuple[ScanPoint, ...]
    measurement: MeasurementDesign
    skipped: tuple[Skipped, ...]
    shortest_s: float
    longest_s: float


def make_plan(
    scene: ScanScene,
    surface: Surface | None = None,
    measurement: MeasurementDesign | None = None,
    timing: Timing | None = None,
) -> Plan:
    """Points of a scene on its surface.

    Parameters
    ----------
    scene : ScanScene
    surface : Surface, optional
        In place of the scene's; needed where that is to be found by touch.
    measurement : MeasurementDesign, optional
        In place of that which `design_measurement` makes.
    timing : Timing, optional

    Raises
    ------
    ValueError
        If the surface is not known yet, or no position lies on it.
    """
    timing = Timing() if timing is None else timing
    measurement = design_measurement(scene) if measurement is None else measurement
    if surface is None:
        if isinstance(scene.surface, TouchRequest):
            raise ValueError("surface: got none; accepted is one, the scene's is found by touch")
        surface = scene.surface
    xy, given_z = scene.positions_m[:, :2], scene.positions_m[:, 2]
    height, normals = surface.height_m(xy), surface.normal(xy)
    z = np.where(np.isnan(given_z), height, given_z)
    off = np.isnan(z) | np.any(np.isnan(normals), axis=1)
    with np.errstate(invalid="ignore"):
        steep = ~off & (normals[:, 2] < np.cos(STEEPEST_RAD))
    kept = ~off & ~steep
    if not kept.any():
        raise ValueError(
            f"positions: got {len(xy)}, of which {int(off.sum())} beside the surface and {int(steep.sum())} "
            "too steep; accepted is one usable position or more"
        )
    turns = tip_orientation(normals[kept], scene.sensor.heading_rad)
    std = surface.height_std_m(xy[kept])
    where = np.column_stack([xy[kept], z[kept]])
    points = tuple(
        ScanPoint(
            index,
            tuple(where[index].tolist()),
            tuple(normals[kept][index].tolist()),
            tuple(turns[index].tolist()),
            f"{scene.name}, point {index + 1}",
            float(std[index]),
        )
        for index in range(len(where))
    )
    each_s = timing.approach_s + timing.settle_s + timing.retract_s
    each_s += scene.blocks.most * measurement.block_s
    skipped = [
        Skipped(f"{int(left.sum())} points", why, float(left.sum() * each_s))
        for left, why in (
            (off, "beside the surface"),
            (steep, f"steeper than {np.degrees(STEEPEST_RAD):.0f} degrees"),
        )
        if left.any()
    ]
    return plan_points(scene, points, skipped, measurement, timing)


def compile_scene(scene: ScanScene) -> Plan:
    """Plan of a scene before anything moves; a surface to be found by touch is taken to be level.

    Raises
    ------
    ValueError
        As `make_plan`.
    """
    if isinstance(scene.surface, TouchRequest):
        return make_plan(scene, Plane((0.0, 0.0, scene.surface.expected_height_m)))
    return make_plan(scene)


def clear_plan(scene: ScanScene, plan: Plan, surface: Surface, use: TipUse | None) -> Plan:
    """The plan without points at which the sensor would not stay clear of the surface; None: not looked at.

    Raises
    ------
    ValueError
        If that is all of them.
    """
    return plan if use is None else plan_with(scene, plan, *clear_points(plan.points, surface, use))


def plan_with(
    scene: ScanScene, plan: Plan, points: Sequence[ScanPoint], left: Sequence[LeftOut]
) -> Plan:
    """The plan with these points, renumbered, and what is left out of it noted.

    Raises
    ------
    ValueError
        If there is no point.
    """
    if not points:
        raise ValueError(f"positions: all {len(left)} are left out; the first: {left[0].why}")
    each_s = plan.longest_s / len(plan.points)
    numbered = tuple(
        replace(point, index=index, label=f"{scene.name}, point {index + 1}")
        for index, point in enumerate(points)
    )
    entries = [Skipped(f"the point at {_in_mm(out.point)}", out.why, each_s) for out in left]
    # what is saved at each point follows from their number
    noted = plan.skipped[: len(plan.skipped) - len(plan.measurement.skipped)]
    return plan_points(scene, numbered, [*noted, *entries], plan.measurement)


def _in_mm(point: ScanPoint) -> str:
    x, y, _ = point.position_m
    return f"x = {1e3 * x:.2f}, y = {1e3 * y:.2f} mm"


def plan_points(
    scene: ScanScene,
    points: tuple[ScanPoint, ...],
    skipped: Sequence[Skipped] = (),
    measurement: MeasurementDesign | None = None,
    timing: Timing | None = None,
) -> Plan:
    """Plan of points that are known: of poses given, of a run that is continued."""
    timing = Timing() if timing is None else timing
    measurement = design_measurement(scene) if measurement is None else measurement
    shortest_s, longest_s = (
        duration_s(points, blocks, measurement, timing)
        for blocks in (scene.blocks.least, scene.blocks.most)
    )
    per_point = [Skipped(s.what, s.why, s.saved_s * len(points)) for s in measurement.skipped]
    return Plan(points, measurement, (*skipped, *per_point), shortest_s, longest_s)


def duration_s(
    points: tuple[ScanPoint, ...],
    blocks: int,
    measurement: MeasurementDesign,
    timing: Timing | None = None,
) -> float:
    """Time that the remaining points take with so many blocks each [s]."""
    if not points:
        return 0.0
    timing = Timing() if timing is None else timing
    position = np.array([point.position_m for point in points])
    travel_m = float(np.sum(np.linalg.norm(np.diff(position, axis=0), axis=1)))
    contact_s = timing.approach_s + timing.settle_s + timing.retract_s
    measuring_s = blocks * measurement.block_s
    return travel_m / timing.travel_m_s + len(points) * (contact_s + measuring_s)


def tip_orientation(normal: npt.ArrayLike, heading_rad: float) -> FloatArray:
    """(..., 4) unit quaternions (x, y, z, w) of the frame `tip`.

    Parameters
    ----------
    normal : (..., 3) float
        Outward unit normals: the tip's +z.
    heading_rad : float
        Direction of the tip's +x, from clamp to tip, seen from above [rad]: +x is its projection onto the
        surface.

    Raises
    ------
    ValueError
        If a normal points along the heading.
    """
    z = np.asarray(normal, float)
    heading = np.array([np.cos(heading_rad), np.sin(heading_rad), 0.0])
    x = heading - np.sum(z * heading, axis=-1, keepdims=True) * z
    length = np.linalg.norm(x, axis=-1, keepdims=True)
    if not np.all(length > 1e-6):
        raise ValueError(
            f"heading_rad: got {heading_rad:g}, along a normal; accepted is across all of them"
        )
    x = x / length
    frame = np.stack([x, np.cross(z, x), z], axis=-1)  # (..., 3, 3), columns are the axes
    quaternions = Rotation.from_matrix(frame.reshape(-1, 3, 3)).as_quat()
    return np.asarray(quaternions.reshape(*z.shape[:-1], 4))
