# SPDX-License-Identifier: Apache-2.0
"""Tissue classes from runs: calls, points of other tissues, stated probabilities; simulated."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from scipy import stats

from benchmarks.skip_decision import AGES_S, FORCE_STD_N, PREPARATION_PERCENT
from benchmarks.skip_point import SimulatedPoint
from tactile_resonance._typing import BoolArray, FloatArray
from tactile_resonance.configuration import share_path
from tactile_resonance.frf.measurement import MeasurementFrf
from tactile_resonance.poles.estimator import poles_of_bands
from tactile_resonance.report.drawing import (
    SIMULATED,
    draw_poles,
    draw_reliability,
    draw_steps,
    new_figure,
    save_figure,
)
from tactile_resonance.scan.labels import read_nominal
from tactile_resonance.scan.measurement import excitation_of
from tactile_resonance.scan.plan import make_plan
from tactile_resonance.scan.scene import read_scan_scene
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.sensor.experiments import POSITION_PERCENT
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.tissue.classify import UNKNOWN, TissueClass
from tactile_resonance.tissue.comparison import differences_from_rest, find_clusters
from tactile_resonance.tissue.nominal_contact import ContactLoad, refer_to_nominal
from tactile_resonance.tissue.spread import (
    ReferencePoints,
    smallest_steps,
    spreads_of,
    within_preparation,
)
from tactile_resonance.tissue.trial import Trial, call_points, reliability

SCENE, NOMINAL = "config/scenes/two_gelatines.yaml", "config/scenes/inclusion_scan.yaml"
PERCENT = (10.0, 12.0, 14.0, 16.0)
CLOSE = (10.0, 11.0, 12.0)
"""Concentrations so near that calls of most points are uncertain."""
OUTSIDE = ("cortex", "white", "liver", "tumour")
BEYOND = 18.0
"""A gelatine beyond those of the library."""
CASTINGS, POSITIONS = 12, 2
"""Of each tissue, from which a library is built."""
MAP, MAP_PERCENT = (18, 7), 10.8
"""Points of a map of 10 % gelatine, and of this one [% w/w]."""
LEVELS = (0.002, 0.01, 0.05)
PROCESSES, CHUNK = 2, 24
Kind = str | float


@dataclass(frozen=True)
class Count:
    """How much is measured.

    Attributes
    ----------
    libraries : int
    outside : int
        Points of each tissue that is in no library.
    maps : int
    """

    libraries: int = 40
    outside: int = 200
    maps: int = 20


QUICK = Count(4, 24, 3)


@cache
def _bench() -> tuple[SimulatedBench, object, object, object]:
    """Of this process: bench, tissues, design of a measurement, nominal contact."""
    scene = read_scan_scene(share_path(SCENE))
    design = replace(make_plan(scene).measurement, periods=1)
    return (
        SimulatedBench.from_configuration(),
        read_tissues(),
        design,
        read_nominal(share_path(NOMINAL)),
    )


def block_s() -> float:
    """Of the one block of each point."""
    return _bench()[2].block_s


def measure(task: tuple[Kind, int, int]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pole, covariance for tissue and as measured: of a tissue or concentration, a casting and a position.

    Noise, converters, the sensor's nonlinearity, a contact that creeps, of an age anywhere in a range, and a
    force other than stated.
    """
    of, casting, position = task
    bench, library, design, nominal = _bench()
    key = [round(100 * of) if isinstance(of, float) else int.from_bytes(of.encode(), "big") % 2**32]
    of_casting = np.random.default_rng([*key, casting])
    rng = np.random.default_rng([*key, casting, position + 1])
    if isinstance(of, float):
        percent = of + PREPARATION_PERCENT * of_casting.standard_normal()
        tissue = library.gelatine(percent + POSITION_PERCENT * rng.standard_normal())
    else:
        tissue = library[of]
    age_s, seed = rng.uniform(*AGES_S), int(rng.integers(1 << 31))
    force_n = nominal.force_n + FORCE_STD_N * rng.standard_normal()
    point = SimulatedPoint(bench, tissue, force_n, age_s, seed=seed, distortion=True, creep=True)
    excitation = excitation_of(design, seed)
    poles = poles_of_bands(MeasurementFrf(0).add(point.block(excitation), excitation), design.bands)
    load = ContactLoad(nominal.force_n, FORCE_STD_N, age_s + point.time_s / 2)
    mode = poles.main
    at = refer_to_nominal(mode.estimate, mode.covariance, load, nominal)
    return at.compared, at.covariance, mode.covariance


