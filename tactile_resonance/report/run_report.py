# SPDX-License-Identifier: Apache-2.0
"""A run as one page that needs nothing else: warnings, what can be looked at by a click, tables."""

from __future__ import annotations

import base64
import html
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from tactile_resonance.configuration import parse_yaml
from tactile_resonance.fields import counted
from tactile_resonance.report import run_tables as tables
from tactile_resonance.report.drawing import SIMULATED
from tactile_resonance.report.page import map_entry, page, page_data, point_entry
from tactile_resonance.report.paper_figures import paper_figures
from tactile_resonance.report.point_details import PointDetails, lines_each
from tactile_resonance.report.run_tables import SURE, Truths, repeats_sentence, table_notes
from tactile_resonance.scan.decision import Verdict
from tactile_resonance.scan.plan import plan_against_outcome
from tactile_resonance.scan.point_outcome import (
    SILENT,
    SensorHealth,
    budget_sentence,
    sensor_health,
)
from tactile_resonance.scan.point_result import PointOutcome, PointResult
from tactile_resonance.scan.pole_map import GrowingMap, PoleMap
from tactile_resonance.scan.recorded import measurements_of_file
from tactile_resonance.scan.run_content import RunContent, not_checked
from tactile_resonance.scan.scene import DriftLimits, Output, ScanScene, read_run_scene, scene_of
from tactile_resonance.scan.tissue_tests import TYPE as TEST_TYPE
from tactile_resonance.tissue.classify import UNKNOWN
from tactile_resonance.tones import SilentRecord, silent_record

if TYPE_CHECKING:
    from tactile_resonance.report.run_map import RunBoundary

# Facts of the run that have a place of their own on the page.
_SHOWN = {"skipped", "notes", "surface"}
_FIGURES = "Figures in the manner of the paper, from the estimates of the run"
_CELLS = 60  # of the map between the points, along its longer side
_MOST_NAMED = 8  # points or files, in a warning
_SIGNIFICANT, _FORCE_SHARE = 4.0, 0.05


def pole_maps_of(run: RunContent) -> list[PoleMap]:
    """Of each band a map of every point's latest attempt that counts, without those skipped.

    None without a point, or where the scene wants no map.
    """
    scene = scene_of(run.path)
    if not run.results or (scene is not None and Output.MAP not in scene.outputs):
        return []
    bands = 1 if scene is None else len(scene.sensor.bands)
    maps = [
        GrowingMap(result.of_band(k) for result in run.results).map
        for k in range(bands)
    ]
    return [pole_map for pole_map in maps if pole_map.points]


def as_page(
    run: RunContent,
    pole_maps: Sequence[PoleMap],
    pictures: Sequence[bytes],
    details: Mapping[int, PointDetails],
    truths: Truths,
    boundary: RunBoundary | None = None,
) -> str:
    """HTML that needs nothing else; see `page.page`.

    Parameters
    ----------
    run : RunContent
    pole_maps : sequence of PoleMap
        Of the bands, as `pole_maps_of` gives them.
    pictures : sequence of bytes
        Of these (PNG): for paper, and where no script runs.
    details : mapping of int to PointDetails
        By point, as far as they are to be in the page.
    truths : mapping of int to PointTruth
        What the simulated bench knew, by point; empty for hardware.
    boundary : RunBoundary, optional
        That was wanted.
    """
    name, scene = scene_name(run), scene_of(run.path)
    plan = [] if scene is None else plan_against_outcome(scene, run)
    measured = [result for result in run.latest if result.outcome is PointOutcome.DONE]
    notes = run.facts.get("notes") or {"notes": "none"}
    facts = {key: value for key, value in run.facts.items() if key not in _SHOWN}
    sections = {
        "Plan and outcome": tables.text_table(("what", "planned", "came"), plan),
        "Boundary": tables.paragraphs([] if boundary is None else boundary.sentences()),
        "Sensor in free air": tables.paragraphs([_health(run, scene)[1]]),
        "Silent record": tables.bullets(silent_lines(run)),
        "Notes of the session": tables.bullets(f"{key}: {value}" for key, value in notes.items()),
        "Surface, found by touch": tables.touches_table(run.facts.get("surface")),
        "Time": tables.time_table(measured),
        "Points": tables.results_table(tables.COLUMNS, run.latest)
        + tables.paragraphs(table_notes(run.latest, truths)),
        f"Against free air{' and the truth of the simulation' if truths else ''}": tables.results_table(
            (*tables.AIR_COLUMNS, *tables.truth_columns(truths)), measured
        ),
        "Further bands": tables.bands_table(measured),
        "Nonlinear distortion": tables.distortion_table(measured),
        "Left out": tables.bullets(skipped_lines(run)),
        "Scene": f"<pre>{html.escape(run.scene)}</pre>",
        "Made with": f"<pre>{html.escape(yaml.safe_dump(facts, sort_keys=False))}</pre>",
    }
    warned = warnings_of(run, boundary, details)
    head = f"<h1>{html.escape(name)}</h1>{tables.warning_list(warned)}"
    head += tables.paragraphs(summary(run))
    encoded = (base64.b64encode(picture).decode() for picture in pictures)
    paper = "".join(f'<img alt="pole map" src="data:image/png;base64,{data}">' for data in encoded)
    below = "".join(
        f"<h2>{html.escape(title)}</h2>{text}" for title, text in sections.items() if text
    )
    entry = run_entry(run, name, pole_maps, details, boundary)
    data = page_data([entry], paper_figures(run, details), _FIGURES)
    return page(name, f'{head}<div class="paper">{paper}</div>', data, below)


