# SPDX-License-Identifier: Apache-2.0
"""Numerical stability of the poles: each cell of a map right within its stated uncertainty, or with a status.

A cell is a system at the edge of double precision, seen on given lines with given noise. Its response is
computed to fifty digits. The fits of its seeded runs are right, or carry a status that says why they are not,
or are silent: wrong beyond six of their stated standard deviations (and what rounding of the data allows) under
a status that can be relied on. Two modes of which the Cramer-Rao bound exceeds a quarter of their distance
cannot be distinguished: one between them counts as right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.stability_cells import SNR_DB, Cell, cells
from tactile_resonance.frf.result import FRF
from tactile_resonance.poles.identify import identify_batch
from tactile_resonance.poles.result import PolesBatch, PolesStatus

RUNS, QUICK_RUNS, QUICK_ORDER = 12, 3, 12
VARIANCE_DOF = 14
"""Of the sample variance of each line."""
DEVIATIONS = 6.0
ROUNDINGS = 1000.0
"""Errors of so many times what rounding of the data stands for are accepted."""
RELIED_ON = (PolesStatus.OK, PolesStatus.NO_COVARIANCE, PolesStatus.MODEL_ERROR)


@dataclass(frozen=True)
class Outcome:
    """Runs of a cell: how many are right, carry a status, and are silently wrong."""

    cell: Cell
    right: int
    with_status: int
    silent: int


def outcome(cell: Cell, rng: np.random.Generator, runs: int) -> Outcome:
    """Fit the runs of a cell, and judge each."""
    fits = _fits(cell, rng, runs if cell.noise > 0 else 1)
    count = fits.cost.size
    relied_on = np.any([fits.has_status(status) for status in RELIED_ON], axis=0)
    right = sum(bool(relied_on[k]) and _right(cell, fits, k) for k in range(count))
    with_status = int(count - relied_on.sum())
    return Outcome(cell, right, with_status, count - right - with_status)


def _fits(cell: Cell, rng: np.random.Generator, runs: int) -> PolesBatch:
    shape = (runs, cell.frequency_hz.size)
    noise = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) * np.sqrt(cell.noise / 2)
    known = {}
    with np.errstate(under="ignore", over="ignore"):
        g = (cell.unscaled + noise) * cell.scale
        if cell.noise > 0:
            sample = cell.noise * rng.gamma(VARIANCE_DOF, 1 / VARIANCE_DOF, shape)
            known = {"variance_noise": sample * cell.scale * cell.scale, "noise_dof": VARIANCE_DOF}
    if cell.single:
        g = g.astype(np.complex64)
    return identify_batch(FRF(cell.frequency_hz, g, **known), None, cell.structure)


def _right(cell: Cell, fits: PolesBatch, run: int) -> bool:
    """Whether each mode that is reported is one of the true ones."""
    limit = ROUNDINGS * cell.rounding  # (modes, 2)
    truth = cell.truth
    close = 4 * cell.bound(cell.noise)[:, 0] > cell.nearest()
    low, high = (truth[close, 0].min(), truth[close, 0].max()) if close.any() else (np.inf, -np.inf)
    best = np.where(np.isfinite(fits.total_covariance), fits.total_covariance, fits.covariance)[run]
    for k in np.flatnonzero(fits.significant[run] & np.isfinite(fits.f0_hz[run])):
        found = np.array([fits.f0_hz[run, k], fits.damping_ratio[run, k]])
        with np.errstate(invalid="ignore"):  # of exact data rounding is all that is left
            std = np.sqrt(np.diag(best[k]))
        stated = DEVIATIONS * np.where(np.isfinite(std) & (cell.noise > 0), std, 0.0)
        near = np.all(np.abs(found - truth) <= stated + limit, axis=-1).any()
        between = low - stated[0] <= found[0] <= high + stated[0]
        if not (near or between):
            return False
    return True


def run(output: Path, quick: bool) -> str:
    """Fit all cells, draw ``stability.png`` into `output`, and return the page."""
    rng = np.random.default_rng(1)
    every = cells(QUICK_ORDER) if quick else cells()
    outcomes = [outcome(cell, rng, QUICK_RUNS if quick else RUNS) for cell in every]
    text = _page(outcomes)
    _draw(outcomes, output / "stability.png")
    return text


def _page(outcomes: Sequence[Outcome]) -> str:
    silent_cells = sum(of.silent > 0 for of in outcomes)
    fits = sum(of.right + of.with_status + of.silent for of in outcomes)
    lines = [
        "# Numerical stability of the poles",
        "",
        "`tools/run.sh tactile_resonance benchmark stability`. Simulated. " + _about(),
        "",
        f"{len(outcomes)} cells, {fits} fits: {sum(of.right for of in outcomes)} right, "
        f"{sum(of.with_status for of in outcomes)} with a status, {sum(of.silent for of in outcomes)} silent. "
        f"**Silent cells: {silent_cells}.**",
        "",
        "Cells hold the runs that are right, with a status and, where there are any, silent, in bold. "
        "`exact`: one run, without noise but rounding.",
        "",
        "![Maps](stability.png)",
    ]
    for family, rows in _maps(outcomes).items():
        heads = [of.cell.column for of in next(iter(rows.values()))]
        lines += ["", f"## {family[0].upper()}{family[1:]}", "", "| | " + " | ".join(heads) + " |"]
        lines.append("|---|" + "---:|" * len(heads))
        for row, cells_of_row in rows.items():
            lines.append(f"| {row} | " + " | ".join(map(_entry, cells_of_row)) + " |")
    return "\n".join([*lines, ""])


def _about() -> str:
    assert __doc__ is not None
    return " ".join(__doc__.split("\n\n", 1)[1].split())


def _entry(of: Outcome) -> str:
    entry = f"{of.right}"
    if of.with_status or of.silent:
        entry += f", {of.with_status}"
    return entry + (f", **{of.silent}**" if of.silent else "")


def _maps(outcomes: Sequence[Outcome]) -> dict[str, dict[str, list[Outcome]]]:
    """Outcomes by family and row."""
    maps: dict[str, dict[str, list[Outcome]]] = {}
    for of in outcomes:
        maps.setdefault(of.cell.family, {}).setdefault(of.cell.row, []).append(of)
    return maps


def _draw(outcomes: Sequence[Outcome], path: Path) -> None:
    """Share of right runs of each cell in green, of those with a status in grey, silent ones red."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    maps = _maps(outcomes)
    columns = 4
    figure = Figure(figsize=(13, 2.1 * -(-len(maps) // columns)), layout="constrained")
    axes = figure.subplots(-(-len(maps) // columns), columns, squeeze=False).ravel()
    green, grey, red = (np.array(mpl.colors.to_rgb(name)) for name in ("#2a9d5c", "#c8c8c8", "#d62728"))
    for axis, (family, rows) in zip(axes, maps.items(), strict=False):
        image = np.empty((len(rows), len(SNR_DB), 3))
        for i, of_row in enumerate(rows.values()):
            for j, of in enumerate(of_row):
                share = of.right / (of.right + of.with_status + of.silent)
                image[i, j] = red if of.silent else share * green + (1 - share) * grey
        axis.imshow(image, aspect="auto")
        axis.set_title(family, fontsize=8)
        axis.set_yticks(range(len(rows)), list(rows), fontsize=7)
        axis.set_xticks(range(len(SNR_DB)), [of.cell.column for of in of_row], fontsize=7, rotation=45)
    for axis in axes[len(maps) :]:
        axis.set_axis_off()
    figure.suptitle("Simulated: right (green), with a status (grey), silently wrong (red)", fontsize=9)
    figure.savefig(path, dpi=110)
