# SPDX-License-Identifier: Apache-2.0
"""Several runs on one page: maps side by side, and by how much poles differ at places in common."""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats
from scipy.spatial import cKDTree

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import counted
from tactile_resonance.report import run_tables as tables
from tactile_resonance.report.page import HIGH, LOW, MM, listed, page, page_data
from tactile_resonance.report.point_details import MOST_DETAILED, details_of
from tactile_resonance.report.run_map import boundary_of_run
from tactile_resonance.report.run_report import (
    median_std,
    pole_maps_of,
    run_entry,
    scene_name,
    warnings_of,
)
from tactile_resonance.scan.point_result import PointKind, PointResult
from tactile_resonance.scan.pole_map import SAME_PLACE_M
from tactile_resonance.scan.run_content import RunContent
from tactile_resonance.scan.scene import ScanScene, scene_of

SIGNIFICANT = 3.0
"""Standard deviations beyond which a difference is counted."""
_CONDITIONS: dict[str, Callable[[ScanScene], str]] = {
    "sensor": lambda scene: scene.sensor.name,
    "band": lambda scene: f"{scene.sensor.band_low_hz:g} to {scene.sensor.band_high_hz:g} Hz",
    "force": lambda scene: f"{1e3 * scene.force_n:g} mN",
    "nominal contact": lambda scene: _contact_text(scene),
}
"""By which poles of one tissue differ, of a scene."""
_RANGE = 6.0  # of the colours of differences, in standard deviations


@dataclass(frozen=True, eq=False)
class Difference:
    """What two runs found at one place.

    Attributes
    ----------
    first, other : PointResult
    change : (2,) float
        Of f0 [Hz] and damping ratio, other less first.
    covariance : (2, 2) float
        Of the change: the sum of both, as of independent measurements.
    nominal : bool
        Whether both poles are at the nominal contact; else as measured.
    """

    first: PointResult
    other: PointResult
    change: FloatArray
    covariance: FloatArray
    nominal: bool

    @property
    def deviations(self) -> FloatArray:
        """(2,) changes in their standard deviations."""
        return self.change / np.sqrt(np.diag(self.covariance))

    @property
    def distance2(self) -> float:
        """Chi-square of both together, with two degrees of freedom where nothing changed."""
        return float(self.change @ np.linalg.solve(self.covariance, self.change))


def differences(first: RunContent, other: RunContent) -> list[Difference]:
    """At each place of the first run within 0.1 mm of one of the other, in one frame, where both have poles.

    Of several points at one place each is compared once, with one of the other run: differences that share a
    point would not be independent.
    Poles at the nominal contact are compared where both points have them and both scenes mean one force and age
    by it: their covariance holds what force and age of contact add. An error of the sensitivity to these is
    common to both, so it is counted twice.
    """
    one_contact = _nominal(first) == _nominal(other)
    points, others = (
        [r for r in run.latest if not r.failed and r.kind is PointKind.TISSUE]
        for run in (first, other)
    )
    if not points or not others:
        return []
    places_m, others_m = (np.array([r.position_m for r in of]) for of in (points, others))
    near = cKDTree(others_m).query_ball_point(places_m, SAME_PLACE_M)
    candidates = sorted(
        (float(np.linalg.norm(places_m[k] - others_m[j])), k, j)
        for k, found in enumerate(near)
        for j in found
        if points[k].frame_id == others[j].frame_id
    )
    other_of: dict[int, int] = {}
    taken: set[int] = set()
    for _, k, j in candidates:  # the nearest first
        if k not in other_of and j not in taken:
            other_of[k] = j
            taken.add(j)
    pairs = [_difference(points[k], others[j], one_contact) for k, j in sorted(other_of.items())]
    return [pair for pair in pairs if np.all(np.isfinite(pair.covariance))]


def unlike(first: RunContent, other: RunContent) -> list[str]:
    """What sets the poles of two runs apart beside what was touched: sensor, band, force, nominal contact."""
    scenes = scene_of(first.path), scene_of(other.path)
    told = []
    for what, value in _CONDITIONS.items():
        one, two = ("unknown" if scene is None else value(scene) for scene in scenes)
        if one != two:
            told.append(f"{what} {two} against {one}")
    return told