def run_entry(
    run: RunContent,
    name: str,
    pole_maps: Sequence[PoleMap],
    details: Mapping[int, PointDetails],
    boundary: RunBoundary | None = None,
    most: int = 0,
) -> dict[str, Any]:
    """A run as `page.js` shows it: its points and map in each band, and what a click on a point shows.

    Parameters
    ----------
    most : int
        Points with details in the page, where there are more than those of this run.
    """
    scene = scene_of(run.path)
    bands = [None] if scene is None else scene.sensor.bands
    lines = lines_each(max(most, len(details)))
    return {
        "name": name,
        "simulated": any(result.simulated for result in run.latest),
        "tested": len(run.messages_at(TEST_TYPE)),
        "force_mn": None if scene is None else 1e3 * scene.force_n,
        "bands": [
            {
                "name": "" if band is None else f"{band.low_hz:g} to {band.high_hz:g} Hz",
                "points": [point_entry(result.of_band(k)) for result in run.latest],
                **map_entry(
                    None if pole_map is None else pole_map.surface(_CELLS),
                    *(() if k or boundary is None else (boundary.boundary, boundary.true_outline_m)),
                ),
            }
            for k, (band, pole_map) in enumerate(zip_longest(bands, pole_maps[: len(bands)]))
        ],
        "details": {str(index): each.entry(lines) for index, each in details.items()},
    }


