# SPDX-License-Identifier: Apache-2.0
"""What it costs and how wrong it is: the figures of all benchmarks that count, on one screen.

Each figure is measured anew, beside the page that treats it. Times are ratios to something known, measured in
the same run. What has become worse than the figures kept beside this page is reported.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np

from benchmarks import frf, poles_methods, skip_decision, stability
from benchmarks.poles_methods import BARE, Method, estimates_of, joint_plan
from benchmarks.poles_plant import Plant, judge
from benchmarks.stability_cells import cells
from tactile_resonance._typing import FloatArray
from tactile_resonance.commands.benchmark import NAMES
from tactile_resonance.frf.spectra import Spectrum, transient_free_spectra
from tactile_resonance.poles.joint import JointPlan
from tactile_resonance.poles.structure import ModelStructure
from tactile_resonance.report.drawing import new_figure, save_figure

KEPT = Path("docs/benchmarks/overview.json")
WORSE = {"time": 1.5, "error": 1.15, "count": 1.0}
"""A figure is reported from so many times the kept one on."""
SLOWER = 2.0
"""So many times more of a time in few repetitions, on whatever machine."""
CLEARLY = 0.05
"""Errors of few runs that differ by less are alike."""
CALLED, ROUNDS, COVERED = 400, 7, 4000


@dataclass(frozen=True)
class Value:
    """One figure.

    Attributes
    ----------
    name : str
    value : float
        The smaller the better.
    text : str
        How it is printed.
    kind : {"time", "error", "count"}
    page : str
        Name of the benchmark that treats it.
    """

    name: str
    value: float
    text: str
    kind: str
    page: str


@dataclass(frozen=True)
class Scaling:
    """Time of one call against one size, and the slope of its logarithms."""

    name: str
    size: FloatArray
    time_s: FloatArray

    @property
    def slope(self) -> float:
        """Of the upper half of the sizes, where what a call costs anyway does not count."""
        half = slice(self.size.size // 2 - 1, None)
        return float(np.polyfit(np.log(self.size[half]), np.log(self.time_s[half]), 1)[0])


def run(output: Path, quick: bool) -> str:
    """Measure, write ``overview.json`` and ``overview.png`` into `output`; return the page.

    Raises
    ------
    ValueError
        Where the figures kept cannot be read.
    """
    methods = poles_methods.compare_methods(quick)
    values = [*_frf_values(quick), *_pole_values(methods), *_coverage(), *_decision(), *_stability()]
    scalings = _scalings(2 if quick else ROUNDS)
    worse = _worse(values)
    pages = [name for name in NAMES if (output / f"{name}.md").exists()]
    text = _page(values, methods, scalings, worse, pages)
    kept = {of.name: round(of.value, 6) for of in values}
    (output / "overview.json").write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    _draw(methods, scalings, output / "overview.png")
    return text


def guard() -> tuple[str, bool]:
    """`compared` with what follows from seeds alone, and with times in few repetitions; nothing is written."""
    return compared([*_frf_values(quick=True), *_coverage(), *_stability()])


def compared(values: Sequence[Value]) -> tuple[str, bool]:
    """Values beside those kept, as text, and whether none is worse; times, which the machine makes, never are.

    Raises
    ------
    ValueError
        Where the figures kept cannot be read.
    """
    worse = [of.name for of in values if of.kind != "time" and _worse([of])]
    lines = [f"{'worse: ' if of.name in worse else ''}{of.name}: {of.text}" for of in values]
    lines += [f"slower: {text}" for of in values if of.kind == "time" for text in _worse([of], SLOWER)]
    return "\n".join(lines), not worse


def _frf_values(quick: bool) -> list[Value]:
    timing = frf.measure_timing(5 if quick else 30)
    accuracy = frf.measure_accuracy(0.02, 40.0, runs=4)["fast, order 2"]
    found = []
    for name in ("whole FRF with covariance", "live, 8th block: FRF, bins of 200-300 Hz, faults"):
        ratio = float(np.median(timing[name][1]))
        found.append(Value(f"{name}, over the bare FFT of its record", ratio, f"{ratio:.2f}", "time", "frf"))
    error = accuracy[0]
    name = "FRF: mean square error over the least possible, 200-300 Hz"
    return [*found, Value(name, error, f"{error:.2f}", "error", "frf")]


def _pole_values(methods: Sequence[Method]) -> list[Value]:
    of = {method.name: method for method in methods}
    fft = methods[0].time_s
    single, batched = (of[f"joint, 2nd order, {how}"] for how in ("single", "batched"))
    scipy_s = of["scipy least_squares, same cost as joint"].time_s
    error = float(np.max(single.error))
    ratio = single.time_s / fft
    return [
        Value("one joint fit of poles and transient, over the FFT of its record", ratio, f"{ratio:.2f}",
              "time", "poles"),
        Value("a joint fit in a batch, over scipy's least_squares on the same cost",
              batched.time_s / scipy_s, f"1/{scipy_s / batched.time_s:.0f}", "time", "poles"),
        Value("poles: error over the Cramer-Rao bound, larger of f0 and damping", error, f"{error:.2f}",
              "error", "poles"),
    ]  # fmt: skip


def _coverage() -> list[Value]:
    """How far the coverage of the 95 % ellipse is off, over damping and noise."""
    worst = 0.0
    for damping_ratio, snr_db in ((0.02, 40.0), (0.005, 20.0), (0.05, 60.0)):
        plant = Plant(damping_ratio, snr_db, 2)
        u, y = plant.noisy(np.random.default_rng(3), COVERED, plant.bins())
        fits = joint_plan(plant, BARE).from_bins(u, y)
        errors = estimates_of(fits) - [250.0, damping_ratio]
        worst = max(worst, abs(judge(errors, fits.covariance[:, 0], plant.bound())[1] - 0.95))
    name = f"95 % ellipses of poles: coverage off by at most ({COVERED} runs of 3 cases)"
    return [Value(name, worst, f"{100 * worst:.1f} %", "error", "poles")]


def _decision() -> list[Value]:
    known = skip_decision.shared()
    wanted = known.scene.precision
    classes = dict(zip(skip_decision.PERCENT, (wanted.first.name, wanted.second.name), strict=True))
    case = "distortion, creep, force"
    done = [
        (name, skip_decision.carry_out((case, percent, seed)))
        for percent, name in classes.items()
        for seed in range(CALLED // 2)
    ]
    median_s = float(np.median([of.blocks for _, of in done])) * known.design.block_s
    wrong = sum(of.called in classes.values() and of.called != name for name, of in done)
    return [
        Value("10 from 12 % gelatine at 99 %: vibration, median", median_s, f"{1e3 * median_s:.0f} ms",
              "error", "skip"),
        Value(f"wrong decisions, of {CALLED}", wrong, str(wrong), "count", "skip"),
    ]  # fmt: skip


def _stability() -> list[Value]:
    rng = np.random.default_rng(1)
    every = cells(stability.QUICK_ORDER)
    done = [stability.outcome(cell, rng, stability.QUICK_RUNS) for cell in every]
    silent = sum(of.silent > 0 for of in done)
    name = f"cells at the edge of double precision that are wrong without a status, of {len(every)}"
    return [Value(name, silent, str(silent), "count", "stability")]


def _scalings(rounds: int) -> list[Scaling]:
    """Of whole FRFs and joint fits, in samples, lines, points and modes."""
    rng = np.random.default_rng(0)

    def spectrum(samples: int, lines: int) -> Callable[[], object]:
        harmonics = np.arange(4, 4 + lines)
        u, y = rng.standard_normal((2, 4, samples))
        return lambda: transient_free_spectra(Spectrum.of(u, y), harmonics)

    plant = Plant(0.02, 40.0, 2)
    u, y = plant.noisy(rng, 8192, plant.bins())

    def points(count: int) -> Callable[[], object]:
        plan = joint_plan(plant, BARE)
        return lambda: plan.from_bins(u[:count], y[:count])

    def modes(count: int) -> Callable[[], object]:
        harmonics = np.arange(40, 200)
        plan = JointPlan(5e3, 2000, 4, harmonics, (100.0, 499.0), ModelStructure(2 * count, 2 * count))
        s = 2j * np.pi * plan.frequency_hz
        g = np.full(s.size, 0.1 + 0j)
        for f0_hz in np.linspace(150, 450, count):
            w0 = 2 * np.pi * f0_hz
            g += 0.04 * w0**2 / (s**2 + 0.04 * w0 * s + w0**2)
        u = np.where(plan.driven, np.exp(2j * np.pi * rng.random(s.size)), 0)
        noise = 1e-3 * rng.standard_normal((s.size, 2)).view(complex)[:, 0]
        return lambda: plan.from_bins(u, g * u + noise)

    calls = {
        "FRF: samples of a period": {n: spectrum(n, 400) for n in 2 ** np.arange(11, 19)},
        "FRF: excited lines": {n: spectrum(2**16, n) for n in 2 ** np.arange(7, 15)},
        "joint fits: points": {n: points(n) for n in 2 ** np.arange(4, 14)},
        "joint fit: modes of the model": {n: modes(n) for n in (1, 2, 3, 4, 6, 8)},
    }
    return [
        Scaling(name, np.array(list(of), float), np.array([_least_s(call, rounds) for call in of.values()]))
        for name, of in calls.items()
    ]


def _least_s(call: Callable[[], object], rounds: int) -> float:
    """Least processor time of several calls, after a first one [s]."""
    call()
    times = []
    for _ in range(rounds):
        begun_s = time.process_time()
        call()
        times.append(time.process_time() - begun_s)
    return max(min(times), 1e-9)


def _worse(values: Sequence[Value], slack: float = 1.0) -> list[str]:
    """What has become worse than the figures kept, by `slack` times more than is accepted of its kind."""
    if not KEPT.exists():
        return []
    try:
        kept = json.loads(KEPT.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{KEPT}: {error}; delete it to begin anew") from error
    return [
        f"{of.name}: {of.value:.3g}, {kept[of.name]:.3g} before"
        for of in values
        if of.name in kept and of.value > slack * WORSE[of.kind] * kept[of.name]
    ]


def _front(methods: Sequence[Method]) -> list[Method]:
    """Methods that no other one beats in time and error, fastest first."""
    rated = sorted(
        (m for m in methods if np.isfinite(m.error).all()), key=lambda m: (m.time_s, m.error.max())
    )
    front: list[Method] = []
    for method in rated:
        if not front or method.error.max() < (1 - CLEARLY) * front[-1].error.max():
            front.append(method)
    return front


def _page(
    values: Sequence[Value],
    methods: Sequence[Method],
    scalings: Sequence[Scaling],
    worse: Sequence[str],
    pages: Sequence[str],
) -> str:
    fft_s = methods[0].time_s
    page = "| {} | {} | [`benchmark {page}`]({page}.md) |"
    return "\n".join([
        "# Benchmarks",
        "",
        "`make bench`; this page alone: `tools/run.sh tactile_resonance benchmark overview`. Simulated.",
        "Times are processor times over that of something known in the same run.",
        "",
        "| | | more |",
        "|---|---:|---|",
        *(page.format(of.name, of.text, page=of.page) for of in values),
        "",
        *(["Worse than the figures kept:", "", *(f"- {text}" for text in worse), ""] if worse else []),
        "## Run time against error",
        "",
        "One mode of 2 % damping, 40 dB, 8 periods; error: the larger of those of f0 and damping ratio over",
        f"the Cramer-Rao bound. Methods that no other one beats in both, by {100 * CLEARLY:g} % or more:",
        "",
        "| method | time per point over the FFT of its record | error |",
        "|---|---:|---:|",
        *(f"| {m.name} | {m.time_s / fft_s:.3g} | {m.error.max():.2f} |" for m in _front(methods)),
        "",
        f"Behind them, of {len(methods) - 1}: "
        + "; ".join(
            f"{m.name} {m.time_s / fft_s:.2g}, {m.error.max():.3g}"
            for m in methods[1:]
            if m not in _front(methods) and np.isfinite(m.time_s)
        )
        + ".",
        "",
        "![Run time against error, and scaling](overview.png)",
        "",
        "Slopes of the logarithms of time and size, over the larger half of the sizes: "
        + ", ".join(f"{of.name} {of.slope:.2f}" for of in scalings)
        + ".",
        "",
        "## Pages",
        "",
        *(f"- [{name}]({name}.md): {_about(name)}" for name in pages),
        "",
    ])  # fmt: skip


def _about(name: str) -> str:
    """First sentence of a benchmark's own description."""
    text = import_module(f"benchmarks.{name}").__doc__ or ""
    return text.split("\n\n")[0].replace("\n", " ").strip().rstrip(".")


