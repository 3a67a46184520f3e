# SPDX-License-Identifier: Apache-2.0
"""Poles where reality leaves the model: what is stated, what is named, and how far off it is; simulated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy import stats
from tqdm import tqdm

from benchmarks.cubic_resonator import (
    BAND_HZ,
    DAMPING_RATIO,
    F0_HZ,
    HARMONICS,
    SAMPLE_RATE_HZ,
    SAMPLES_PER_PERIOD,
    linear_mode,
    records,
)
from tactile_resonance._typing import BoolArray, FloatArray
from tactile_resonance.multisine import design_multisine
from tactile_resonance.poles.estimator import identify_poles_from_records
from tactile_resonance.poles.joint import JointPlan, PoleEstimator
from tactile_resonance.poles.result import (
    Poles,
    PolesBatch,
    PolesStatus,
    natural_frequency_and_damping,
)
from tactile_resonance.poles.structure import ModelStructure
from tactile_resonance.simulation.sensor.bench import DEFAULT_EFFECTS, BenchRun, SimulatedBench
from tactile_resonance.simulation.sensor.bimorph import CoupledBimorph, pole_trajectory
from tactile_resonance.simulation.sensor.response import Lines
from tactile_resonance.simulation.tissue.library import read_tissues

GROUPS, QUICK_GROUPS, CHUNK = 400, 60, 400
CUBIC = {None: 0.0, -45: 2.8e-5, -36: 8e-5, -27: 2.5e-4}
"""Distortion over response in the band [dB]: k [1/V^2]."""
REALISATIONS, PERIODS, SNR_DB = (2, 3, 4, 8), (2, 8), (40.0, 60.0)
STRUCTURE = ModelStructure(2, 2)
RECORDS, QUICK_RECORDS, TISSUE, LEVEL_V = 1200, 24, "gel10", 4.0
BENCH_REALISATIONS = (2, 3, 4, 6, 8)
CREEP_TISSUES, CREEP_BLOCKS, CREEP_RECORDS, QUICK_CREEP_RECORDS = (
    ("cortex", "liver", "gel10"),
    (2, 3, 5, 8),
    100,
    20,
)
CREEP_FORCE_N, HELD_FROM_S, CREEP_LEVEL_V = 0.01, 0.3, 0.1
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
    named : float
        Share of groups of which the message says that realisations differ.
    truth : (2,) float
        f0 [Hz] and damping ratio of the best linear approximation.
    """

    ok: BoolArray
    deviations: FloatArray
    mse: FloatArray
    named: float
    truth: FloatArray


def measure(
    realisations: int, periods: int, distortion_db: int | None, snr_db: float, groups: int
) -> Row:
    """Monte Carlo of groups of realisations, seeded by the cell.

    The truth is the mean of all fits to single realisations: the best linear approximation at this level.
    """
    seed = [realisations, periods, -(distortion_db or 0), int(snr_db)]
    rng = np.random.default_rng(seed)
    options = (SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, periods, HARMONICS, BAND_HZ, STRUCTURE)
    together, alone = PoleEstimator(*options), JointPlan(*options)
    count, bins = groups * realisations, list[tuple[FloatArray, FloatArray]]()
    for first in range(0, count, CHUNK):
        u, y = records(rng, min(CHUNK, count - first), periods, CUBIC[distortion_db], snr_db)
        bins.append(alone.transform(u, y))
    u, y = (np.concatenate(c).reshape(groups, realisations, -1) for c in zip(*bins, strict=True))
    one = alone.from_bins(u, y)
    each = np.stack([one.f0_hz[..., 0], one.damping_ratio[..., 0]], axis=-1)  # (groups, M, 2)
    truth = np.array(linear_mode()) if distortion_db is None else each.mean(axis=(0, 1))
    return _judged(together.from_bins(u, y), each, truth)


def run(output: Path, quick: bool) -> str:
    """Measure; return the page."""
    page = "\n".join(
        [
            "# Poles where reality leaves the model",
            "",
            "`tools/run.sh tactile_resonance benchmark truth`. Simulated.",
            "",
            *cubic_table(QUICK_GROUPS if quick else GROUPS),
            "",
            *bench_table(QUICK_RECORDS if quick else RECORDS),
            "",
            *creep_table(QUICK_CREEP_RECORDS if quick else CREEP_RECORDS),
        ]
    )
    return page + "\n"