def _contact_text(scene: ScanScene) -> str:
    contact = scene.nominal_contact
    return "none" if contact is None else f"{1e3 * contact.force_n:g} mN and {contact.age_s:g} s"


def _nominal(run: RunContent) -> tuple[float, float] | None:
    """Force [N] and age [s] to which the run's poles are referred."""
    scene = scene_of(run.path)
    contact = None if scene is None else scene.nominal_contact
    return None if contact is None else (contact.force_n, contact.age_s)


def _difference(first: PointResult, other: PointResult, one_contact: bool) -> Difference:
    nominal = one_contact and all(np.isfinite(r.nominal_f0_std_hz) for r in (first, other))
    (x, p), (y, q) = (r.pole("nominal_" if nominal else "") for r in (first, other))
    return Difference(first, other, y - x, p + q, nominal)


def sentence(name: str, first: str, found: Sequence[Difference], apart: Sequence[str] = ()) -> str:
    """What the differences of one run from the first say together; `apart` as `unlike` gives it."""
    if not found:
        return f"{name} and {first} have no place in common (0.1 mm) where both have poles with a covariance."
    own = [each for each in found if each.change.any()]
    if copies := len(found) - len(own):
        same = "hold one measurement to the last digit, a copy or a simulation of one seed: it says nothing"
        told = f"At {counted(copies, 'common place')} {name} and {first} {same}."
        return f"{told} Elsewhere: {sentence(name, first, own, apart)}" if own else told
    off = np.array([each.deviations for each in found])
    rms, largest = np.sqrt(np.mean(off**2, axis=0)), np.max(np.abs(off), axis=0)
    beyond = int(np.count_nonzero(np.any(np.abs(off) > SIGNIFICANT, axis=1)))
    differ = "differs" if beyond == 1 else "differ"
    total = sum(each.distance2 for each in found)
    chance = float(stats.chi2.sf(total, 2 * len(found)))
    nominal = sum(each.nominal for each in found)
    which = {0: "as measured", len(found): "at the nominal contact"}.get(
        nominal, f"at the nominal contact at {nominal} of them, else as measured"
    )
    # the deviations of poles as measured are of noise alone
    included = "" if nominal == len(found) else ", force and age of contact included"
    beside = f" Beside what was touched they differ by {'; '.join(apart)}." if apart else ""
    return (
        f"{name} less {first}, {counted(len(found), 'place')} in common, poles {which}: differences of f0 have "
        f"an rms of {rms[0]:.2f} of their standard deviations, at most {largest[0]:.1f}, those of the damping "
        f"ratio {rms[1]:.2f}, at most {largest[1]:.1f}; {counted(beyond, 'place')} {differ} by more than "
        f"{SIGNIFICANT:g}. Were "
        f"nothing different{included}, chance would give as much or more with probability {chance:.2g}.{beside}"
    )