def warnings_of(
    run: RunContent,
    boundary: RunBoundary | None = None,
    details: Mapping[int, PointDetails] | None = None,
) -> list[str]:
    """What a reader must know before any figure of the run, the gravest first."""
    results, scene, unreadable = run.latest, None, ""
    try:
        scene = read_run_scene(run.path / "scene.yaml")
    except ValueError as error:
        unreadable = str(error)
    told = [f"damaged: {problem}" for problem in run.problems[:_MOST_NAMED]]
    if len(run.problems) > _MOST_NAMED:
        more = counted(len(run.problems) - _MOST_NAMED, "further file is", "further files are")
        told.append(f"{more} damaged")
    if run.unchecked:
        told.append(not_checked(run.unchecked))
    unread = [each.problem for each in (details or {}).values() if each.problem]
    if unread:
        told.append(
            f"FRF, force or mechanical tests of {counted(len(unread), 'point')} cannot be read: {unread[0]}"
        )
    if unreadable:
        told.append(
            f"{unreadable}: plan and outcome cannot be compared, further bands are left out, and drift "
            "is judged by the usual limits"
        )
    if len(results) < len(run.points):
        told.append(
            f"{len(run.points) - len(results)} of {len(run.points)} points are not finished"
        )
    health, sentence = _health(run, scene)
    if health is not SensorHealth.STEADY:
        told.append(sentence)
    measured = [r for r in results if r.outcome is PointOutcome.DONE]
    hopeless = [r for r in measured if r.verdict == Verdict.HOPELESS.value]
    off: list[PointResult] = []
    if scene is not None:
        off = [r for r in measured if _force_is_off(r, scene.force_n)]
    not_tested = _not_tested(run, scene, details or {})
    for what, points, why in (
        ("failed", [r for r in results if r.outcome is PointOutcome.FAILED], lambda r: r.reason),
        ("poles with a remark", [r for r in measured if _remarks(r)], _remarks),
        ("precision out of reach", hopeless, lambda r: f"{counted(r.blocks, 'block')}"),
        ("force other than the scene's", off, lambda r: f"{1e3 * r.force_n:.2f} mN"),
        ("force not quiet at first", [r for r in measured if r.gate], lambda r: r.gate),
        (
            "mechanical test failed",
            [r for r in results if r.index in not_tested],
            lambda r: not_tested[r.index],
        ),
        (
            "tissue unknown",
            [r for r in measured if r.tissue_class == UNKNOWN],
            lambda r: r.tissue_reason,
        ),
    ):
        if points:
            named = [f"{r.index + 1}" + (f" ({text})" if (text := why(r)) else "") for r in points]
            more = f" and {len(points) - _MOST_NAMED} more" if len(points) > _MOST_NAMED else ""
            of = f"{len(points)} of {len(results)} points"
            told.append(f"{what}, {of}: {', '.join(named[:_MOST_NAMED])}{more}")
    if boundary is not None and not boundary.met:
        told.append("the boundary is not known as well as was asked for")
    if any(r.repeats for r in results):
        told.append(repeats_sentence(results))
    simulated = any(result.simulated for result in results)
    return [*([SIMULATED] if simulated else []), *told]


def _health(run: RunContent, scene: ScanScene | None) -> tuple[SensorHealth, str]:
    return sensor_health(run, scene.drift_limits if scene else DriftLimits())


def _not_tested(
    run: RunContent, scene: ScanScene | None, details: Mapping[int, PointDetails]
) -> dict[int, str]:
    """Why mechanical tests failed, by point: they were not carried out, or could not be fitted."""
    counts, why = run.messages_at(TEST_TYPE), {}
    for result in run.latest:
        asked = () if scene is None else scene.protocols
        wanted = sum(each.concerns(result.index) for each in asked)
        reasons = []
        if result.outcome is PointOutcome.DONE and counts.get(result.index, 0) < wanted:
            reasons.append(result.reason or "no record")
        tests = details[result.index].tests if result.index in details else ()
        reasons += [f"{t.test.protocol.value}: {t.reason}" for t in tests if t.fit is None]
        if reasons:
            why[result.index] = "; ".join(reasons)
    return why


def _remarks(result: PointResult) -> str:
    """Status of the poles of each band where something speaks against them; empty: nothing does."""
    further = [
        f"{band.band_low_hz:g} to {band.band_high_hz:g} Hz: {band.poles_status}"
        for band in result.further
        if band.poles_status not in SURE
    ]
    first = [] if result.poles_status in SURE else [result.poles_status]
    return "; ".join(first + further)


def _force_is_off(result: PointResult, force_n: float) -> bool:
    """Whether the mean force differs from the scene's beyond its noise and by more than a share of it."""
    off_n = abs(result.force_n - force_n)
    noise_n = np.nan_to_num(result.force_std_n)
    return bool(off_n > _FORCE_SHARE * force_n and off_n > _SIGNIFICANT * noise_n)


