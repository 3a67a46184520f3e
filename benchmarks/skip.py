# SPDX-License-Identifier: Apache-2.0
"""What a scan takes when it does everything, and when it does what its scene needs; simulated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks import skip_decision, skip_time, skip_touches
from benchmarks.skip_hands import Scanned, scan
from tactile_resonance.configuration import parse_yaml, share_path
from tactile_resonance.report.drawing import SIMULATED, new_figure, save_figure
from tactile_resonance.scan.adaptive import Adaptive, known_points
from tactile_resonance.scan.level_set import LevelSet, difference_m2

Content = Mapping[str, Any]
FINE_M = 0.002
EVERYTHING: Content = {
    "outputs": ["poles", "frf", "distortion", "map"],
    "sensor": {"band_low_hz": 200.0, "band_high_hz": 300.0},
    "precision": None,
    "blocks": {"least": 8, "most": 8},
}
"""All that a scan can do, asked for or not: the whole range, distortion, the most blocks of 0.4 s."""
SEPARATING: Content = {"band_low_hz": 200.0, "band_high_hz": 620.0, "samples_per_period": "auto"}


PREFACE = (
    "`tools/run.sh tactile_resonance benchmark skip`. Everything is simulated, in virtual time: the bench with",
    "its ten modes, noise and converters, a force that is off by 0.15 mN (standard deviation) at each point,",
    "and the functions that the nodes call, from samples to decisions. A touch takes what the last table says.",
)
SCENES = (
    "Exhaustive: the whole range of lines with those that show distortion, eight periods of 0.4 s, a grid, a",
    "tare and the whole way at each point. Planned: what `plan` makes of the scene. Off the truth: rms of f0",
    "over the points; where a boundary is wanted, the area between the true and the stated one.",
)


@dataclass(frozen=True)
class Case:
    """A scene as its plan carries it out, and as it would be without any choice.

    Attributes
    ----------
    planned : mapping
        Content of its file.
    exhaustive : mapping
        What is put in its place; None: left out.
    """

    planned: Content
    exhaustive: Content


def run(output: Path, quick: bool) -> str:
    """Measure, draw ``skip.png`` into `output`, and return the page."""
    whole_s, short_s = (_overhead_s(skip_time.SKIPPINGS[name]) for name in ("nothing", "both"))
    cases = _cases(quick)
    found = {name: _both(case, whole_s, short_s) for name, case in cases.items()}
    save_figure(_draw(found), output / "skip.png")
    page = "\n".join(
        [
            "# What a scene does not need, and what leaving it out saves",
            "",
            *PREFACE,
            "",
            "## Six scenes, and one that needs everything",
            "",
            *SCENES,
            "",
            *_scene_table(found),
            "",
            "![time of both](skip.png)",
            "",
            "## Each kind of skipping alone",
            "",
            "The inclusion. One thing at a time is left out of the exhaustive scan.",
            "",
            *_one_by_one(
                cases["inclusion"], found["inclusion"][1].scene.adaptive, whole_s, short_s
            ),
            "",
            "## Touches for a boundary",
            "",
            "Balls of random size and place under gelatine, poles with a standard deviation of 0.02 Hz.",
            "",
            *skip_touches.table(skip_touches.rows(quick)),
            "",
            "## Vibration for a decision",
            "",
            *skip_decision.decision_lines(quick),
            "",
            "## Time between points",
            "",
            "Contacts in virtual time by the controller of contact_node, blocks of 0.8 s (phase hold).",
            "",
            *skip_time.table(1 if quick else 4),
            "",
        ]
    )
    return page


def _cases(quick: bool) -> dict[str, Case]:
    """The six scenes, by name."""
    dish = [_disc("gelatine 10 %", (0.0, 0.0), gelatine_percent=10.0)]
    side_m, fine_m = 0.02, 2 * FINE_M if quick else FINE_M
    square = {"center_m": [0.0, 0.0], "size_m": [side_m, side_m]}
    on_grid = {"positions": {"grid": {**square, "spacing_m": fine_m}}}
    coarse = {"positions": {"grid": {**square, "spacing_m": 2 * FINE_M}}}

    def adaptive(wanted: Content) -> Content:
        asked = {**square, "spacing_m": 0.001, "smallest_m": 0.006, "start": 9, "most": 80}
        return {"adaptive": {**asked, **wanted}}

    ball = parse_yaml(share_path("config/scenes/inclusion_scan.yaml").read_text(encoding="utf-8"))
    gelatines = parse_yaml(
        share_path("config/scenes/gelatine_phantoms.yaml").read_text(encoding="utf-8")
    )
    two = parse_yaml(share_path("config/scenes/two_gelatines.yaml").read_text(encoding="utf-8"))
    shared = {"force_n": 0.01, "regions": dish, "sensor": SEPARATING}
    precise = {"precision": {"f0_std_hz": 0.02}}
    boundary = {"boundary": {"f0_hz": skip_touches.LEVEL_HZ, "area_m2": 1e-6}}
    slope = {"from": {"gelatine_percent": 10.0}, "to": {"gelatine_percent": 16.0}}
    slope |= {"start_m": [-0.01, 0.0, 0.0], "end_m": [0.01, 0.0, 0.0]}
    return {
        "uniform": Case(
            {**shared, **precise, "positions": adaptive({"map": {"f0_std_hz": 0.05}})},
            {**EVERYTHING, **coarse},
        ),
        "four concentrations": Case({**gelatines, "sensor": SEPARATING}, EVERYTHING),
        "two concentrations, called": Case(two, EVERYTHING),
        "inclusion": Case(
            {
                **shared,
                **precise,
                "buried": ball["buried"],
                "positions": adaptive(boundary),
            },
            {**EVERYTHING, **on_grid},
        ),
        "gradient": Case(
            {
                **shared,
                **precise,
                "regions": [{"name": "slope", "gradient": slope, "disc": dish[0]["disc"]}],
                "positions": adaptive({"map": {"f0_std_hz": 0.2}}),
            },
            {**EVERYTHING, **on_grid},
        ),
        "cortex, white matter, tumour": Case(_brain(), EVERYTHING),
        "nothing to skip": Case(
            {
                "force_n": 0.01,
                "regions": dish,
                "blocks": {"least": 8, "most": 8},
                "outputs": EVERYTHING["outputs"],
                "positions": {"list": [[0.004 * k, 0.0] for k in range(-2, 3)]},
            },
            {},
        ),
    }


def _brain() -> Content:
    """Three tissues side by side; each pole is to be known to 50 mHz."""
    places = {"cortex": (-0.03, 0.0), "white": (0.0, 0.0), "tumour": (0.03, 0.0)}
    offsets = [[0.003 * k, 0.003 * j] for k, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return {
        "force_n": 0.01,
        "regions": [_disc(name, xy, tissue=name) for name, xy in places.items()],
        "sensor": SEPARATING,
        "positions": {
            "around": {"centres_m": [list(xy) for xy in places.values()], "offsets_m": offsets}
        },
        "precision": {"f0_std_hz": 0.05},
    }


def _disc(name: str, xy_m: tuple[float, float], **of: object) -> dict[str, Any]:
    return {
        "name": name,
        **of,
        "disc": {"center_m": list(xy_m), "radius_m": 0.0145 if xy_m[0] else 0.025},
    }


def _with(content: Content, changes: Content) -> Content:
    """Content with changes; None leaves a field out."""
    merged = {**content, **changes}
    return {key: value for key, value in merged.items() if value is not None}


def _both(case: Case, whole_s: float, short_s: float) -> tuple[Scanned, Scanned]:
    planned = _with(case.planned, {})
    exhaustive = _with(case.planned, case.exhaustive)
    needed_s = short_s if case.exhaustive else whole_s
    return scan(exhaustive, 1, whole_s), scan(planned, 1, needed_s)


def _overhead_s(skipping: skip_time.Skipping) -> float:
    """Of a point besides its blocks [s]."""
    times = skip_time.point_times(skipping)
    return float(np.mean(times.total_s[1:])) - skip_time.BLOCKS_S


def _scene_table(found: Mapping[str, tuple[Scanned, Scanned]]) -> list[str]:
    head = (
        "touches | vibration a point [ms] | scan [s] | computing [s] | samples [MB] | off the truth"
    )
    lines = [f"| scene | | {head} |", "|---|---|---:|---:|---:|---:|---:|---|"]
    for name, (exhaustive, planned) in found.items():
        asked = planned.scene.adaptive
        lines.append(f"| {name} | exhaustive | {_cells(exhaustive, asked)} |")
        lines.append(f"| | planned | {_cells(planned, asked)} |")
        ratios = [
            getattr(exhaustive.hands, field) / getattr(planned.hands, field)
            for field in ("touches", "vibration_s", "time_s", "computing_s", "sample_bytes")
        ]
        each = ratios[1] / ratios[0]
        texts = [f"{ratio:.1f} x" for ratio in (ratios[0], each, *ratios[2:])]
        lines.append(f"| | less | {' | '.join(texts)} | |")
    return lines


def _cells(done: Scanned, asked: Adaptive | None) -> str:
    hands = done.hands
    each_ms = 1e3 * hands.vibration_s / hands.touches
    texts = [
        f"{hands.touches}",
        f"{each_ms:.0f}",
        f"{hands.time_s:.1f}",
        f"{hands.computing_s:.2f}",
    ]
    texts += [f"{hands.sample_bytes / 1e6:.1f}", _error(done, asked)]
    return " | ".join(texts)


def _error(done: Scanned, asked: Adaptive | None) -> str:
    """How far off the truth what was wanted is."""
    results = [result for result in done.run.latest if not result.failed]
    missing = len(done.run.latest) - len(results)
    place_m = np.array([result.position_m[:2] for result in results])
    off_hz = np.array([result.f0_hz for result in results]) - done.true_f0_hz(place_m)
    text = f"{1e3 * np.sqrt(np.mean(off_hz**2)):.0f} mHz"
    if asked is not None and isinstance(asked.wanted, LevelSet):
        surface = asked.krige(known_points(results))
        assert surface is not None
        truth = done.true_f0_hz(asked.raster.xy_m)
        wrong_m2 = difference_m2(surface, asked.wanted, asked.raster, truth)
        text += f", {1e6 * wrong_m2:.1f} mm2"
    return text + (f", {missing} points without poles" if missing else "")


def _one_by_one(case: Case, asked: Adaptive | None, whole_s: float, short_s: float) -> list[str]:
    exhaustive = _with(case.planned, case.exhaustive)
    adaptive = case.planned["positions"]
    alone: dict[str, tuple[Content, float]] = {
        "nothing": (exhaustive, whole_s),
        "lines outside of the band, distortion": (_with(exhaustive, {"outputs": None}), whole_s),
        "blocks after the precision": (
            _with(
                exhaustive, {"precision": {"f0_std_hz": 0.02}, "blocks": {"least": 2, "most": 8}}
            ),
            whole_s,
        ),
        "long periods, lines, blocks": (
            _with(case.planned, {"positions": exhaustive["positions"]}),
            whole_s,
        ),
        "touches": (_with(exhaustive, {"positions": adaptive}), whole_s),
        "time between points": (exhaustive, short_s),
        "all": (_with(case.planned, {}), short_s),
    }
    head = (
        "touches | vibration a point [ms] | scan [s] | computing [s] | samples [MB] | off the truth"
    )
    lines = [f"| left out | {head} |", "|---|---:|---:|---:|---:|---:|---|"]
    for name, (content, overhead_s) in alone.items():
        lines.append(f"| {name} | {_cells(scan(content, 1, overhead_s), asked)} |")
    return lines


def _draw(found: Mapping[str, tuple[Scanned, Scanned]]) -> Figure:
    """Vibration of a touch, touches and time of each scan, exhaustive and planned."""
    figure = new_figure(13, 5)
    figure.suptitle(f"what a scan takes ({SIMULATED})")
    panels = {
        "vibration of a touch [ms]": lambda hands: 1e3 * hands.vibration_s / hands.touches,
        "touches": lambda hands: hands.touches,
        "time of the scan [s]": lambda hands: hands.time_s,
    }
    for axes, (label, value) in zip(
        figure.subplots(1, 3, sharey=True), panels.items(), strict=True
    ):
        for k, (name, of) in enumerate(
            zip(("exhaustive", "planned"), zip(*found.values(), strict=True), strict=True)
        ):
            values = [value(each.hands) for each in of]
            bars = axes.barh(np.arange(len(of)) + 0.4 * (k - 0.5), values, 0.38, label=name)
            axes.bar_label(bars, fmt="%.3g", padding=3, fontsize=8)
        axes.set(xlabel=label, xscale="log", xlim=(1, 3e4 if "ms" in label else 3e3))
    figure.axes[0].set_yticks(range(len(found)), list(found))
    figure.axes[0].invert_yaxis()
    figure.axes[2].legend(loc="lower right")
    return figure
