# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo of the joint estimator on several realisations of the phases, against the bound."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy import stats

from benchmarks.poles_plant import (
    BAND_HZ,
    F0_HZ,
    HARMONICS,
    SAMPLE_RATE_HZ,
    SAMPLES_PER_PERIOD,
    Plant,
    bound_of_realisations,
    judge,
)
from tactile_resonance._typing import FloatArray
from tactile_resonance.poles.joint import PoleEstimator
from tactile_resonance.poles.result import PolesStatus
from tactile_resonance.poles.structure import ModelStructure

REALISATIONS = (2, 4, 7)
PERIODS = (1, 2, 8)
DAMPING = (0.01, 0.02, 0.05)
# Signal-to-noise ratio, and distortion over noise on a bin of one realisation [dB].
LEVELS_DB = ((20.0, None), (40.0, None), (40.0, 20.0))
CHUNK = 250


@dataclass(frozen=True)
class Cell:
    """A cell of the grid.

    Attributes
    ----------
    realisations : int
    plant : Plant
        Of the first one.
    distortion_db : float or None
    ratio : (2,) float
        Mean square errors of f0 and damping over the bound.
    coverage, coverage_noise : float
        Of the 95 % ellipse from the total covariance, and from that of noise.
    failed, alarms : int
        Fits without covariance; fits that claim a model error, of which there is none.
    """

    realisations: int
    plant: Plant
    distortion_db: float | None
    ratio: FloatArray
    coverage: float
    coverage_noise: float
    failed: int
    alarms: int


def grid_table(runs: int) -> list[str]:
    """The grid as lines of a page."""
    grid = product(REALISATIONS, PERIODS, DAMPING, LEVELS_DB)
    cells = [measure_cell(m, p, zeta, snr, more, runs) for m, p, zeta, (snr, more) in grid]
    low, high = (stats.chi2.ppf(p, runs) / runs for p in (0.0005, 0.9995))
    clean = [cell for cell in cells if cell.distortion_db is None]
    distorted = [cell for cell in cells if cell.distortion_db is not None]
    least, most = (stats.binom.ppf(p, runs, 0.95) / runs for p in (0.0005, 0.9995))
    alarms = 1e3 * np.mean([cell.alarms for cell in cells]) / runs
    rows = [
        f"## Several realisations of the phases, {runs} runs a cell, second-order model",
        "",
        "Each realisation is a record from rest with other phases and a transient of its own. "
        "Distortion is simulated as an independent circular error on the excited bins of each "
        "realisation. The bound is that of the same data with all initial states and levels "
        "unknown. Coverage is that of the 95 % ellipse from the total covariance and, beside it, "
        "from the covariance of noise alone, which says nothing of distortion; of single periods "
        "both hold both. The 99.9 % interval of a ratio of 1 is "
        f"{low:.3f} to {high:.3f}, of a coverage of 95 % {least:.4f} to {most:.4f}. Without distortion: "
        f"{_summary(clean)}. The total covariance counts the scatter of the poles of so few realisations "
        "where chance seldom makes it, so that it covers more than 95 %. With distortion: "
        f"{_summary(distorted)}; lines that are distorted are taken for those of a resonator that is not "
        "linear, and what rings between harmonics is not relied on, which the bound does. Failed fits: "
        f"{sum(cell.failed for cell in cells)}. Alarms: fits that claim a model error, of which "
        f"there is none here; {alarms:.2g} in a thousand over all cells.",
        "",
        "| realisations | periods | damping | SNR | distortion over noise | MSE | coverage, total "
        "| coverage, noise | alarms |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for cell in cells:
        more = "none" if cell.distortion_db is None else f"{cell.distortion_db:g} dB"
        rows.append(
            f"| {cell.realisations} | {cell.plant.periods} | {100 * cell.plant.damping_ratio:g} % "
            f"| {cell.plant.snr_db:g} dB | {more} | {cell.ratio[0]:.3f}, {cell.ratio[1]:.3f} "
            f"| {cell.coverage:.4f} | {cell.coverage_noise:.4f} | {cell.alarms} |"
        )
    return rows


def _summary(cells: list[Cell]) -> str:
    """Mean and worst ratio, and coverage, of some cells."""
    ratios, covered = [cell.ratio for cell in cells], [cell.coverage for cell in cells]
    return (
        f"mean of the ratios {np.mean(ratios):.3f}, worst {np.max(ratios):.3f}, coverage "
        f"{min(covered):.4f} to {max(covered):.4f}"
    )


def measure_cell(
    realisations: int,
    periods: int,
    damping_ratio: float,
    snr_db: float,
    distortion_db: float | None,
    runs: int,
) -> Cell:
    """Monte Carlo of one cell, seeded by the cell."""
    seed = [realisations, periods, int(1e4 * damping_ratio), int(snr_db), distortion_db is None]
    rng = np.random.default_rng(seed)
    plants = [Plant(damping_ratio, snr_db, periods, 100 + m) for m in range(realisations)]
    bins = plants[0].bins()
    variance_y, variance_u = plants[0].noise
    level = 0.0 if distortion_db is None else variance_y * 10 ** (distortion_db / 10)
    known = periods == 1 and distortion_db is None
    plan = PoleEstimator(
        SAMPLE_RATE_HZ,
        SAMPLES_PER_PERIOD,
        periods,
        HARMONICS,
        BAND_HZ,
        ModelStructure(2, 2),
        input_noise_ratio=variance_u / variance_y if known else None,
    )
    errors, noise, total, alarms = [], [], [], 0
    for first in range(0, runs, CHUNK):
        pairs = [plant.noisy(rng, min(CHUNK, runs - first), bins) for plant in plants]
        u, y = (np.stack(channel, axis=1) for channel in zip(*pairs, strict=True))
        parts = rng.standard_normal((*y.shape, 2)) * np.sqrt(level / 2)
        y = y + parts.view(complex)[..., 0] * (bins % periods == 0)
        result = plan.from_bins(u, y)
        found = np.stack([result.f0_hz[:, 0], result.damping_ratio[:, 0]], axis=-1)
        errors.append(found - [F0_HZ, damping_ratio])
        noise.append(result.covariance[:, 0])
        total.append(result.total_covariance[:, 0])
        alarms += int(result.has_status(PolesStatus.MODEL_ERROR).sum())
    error, from_noise, in_total = (np.concatenate(v) for v in (errors, noise, total))
    good = np.isfinite(error).all(axis=-1) & np.isfinite(in_total).all(axis=(-2, -1))
    bound = bound_of_realisations(plants, level)
    ratio, coverage = judge(error[good], in_total[good], bound)
    coverage_noise = judge(error[good], from_noise[good], bound)[1]
    failed = int(np.sum(~good))
    return Cell(
        realisations, plants[0], distortion_db, ratio, coverage, coverage_noise, failed, alarms
    )
