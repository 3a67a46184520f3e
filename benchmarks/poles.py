# SPDX-License-Identifier: Apache-2.0
"""Poles: run time against error, and the Monte Carlo grid against the Cramer-Rao bound.

``run(output, quick)`` writes ``poles.md`` and ``poles.png`` into `output` and returns the text.
Everything is simulated on the plant of `poles_plant.py`; times are those of one thread of the
machine it runs on, to be read as ratios to the Fourier transform of the same record.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy import stats

from benchmarks.poles_bias import tissue_bias
from benchmarks.poles_methods import (
    BARE,
    BATCH,
    Method,
    compare_methods,
    estimates_of,
    joint_plan,
    local_polynomial_spectra,
)
from benchmarks.poles_plant import BAND_HZ, Plant, judge
from benchmarks.poles_realisations import grid_table
from benchmarks.poles_reidentify import reidentify_table
from tactile_resonance._typing import FloatArray
from tactile_resonance.poles.identify import identify_spectra
from tactile_resonance.poles.result import PolesBatch, PolesStatus
from tactile_resonance.poles.structure import ModelStructure

DAMPING = (0.005, 0.01, 0.02, 0.05, 0.1)
SNR_DB = (10.0, 20.0, 40.0, 60.0, 80.0)
PERIODS = (1, 2, 8)
CHUNK = 1000
# Outside the band the local polynomial method needs neighbours.
MARGIN_HZ = 30.0


PARTS = ("methods", "bias", "grid", "realisations", "reidentify")


def run(output: Path, quick: bool, part: str | None = None) -> str:
    """Draw the figure; return the page.

    Parameters
    ----------
    output : Path
        Folder of the figure, and of the page before.
    quick : bool
        A thinned Monte Carlo: 500 runs a cell instead of 20 000, of realisations instead of 3000.
    part : {"methods", "bias", "grid", "realisations", "reidentify"}, optional
        Renew this table alone, the others stay as they are in `output`. All when absent.
    """
    page = output / "poles.md"
    sections = [_heading(quick), *([] for _ in PARTS)]
    if part is not None:
        there = _sections(page.read_text(encoding="utf-8"))
        sections[1 : len(there)] = there[1:]
    for k, name in enumerate(PARTS, 1):
        if part in (None, name):
            sections[k] = _measured(name, output, quick)
    text = "\n".join(line for section in sections for line in section) + "\n"
    return text


def _measured(part: str, output: Path, quick: bool) -> list[str]:
    """A part's lines."""
    if part == "methods":
        methods = compare_methods(quick)
        _figure(methods, output / "poles.png")
        return _method_table(methods)
    if part == "bias":
        return _bias_table()
    if part == "realisations":
        return grid_table(500 if quick else 3000)
    if part == "reidentify":
        return reidentify_table(20_000) if quick else reidentify_table()
    runs = 500 if quick else 20000
    cells = [
        measure_cell(Plant(zeta, snr, periods), runs)
        for periods in PERIODS
        for zeta in DAMPING
        for snr in SNR_DB
    ]
    return _grid_table(cells, runs)


def _sections(text: str) -> list[list[str]]:
    """Lines of a page by its headings of second order."""
    sections: list[list[str]] = [[]]
    for line in text.splitlines():
        if line.startswith("## "):
            sections.append([])
        sections[-1].append(line)
    return sections


@dataclasses.dataclass(frozen=True)
class Cell:
    """A cell of the Monte Carlo grid: MSE over bound, coverage, failures; NaN where no ELiS is.

    Alarms are fits that claim a model error where there is none.
    """

    plant: Plant
    ratio: FloatArray
    coverage: float
    failed: int
    alarms: int
    elis_ratio: FloatArray
    elis_coverage: float
    bound: FloatArray
    settled_bound: FloatArray