def cubic_table(groups: int) -> list[str]:
    """Groups of realisations of a resonator that is not linear, as lines of a page."""
    cells = list(product(CUBIC, SNR_DB, REALISATIONS, PERIODS))
    least = stats.binom.ppf(0.001, groups, 0.93) / groups
    lines = [
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
            f"| {row.truth[0] - F0_HZ:+.3f} Hz |"
        )
    return [*lines, "", f"All rows: {inside / said_ok:.4f} of {said_ok} results that say `ok`."]


def bench_table(count: int) -> list[str]:
    """Realisations of the simulated bench at a high level, in disjoint groups, as lines of a page."""
    bench, tissue = SimulatedBench.from_configuration(), read_tissues()[TISSUE]
    effects = replace(DEFAULT_EFFECTS, nonlinearity=True)
    design = design_multisine(level_v=LEVEL_V)
    options = (design.sample_rate_hz, design.samples_per_period, 2, design.harmonics, BAND_HZ)
    plan = JointPlan(*options)
    u, y = np.empty((2, count, plan.bins.size), complex)
    for k in tqdm(range(count), desc="records", disable=None):
        excitation = design_multisine(level_v=LEVEL_V, seed=k)
        block = bench.start(tissue, seed=k, effects=effects).block(Lines.of(excitation), 2)
        volts = (channel.volts().reshape(2, -1) for channel in (block.actuator, block.sensor))
        u[k], y[k] = plan.transform(*volts)
    alone = plan.from_bins(u, y)
    each = np.stack([alone.f0_hz[:, 0], alone.damping_ratio[:, 0]], axis=-1)
    lines = [
        f"## Realisations of the simulated bench at {LEVEL_V:g} V rms",
        "",
        f"Ten modes on {TISSUE}, 10 Hz to 10 kHz, two periods from rest, with its static nonlinearity; {count} "
        "records in disjoint groups. f0 of one realisation scatters by "
        f"{1e3 * each[:, 0].std():.0f} mHz; fits to one state {1e3 * _median_std(alone):.0f} mHz.",
        "",
        "| realisations | groups | ok | coverage, ok | worst | MSE f0, damping | scatter of f0 | stated |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for realisations in BENCH_REALISATIONS:
        groups = count // realisations
        part = slice(0, groups * realisations)
        pairs = (v[part].reshape(groups, realisations, -1) for v in (u, y))
        result = PoleEstimator(*options).from_bins(*pairs)
        row = _judged(result, each[part].reshape(groups, realisations, 2), each.mean(axis=0))
        lines.append(
            f"| {realisations} | {groups} | {row.ok.mean():.3f} "
            f"| {(row.deviations[row.ok] ** 2 < INSIDE).mean():.3f} | {row.deviations.max():.1f} "
            f"| {row.mse[0]:.2f}, {row.mse[1]:.2f} | {1e3 * result.f0_hz[:, 0].std():.0f} mHz "
            f"| {1e3 * _median_std(result):.0f} mHz |"
        )
    return lines


def _median_std(result: PolesBatch) -> float:
    """Stated deviation of f0 [Hz]; the total one where there is one."""
    total = result.total_covariance[:, 0, 0, 0]
    stated = np.where(np.isfinite(total), total, result.covariance[:, 0, 0, 0])
    return float(np.sqrt(np.median(stated)))


def _judged(result: PolesBatch, each: FloatArray, truth: FloatArray) -> Row:
    """A batch of groups whose realisations by themselves give poles `each` (groups, M, 2)."""
    error = np.stack([result.f0_hz[:, 0], result.damping_ratio[:, 0]], axis=-1) - truth
    covariance = result.total_covariance[:, 0]
    known = np.isfinite(covariance).all(axis=(-2, -1))
    inverse = np.linalg.inv(np.where(known[:, None, None], covariance, np.eye(2)))
    squared = np.where(known, np.einsum("bi,bij,bj->b", error, inverse, error), np.inf)
    assert result.remark is not None
    return Row(
        ok=result.has_status(PolesStatus.OK),
        deviations=np.sqrt(squared),
        mse=np.mean(error**2, axis=0) / np.mean((each.mean(axis=1) - truth) ** 2, axis=0),
        named=float(np.mean(result.remark != "")),
        truth=truth,
    )


def creep_table(count: int) -> list[str]:
    """Contact that creeps under a held force, as lines of a page."""
    least = stats.binom.ppf(0.001, count, 0.93) / count
    lines = [
        "## Contact that creeps",
        "",
        f"{CREEP_FORCE_N * 1e3:g} mN held from {HELD_FROM_S:g} s before the record on, blocks of 0.4 s "
        f"from rest, multisines of {BAND_HZ[0]:g} to {BAND_HZ[1]:g} Hz, {CREEP_LEVEL_V:g} V rms; {count} "
        "records a row. Poles are compared with the mean of the bench's over the record, drifts with "
        "the straight line nearest to it. Coverage is that of 95 % ellipses; below "
        f"{least:.3f} it would be below 93 % with 99.9 % confidence. The deviation of f0 is that stated, the "
        "median; next to it, over that of a contact that stays as it is in the middle. Off is the mean error "
        "in stated deviations; a constant contact is off by up to 0.2 in f0, 0.4 in the damping ratio. "
        "At the instant: what the bench's pole at `instant_s` differs by from its mean, in the same.",
        "",
        "| tissue | blocks | ok | found to change | coverage | of the drift | std of f0 | over constant "
        "| off in f0, damping | worst | at the instant |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for tissue, blocks in tqdm(
        list(product(CREEP_TISSUES, CREEP_BLOCKS)), desc="creep", disable=None
    ):
        lines.append(_creep_row(tissue, blocks, count))
    return lines


def _creep_row(name: str, blocks: int, count: int) -> str:
    bench, tissue, length_s = SimulatedBench.from_configuration(), read_tissues()[name], blocks * 0.4

    def creeping(time_s: float) -> CoupledBimorph:
        return bench.coupled(tissue, force_n=CREEP_FORCE_N, hold_time_s=HELD_FROM_S + time_s)

    place = np.linspace(-1, 1, 8 * blocks + 1)  # of the record
    track = pole_trajectory(creeping((1 + at) * length_s / 2) for at in place.tolist())
    # as in the estimate, the mean and the straight line nearest to the change
    f0_damping = np.stack(natural_frequency_and_damping(track))  # (2, T)
    mean, slope = np.polynomial.legendre.legfit(place, f0_damping.T, 6)[:2]
    slope *= 2 / length_s
    middle = {"force_n": CREEP_FORCE_N, "hold_time_s": HELD_FROM_S + length_s / 2}
    found, constant = [], []
    for seed in range(count):
        found.append(_poles_of(BenchRun(bench.sensor, creeping, seed=seed), blocks, seed))
        constant.append(_poles_of(bench.start(tissue, seed=seed, **middle), blocks, seed))
    errors, rates, inside, instants = [], [], [], []
    for poles in found:
        covariance = poles.best_covariance[0]
        error = np.array([poles.f0_hz[0], poles.damping_ratio[0]]) - mean
        errors.append(error / np.sqrt(np.diag(covariance)))
        inside.append(error @ np.linalg.solve(covariance, error) < INSIDE)
        if poles.instant_s is not None:
            rate = np.array([poles.f0_drift_hz_per_s[0], poles.damping_drift_per_s[0]]) - slope
            rates.append(rate @ np.linalg.solve(poles.drift_covariance[0], rate) < INSIDE)
            at = [np.interp(poles.instant_s / length_s * 2 - 1, place, v) for v in f0_damping]
            instants.append((at - mean) / np.sqrt(np.diag(covariance)))
    off, there = np.mean(errors, axis=0), np.median(instants, axis=0)
    stds = [np.median([np.sqrt(p.covariance[0, 0, 0]) for p in some]) for some in (found, constant)]
    return (
        f"| {name} | {blocks} | {np.mean([p.status is PolesStatus.OK for p in found]):.3f} "
        f"| {len(rates) / count:.3f} | {np.mean(inside):.3f} | {np.mean(rates):.3f} "
        f"| {1e3 * stds[0]:.1f} mHz | {stds[0] / stds[1]:.2f} | {off[0]:+.2f}, {off[1]:+.2f} "
        f"| {np.abs(errors).max():.1f} | {there[0]:+.1f}, {there[1]:+.1f} |"
    )


def _poles_of(run: BenchRun, blocks: int, seed: int) -> Poles:
    """Of a record of blocks from rest, with phases of its own."""
    excitation = design_multisine(band_hz=BAND_HZ, level_v=CREEP_LEVEL_V, seed=seed)
    block = run.block(Lines.of(excitation), blocks)
    u, y = (c.volts().reshape(blocks, -1) for c in (block.actuator, block.sensor))
    return identify_poles_from_records(
        u,
        y,
        sample_rate_hz=excitation.sample_rate_hz,
        harmonics=excitation.harmonics,
        band_hz=BAND_HZ,
    )
