# SPDX-License-Identifier: Apache-2.0
"""Tables of a run: of its page, as HTML in which every text is escaped, and of the terminal."""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from tactile_resonance.fields import counted
from tactile_resonance.report.point_details import PointTruth, deviation, deviations
from tactile_resonance.scan.point_outcome import time_budget
from tactile_resonance.scan.point_result import RESULTS, PointOutcome, PointResult

MOST_ROWS = 500
"""Of a table in a page; a browser takes seconds for ten thousand, and `results.csv` has all."""
_HEAD = "point  x [mm]  y [mm]  force [mN]  f0 [Hz]   +- std   damping   +- std   tissue                  "
_TRUTH_HEAD = "true f0   dev  true damping   dev"

SURE = ("", "ok", "no covariance")
"""Status of poles that nothing speaks against."""
Truths = Mapping[int, PointTruth]
Columns = Sequence[tuple[str, Callable[[PointResult], str]]]
COLUMNS: Columns = (
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
    ("tissue", lambda r: tissue_of(r)),
    ("repeats", lambda r: f"{r.repeats}: {r.disturbances}" if r.repeats else "-"),
    ("outcome", lambda r: _outcome(r)),
)
AIR_COLUMNS: Columns = (
    ("point", lambda r: f"{r.index + 1}"),
    ("f0 less that in air [Hz]", lambda r: _with_std(r.f0_shift_hz, r.f0_shift_std_hz, 3)),
    ("f0 over that in air", lambda r: _with_std(r.f0_over_air, r.f0_over_air_std, 5)),
    ("damping less that in air", lambda r: _with_std(r.damping_shift, r.damping_shift_std, 5)),
)
_TEXT = {
    "tissue",
    "repeats",
    "outcome",
    "what",
    "planned",
    "came",
    "run",
    "scene",
    "tissue of the other",
}


def paragraphs(lines: Iterable[str]) -> str:
    """One paragraph a text."""
    return "".join(f"<p>{html.escape(line)}</p>" for line in lines)


def warning_list(lines: Sequence[str]) -> str:
    """What stands above all else; that there is nothing, where so."""
    if not lines:
        return '<p class="calm">Nothing to warn of.</p>'
    return f'<div class="warnings"><b>Warnings</b>{bullets(lines)}</div>'


def bullets(lines: Iterable[str]) -> str:
    """A list of texts; nothing without one."""
    items = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
    return items and f"<ul>{items}</ul>"


def _row(kind: str, names: Sequence[str], texts: Sequence[str], css: str = "") -> str:
    cells = ""
    for name, text in zip(names, texts, strict=True):
        side = ' class="text"' if name in _TEXT else ""
        cells += f"<{kind}{side}>{html.escape(text)}</{kind}>"
    return f"<tr{css}>{cells}</tr>"


def table(names: Sequence[str], rows: Sequence[str], all_in: str = "") -> str:
    """Table of columns with these names: the first `MOST_ROWS` rows, and which file has those left out."""
    head, body = _row("th", names, names), "".join(rows[:MOST_ROWS])
    more = len(rows) - MOST_ROWS
    left_out = f"{counted(more, 'further row is', 'further rows are')} left out here"
    whole = f"; {all_in} has all" if all_in else ""
    told = paragraphs([f"{left_out}{whole}."]) if more > 0 else ""
    return (
        f'<div class="wide"><table><thead>{head}</thead><tbody>{body}</tbody></table></div>{told}'
    )


def text_table(names: Sequence[str], rows: Sequence[Sequence[str]], all_in: str = "") -> str:
    """Table of texts, a row each; nothing without one."""
    return table(names, [_row("td", names, row) for row in rows], all_in) if rows else ""


def results_table(columns: Columns, results: Sequence[PointResult]) -> str:
    """One row a result; a click on it shows the point of the page's first run."""
    names, rows = [name for name, _ in columns], []
    for result in results[: MOST_ROWS + 1]:
        css = "" if result.outcome is PointOutcome.DONE else ' class="failed"'
        place = f'{css} data-run="0" data-point="{result.index}"'
        rows.append(_row("td", names, [show(result) for _, show in columns], place))
    rows += [""] * (len(results) - len(rows))
    return table(names, rows, RESULTS)


def truth_columns(truths: Truths) -> Columns:
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


def bands_table(results: Sequence[PointResult]) -> str:
    """Table of the poles in the second and further bands; an empty text where a run has one band only."""
    names = ("point", "band [Hz]", "f0 [Hz]", "damping ratio", "status")
    rows = [
        (
            f"{result.index + 1}",
            f"{band.band_low_hz:g} to {band.band_high_hz:g}",
            _with_std(band.f0_hz, band.f0_std_hz, 3),
            _with_std(band.damping_ratio, band.damping_ratio_std, 5),
            band.poles_status,
        )
        for result in results
        for band in result.further
    ]
    return text_table(names, rows, RESULTS)


