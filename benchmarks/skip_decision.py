# SPDX-License-Identifier: Apache-2.0
"""Vibration until two tissues are distinguished, errors of that decision, coverage of the ellipses.

All of it on the simulated bench with its ten modes, from rest, block by block until the decision, of the period
that the plan chooses, by the code that frf_node, poles_node and scan_node run: `tools/run.sh python -m
benchmarks.skip_decision` prints the tables.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context

import numpy as np
from scipy import stats

from benchmarks.skip_point import SimulatedPoint, pole_of
from tactile_resonance._typing import FloatArray
from tactile_resonance.configuration import share_path
from tactile_resonance.frf.measurement import MeasurementFrf
from tactile_resonance.poles.estimator import poles_of_bands
from tactile_resonance.scan.decision import (
    BlockLimits,
    Precise,
    Separate,
    Verdict,
    decide,
)
from tactile_resonance.scan.measurement import MeasurementDesign, excitation_of
from tactile_resonance.scan.plan import make_plan
from tactile_resonance.scan.scene import ScanScene, read_scan_scene
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.tissue.library import Tissue, TissueLibrary, read_tissues
from tactile_resonance.tissue.classify import TissueClass
from tactile_resonance.tissue.nominal_contact import (
    ContactLoad,
    NominalContact,
    refer_to_nominal,
)

SCENE = "config/scenes/two_gelatines.yaml"
PERCENT = (10.0, 12.0)
"""Of the classes of the scene, in the order in which it separates them."""
PREPARATION_PERCENT = 0.33
"""Standard deviation between two castings [% w/w]: -30 dB of the response (arXiv 1805.00682)."""
FORCE_STD_N = 1.5e-4
"""Of the force about that which is stated."""
AGES_S = (0.3, 2.0)
"""Of the contact when the first block begins: anywhere between."""
CLOSE_PERCENT = 0.06
"""Between two gelatines [% w/w] that one block seldom distinguishes, for its noise alone."""
STOP_STD_HZ = 0.02
"""Of f0, that ends a measurement for its precision."""
TISSUES = ("gel10", "gel12", "gel14", "gel16", "cortex", "white", "liver", "tumour")
INSIDE = stats.chi2.ppf(0.95, 2)
PROCESSES, CHUNK = 2, 20


@dataclass(frozen=True)
class Count:
    """Points of each kind."""

    one_block: int = 2000
    precise: int = 300
    called: int = 10_000
    close: int = 4000


QUICK = Count(30, 10, 400, 200)


@dataclass(frozen=True)
class Case:
    """How points are measured, and what happens to them beside noise and quantisation.

    Attributes
    ----------
    wanted : Separate, Precise or None
    limits : BlockLimits
    nominal : NominalContact or None
    ages_s : (float, float)
        Of the contact when the first block begins.
    distortion, creep, force : bool
        The sensor's nonlinearity; a contact that grows while it is measured; a force other than stated.
    sweep : bool
        As the plan has it; else random phases.
    """

    wanted: Separate | Precise | None
    limits: BlockLimits
    nominal: NominalContact | None = None
    ages_s: tuple[float, float] = AGES_S
    distortion: bool = False
    creep: bool = False
    force: bool = False
    sweep: bool = True


@dataclass(frozen=True)
class Bench:
    """What all points share."""

    bench: SimulatedBench
    library: TissueLibrary
    scene: ScanScene
    design: MeasurementDesign
    cases: Mapping[str, Case]

    def pole(self, tissue: Tissue, nominal: NominalContact) -> FloatArray:
        """(2,) of the mode on a tissue at the nominal contact."""
        held_s = nominal.age_s
        return pole_of(self.bench.coupled(tissue, force_n=nominal.force_n, hold_time_s=held_s))


@cache
def shared() -> Bench:
    """Of this process."""
    scene, library = read_scan_scene(share_path(SCENE)), read_tissues()
    design, nominal = make_plan(scene).measurement, scene.nominal_contact
    called = Case(scene.precision, design.blocks, nominal)
    cases = {
        "one block": Case(None, BlockLimits(1, 1)),
        "random phases": Case(None, BlockLimits(1, 1), sweep=False),
        "precise": Case(Precise(STOP_STD_HZ), BlockLimits(3, design.blocks.most)),
        "none": called,
        "distortion, creep, force": replace(called, distortion=True, creep=True, force=True),
    }
    made = Bench(SimulatedBench.from_configuration(), library, scene, design, cases)
    means = [made.pole(library.gelatine(percent), nominal) for percent in close_pair()]
    close = (
        TissueClass(name, mean, np.zeros((2, 2))) for name, mean in zip("ab", means, strict=True)
    )
    wanted = Separate(*close, scene.precision.probability)
    cases["close"] = Case(wanted, design.blocks, ages_s=(nominal.age_s, nominal.age_s))
    return made


def close_pair() -> tuple[float, float]:
    """Concentrations of the two gelatines that are nearly the same [% w/w]."""
    return PERCENT[0], PERCENT[0] + CLOSE_PERCENT


def squared(deviation: FloatArray, covariance: FloatArray) -> float:
    """Mahalanobis distance, squared; infinite where there is no pole with a covariance."""
    if not (np.isfinite(deviation).all() and np.isfinite(covariance).all()):
        return float("inf")
    return float(deviation @ np.linalg.solve(covariance, deviation))


@dataclass(frozen=True)
class Outcome:
    """Of one point.

    Attributes
    ----------
    blocks : int
    verdict : Verdict
    called : str
    distance, nominal : float
        Squared Mahalanobis distances: of the measured pole from the true one, and of that at the nominal
        contact, with its covariance for tissue, from the truth there.
    std, error : (2,) float
        Of the measured pole.
    """

    blocks: int
    verdict: Verdict
    called: str
    distance: float
    nominal: float
    std: FloatArray
    error: FloatArray


def measure(tissue: Tissue, case: Case, seed: int) -> Outcome:
    """One point, block by block until it is enough."""
    known, rng, limits = shared(), np.random.default_rng([seed, 1]), case.limits
    scene, design = known.scene, replace(known.design, periods=limits.most, sweep=case.sweep)
    error_n, age_s = FORCE_STD_N * rng.standard_normal() * case.force, rng.uniform(*case.ages_s)
    point = SimulatedPoint(
        known.bench,
        tissue,
        scene.force_n + error_n,
        age_s,
        seed=seed,
        distortion=case.distortion,
        creep=case.creep,
    )
    excitation, frf = excitation_of(design, seed), MeasurementFrf(0)
    while True:
        poles = poles_of_bands(frf.add(point.block(excitation), excitation), design.bands)
        blocks = round(point.time_s / design.block_s)
        pressed = ContactLoad(scene.force_n, FORCE_STD_N, age_s + point.time_s / 2)
        mode, asked = poles.main, (case.nominal, blocks, case.wanted, limits, design.block_s)
        decision = decide(poles, pressed, *asked)
        if decision.stop:
            break
    error, nominal = mode.estimate - point.truth(), float("nan")
    if case.nominal is not None:
        at = refer_to_nominal(mode.estimate, mode.covariance, pressed, case.nominal)
        nominal = squared(at.compared - known.pole(tissue, case.nominal), at.covariance)
    distance = squared(error, mode.covariance)
    called = decision.called
    return Outcome(blocks, decision.verdict, called, distance, nominal, mode.std, error)


def carry_out(task: tuple[str, str | float, int]) -> Outcome:
    """A point of a case on a tissue of the library or on a gelatine about this concentration, with its seed."""
    name, of, seed = task
    known = shared()
    case = known.cases[name]
    if isinstance(of, str):
        return measure(known.library[of], case, seed)
    spread = PREPARATION_PERCENT if case.nominal is not None else 0.0
    casting = of + spread * np.random.default_rng([seed, 2]).standard_normal()
    return measure(known.library.gelatine(casting), case, seed)


def decision_lines(quick: bool) -> list[str]:
    """All tables, as lines of a page."""
    count, known = QUICK if quick else Count(), shared()
    block_s, wanted = known.design.block_s, known.scene.precision
    classes = wanted.first.name, wanted.second.name
    with ProcessPoolExecutor(PROCESSES, mp_context=get_context("fork")) as pool:

        def measured(name: str, of: Sequence[str | float], each: int) -> list[list[Outcome]]:
            """So many points of each tissue, each with a seed of its own."""
            tasks = [(name, one, k * each + n) for k, one in enumerate(of) for n in range(each)]
            done = list(pool.map(carry_out, tasks, chunksize=CHUNK))
            return [done[k * each : (k + 1) * each] for k in range(len(of))]

        one = measured("one block", TISSUES, count.one_block)
        (random,) = measured("random phases", TISSUES[:1], count.one_block)
        precise = measured("precise", TISSUES, count.precise)
        names = "none", "distortion, creep, force"
        called = {name: measured(name, PERCENT, count.called // 2) for name in names}
        close = measured("close", close_pair(), count.close // 2)
    header = [
        "| tissue | blocks, median | f0 off by [mHz] | stated | damping off by | stated | coverage |",
        "|---|---|---|---|---|---|---|",
    ]
    times = "vibration [ms], median | mean | 90 % | 99 % | errors | undecided | of neither |"
    return [
        f"`{SCENE}`: blocks of {1e3 * block_s:.1f} ms, from rest, on the bench's ten modes. Coverage is that "
        "of 95 % ellipses, with its 95 % limits; deviations are standard deviations, stated ones medians.",
        "",
        "### One block",
        "",
        *header,
        *map(_tissue_row, TISSUES, one),
        _tissue_row(f"{TISSUES[0]}, random phases", random),
        "",
        f"### Blocks until the standard deviation of f0 is {1e3 * STOP_STD_HZ:g} mHz",
        "",
        *header,
        *map(_tissue_row, TISSUES, precise),
        "",
        f"### {PERCENT[0]:g} against {PERCENT[1]:g} % gelatine at {100 * wanted.probability:g} %",
        "",
        f"{count.called} castings, half of each, that spread by {PREPARATION_PERCENT:g} % w/w; contacts "
        f"{AGES_S[0]:g} to {AGES_S[1]:g} s old; the force is off by {1e3 * FORCE_STD_N:g} mN where it is. "
        "Errors are calls of the other class. A casting near the middle between the classes stays undecided: "
        "the test gives up where no block more would decide it.",
        "",
        f"| beside noise | {times}",
        "|---|---|---|---|---|---|---|---|",
        *(f"| {name} | {_called(done, classes, block_s)} |" for name, done in called.items()),
        "",
        "When the test stops: the ellipse of the measured pole about the true one, and that for tissue, at "
        "nominal force and age, about the true pole there.",
        "",
        "| beside noise | class | coverage | for tissue |",
        "|---|---|---|---|",
        *(
            f"| {name} | {of} | {_covered(each, 'distance')} | {_covered(each, 'nominal')} |"
            for name, done in called.items()
            for of, each in zip(classes, done, strict=True)
        ),
        "",
        "### Noise alone, several blocks",
        "",
        f"{count.close} points of two gelatines {CLOSE_PERCENT:g} % w/w apart, without spread: what errors the "
        "test makes when its covariance is that of few lines and it stops when it likes.",
        "",
        f"| {times}",
        "|---|---|---|---|---|---|---|",
        f"| {_called(close, ('a', 'b'), block_s)} |",
    ]


def _tissue_row(of: str, done: Sequence[Outcome]) -> str:
    """Precision and coverage of many measurements of one tissue."""
    off, stated = (np.array([getattr(each, name) for each in done]) for name in ("error", "std"))
    found = np.isfinite(off).all(axis=1)
    (f0, damping), (f0_std, damping_std) = off[found].std(axis=0), np.median(stated[found], axis=0)
    blocks = np.median([each.blocks for each in done])
    return (
        f"| {of} | {blocks:g} | {1e3 * f0:.1f} | {1e3 * f0_std:.1f} | {damping:.1e} | {damping_std:.1e} | "
        f"{_covered(done, 'distance')} |"
    )


def _called(done: Sequence[Sequence[Outcome]], names: Sequence[str], block_s: float) -> str:
    """Time and errors of many points of two classes."""
    pairs = [(each, name) for points, name in zip(done, names, strict=True) for each in points]
    time_ms = 1e3 * block_s * np.array([each.blocks for each, _ in pairs])
    wrong = _share([each.called not in ("", name) for each, name in pairs], 5)
    undecided = _share([not each.called for each, _ in pairs], 4)
    neither = _share([each.verdict is Verdict.NEITHER for each, _ in pairs], 5)
    quantiles = (np.median(time_ms), time_ms.mean(), *np.quantile(time_ms, (0.9, 0.99)))
    return " | ".join([*(f"{each:.0f}" for each in quantiles), wrong, undecided, neither])


def _covered(done: Sequence[Outcome], name: str) -> str:
    """Coverage of an ellipse of 95 %."""
    return _share([getattr(each, name) < INSIDE for each in done], 3)


def _share(which: Sequence[bool], digits: int) -> str:
    """How large a part, with its 95 % limits (Clopper and Pearson)."""
    result = stats.binomtest(int(np.sum(which)), len(which))
    limits = result.proportion_ci(0.95)
    return f"{result.statistic:.{digits}f} ({limits.low:.{digits}f} to {limits.high:.{digits}f})"


if __name__ == "__main__":
    import sys

    print("\n".join(decision_lines("--quick" in sys.argv[1:])))
