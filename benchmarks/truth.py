# SPDX-License-Identifier: Apache-2.0
"""Poles where reality leaves the model: what is stated, what is named, and how far off it is; simulated."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy import stats
from tqdm import tqdm

from benchmarks.cubic_resonator import (
    BAND_HZ,
    DAMPING_RATIO,
    F0_HZ,
    HARMONICS,
    SAMPLE_RATE_HZ,
    SAMPLES_PER_PERIOD,
    records,
)
from tactile_resonance.identification.joint import JointPlan
from tactile_resonance.identification.realisations import RealisationsPlan
from tactile_resonance.identification.result import PolesStatus
from tactile_resonance.identification.structure import ModelStructure

FloatArray = npt.NDArray[np.float64]

GROUPS, QUICK_GROUPS, CHUNK = 400, 60, 400
CUBIC = {None: 0.0, -45: 2.8e-5, -36: 8e-5, -27: 2.5e-4}
"""Distortion over response in the band [dB]: k [1/V^2]."""
REALISATIONS, PERIODS, SNR_DB = (2, 3, 4, 8), (2, 8), (40.0, 60.0)
STRUCTURE = ModelStructure(2, 2)
INSIDE = stats.chi2.ppf(0.95, 2)


@dataclass(frozen=True)
class Row:
    """One cell: errors in deviations of the total covariance, and what is said.

    Attributes
    ----------
    ok : (groups,) bool
    deviations : (groups,) float
        Mahalanobis distance of (f0, damping) from the truth.
    mse : (2,) float
        Of f0 and damping over those of the mean of fits to single realisations.
    shift_hz : float
        Of the best linear approximation from the small-signal resonance.
    named : float
        Share of groups of which the message says that realisations differ.
    """

    ok: npt.NDArray[np.bool_]
    deviations: FloatArray
    mse: FloatArray
    shift_hz: float
    named: float


def measure(
    realisations: int, periods: int, distortion_db: int | None, snr_db: float, groups: int
) -> Row:
    """Monte Carlo of groups of realisations, seeded by the cell.

    The truth is the mean of all fits to single realisations: the best linear approximation at this level.
    """
    seed = [realisations, periods, -(distortion_db or 0), int(snr_db)]
    rng = np.random.default_rng(seed)
    options = (SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, periods, HARMONICS, BAND_HZ, STRUCTURE)
    together, alone = RealisationsPlan(*options), JointPlan(*options)
    chunk = max(1, CHUNK // realisations)
    results, singles = [], []
    for first in range(0, groups, chunk):
        count = min(chunk, groups - first)
        u, y = records(rng, count * realisations, periods, CUBIC[distortion_db], snr_db)
        u, y = (v.reshape(count, realisations, *v.shape[1:]) for v in (u, y))
        results.append(together(u, y))
        one = alone(u, y)
        singles.append(np.stack([one.f0_hz[..., 0], one.damping_ratio[..., 0]], axis=-1))
    each = np.concatenate(singles)  # (groups, M, 2)
    truth = np.array([F0_HZ, DAMPING_RATIO])
    if distortion_db is not None:
        truth = each.mean(axis=(0, 1))
    found = np.concatenate(
        [np.stack([r.f0_hz[:, 0], r.damping_ratio[:, 0]], axis=-1) for r in results]
    )
    covariance = np.concatenate([r.total_covariance[:, 0] for r in results])
    error = found - truth
    squared = np.einsum("bi,bij,bj->b", error, np.linalg.pinv(covariance), error)
    squared[~np.isfinite(squared)] = np.inf
    return Row(
        ok=np.concatenate([r.has_status(PolesStatus.OK) for r in results]),
        deviations=np.sqrt(squared),
        mse=np.mean(error**2, axis=0) / np.mean((each.mean(axis=1) - truth) ** 2, axis=0),
        shift_hz=float(truth[0] - F0_HZ),
        named=float(np.mean(np.concatenate([r.remark != "" for r in results]))),
    )


def run(output: Path, quick: bool) -> str:
    """Measure, write ``truth.md`` into `output`, and return the page."""
    groups = QUICK_GROUPS if quick else GROUPS
    cells = list(product(CUBIC, SNR_DB, REALISATIONS, PERIODS))
    least = stats.binom.ppf(0.001, groups, 0.93) / groups
    lines = [
        "# Poles where reality leaves the model",
        "",
        "`tools/run.sh tactile_resonance benchmark truth`. Simulated.",
        "",
        "## Realisations of a resonator that is not linear",
        "",
        f"A mode at {F0_HZ:g} Hz, damping {DAMPING_RATIO:g}, with cubic stiffness, from rest; multisines "
        f"of 10 to 1000 Hz with other phases in each realisation; {groups} groups of realisations a row. "
        "The truth is the best linear approximation at that level, the mean of all fits to single "
        "realisations; of the linear one the pole itself. Coverage is that of the 95 % ellipse of the "
        "total covariance. Distortion is the scatter of the response over the response, in the band. "
        "Mean square errors are over those of the mean of fits to single realisations. A coverage below "
        f"{least:.3f} among `ok` would be below 93 % with 99.9 % confidence.",
        "",
        "| distortion | SNR | realisations | periods | ok | coverage, ok | coverage, all "
        "| beyond 6 deviations, ok | worst | MSE f0, damping | realisations named | shift of f0 |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    inside, said_ok = 0, 0
    for distortion_db, snr_db, realisations, periods in tqdm(cells, desc="cells", disable=None):
        row = measure(realisations, periods, distortion_db, snr_db, groups)
        held = row.deviations**2 < INSIDE
        inside, said_ok = inside + int(held[row.ok].sum()), said_ok + int(row.ok.sum())
        kind = "none" if distortion_db is None else f"{distortion_db} dB"
        lines.append(
            f"| {kind} | {snr_db:g} dB | {realisations} | {periods} | {row.ok.mean():.3f} "
            f"| {held[row.ok].mean():.3f} | {held.mean():.3f} | {int((row.deviations[row.ok] > 6).sum())} "
            f"| {row.deviations.max():.1f} | {row.mse[0]:.2f}, {row.mse[1]:.2f} | {row.named:.2f} "
            f"| {row.shift_hz:+.3f} Hz |"
        )
    lines += ["", f"All rows: coverage of {said_ok} results that say `ok`: {inside / said_ok:.4f}."]
    page = "\n".join(lines) + "\n"
    (output / "truth.md").write_text(page)
    return page