def _draw(methods: Sequence[Method], scalings: Sequence[Scaling], path: Path) -> None:
    figure = new_figure(12, 4.8)
    left, right = figure.subplots(1, 2)
    fft_s, front = methods[0].time_s, _front(methods)
    rated = [method for method in methods[1:] if np.isfinite(method.error).all()]
    for number, method in enumerate(rated, start=1):
        at = method.time_s / fft_s, float(method.error.max())
        colour = "tab:blue" if method in front else "tab:grey"
        left.plot(*at, "o", color=colour, markersize=4, label=f"{number} {method.name}")
        left.annotate(str(number), at, fontsize=7, xytext=(3, 3), textcoords="offset points")
    left.plot(
        [m.time_s / fft_s for m in front], [m.error.max() for m in front], drawstyle="steps-post"
    )
    left.set(xscale="log", yscale="log", title="Poles: run time against error, simulated")
    left.set_xlabel("time per point over the FFT of its record")
    left.set_ylabel("error over the Cramer-Rao bound")
    left.set_ylim(top=100 * max(of.error.max() for of in rated))  # the legend hides none
    left.legend(fontsize=5.5, loc="upper center", ncols=2, handlelength=0)
    for of in scalings:
        right.plot(of.size, 1e3 * of.time_s, "o-", markersize=3, label=f"{of.name}, slope {of.slope:.2f}")
    right.set(xscale="log", yscale="log", title="Scaling", xlabel="size", ylabel="processor time [ms]")
    right.legend(fontsize=7)
    save_figure(figure, path)
