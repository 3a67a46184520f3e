# SPDX-License-Identifier: Apache-2.0
"""A run as one page that needs nothing else, and as a table."""

from __future__ import annotations

import base64
import html
from collections import Counter
from collections.abc import Sequence

import numpy as np
import yaml

from tactile_resonance.report.drawing import SIMULATED
from tactile_resonance.scan.point_result import Outcome, PointResult
from tactile_resonance.scan.pole_map import PoleMap, point_of_result
from tactile_resonance.scan.run_content import RunContent

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 76rem;
  padding: 0 1rem; color: #222 }
img { max-width: 100% } table { border-collapse: collapse; font-size: 13px }
td, th { border-bottom: 1px solid #ddd; padding: .2rem .6rem; text-align: right }
td.text, th.text { text-align: left } tr.failed td { color: #b00 } .mark { color: #b00; font-weight: 600 }
pre { background: #f5f5f5; padding: .8rem; overflow-x: auto; font-size: 12px }
"""
_COLUMNS = (
    ("point", lambda r: f"{r.index + 1}" + (f" (attempt {r.attempt + 1})" if r.attempt else "")),
    ("x [mm]", lambda r: _number(1e3 * r.x_m, 2)),
    ("y [mm]", lambda r: _number(1e3 * r.y_m, 2)),
    ("z [mm]", lambda r: _number(1e3 * r.z_m, 2)),
    ("force [mN]", lambda r: _with_std(1e3 * r.force_n, 1e3 * r.force_std_n, 2)),
    ("f0 [Hz]", lambda r: _with_std(r.f0_hz, r.f0_std_hz, 3)),
    ("damping ratio", lambda r: _with_std(r.damping_ratio, r.damping_ratio_std, 5)),
    ("blocks", lambda r: f"{r.blocks}" + (f" ({r.blocks_saved} saved)" if r.blocks_saved else "")),
    ("tissue", lambda r: _tissue(r)),
    ("outcome", lambda r: _outcome(r)),
)
_TEXT = {"tissue", "outcome"}


def pole_map_of(run: RunContent) -> PoleMap:
    """Map of the latest attempt at every finished point; those skipped are not on it."""
    pole_map = PoleMap()
    for result in run.latest:
        if result.outcome is not Outcome.SKIPPED:
            pole_map = pole_map.with_point(point_of_result(result))
    return pole_map


def as_page(run: RunContent, picture: bytes | None) -> str:
    """HTML with the picture (PNG) in it; nothing is fetched from elsewhere."""
    name = _scene_name(run)
    parts = [f"<h1>{html.escape(name)}</h1>"]
    if any(result.simulated for result in run.latest):
        parts.append(f'<p class="mark">{SIMULATED}</p>')
    parts += [f"<p>{html.escape(line)}</p>" for line in summary(run)]
    if picture is not None:
        data = base64.b64encode(picture).decode()
        parts.append(f'<img alt="pole map" src="data:image/png;base64,{data}">')
    parts += ["<h2>Points</h2>", _table(run.latest)]
    skipped = run.facts.get("skipped", [])
    if skipped:
        parts += ["<h2>Left out</h2><ul>"]
        parts += [f"<li>{html.escape(line)}</li>" for line in skipped_lines(run)]
        parts += ["</ul>"]
    if run.problems:
        parts += ["<h2>Damaged files</h2><ul>"]
        parts += [f"<li>{html.escape(problem)}</li>" for problem in run.problems]
        parts += ["</ul>"]
    parts += ["<h2>Scene</h2>", f"<pre>{html.escape(run.scene)}</pre>"]
    facts = yaml.safe_dump({k: v for k, v in run.facts.items() if k != "skipped"}, sort_keys=False)
    parts += ["<h2>Made with</h2>", f"<pre>{html.escape(facts)}</pre>"]
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(name)}</title>'
        f"<style>{_STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )


def summary(run: RunContent) -> list[str]:
    """Sentences: how far it has come, what was found, what ending early saved."""
    done = Counter(result.outcome for result in run.latest)
    lines = [
        f"{len(run.latest)} of {len(run.points)} points finished: {done[Outcome.DONE]} with poles, "
        f"{done[Outcome.FAILED]} failed, {done[Outcome.SKIPPED]} skipped."
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
    classes = Counter(r.tissue_class for r in run.latest if r.tissue_class)
    if classes:
        named = ", ".join(f"{name} {count}" for name, count in sorted(classes.items()))
        lines.append(f"Tissue called: {named}.")
    return lines


def skipped_lines(run: RunContent) -> list[str]:
    """What the plan left out, why, and what that saved."""
    lines = []
    for entry in run.facts.get("skipped", []):
        saved_s = entry.get("saved_s", 0.0)
        saved = f"; saves up to {saved_s:.0f} s" if saved_s else ""
        lines.append(f"{entry['what']}: {entry['why']}{saved}")
    return lines


def _table(results: Sequence[PointResult]) -> str:
    def cell(kind: str, name: str, text: str) -> str:
        css = ' class="text"' if name in _TEXT else ""
        return f"<{kind}{css}>{html.escape(text)}</{kind}>"

    rows = ["<tr>" + "".join(cell("th", name, name) for name, _ in _COLUMNS) + "</tr>"]
    for result in results:
        css = "" if result.outcome is Outcome.DONE else ' class="failed"'
        rows.append(
            f"<tr{css}>" + "".join(cell("td", n, show(result)) for n, show in _COLUMNS) + "</tr>"
        )
    return f"<table>{''.join(rows)}</table>"


def _scene_name(run: RunContent) -> str:
    try:
        content = yaml.safe_load(run.scene)
    except yaml.YAMLError:
        content = None
    named = content.get("name") if isinstance(content, dict) else None
    return str(named or run.path.name)


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "-"


def _with_std(value: float, std: float, digits: int) -> str:
    text = _number(value, digits)
    return f"{text} ± {std:.2g}" if np.isfinite(value) and np.isfinite(std) else text


def _tissue(result: PointResult) -> str:
    if not result.tissue_class or np.isnan(result.tissue_probability):
        return result.tissue_class or "-"
    return f"{result.tissue_class} ({100 * result.tissue_probability:.1f} %)"


def _outcome(result: PointResult) -> str:
    parts = [result.outcome.name.lower(), result.verdict, result.reason, result.notes]
    return "; ".join(part for part in parts if part)
