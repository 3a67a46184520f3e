# SPDX-License-Identifier: Apache-2.0
"""A plan in words, and what became of it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tactile_resonance.contact.force_spread import SHORTEST_S
from tactile_resonance.contact.parameters import FORCE_SHARE, read_contact
from tactile_resonance.fields import counted
from tactile_resonance.scan.adaptive import Adaptive, WantedMap, known_points
from tactile_resonance.scan.decision import Precise, Separate
from tactile_resonance.scan.measurement import CALIBRATED_S, MeasurementDesign, design_measurement
from tactile_resonance.scan.period import LEAST_DISTANCE, lines_wanted, mains_distances, mains_in
from tactile_resonance.scan.plan import Plan
from tactile_resonance.scan.point_result import PointOutcome, PointResult
from tactile_resonance.scan.references import SILENT
from tactile_resonance.scan.run_content import RunContent
from tactile_resonance.scan.scene import Output, ScanScene
from tactile_resonance.scan.surface import TouchRequest
from tactile_resonance.sensor import MAX_LEVEL_V

Rows = list[tuple[str, str]]


def plan_rows(plan: Plan) -> Rows:
    """What a scan will excite, compute, publish and draw, with names for people."""
    scene, design, count = plan.scene, plan.measurement, plan.most_points
    # touches before the first point is measured
    before = len(scene.surface.points_m) if isinstance(scene.surface, TouchRequest) else 0
    before += scene.normals.touches * count if scene.normals else 0
    stretches = " and ".join(f"{low:g} to {high:g}" for low, high in design.stretches_hz)
    at_most = "at most " if scene.adaptive else ""
    rows = [
        (
            "touches",
            f"{at_most}{before + count}: {counted(count, 'point')}"
            + (f", {before} for surface and normals" if before else ""),
        ),
    ]
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
        ("mains", _mains(design)),
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
    rows.append(("time", f"{plan.shortest_s:.0f} to {plan.longest_s:.0f} s"))
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
    return f"{met}: {1e6 * loss:.2g} mm2, {counted(len(results), 'touch', 'touches')}"


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
    point_s = plan.duration_s(plan.measurement.blocks.least, 1)
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
            f"force_n: {plan.scene.force_n:g} N, contact_node refuses more than two thirds of its "
            f"limits.abort_force_n, by default {most_n:g} N: points fail"
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


def _mains(design: MeasurementDesign) -> str:
    """Which harmonics of the mains cannot be distinguished from the response at excited lines."""
    hum_hz = mains_in(design.bands)
    spacing_hz = design.sample_rate_hz / design.samples
    near = [hz for hz in hum_hz if mains_distances(np.array([hz]), spacing_hz) < LEAST_DISTANCE]
    distance = f"{LEAST_DISTANCE:g} of the spacing of lines"
    if not near:
        return f"harmonics of 50 and 60 Hz in the bands are {distance} or more from the next line"
    names = ", ".join(f"{hz:g}" for hz in near)
    return f"hum at {names} Hz would count as response: it is within {distance} from the next line"


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