def distortion_table(results: Sequence[PointResult]) -> str:
    """Levels at the lines left out, against those excited; in brackets the noise, as far as it is known."""
    sides = ("output, even [dB]", "output, odd [dB]", "input, even [dB]", "input, odd [dB]")

    def level(value_db: float, noise_db: float, above: bool) -> str:
        if np.isnan(value_db):
            return "-"
        if np.isnan(noise_db):
            return f"{_number(value_db, 1)}, noise unknown"
        text = f"{_number(value_db, 1)} ({_number(noise_db, 1)})"
        return text if above else f"{text}, only noise"

    rows = [
        (
            f"{result.index + 1}",
            f"{band.low_hz:g} to {band.high_hz:g}",
            level(band.even_db, band.even_noise_db, band.even_above_noise),
            level(band.odd_db, band.odd_noise_db, band.odd_above_noise),
            _number(band.input_even_db, 1),
            _number(band.input_odd_db, 1),
        )
        for result in results
        for band in result.distortion
    ]
    return text_table(("point", "band [Hz]", *sides), rows, RESULTS)


def time_table(results: Sequence[PointResult]) -> str:
    """Where the time of the points went; nothing where it is unknown, as in runs of earlier versions."""
    budget = time_budget(results)
    whole_s = float(sum(each.sum() for each in budget.values()))
    if not whole_s:
        return ""
    names, rows = ("what", "median [s]", "largest [s]", "all points [s]", "share [%]"), []
    for name, each in {**budget, "all": np.sum(list(budget.values()), axis=0)}.items():
        figures = (np.median(each), each.max(), each.sum())
        texts = (f"{figure:.2f}" for figure in figures)
        rows.append((name, *texts, f"{100 * each.sum() / whole_s:.0f}"))
    return text_table(names, rows)


def touches_table(surface: Mapping[str, Any] | None) -> str:
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
        rows.append((x, y, z, f"{1e3 * residual:+.3f}", f"{1e3 * touch['force_n']:.2f}"))
    told = {
        True: "The touches lie on it as well as their noise allows.",
        False: "The touches lie off it by more than their noise explains.",
        None: "There was no touch to spare to check it.",
    }[surface["consistent"]]
    return paragraphs([f"A {surface['form']}. {told}"]) + text_table(names, rows)


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


def point_table(results: Sequence[PointResult], truths: Truths) -> str:
    """One line per point, with the status of its poles where something speaks against them.

    Deviations from the truth are in standard deviations of the point.
    """
    head = _HEAD + (_TRUTH_HEAD if truths else "")
    lines = [head.rstrip(), "-" * len(head.rstrip())]
    for result in results:
        start = f"{result.index + 1:5d}  {1e3 * result.x_m:6.2f}  {1e3 * result.y_m:6.2f}  "
        if result.outcome is not PointOutcome.DONE:
            lines.append(f"{start}{result.outcome.name.lower()}: {result.reason}")
            continue
        line = (
            f"{start}{1e3 * result.force_n:10.2f}  {result.f0_hz:7.3f}  {result.f0_std_hz:7.2g}  "
            f"{result.damping_ratio:.5f}  {result.damping_ratio_std:7.1g}  {tissue_of(result):<22}"
        )
        truth = truths.get(result.index)
        if truth is not None:
            off = deviation(result, truth)
            line += f"  {truth.estimate[0]:7.3f}  {off[0]:+4.1f}       {truth.estimate[1]:.5f}  {off[1]:+4.1f}"
        if result.poles_status not in SURE:
            line += f"  {result.poles_status}"
        lines.append(line.rstrip())
    return "\n".join(lines)


def table_notes(results: Sequence[PointResult], truths: Truths) -> list[str]:
    """Sentences below the table: how far from the truth, how often points were repeated."""
    notes = []
    off = deviations(results, truths)
    if len(off):
        rms = np.sqrt(np.mean(off**2, axis=0))
        notes.append(
            f"deviation from the simulation's truth, in standard deviations of each point: rms {rms[0]:.2f} "
            f"of f0, {rms[1]:.2f} of the damping ratio; largest {np.max(np.abs(off)):.1f}"
        )
    notes.append(repeats_sentence(results))
    return notes


def repeats_sentence(results: Sequence[PointResult]) -> str:
    """How often points were repeated, and why."""
    points = [r for r in results if r.repeats]
    if not points:
        return "no point had to be repeated"
    why: Counter[str] = Counter()
    for result in points:
        for part in result.disturbances.split(", "):
            kind, _, count = part.rpartition(" ")
            why[kind] += int(count)
    causes = ", ".join(f"{kind} {count}" for kind, count in why.most_common())
    return (
        f"{len(points)} of {len(results)} points had to be repeated, {sum(r.repeats for r in points)} times in "
        f"all: {causes}"
    )


def tissue_of(result: PointResult) -> str:
    """The class that was called, with its probability; a dash where none was."""
    if not result.tissue_class or np.isnan(result.tissue_probability):
        return result.tissue_class or "-"
    return f"{result.tissue_class} ({100 * result.tissue_probability:.1f} %)"