@dataclass(frozen=True)
class Way:
    """How a library is made of its castings.

    Attributes
    ----------
    castings : int
        Of each tissue.
    pool : bool
        Spreads are those of all tissues together.
    plug_in : bool
        They are taken for known.
    """

    castings: int
    pool: bool = False
    plug_in: bool = False

    def classes(self, points: ReferencePoints) -> list[TissueClass]:
        """Of reference points."""
        spreads = spreads_of(points, self.pool)
        if self.plug_in:
            return [TissueClass(s.name, s.mean, s.covariance) for s in spreads]
        return [spread.as_class() for spread in spreads]


WAYS = {
    "12 castings of each": Way(CASTINGS),
    "12, spreads pooled": Way(CASTINGS, pool=True),
    "12, spreads taken for known": Way(CASTINGS, plug_in=True),
    "4 castings of each": Way(4),
    "4, spreads pooled": Way(4, pool=True),
    "4, spreads taken for known": Way(4, plug_in=True),
}


def name_of(kind: Kind) -> str:
    """Of a tissue."""
    return f"gelatine {kind:g} %" if isinstance(kind, float) else kind


def measured(
    pool: ProcessPoolExecutor, kinds: Sequence[Kind], castings: int, positions: int, first: int = 0
) -> ReferencePoints:
    """Points of castings of several tissues, each at some positions."""
    tasks = [
        (kind, first + casting, position)
        for kind in kinds
        for casting in range(castings)
        for position in range(positions)
    ]
    estimate, covariance, own = map(
        np.array, zip(*pool.map(measure, tasks, chunksize=CHUNK), strict=True)
    )
    tissue = np.array([name_of(kind) for kind, _, _ in tasks])
    casting = np.array([str(k) for _, k, _ in tasks])
    position = np.array([str(k) for _, _, k in tasks])
    return ReferencePoints(
        estimate, covariance, own, np.ones(len(tasks)), tissue, casting, position, casting
    )