def summary(run: RunContent) -> list[str]:
    """Sentences: how far it has come, what was found, what ending early saved."""
    done = Counter(result.outcome for result in run.latest)
    lines = [
        f"{len(run.latest)} of {len(run.points)} points finished: {done[PointOutcome.DONE]} with poles, "
        f"{done[PointOutcome.FAILED]} failed, {done[PointOutcome.SKIPPED]} skipped."
    ]
    found = [r for r in run.latest if np.isfinite(r.f0_hz)]
    if found:
        f0 = np.array([r.f0_hz for r in found])
        lines.append(
            f"f0 from {f0.min():.2f} to {f0.max():.2f} Hz, standard deviation of a point {median_std(found)}."
        )
    blocks = sum(r.blocks for r in run.latest)
    saved = sum(r.blocks_saved for r in run.latest)
    if saved:
        seconds = float(np.nansum([r.saved_s for r in run.latest]))
        lines.append(
            f"{counted(blocks, 'block')} measured; {saved} more were allowed and not taken, "
            f"{seconds:.1f} s saved."
        )
    if given_up := sum(r.verdict == Verdict.HOPELESS.value for r in run.latest):
        lines.append(f"Precision out of reach at {counted(given_up, 'point')}, which ended early.")
    if time := budget_sentence(run.latest):
        lines.append(time)
    classes = Counter(r.tissue_class for r in run.latest if r.tissue_class)
    if classes:
        named = ", ".join(f"{name} {count}" for name, count in sorted(classes.items()))
        lines.append(f"Tissue called: {named}.")
        lines.append(_compared(run, [r for r in run.latest if r.tissue_class]))
    return lines


def median_std(results: Sequence[PointResult]) -> str:
    """Median of the standard deviations of f0, and of how many points there is none."""
    known = [r.f0_std_hz for r in results if np.isfinite(r.f0_std_hz)]
    if not known:
        return "unknown"
    without = len(results) - len(known)
    unknown = f", unknown at {without} of {len(results)} points" if without else ""
    return f"{np.median(known):.2g} Hz (median{unknown})"


def read_silent(run: RunContent) -> SilentRecord | None:
    """Tones and noise of a run's silent record; None where it has none.

    Raises
    ------
    ValueError
        If its file is damaged or holds no samples.
    """
    for path in run.paths(reference=SILENT):
        for stored in measurements_of_file(path):
            records = stored.records
            if not records or stored.gaps:
                raise ValueError(f"{path.name}: {len(records)} records, expected some without a gap")
            u, y = (
                np.stack([getattr(record, channel).volts() for record in records])
                for channel in ("actuator", "sensor")
            )  # (P, N)
            return silent_record(u, y, sample_rate_hz=records[0].sample_rate_hz)
        raise ValueError(f"{path.name}: no measurement, expected a silent one")
    return None


def silent_lines(run: RunContent) -> list[str]:
    """Noise and tones of both channels without drive; empty where no silent record was taken."""
    try:
        silent = read_silent(run)
    except ValueError as error:
        return [str(error)]
    return [] if silent is None else silent.text().splitlines()


def _compared(run: RunContent, called: Sequence[PointResult]) -> str:
    """What classes were compared with."""
    referred = [r for r in called if np.isfinite(r.nominal_f0_std_hz)]
    if not referred:
        reasons = "; ".join(sorted({r.tissue_reason for r in called if r.tissue_reason}))
        return f"No pole is referred to a nominal contact: {reasons or 'of an earlier version'}."
    std = np.median([r.nominal_f0_std_hz for r in referred])
    scene = scene_of(run.path)
    nominal = scene and scene.nominal_contact
    which = f", {1e3 * nominal.force_n:g} mN and {nominal.age_s:g} s" if nominal else ""
    return (
        f"Tissue is called from {len(referred)} poles at the nominal force and age of contact{which}: "
        f"standard deviation of f0 {std:.2g} Hz (median)."
    )


def skipped_lines(run: RunContent) -> list[str]:
    """What the plan left out, why, and what that saved."""
    lines = []
    for entry in run.facts.get("skipped", []):
        saved_s = entry.get("saved_s", 0.0)
        saved = f"; saves up to {saved_s:.0f} s" if saved_s else ""
        lines.append(f"{entry['what']}: {entry['why']}{saved}")
    return lines


def scene_name(run: RunContent) -> str:
    """Name of what was scanned; of the folder where the scene has none."""
    try:
        content = parse_yaml(run.scene)
    except ValueError:
        content = None
    named = content.get("name") if isinstance(content, dict) else None
    return str(named or run.path.name)
