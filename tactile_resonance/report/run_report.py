# SPDX-License-Identifier: Apache-2.0
"""A run as one page that needs nothing else, and as a table."""

from __future__ import annotations

import base64
import html
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np
import yaml

from tactile_resonance.report.drawing import SIMULATED
from tactile_resonance.report.point_table import table_notes, tissue_of
from tactile_resonance.scan.bench_truth import PointTruth, deviation
from tactile_resonance.scan.plan_text import plan_against_outcome
from tactile_resonance.scan.point_result import PointOutcome, PointResult
from tactile_resonance.scan.point_times import budget_sentence, time_budget
from tactile_resonance.scan.pole_map import PoleMap
from tactile_resonance.scan.recorded import measurements_of_file
from tactile_resonance.scan.references import SILENT, SensorHealth, sensor_health
from tactile_resonance.scan.run_content import NOT_CHECKED, RECORDING, RunContent
from tactile_resonance.scan.scene import DriftLimits, Output, ScanScene, read_run_scene
from tactile_resonance.silent import SilentRecord, silent_record
from tactile_resonance.strict_yaml import parse_yaml

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 76rem;
  padding: 0 1rem; color: #222 }
img { max-width: 100% } table { border-collapse: collapse; font-size: 13px }
td, th { border-bottom: 1px solid #ddd; padding: .2rem .6rem; text-align: right }
.wide { overflow-x: auto } td { white-space: nowrap } th { vertical-align: bottom }
td.text, th.text { text-align: left } tr.failed td { color: #b00 } .mark { color: #b00; font-weight: 600 }
pre { background: #f5f5f5; padding: .8rem; overflow-x: auto; font-size: 12px }
"""
Truths = Mapping[int, PointTruth]
Columns = Sequence[tuple[str, Callable[[PointResult], str]]]
_COLUMNS: Columns = (
    ("point", lambda r: f"{r.index + 1}" + (f" (attempt {r.attempt + 1})" if r.attempt else "")),
    ("x [mm]", lambda r: _number(1e3 * r.x_m, 2)),
    ("y [mm]", lambda r: _number(1e3 * r.y_m, 2)),
    ("z [mm]", lambda r: _number(1e3 * r.z_m, 2)),
    ("force [mN]", lambda r: _with_std(1e3 * r.force_n, 1e3 * r.force_std_n, 2)),
    ("rms of the force, smallest to largest [mN]", lambda r: _spread(r)),
    ("age of contact [s]", lambda r: _number(r.contact_age_s, 2)),
    ("measured f0 [Hz]", lambda r: _with_std(r.f0_hz, r.f0_std_hz, 3)),
    ("measured damping ratio", lambda r: _with_std(r.damping_ratio, r.damping_ratio_std, 5)),
    ("nominal f0 [Hz]", lambda r: _with_std(r.nominal_f0_hz, r.nominal_f0_std_hz, 3)),
    (
        "nominal damping ratio",
        lambda r: _with_std(r.nominal_damping_ratio, r.nominal_damping_ratio_std, 5),
    ),
    ("blocks", lambda r: f"{r.blocks}" + (f" ({r.blocks_saved} saved)" if r.blocks_saved else "")),
    ("tissue", tissue_of),
    ("repeats", lambda r: f"{r.repeats}: {r.disturbances}" if r.repeats else "-"),
    ("outcome", lambda r: _outcome(r)),
)
# Facts of the run that have a place of their own on the page.
_SHOWN = {"skipped", "notes", "surface"}
_AIR_COLUMNS: Columns = (
    ("point", lambda r: f"{r.index + 1}"),
    ("f0 less that in air [Hz]", lambda r: _with_std(r.f0_shift_hz, r.f0_shift_std_hz, 3)),
    ("f0 over that in air", lambda r: _with_std(r.f0_over_air, r.f0_over_air_std, 5)),
    ("damping less that in air", lambda r: _with_std(r.damping_shift, r.damping_shift_std, 5)),
)
_TEXT = {"tissue", "repeats", "outcome", "what", "planned", "came"}


def pole_maps_of(run: RunContent) -> list[PoleMap]:
    """Of each band a map of every point's latest attempt that counts, without those skipped.

    None without a point, or where the scene wants no map.
    """
    scene = scene_of(run)
    if not run.results or (scene is not None and Output.MAP not in scene.outputs):
        return []
    bands = 1 if scene is None else len(scene.sensor.bands)
    maps = [
        reduce(PoleMap.with_result, (result.of_band(k) for result in run.results), PoleMap())
        for k in range(bands)
    ]
    return [pole_map for pole_map in maps if pole_map.points]


def as_page(
    run: RunContent, pictures: Sequence[bytes], truths: Truths, boundary: Sequence[str] = ()
) -> str:
    """HTML with the pictures (PNG) in it; nothing is fetched from elsewhere.

    Parameters
    ----------
    run : RunContent
    pictures : sequence of bytes
        Maps of the bands, in their order.
    truths : mapping of int to PointTruth
        What the simulated bench knew, by point; empty for hardware.
    boundary : sequence of str
        What is known of the boundary that was wanted.
    """
    name, scene = _scene_name(run), scene_of(run)
    simulated = any(result.simulated for result in run.latest)
    health, sentence = sensor_health(run, scene.drift_limits if scene else DriftLimits())
    measured = [result for result in run.latest if result.outcome is PointOutcome.DONE]
    notes = run.facts.get("notes") or {"notes": "none"}
    facts = {key: value for key, value in run.facts.items() if key not in _SHOWN}
    sections = {
        "Plan and outcome": _compared_with_plan(scene, run),
        "Boundary": _paragraphs(boundary),
        "Sensor in free air": _paragraphs([sentence], mark=health is not SensorHealth.STEADY),
        "Silent record": _bullets(silent_lines(run)),
        "Notes of the session": _bullets([f"{key}: {value}" for key, value in notes.items()]),
        "Surface, found by touch": _touches(run.facts.get("surface")),
        "Time": _time_table(measured),
        "Points": _results(_COLUMNS, run.latest) + _paragraphs(table_notes(run.latest, truths)),
        f"Against free air{' and the truth of the simulation' if truths else ''}": _results(
            (*_AIR_COLUMNS, *_truth_columns(truths)), measured
        ),
        "Further bands": _bands_table(measured),
        "Nonlinear distortion": _distortion_table(measured),
        "Left out": _bullets(skipped_lines(run)),
        "Damaged files": _bullets(
            [*run.problems, *([NOT_CHECKED.format(run.unchecked)] if run.unchecked else [])]
        ),
        "Scene": f"<pre>{html.escape(run.scene)}</pre>",
        "Made with": f"<pre>{html.escape(yaml.safe_dump(facts, sort_keys=False))}</pre>",
    }
    parts = [f"<h1>{html.escape(name)}</h1>"]
    parts += [_paragraphs([SIMULATED], mark=True) if simulated else "", _paragraphs(summary(run))]
    for picture in pictures:
        data = base64.b64encode(picture).decode()
        parts.append(f'<img alt="pole map" src="data:image/png;base64,{data}">')
    parts += [f"<h2>{html.escape(title)}</h2>{text}" for title, text in sections.items() if text]
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(name)}</title>'
        f"<style>{_STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )


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
        std = np.median([r.f0_std_hz for r in found])
        lines.append(
            f"f0 from {f0.min():.2f} to {f0.max():.2f} Hz, standard deviation of a point {std:.2g} Hz (median)."
        )
    blocks = sum(r.blocks for r in run.latest)
    saved = sum(r.blocks_saved for r in run.latest)
    if saved:
        seconds = float(np.nansum([r.saved_s for r in run.latest]))
        lines.append(
            f"{blocks} blocks measured; {saved} more were allowed and not needed, {seconds:.1f} s saved."
        )
    if time := budget_sentence(run.latest):
        lines.append(time)
    classes = Counter(r.tissue_class for r in run.latest if r.tissue_class)
    if classes:
        named = ", ".join(f"{name} {count}" for name, count in sorted(classes.items()))
        lines.append(f"Tissue called: {named}.")
        lines.append(_compared(run, [r for r in run.latest if r.tissue_class]))
    return lines


def read_silent(run: RunContent) -> SilentRecord | None:
    """Tones and noise of a run's silent record; None where it has none.

    Raises
    ------
    ValueError
        If its file is damaged or holds no samples.
    """
    for file in run.files:
        if file.name.endswith(f"-{SILENT}.mcap"):
            for stored in measurements_of_file(run.path / RECORDING / file.name):
                records = stored.records
                if not records or stored.gaps:
                    raise ValueError(
                        f"{file.name}: {len(records)} records, expected some without a gap"
                    )
                u, y = (
                    np.stack([getattr(record, channel).volts() for record in records])
                    for channel in ("actuator", "sensor")
                )  # (P, N)
                return silent_record(u, y, sample_rate_hz=records[0].sample_rate_hz)
            raise ValueError(f"{file.name}: no measurement, expected a silent one")
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
    scene = scene_of(run)
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


def _paragraphs(lines: Iterable[str], mark: bool = False) -> str:
    css = ' class="mark"' if mark else ""
    return "".join(f"<p{css}>{html.escape(line)}</p>" for line in lines)


def _bullets(lines: Iterable[str]) -> str:
    items = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
    return items and f"<ul>{items}</ul>"


def _row(kind: str, names: Sequence[str], texts: Sequence[str], css: str = "") -> str:
    cells = ""
    for name, text in zip(names, texts, strict=True):
        side = ' class="text"' if name in _TEXT else ""
        cells += f"<{kind}{side}>{html.escape(text)}</{kind}>"
    return f"<tr{css}>{cells}</tr>"


def _table(names: Sequence[str], rows: Iterable[str]) -> str:
    return f'<div class="wide"><table>{_row("th", names, names)}{"".join(rows)}</table></div>'


def _results(columns: Columns, results: Iterable[PointResult]) -> str:
    names, rows = [name for name, _ in columns], []
    for result in results:
        css = "" if result.outcome is PointOutcome.DONE else ' class="failed"'
        rows.append(_row("td", names, [show(result) for _, show in columns], css))
    return _table(names, rows)


def _truth_columns(truths: Truths) -> Columns:
    """What the simulated bench knew; none of it for hardware."""
    if not truths:
        return ()

    def known(show: Callable[[PointResult, PointTruth], str]) -> Callable[[PointResult], str]:
        return lambda r: show(r, truths[r.index]) if r.index in truths else "-"

    return (
        ("true f0 [Hz]", known(lambda _, truth: _number(truth.estimate[0], 3))),
        ("off by [std]", known(lambda r, truth: f"{deviation(r, truth)[0]:+.1f}")),
        ("true damping", known(lambda _, truth: _number(truth.estimate[1], 5))),
        ("off by [std]", known(lambda r, truth: f"{deviation(r, truth)[1]:+.1f}")),
    )


def _bands_table(results: Sequence[PointResult]) -> str:
    """Poles of the bands beyond the first; empty where there are none."""
    names, rows = ("point", "band [Hz]", "f0 [Hz]", "damping ratio", "status"), []
    for result in results:
        for band in result.further:
            texts = (
                f"{result.index + 1}",
                f"{band.band_low_hz:g} to {band.band_high_hz:g}",
                _with_std(band.f0_hz, band.f0_std_hz, 3),
                _with_std(band.damping_ratio, band.damping_ratio_std, 5),
                band.poles_status,
            )
            rows.append(_row("td", names, texts))
    return _table(names, rows) if rows else ""


def _distortion_table(results: Sequence[PointResult]) -> str:
    """Levels at the lines left out, against those excited; in brackets the noise; empty where unknown."""
    sides = ("output, even [dB]", "output, odd [dB]", "input, even [dB]", "input, odd [dB]")
    names, rows = ("point", "band [Hz]", *sides), []

    def level(value_db: float, noise_db: float, above: bool) -> str:
        text = f"{_number(value_db, 1)} ({_number(noise_db, 1)})"
        return text if above else f"{text}, only noise"

    for result in results:
        for band in result.distortion:
            texts = (
                f"{result.index + 1}",
                f"{band.low_hz:g} to {band.high_hz:g}",
                level(band.even_db, band.even_noise_db, band.even_above_noise),
                level(band.odd_db, band.odd_noise_db, band.odd_above_noise),
                _number(band.input_even_db, 1),
                _number(band.input_odd_db, 1),
            )
            rows.append(_row("td", names, texts))
    return _table(names, rows) if rows else ""


def _time_table(results: Sequence[PointResult]) -> str:
    """Where the time of the points went; nothing where it is unknown, as in runs of earlier versions."""
    budget = time_budget(results)
    whole_s = float(sum(each.sum() for each in budget.values()))
    if not whole_s:
        return ""
    names, rows = ("what", "median [s]", "largest [s]", "all points [s]", "share [%]"), []
    for name, each in {**budget, "all": np.sum(list(budget.values()), axis=0)}.items():
        figures = (np.median(each), each.max(), each.sum())
        texts = (f"{figure:.2f}" for figure in figures)
        rows.append(_row("td", names, (name, *texts, f"{100 * each.sum() / whole_s:.0f}")))
    return _table(names, rows)


def _compared_with_plan(scene: ScanScene | None, run: RunContent) -> str:
    """Nothing where the scene cannot be read."""
    if scene is None:
        return ""
    names = ("what", "planned", "came")
    return _table(names, [_row("td", names, row) for row in plan_against_outcome(scene, run)])


def _touches(surface: Mapping[str, Any] | None) -> str:
    """What the surface rests on; empty where it was not found by touch."""
    if surface is None:
        return ""
    names, rows = (
        ("ball x [mm]", "ball y [mm]", "ball z [mm]", "off the form [mm]", "force [mN]"),
        [],
    )
    for touch, residual in zip(surface["touches"], surface["residuals_m"], strict=True):
        x, y, z = (f"{1e3 * value:.3f}" for value in touch["ball_m"])
        z += f" ± {1e3 * touch['std_m']:.2g}"
        texts = (x, y, z, f"{1e3 * residual:+.3f}", f"{1e3 * touch['force_n']:.2f}")
        rows.append(_row("td", names, texts))
    told = {
        True: "The touches lie on it as well as their noise allows.",
        False: "The touches lie off it by more than their noise explains.",
        None: "There was no touch to spare to check it.",
    }[surface["consistent"]]
    return _paragraphs([f"A {surface['form']}. {told}"]) + _table(names, rows)


def scene_of(run: RunContent) -> ScanScene | None:
    """None where it cannot be read: a run is reported whatever became of its scene."""
    try:
        return read_run_scene(run.path / "scene.yaml")
    except ValueError:
        return None


def _scene_name(run: RunContent) -> str:
    try:
        content = parse_yaml(run.scene)
    except ValueError:
        content = None
    named = content.get("name") if isinstance(content, dict) else None
    return str(named or run.path.name)


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "-"


def _with_std(value: float, std: float, digits: int) -> str:
    text = _number(value, digits)
    return f"{text} ± {std:.2g}" if np.isfinite(value) and np.isfinite(std) else text


def _spread(result: PointResult) -> str:
    """How the force moved while it was measured."""
    if not np.isfinite(result.force_rms_n):
        return "-"
    low, high = (_number(1e3 * force, 2) for force in (result.force_min_n, result.force_max_n))
    return f"{_number(1e3 * result.force_rms_n, 2)}, {low} to {high}"


def _outcome(result: PointResult) -> str:
    parts = [result.outcome.name.lower(), result.verdict, result.gate]
    parts += [result.reason, result.tissue_reason, result.notes]
    return "; ".join(part for part in parts if part)