def of_group(points: ReferencePoints, group: int, castings: int = CASTINGS) -> ReferencePoints:
    """First castings of the twelve of each tissue that a library is built from."""
    number = points.preparation.astype(int)
    return points.where((number // CASTINGS == group) & (number % CASTINGS < castings))


def tried(points: ReferencePoints, way: Way, without: str = "") -> Trial:
    """Each library calls the castings of the next, of all tissues; `without` one of them in the library."""
    groups = 1 + int(points.preparation.astype(int).max()) // CASTINGS
    trials = []
    for group in range(groups):
        library = of_group(points, group, way.castings)
        classes = way.classes(library.where(library.tissue != without))
        castings = of_group(points, (group + 1) % groups)
        trials.append(call_points(castings, classes, LEVELS[0]))
    return Trial.joined(trials)


def outside(points: ReferencePoints, strange: ReferencePoints) -> Trial:
    """Points of other tissues, each called by the next of all libraries."""
    groups = 1 + int(points.preparation.astype(int).max()) // CASTINGS
    number = np.arange(len(strange.tissue)) % groups
    return Trial.joined(
        [
            call_points(
                strange.where(number == group),
                WAYS["12 castings of each"].classes(of_group(points, group)),
                LEVELS[0],
            )
            for group in range(groups)
        ]
    )


def called(trial: Trial, level: float) -> npt.NDArray[np.str_]:
    """(n,) what each point is called where points beyond this level are unknown."""
    return np.where(trial.tail < level, UNKNOWN, trial.likely)


def share(which: BoolArray) -> str:
    """Part in per cent, with its 95 % limits (Clopper and Pearson); points are independent."""
    result = stats.binomtest(int(which.sum()), len(which))
    limits = result.proportion_ci(0.95)
    return f"{100 * result.statistic:.2f} ({100 * limits.low:.2f} to {100 * limits.high:.2f})"


def run(output: Path, quick: bool) -> str:
    """Measure, draw ``references.png`` into `output`, and return the page."""
    count = QUICK if quick else Count()
    castings = CASTINGS * count.libraries
    with ProcessPoolExecutor(PROCESSES, mp_context=get_context("fork")) as pool:
        points = measured(pool, (*PERCENT, CLOSE[1]), castings, POSITIONS)
        strange = measured(pool, (*OUTSIDE, BEYOND), count.outside, 1)
        maps = (
            [measured(pool, (PERCENT[0],), 1, MAP[0], castings + k) for k in range(count.maps)],
            [measured(pool, (MAP_PERCENT,), 1, MAP[1], castings + k) for k in range(count.maps)],
        )
    close_names = [name_of(kind) for kind in CLOSE]
    close = points.where(np.isin(points.tissue, close_names))
    points = points.where(points.tissue != name_of(CLOSE[1]))
    uncertain = tried(close, WAYS["12 castings of each"])
    bins = reliability(uncertain)
    page = "\n".join(
        [
            "# References from runs: calls, unknown points, probabilities that hold",
            "",
            *PREFACE,
            "",
            *_calls_table(points),
            "",
            "## Tissues that are not in the library",
            "",
            *_outside_table(points, strange),
            "",
            "## Stated probabilities",
            "",
            *_reliability_table(bins),
            "",
            "![poles, reliability, smallest step, rates](references.png)",
            "",
            "## Smallest step",
            "",
            *_step_table(points),
            "",
            "## Maps without references",
            "",
            *_map_lines(maps, *within_preparation([s.sources for s in spreads_of(points)])),
            "",
        ]
    )
    save_figure(_draw(points, strange, bins), output / "references.png")
    return page


PREFACE = (
    "`tools/run.sh tactile_resonance benchmark references`. Everything is simulated and seeded: the bench with",
    "its ten modes, noise, converters, the sensor's nonlinearity, a contact that creeps, a force that is off",
    "by 0.15 mN (standard deviation) from the stated one, ages of contact from 0.3 to 2 s, castings that",
    f"spread by {PREPARATION_PERCENT:g} % w/w and positions by {POSITION_PERCENT:g} % w/w. A point is one",
    "block of 59 ms, from rest, of the plan of `config/scenes/two_gelatines.yaml`, by the functions that the",
    "nodes run.",
    "A library is built by the functions of `references build` from castings of each of 10, 12, 14 and 16 %,",
    "two positions each. It calls the castings of the next library: each casting is called once, and by none",
    "that it is part of. In brackets: 95 % limits, of castings.",
)


def _calls_table(points: ReferencePoints) -> list[str]:
    lines = [
        "## 10, 12, 14 and 16 % gelatine",
        "",
        "| library | unknown below | right [%] | another class [%] | unknown [%] |",
        "|---|---:|---|---|---|",
    ]
    trials = {name: tried(points, way) for name, way in WAYS.items()}
    for name, trial in trials.items():
        first = trial.where(np.arange(len(trial.tissue)) % POSITIONS == 0)
        for level in LEVELS:
            names = called(first, level)
            right, unknown = names == first.tissue, names == UNKNOWN
            cells = (share(right), share(~right & ~unknown), share(unknown))
            lines.append(f"| {name} | {100 * level:g} % | {' | '.join(cells)} |")
    trial = trials["12 castings of each"]
    told = share(trial.called == trial.tissue).partition(" ")[0]
    return [
        *lines,
        "",
        f"The first of each casting's positions counts: {len(trial.tissue) // POSITIONS} points. Of both "
        f"positions, at {100 * LEVELS[0]:g} %, {told} % are called right. Unknown is to be as rare as the "
        "second column states.",
    ]


def _outside_table(points: ReferencePoints, strange: ReferencePoints) -> list[str]:
    lines = [
        "Called `unknown` by libraries of 12 castings [%].",
        "",
        f"| tissue | {' | '.join(f'unknown below {100 * level:g} %' for level in LEVELS)} |",
        "|---|---|---|---|",
    ]
    found = outside(points, strange)
    for name in dict.fromkeys(strange.tissue.tolist()):
        own = found.where(found.tissue == name)
        cells = [share(called(own, level) == UNKNOWN) for level in LEVELS]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    for name in dict.fromkeys(points.tissue.tolist()):
        trial = tried(points, WAYS["12 castings of each"], without=name)
        own = trial.where(trial.tissue == name)
        cells = [share(called(own, level)[::POSITIONS] == UNKNOWN) for level in LEVELS]
        lines.append(f"| {name}, were it not in the library | {' | '.join(cells)} |")
    return lines


def _reliability_table(bins: Sequence) -> list[str]:
    holds = all(each.holds for each in bins)
    return [
        f"Libraries of {', '.join(f'{kind:g}' for kind in CLOSE)} % gelatine, so near that calls are "
        "uncertain. Expected is what a binomial of the stated probability gives, a casting counting once, in "
        f"all bins together with 95 %. {'All are within.' if holds else 'NOT all are within.'}",
        "",
        "| stated [%] | right [%] | expected [%] | points |",
        "|---:|---:|---|---:|",
        *(
            f"| {100 * each.stated:.1f} | {100 * each.right:.1f} | {100 * each.low:.1f} to "
            f"{100 * each.high:.1f} | {each.points} |"
            for each in bins
        ),
    ]


def _step_table(points: ReferencePoints) -> list[str]:
    steps = smallest_steps(spreads_of(points))
    names = list(steps[0].one_block)
    lines = [
        "Step of concentration [% w/w] between two gelatines of which either is taken for the other once in a "
        "hundred, from all castings together: after one block, and without noise in brackets. The paper's "
        "sensor separates 2 %, a surgeon's finger does not (arXiv 1805.00682).",
        "",
        f"| between | {names[0]} | {' | '.join(f'+ {name}' for name in names[1:])} |",
        f"|---|{'---|' * len(names)}",
    ]
    for step in steps:
        cells = (f"{step.one_block[name]:.2f} ({step.limit[name]:.2f})" for name in names)
        lines.append(f"| {step.from_percent:g} and {step.to_percent:g} % | {' | '.join(cells)} |")
    return lines


def _map_lines(
    maps: tuple[list[ReferencePoints], ...], spread: FloatArray, degrees: float
) -> list[str]:
    """What `compare` says of maps of which some points are of another casting."""
    false, found, groups, own = [], [], [], []
    for most, few in zip(*maps, strict=True):
        x, noise = (
            np.concatenate([getattr(each, name) for each in (most, few)])
            for name in ("estimate", "covariance")
        )
        differs = differences_from_rest(x, noise, spread, degrees_of_freedom=degrees).differs
        false.append(differs[: MAP[0]].sum() / max(1, differs.sum()))
        found.append(differs[MAP[0] :].mean())
        groups.append(len(find_clusters(x, noise, spread, degrees_of_freedom=degrees).mean))
        own.append(len(find_clusters(x, noise).mean))
    return [
        f"{len(groups)} maps of {sum(MAP)} points, {MAP[1]} of them of {MAP_PERCENT:g} % gelatine and the "
        "others of 10 %, one casting each, so that some of the two hardly differ. "
        f"{100 * np.mean(found):.0f} % of the {MAP[1]} are said to differ from the rest, and "
        f"{100 * np.mean(false):.1f} % of those that are said to do not (5 % asked for). "
        f"{np.sum(np.array(groups) == 2)} maps are said to have two groups where the spread within a casting "
        f"is that of the library, {np.sum(np.array(own) == 2)} where each group has its own.",
    ]


def _draw(points: ReferencePoints, strange: ReferencePoints, bins: Sequence) -> Figure:
    """Poles, reliability, steps, and right and unknown over the level."""
    figure = new_figure(13, 10)
    (poles, calls), (step, rates) = figure.subplots(2, 2)
    figure.suptitle(f"References of twelve castings ({SIMULATED})")
    draw_poles(poles, points, spreads_of(of_group(points, 0)))
    for k, name in enumerate(dict.fromkeys(strange.tissue.tolist())):
        own = strange.estimate[strange.tissue == name][:100]
        poles.plot(*own.T, "x", ms=3, color=f"C{k + 4}", label=f"{name}, not in it")
    poles.legend(fontsize=7)
    draw_reliability(calls, bins)
    draw_steps(step, smallest_steps(spreads_of(points)))
    levels = np.geomspace(1e-3, 0.2, 12)
    for k, (name, way) in enumerate(WAYS.items()):
        trial = tried(points, way)
        unknown = [np.mean(trial.tail < level) for level in levels]
        rates.plot(levels, unknown, ".-", color=f"C{k}", label=f"known, {name}")
    tail = outside(points, strange).tail
    unknown = [np.mean(tail < level) for level in levels]
    rates.plot(levels, unknown, "k.-", label="tissues not in the library")
    rates.plot(levels, levels, color="0.6", lw=1, label="as stated")
    rates.set(xscale="log", yscale="log", xlabel="unknown_level", ylabel="called unknown")
    rates.set(title="Unknown")
    rates.legend(fontsize=7)
    rates.grid(alpha=0.3)
    return figure