def as_comparison(runs: Sequence[RunContent]) -> str:
    """HTML of two runs or more beside each other; the first one is what the others are compared with."""
    names, entries, warned = _names(runs), [], []
    details = [details_of(run, MOST_DETAILED // len(runs)) for run in runs]
    detailed = sum(map(len, details))
    for name, run, each in zip(names, runs, details, strict=True):
        boundary = boundary_of_run(run)
        warned += [f"{name}: {line}" for line in warnings_of(run, boundary, each)]
        entries.append(run_entry(run, name, pole_maps_of(run), each, boundary, detailed))
    sentences, figures, below = [], [], f"<h2>Runs</h2>{_runs_table(runs, names)}"
    for name, run in zip(names[1:], runs[1:], strict=True):
        what, found = f"{name} less {names[0]}", differences(runs[0], run)
        sentences.append(sentence(name, names[0], found, unlike(runs[0], run)))
        figures.append(_figure(f"{what}, change of f0", found))
        if found:
            below += f"<h2>{html.escape(what)}</h2>{_differences_table(found)}"
    title = f"Comparison of {', '.join(names)}"
    head = (
        f"<h1>{html.escape(title)}</h1>{tables.warning_list(warned)}{tables.paragraphs(sentences)}"
    )
    data = page_data(entries, figures, "Differences at common places")
    return page(title, head, data, below)


def _names(runs: Sequence[RunContent]) -> list[str]:
    """Of their folders, with a number where two are alike."""
    names = [run.path.resolve().name for run in runs]
    many = Counter(names)
    return [f"{name} ({k + 1})" if many[name] > 1 else name for k, name in enumerate(names)]


def _runs_table(runs: Sequence[RunContent], names: Sequence[str]) -> str:
    columns = (
        "run",
        "scene",
        "begun",
        "points",
        "with poles",
        "f0 [Hz]",
        "std of f0",
        "tissue",
    )
    rows = []
    for run, name in zip(runs, names, strict=True):
        found = [r for r in run.latest if not r.failed]
        f0 = np.array([r.f0_hz for r in found])
        spread = f"{f0.min():.2f} to {f0.max():.2f}" if found else "-"
        std = median_std(found) if found else "-"
        classes = Counter(r.tissue_class for r in found if r.tissue_class)
        called = ", ".join(f"{tissue} {count}" for tissue, count in classes.most_common())
        counts = f"{len(run.latest)} of {len(run.points)}", f"{len(found)}"
        begun = str(run.facts.get("begun", "-"))
        rows.append((name, scene_name(run), begun, *counts, spread, std, called or "-"))
    return tables.text_table(columns, rows)


def _differences_table(found: Sequence[Difference]) -> str:
    columns = (
        "x [mm]",
        "y [mm]",
        "points",
        "change of f0 [Hz]",
        "[std]",
        "change of damping",
        "[std]",
    )
    rows = []
    for each in found:
        std, off = np.sqrt(np.diag(each.covariance)), each.deviations
        rows.append(
            (
                *(f"{1e3 * value:.2f}" for value in (each.first.x_m, each.first.y_m)),
                f"{each.first.index + 1} and {each.other.index + 1}",
                *(f"{each.change[0]:+.3f} ± {std[0]:.2g}", f"{off[0]:+.1f}"),
                *(f"{each.change[1]:+.5f} ± {std[1]:.2g}", f"{off[1]:+.1f}"),
                *(each.first.tissue_class or "-", each.other.tissue_class or "-"),
            )
        )
    return tables.text_table((*columns, "tissue", "tissue of the other"), rows)


def _figure(title: str, found: Sequence[Difference]) -> dict[str, Any]:
    """Places in the colours of the change of f0 in standard deviations."""
    if not found:
        note = "Left out: no place in common where both have poles with a covariance."
        return {"title": title, "note": note, "traces": [], "layout": {}}
    where = MM * np.array([each.first.position_m[:2] for each in found])
    off = [each.deviations[0] for each in found]
    texts = [
        f"{x:+.1f} standard deviations, {e.change[0]:+.3f} Hz"
        for x, e in zip(off, found, strict=True)
    ]
    marker = {
        "color": listed(off, 4),
        "size": 14,
        "cmin": -_RANGE,
        "cmax": _RANGE,
        "colorscale": [[0, LOW], [0.5, "#ffffff"], [1, HIGH]],
        "line": {"color": "black", "width": 1},
        "colorbar": {"title": {"text": "[std]"}, "thickness": 14},
    }
    trace = {
        **{"type": "scatter", "mode": "markers", "marker": marker, "name": ""},
        **{"x": listed(where[:, 0]), "y": listed(where[:, 1]), "text": texts, "hoverinfo": "text"},
    }
    axes = {
        "xaxis": {"title": {"text": "x [mm]"}},
        "yaxis": {"title": {"text": "y [mm]"}, "scaleanchor": "x"},
    }
    note = f"Colours end at {_RANGE:g} standard deviations of the difference."
    if all(each.nominal for each in found):
        note += " What force and age of contact add to both alike is counted twice: an rms below 1 is usual."
    return {"title": title, "note": note, "traces": [trace], "layout": axes}
