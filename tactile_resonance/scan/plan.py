# SPDX-License-Identifier: Apache-2.0
"""A scan as it is planned: points in order, what is measured there, the time; in words, and what came of it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.force_spread import SHORTEST_S
from tactile_resonance.contact.goal import LEAST_FORCE_N
from tactile_resonance.contact.parameters import FORCE_SHARE, read_contact
from tactile_resonance.fields import counted, require
from tactile_resonance.scan.adaptive import Adaptive, WantedMap, known_points
from tactile_resonance.scan.clearance import is_along, is_plane
from tactile_resonance.scan.decision import Precise, Separate
from tactile_resonance.scan.measurement import (
    CALIBRATED_S,
    MeasurementDesign,
    Skipped,
    design_measurement,
    lines_wanted,
    mains_sentence,
)
from tactile_resonance.scan.point_outcome import SILENT
from tactile_resonance.scan.point_result import PointOutcome, PointResult
from tactile_resonance.scan.points import (
    LeftOut,
    ScanPoint,
    point_label,
    scan_points,
    tip_orientation,
)
from tactile_resonance.scan.run_content import RunContent
from tactile_resonance.scan.scene import Output, ScanScene, residual_terms_of
from tactile_resonance.scan.surface import Plane, Surface, TouchRequest
from tactile_resonance.scan.tissue_tests import ProtocolRequest
from tactile_resonance.sensor import MAX_LEVEL_V

STEEPEST_RAD = np.pi / 3
TRAVEL_M_S = 0.05
LEAST_GATE_N = 2e-4
"""A gate below this closes on the noise of a load cell of 1 mN at 1 kHz [N]."""
CONTACT_S, NEAR_CONTACT_S = 2.2, 1.1
"""Of each point, as seen on the simulated bench: tare, approach, until the force is held, and back; the second
where the surface was touched near by."""


@dataclass(frozen=True)
class Plan:
    """What a scan will do; every stage of it reads this.

    Attributes
    ----------
    scene : ScanScene
        That it carries out.
    points : tuple of ScanPoint
        Of an adaptive scan the places among which it chooses.
    measurement : MeasurementDesign
        At each of them.
    left_out : tuple of Skipped
        Points, with the time saved; what is saved at each point that is left is the measurement's.
    """

    scene: ScanScene
    points: tuple[ScanPoint, ...]
    measurement: MeasurementDesign
    left_out: tuple[Skipped, ...] = ()

    @property
    def skipped(self) -> tuple[Skipped, ...]:
        """Points and work left out, with the time saved."""
        each = list(self.measurement.skipped)
        if near := self.near:
            at = counted(near, "point")
            what = f"rest for the tare, and height that the surface does not ask for, at {at}"
            why = "zero and plane are known from the point before"
            each.append(Skipped(what, why, near * (CONTACT_S - NEAR_CONTACT_S)))
        return (*self.left_out, *each)

    @cached_property
    def first_points(self) -> tuple[ScanPoint, ...]:
        """Those that are known before the first is touched: all, or the first touches of an adaptive scan."""
        adaptive = self.scene.adaptive
        if adaptive is None:
            return self.points
        first = enumerate(adaptive.first(self._places_m))
        return tuple(self._numbered(self.points[place], index) for index, place in first)

    @property
    def most_points(self) -> int:
        """That are touched."""
        adaptive = self.scene.adaptive
        return len(self.points) if adaptive is None else min(adaptive.most, len(self.points))

    @property
    def near(self) -> int:
        """How many points, of those known beforehand, follow one near by on a plane surface."""
        if not is_plane(self.scene.surface):
            return 0
        return sum(map(is_along, self.first_points, self.first_points[1:]))

    @cached_property
    def shortest_s(self) -> float:
        """With the fewest points and blocks, and of tests what they hold [s]."""
        count = len(self.first_points)
        held_s = sum(asked.hold_s * _tested(asked, count) for asked in self.scene.protocols)
        return count * self.point_s(self.measurement.blocks.least) + held_s

    @cached_property
    def longest_s(self) -> float:
        """With the most [s]."""
        return self.duration_s(self.measurement.blocks.most)

    @property
    def touches_before(self) -> int:
        """For surface and normals, before the first point is measured."""
        scene = self.scene
        touches = len(scene.surface.points_m) if isinstance(scene.surface, TouchRequest) else 0
        return touches + (scene.normals.touches * self.most_points if scene.normals else 0)

    @property
    def search_s(self) -> float:
        """About what these take [s]."""
        return self.touches_before * CONTACT_S

    def duration_s(self, blocks: int) -> float:
        """Of the most points, with so many blocks each, and with the longest tests [s]."""
        tests_s = sum(asked.longest_s * _tested(asked, self.most_points) for asked in self.scene.protocols)
        return self.most_points * self.point_s(blocks) + tests_s

    def point_s(self, blocks: int) -> float:
        """Mean time of a point with so many blocks, without its tests [s].

        Ways that are not known yet count as the mean of those that are.
        """
        position = np.array([point.position_m for point in self.first_points])
        travel_m = float(np.sum(np.linalg.norm(np.diff(position, axis=0), axis=1)))
        contact_s = len(position) * CONTACT_S - self.near * (CONTACT_S - NEAR_CONTACT_S)
        each_s = (travel_m / TRAVEL_M_S + contact_s) / len(position)
        return each_s + blocks * self.measurement.block_s

    def next_point(
        self, touched: Sequence[ScanPoint], results: Iterable[PointResult]
    ) -> ScanPoint | None:
        """The touch that an adaptive scan appends to those before; None where it is enough, or not adaptive.

        Parameters
        ----------
        touched : sequence of ScanPoint
            In order, all finished.
        results : iterable of PointResult
            Latest of each.
        """
        adaptive = self.scene.adaptive
        if adaptive is None:
            return None
        place_of = {point.position_m: place for place, point in enumerate(self.points)}
        before = [place_of[point.position_m] for point in touched]
        last = self.points[before[-1]]
        way_m = np.linalg.norm(self._places_m - self._places_m[before[-1]], axis=1)
        near = [is_along(last, point) for point in self.points]
        contact_s = np.where(near, NEAR_CONTACT_S, CONTACT_S)
        seconds = way_m / TRAVEL_M_S + contact_s
        seconds += self.measurement.blocks.least * self.measurement.block_s
        place = adaptive.next(self._places_m, before, known_points(results), seconds)
        return None if place is None else self._numbered(self.points[place], len(touched))

    @cached_property
    def _places_m(self) -> FloatArray:
        """(p, 2) of all points, seen from above."""
        return np.array([point.position_m[:2] for point in self.points])

    def _numbered(self, point: ScanPoint, index: int) -> ScanPoint:
        return replace(point, index=index, label=point_label(self.scene.name, index))

    def with_points(self, points: Sequence[ScanPoint], left: Sequence[LeftOut]) -> Plan:
        """The same with these points, renumbered, and what is left out of it noted.

        Raises
        ------
        ValueError
            If there is no point.
        """
        if not points:
            raise ValueError(f"positions: all {len(left)} are left out; the first: {left[0][1]}")
        each_s = self.longest_s / len(self.points)
        numbered = tuple(self._numbered(point, index) for index, point in enumerate(points))
        entries = [Skipped(f"the point at {_in_mm(point)}", why, each_s) for point, why in left]
        return replace(self, points=numbered, left_out=(*self.left_out, *entries))


def plan_points(scene: ScanScene, points: tuple[ScanPoint, ...]) -> Plan:
    """Plan of points that are known: of poses given, of a run that is continued."""
    return Plan(scene, points, design_measurement(scene))


def make_plan(scene: ScanScene, surface: Surface | None = None) -> Plan:
    """Points of a scene on its surface.

    Parameters
    ----------
    scene : ScanScene
    surface : Surface, optional
        In place of the scene's. Without it one that is to be found by touch is taken to be level, at the height
        at which it is expected.

    Raises
    ------
    ValueError
        If no position lies on it.
    """
    under = scene.surface if surface is None else surface
    if isinstance(under, TouchRequest):
        under = Plane((0.0, 0.0, under.expected_height_m))
    xy, given_z = scene.positions_m[:, :2], scene.positions_m[:, 2]
    height, normals = under.at(xy)
    z = np.where(np.isnan(given_z), height, given_z)
    off = np.isnan(z) | np.any(np.isnan(normals), axis=1)
    with np.errstate(invalid="ignore"):
        steep = ~off & (normals[:, 2] < np.cos(STEEPEST_RAD))
    kept = ~off & ~steep
    found = f"{len(xy)}, {int(off.sum())} beside the surface and {int(steep.sum())} too steep"
    require(bool(kept.any()), "positions", found, "one usable position or more")
    turns = tip_orientation(normals[kept], scene.sensor.heading_rad)
    std = under.height_std_m(xy[kept])
    where = np.column_stack([xy[kept], z[kept]])
    plan = plan_points(scene, scan_points(scene.name, where, normals[kept], turns, std))
    each_s = CONTACT_S + plan.measurement.blocks.most * plan.measurement.block_s
    left_out = tuple(
        Skipped(counted(int(left.sum()), "point"), why, float(left.sum() * each_s))
        for left, why in (
            (off, "beside the surface"),
            (steep, f"steeper than {np.degrees(STEEPEST_RAD):.0f} degrees"),
        )
        if left.any()
    )
    return replace(plan, left_out=left_out)


def _tested(asked: ProtocolRequest, points: int) -> int:
    """At how many of so many points a test is made."""
    return sum(map(asked.concerns, range(points)))


def _in_mm(point: ScanPoint) -> str:
    x, y, _ = point.position_m
    return f"x = {1e3 * x:.2f}, y = {1e3 * y:.2f} mm"


def plan_rows(plan: Plan) -> list[tuple[str, str]]:
    """What a scan will excite, compute, publish and draw, with names for people."""
    scene, design, count = plan.scene, plan.measurement, plan.most_points
    before = plan.touches_before
    stretches = " and ".join(f"{low:g} to {high:g}" for low, high in design.stretches_hz)
    at_most = "at most " if scene.adaptive else ""
    beside = f", {before} for surface and normals" if before else ""
    rows = [("touches", f"{at_most}{before + count}: {counted(count, 'point')}{beside}")]
    if scene.adaptive is not None:
        rows += [
            (
                "adaptive",
                f"{counted(len(plan.first_points), 'point')} first, "
                "each of the others where it is expected to show most of what is "
                f"{1e3 * scene.adaptive.smallest_m:g} mm wide or wider, among "
                f"{len(plan.points)} places",
            ),
            ("chosen until", f"{adaptive_wanted(scene.adaptive)}, or the most points"),
        ]
    rows += [
        (
            "excited",
            f"{design.grid.value} grid of {design.lines} lines, {stretches} Hz, at "
            f"{design.level_v:.3g} V rms" + (", a rising sweep" if design.sweep else ""),
        ),
        (
            "sampled",
            f"{design.sample_rate_hz:g} Hz, blocks of {design.samples} samples, {design.block_s:g} s",
        ),
        ("period", _period(plan)),
        ("mains", mains_sentence(design)),
        ("measured", f"{design.blocks.least} to {design.blocks.most} blocks a point"),
        ("until", _wanted(scene)),
    ]
    if scene.sensor.calibrated:
        rows.append(("sensor", "calibrated: poles through the parameter calibration of poles_node"))
    for band in design.bands:
        order = (
            "one to three modes, as the data choose" if band.order == 0 else f"order {band.order}"
        )
        of_data = "" if band.order == 0 else f" and {band.residual_terms} residual terms"
        needed = min(residual_terms_of(band.ends_hz), 20)
        if band.order and needed > band.residual_terms:
            of_data += f" ({needed} follow a mode close beside the band, with less bias and less precision)"
        rows.append(("poles", f"{band.low_hz:g} to {band.high_hz:g} Hz, {order}{of_data}"))
    if Output.DISTORTION in scene.outputs:
        rows.append(("distortion", "even and odd, at input and output, in each band of poles"))
    rows += [("tested", str(asked)) for asked in scene.protocols]
    rows.append(("FRF", "at all lines that are excited"))
    if scene.tissue_classes:
        rows.append(("tissue", ", ".join(each.name for each in scene.tissue_classes)))
    rows.append(("published", "excitation, record, frf, poles, point_result of every point"))
    drawn = ["report.html"]
    if Output.MAP in scene.outputs:
        drawn += [*map_names(len(design.bands)), "map.mcap"]
    rows.append(("drawn", ", ".join(drawn)))
    search = f", and about {plan.search_s:.0f} s for surface and normals before" if before else ""
    rows.append(("time", f"{plan.shortest_s:.0f} to {plan.longest_s:.0f} s{search}"))
    rows += [("limit", text) for text in _limits(plan)]
    for left in plan.skipped:
        saved = f"; saves up to {left.saved_s:.1f} s" if left.saved_s else ""
        rows.append(("skipped", f"{left.what}: {left.why}{saved}"))
    return rows


def adaptive_wanted(asked: Adaptive) -> str:
    """When the touches of a scan are enough."""
    wanted = asked.wanted
    if isinstance(wanted, WantedMap):
        return f"f0 +- {wanted.f0_std_hz:g} Hz everywhere"
    levels = " and ".join(f"{level:.2f}" for level in wanted.levels)
    return f"the boundary at {levels} Hz with {1e6 * asked.most_loss:.3g} mm2 expected on its wrong side"


def _found(asked: Adaptive, results: Sequence[PointResult]) -> str:
    """How well what is wanted is known."""
    surface = asked.krige(known_points(results))
    if surface is None:
        return "too few points have a pole"
    loss = asked.loss(surface)
    met = "enough" if loss <= asked.most_loss else "not enough"
    if isinstance(asked.wanted, WantedMap):
        _, std_hz = surface.predict(asked.raster.xy_m[asked.raster.within])
        return f"{met}: +- {std_hz.max():.2g} Hz at most, {counted(len(results), 'touch', 'touches')}"
    return f"{met}: {1e6 * loss:.3g} mm2, {counted(len(results), 'touch', 'touches')}"


def _period(plan: Plan) -> str:
    """Who chose the period, and why so long."""
    design = plan.measurement
    if plan.scene.sensor.samples_per_period is not None:
        return "as the scene says"
    if plan.scene.sensor.calibrated:
        return f"{1e3 * CALIBRATED_S:g} ms: of a calibrated sensor the transient is known"
    gated = f", and at least {SHORTEST_S:g} s for the gate"
    needed = max(design.bands, key=lambda band: lines_wanted(band) / (band.high_hz - band.low_hz))
    return (
        f"the shortest with {lines_wanted(needed)} lines from {needed.low_hz:g} to {needed.high_hz:g} Hz, as "
        f"many as one block takes for its model and noise{'' if plan.scene.gate is None else gated}"
    )


def _limits(plan: Plan) -> list[str]:
    """What will end the scan or its points before they are complete."""
    limits, level_v = plan.scene.time_limits, plan.measurement.level_v
    point_s = plan.point_s(plan.measurement.blocks.least)
    texts = []
    if limits.scan_s < plan.shortest_s:
        texts.append(
            f"time_limits.scan_s: {limits.scan_s:g} s are over before all points are measured "
            f"({plan.shortest_s:.0f} s or more); `resume` goes on"
        )
    if limits.point_s < point_s:
        texts.append(
            f"time_limits.point_s: {limits.point_s:g} s; a point takes {point_s:.1f} s or more and fails"
        )
    _, of_contact = read_contact()
    most_n = FORCE_SHARE * of_contact.abort_force_n
    if plan.scene.force_n > most_n * (1 + 1e-9):
        texts.append(
            f"force_n: {plan.scene.force_n:g} N, contact_node refuses more than {most_n:g} N, two thirds of "
            "its limits.abort_force_n, by default: points fail"
        )
    if plan.scene.force_n < LEAST_FORCE_N:
        texts.append(
            f"force_n: {plan.scene.force_n:g} N, contact_node refuses less than {LEAST_FORCE_N:g} N: points "
            "fail; forces are in newtons"
        )
    texts += [
        f"protocols: {asked}: contact_node holds for {of_contact.hold_s:g} s at most, its limits.hold_s, by "
        "default: not tested"
        for asked in plan.scene.protocols
        if asked.hold_s > of_contact.hold_s
    ]
    if plan.scene.gate is not None and plan.scene.gate.force_rms_n < LEAST_GATE_N:
        texts.append(
            f"gate.force_rms_n: {plan.scene.gate.force_rms_n:g} N; the noise of a cell of 1 mN closes a gate "
            f"below {LEAST_GATE_N:g} N: points fail"
        )
    away_m = max((math.hypot(*point.position_m[:2]) for point in plan.points), default=0.0)
    most_m = math.hypot(*of_contact.workspace.high_m[:2])
    if away_m > most_m:
        texts.append(
            f"positions: up to {away_m:.3g} m from the origin; contact_node's workspace ends at {most_m:.2g} m "
            "from the robot's base by default: points fail; positions are in metres"
        )
    if level_v > MAX_LEVEL_V:
        texts.append(
            f"sensor.level_v: {level_v:.3g} V rms, excitation_node refuses more than its max_level_v, by "
            f"default {MAX_LEVEL_V:g} V rms: points fail"
        )
    return texts


def map_names(bands: int) -> list[str]:
    """Names of the figures of the map, one for each band."""
    return [f"pole_map{f'_{k + 1}' if k else ''}.png" for k in range(bands)]


def plan_against_outcome(scene: ScanScene, run: RunContent) -> list[tuple[str, str, str]]:
    """What was planned and what came, by name.

    Parameters
    ----------
    scene : ScanScene
        Of the run.
    run : RunContent
        As far as it has come.
    """
    results, count = run.latest, len(run.points)
    done = [result for result in results if result.outcome is PointOutcome.DONE]
    limits = design_measurement(scene).blocks
    blocks = f"{limits.least * count} to {limits.most * count}"
    points, chosen = f"{count}", scene.adaptive
    if chosen is not None:
        points, blocks = (f"at most {n}" for n in (chosen.most, limits.most * chosen.most))
    taken_s = float(np.nansum([result.duration_s for result in results]))
    planned_s = [run.facts.get(name) for name in ("shortest_s", "longest_s")]
    rows = [
        ("points", points, f"{len(results)} finished, {len(done)} with poles"),
        ("blocks", blocks, f"{sum(result.blocks for result in results)}"),
    ]
    if all(isinstance(seconds, (int, float)) for seconds in planned_s):
        rows.append(
            ("time", f"{planned_s[0]:.0f} to {planned_s[1]:.0f} s", f"{taken_s:.0f} s at points")
        )
    if chosen is not None:
        rows.append(("touches chosen", adaptive_wanted(chosen), _found(chosen, results)))
    for k, band in enumerate(scene.sensor.bands):
        of_band = [result.of_band(k) for result in done]
        found = [result for result in of_band if not result.failed]
        name = f"poles, {band.low_hz:g} to {band.high_hz:g} Hz"
        rows.append((name, _wanted(scene), f"{len(found)} found{_reached(scene, found)}"))
    if Output.DISTORTION in scene.outputs:
        told = sum(bool(result.distortion) for result in done)
        rows.append(("distortion", "at every point", f"at {told} of {len(done)}"))
    if Output.SILENT in scene.outputs:
        came = "taken" if run.paths(reference=SILENT) else "missing"
        rows.append(("silent record", "before the first point", came))
    return rows


def _wanted(scene: ScanScene) -> str:
    """When a point's blocks are enough."""
    wanted = scene.precision
    if isinstance(wanted, Separate):
        return f"{wanted.first.name} and {wanted.second.name} separated at {100 * wanted.probability:g} %"
    if isinstance(wanted, Precise):
        parts = []
        if wanted.f0_std_hz is not None:
            parts.append(f"f0 +- {wanted.f0_std_hz:g} Hz")
        if wanted.damping_ratio_std is not None:
            parts.append(f"damping ratio +- {wanted.damping_ratio_std:g}")
        return ", ".join(parts)
    return "the most blocks"


def _reached(scene: ScanScene, found: Sequence[PointResult]) -> str:
    """How precise poles are, and how many of them as wanted."""
    std = np.array([result.std for result in found]).reshape(-1, 2)
    known = std[np.all(np.isfinite(std), axis=1)]
    if not len(known):
        return ""
    text = f", +- {np.median(known[:, 0]):.2g} Hz and {np.median(known[:, 1]):.1g} (median)"
    if isinstance(scene.precision, Precise):
        asked = (scene.precision.f0_std_hz, scene.precision.damping_ratio_std)
        met = [all(a is None or s <= a for a, s in zip(asked, row, strict=True)) for row in known]
        text += f", {sum(met)} as precise as wanted"
    return text