def measure_cell(plant: Plant, runs: int) -> Cell:
    """Monte Carlo of one cell, seeded by the cell."""
    seed = [int(1e4 * plant.damping_ratio), int(plant.snr_db), plant.periods]
    rng = np.random.default_rng(seed)
    wide = plant.bins(BAND_HZ[0] - MARGIN_HZ, BAND_HZ[1] + MARGIN_HZ)
    inside = np.isin(wide, plant.bins())
    plan = joint_plan(plant)
    collected: dict[str, list] = {"joint": [], "elis": []}
    alarms = 0
    for _ in range(-(-runs // CHUNK)):
        u, y = plant.noisy(rng, min(runs, CHUNK), wide)
        result = plan.from_bins(u[:, inside], y[:, inside])
        collected["joint"].append(_errors(result, plant))
        alarms += int(result.has_status(PolesStatus.MODEL_ERROR).sum())
        if plant.periods > 1:
            spectra = local_polynomial_spectra(plant, u, y, wide)
            collected["elis"].append(
                _errors(identify_spectra(*spectra, structure=BARE, pooled=False), plant)
            )
    bound = plant.bound()
    ratio, coverage, failed = _judged(collected["joint"], bound)
    elis_ratio, elis_coverage = np.full(2, np.nan), float("nan")
    if collected["elis"]:
        elis_ratio, elis_coverage, _ = _judged(collected["elis"], bound)
    settled = plant.bound(False)
    return Cell(plant, ratio, coverage, failed, alarms, elis_ratio, elis_coverage, bound, settled)


def _errors(result: PolesBatch, plant: Plant) -> tuple[npt.NDArray, npt.NDArray]:
    truth = np.array([250.0, plant.damping_ratio])
    return estimates_of(result) - truth, result.covariance[:, 0]


def _judged(parts: list, bound: npt.NDArray) -> tuple[npt.NDArray, float, int]:
    errors, covariance = (np.concatenate(p) for p in zip(*parts, strict=False))
    good = np.isfinite(errors).all(axis=-1) & np.isfinite(covariance).all(axis=(-2, -1))
    ratio, coverage = judge(errors[good], covariance[good], bound)
    return ratio, coverage, int(np.sum(~good))


def _heading(quick: bool) -> list[str]:
    thinned = " Thinned: not the full number of runs." if quick else ""
    return [
        "# Poles: run time against error",
        "",
        "Simulated: one mode at 250 Hz on a feed-through, random-phase multisine 10 Hz - 10 kHz "
        "from rest, white noise, input noise 20 dB lower. Band 200-300 Hz. Errors are root mean "
        "squares over the standard deviation of the Cramer-Rao bound with unknown initial state "
        "and noise level." + thinned,
        "",
    ]


def _method_table(methods: list[Method]) -> list[str]:
    transform = methods[0].time_s
    rows = [
        "## Damping 2 %, 40 dB, 8 periods",
        "",
        "Least processor time of fifteen rounds in which all methods take turns: what else the "
        "machine does slows all of them, the short single fits most.",
        "",
        "| Method | time per point | over the Fourier transform | points per second | error f0 "
        "| error damping | |",
        "|---|---|---|---|---|---|---|",
    ]
    for m in methods:
        if not np.isfinite(m.time_s):
            rows.append(f"| {m.name} | | | | | | {m.note} |")
            continue
        errors = ["" if np.isnan(e) else f"{e:.2f}" for e in m.error]
        rows.append(
            f"| {m.name} | {1e6 * m.time_s:.3g} us | {m.time_s / transform:.3g} "
            f"| {1 / m.time_s:.3g} | {errors[0]} | {errors[1]} | {m.note} |"
        )
    return [*rows, "", *_against_scipy(methods), ""]


def _against_scipy(methods: list[Method]) -> list[str]:
    """Ours over scipy's least squares on the same cost, and what takes part of it."""
    time_s = {m.name: m.time_s for m in methods}
    figures = []
    for cost in ("FRF", "joint"):
        theirs = time_s[f"scipy least_squares, same cost as {cost}"]
        names = [n for n in time_s if n.startswith(cost) and n.endswith("2nd order, batched")]
        figures += [
            f"{name} {theirs / time_s[name]:.0f}" for name in names if np.isfinite(time_s[name])
        ]
    single = time_s["joint, 2nd order, single"] / methods[0].time_s
    return [
        "Times as fast as scipy.optimize.least_squares on the same cost, in batches of "
        f"{BATCH} points: {'; '.join(figures)}. Points a second on one core, in thousands: joint "
        f"{1e-3 / time_s['joint, 2nd order, batched']:.0f} (goal: 100), FRF "
        f"{1e-3 / time_s['FRF, 2nd order, batched']:.0f} (goal: 200). Single joint fit: {single:.2f} of the "
        "Fourier transform of its record (goal: 0.2)."
    ]


def _bias_table() -> list[str]:
    rows = [
        "## Bias by modes outside the band",
        "",
        "Noise-free records of the simulated bimorph on the tissues of the library, 8 periods from "
        "rest at 1 V rms: error over the standard deviation that the simulated bench's noise gives "
        "(f0, damping). The 2nd-order model is the bare one; residual terms stand for the modes "
        "near 100 and 704 Hz.",
        "",
        "| tissue | 2nd order | mode + 4 residual terms | mode + 6 | mode + 8 |",
        "|---|---|---|---|---|",
    ]
    structures = [BARE, *(ModelStructure.with_residual(2, terms) for terms in (4, 6, 8))]
    for name, biases in tissue_bias(structures).items():
        cells = " | ".join(f"{b[0]:+.2f}, {b[1]:+.2f}" for b in biases)
        rows.append(f"| {name} | {cells} |")
    return [*rows, ""]


def _grid_table(cells: list[Cell], runs: int) -> list[str]:
    low, high = (stats.chi2.ppf(p, runs) / runs for p in (0.0005, 0.9995))
    mean = np.mean([c.ratio for c in cells])
    rows = [
        f"## Monte Carlo, {runs} runs a cell, second-order model",
        "",
        "Mean square error over the bound (f0, damping) and coverage of the 95 % ellipse. Joint: "
        "all bins, transient estimated. ELiS: local polynomial method, sample maximum likelihood "
        "line by line, covariance corrected for the sample variances; a transient that decays "
        "within few bins is beyond its polynomial. The 99.9 % interval of a ratio of 1 is "
        f"{low:.3f} to {high:.3f}. Settled: the bound without transient over that with it "
        "(standard deviation of f0). "
        f"Mean of the joint ratios: {mean:.3f}; worst {max(np.max(c.ratio) for c in cells):.3f}; "
        f"coverage {min(c.coverage for c in cells):.4f} to {max(c.coverage for c in cells):.4f}; "
        f"failed fits: {sum(c.failed for c in cells)}. Alarms: fits that claim a model error, of "
        f"which there is none here; {1e3 * np.mean([c.alarms for c in cells]) / runs:.2g} in a "
        "thousand over all cells, two tests of one in a thousand each.",
        "",
        "| periods | damping | SNR | std f0 [Hz] | settled | joint MSE | coverage | failed | alarms "
        "| ELiS MSE | coverage |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for c in cells:
        std = np.sqrt(c.bound[0, 0])
        elis = "" if np.isnan(c.elis_coverage) else "{:.2f}, {:.2f}".format(*c.elis_ratio)
        covered = "" if np.isnan(c.elis_coverage) else f"{c.elis_coverage:.3f}"
        rows.append(
            f"| {c.plant.periods} | {100 * c.plant.damping_ratio:g} % | {c.plant.snr_db:g} dB "
            f"| {std:.2e} | {np.sqrt(c.settled_bound[0, 0]) / std:.2f} "
            f"| {c.ratio[0]:.3f}, {c.ratio[1]:.3f} | {c.coverage:.4f} "
            f"| {c.failed} | {c.alarms} | {elis} | {covered} |"
        )
    return [*rows, ""]


def _figure(methods: list[Method], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    shown = [m for m in methods if np.isfinite(m.time_s) and np.isfinite(m.error).all()]
    figure, axes = plt.subplots(figsize=(9, 5.5), layout="constrained")
    for m in shown:
        ours = m.name.startswith(("joint", "FRF"))
        colour = plt.get_cmap("tab20")(len(axes.lines) % 20)
        axes.plot(1e6 * m.time_s, np.max(m.error), "o" if ours else "s", color=colour, label=m.name)
    axes.axhline(1, color="black", linewidth=0.8)
    axes.axvline(1e6 * methods[0].time_s, color="grey", linestyle="--", linewidth=0.8)
    axes.text(
        1e6 * methods[0].time_s, axes.get_ylim()[1], " Fourier transform", va="top", fontsize=8
    )
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="time per point [us]",
        ylabel="larger RMS error of f0 and damping / Cramer-Rao bound",
        title="Simulated: damping 2 %, 40 dB, 8 periods",
    )
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(path, dpi=120)
    plt.close(figure)
