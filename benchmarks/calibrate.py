# SPDX-License-Identifier: Apache-2.0
"""Sensors calibrated from records, contacts and decisions through them, against the truth of the simulation."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from benchmarks import calibrate_decision
from benchmarks.calibrate_benches import (
    MADE,
    CalibratedBench,
    Measured,
    calibrated,
    contact_record,
    excitation,
    library,
    make_bench,
    measure,
)
from benchmarks.calibrate_decision import Called, decide_point, tasks
from benchmarks.skip_decision import INSIDE, TISSUES
from tactile_resonance.calibration.contact import ContactStatus
from tactile_resonance.report.drawing import SIMULATED, new_figure, save_figure
from tactile_resonance.simulation.sensor.bench import BenchEffects, BenchRun
from tactile_resonance.simulation.sensor.bimorph import CoupledBimorph, sensor_model
from tactile_resonance.simulation.tissue.library import hertz_contact

PROCESSES = 2
GROUPS = ("natural_rad_s", "damping_ratio", "coupling_rad_s", "tip_deflection")
DURATIONS = ((0.01, 1), (0.02, 1), (0.1, 1), (0.1, 4))
"""Period [s] and periods of a record from rest."""
PREFACE = (
    "`tools/run.sh tactile_resonance benchmark calibrate`. All is simulated: sensors whose parameters of",
    "beam, tip and electronics are 3 % (standard deviation) off `config/sensors/bimorph.yaml`, noise and",
    "converters on. Each is calibrated from four periods of 2 s in air, with a mass of 50 mg that weighs",
    "0.1 % (standard deviation) other than it says, and of a loop-back, its channels 2 us apart. The truth is",
    "for comparison alone. Contacts and decisions: on the same sensors with channels that are not apart.",
)


def run(output: Path, quick: bool) -> str:
    """Measure, draw ``calibrate.png`` into `output`, and return the page."""
    benches, repeats, points = (4, 2, 400) if quick else (50, 4, 10_000)
    context = get_context("fork")
    with ProcessPoolExecutor(PROCESSES, mp_context=context) as pool:
        kinds = [(seed, skewed) for skewed in (True, False) for seed in range(benches)]
        MADE.update(zip(kinds, pool.map(make_bench, *zip(*kinds, strict=True)), strict=True))
    made = [MADE[seed, True] for seed in range(benches)]
    with ProcessPoolExecutor(PROCESSES, mp_context=context) as pool:
        contacts = {
            (name, *duration): list(pool.map(_measured, _cases(name, duration, benches, repeats)))
            for duration in DURATIONS
            for name in TISSUES
        }
        alarms = {what: list(pool.map(_contradicted, _changes(what, benches))) for what in CHANGES}
        of = min(benches, 20)
        called = {
            (block_s, disturbed): list(
                pool.map(decide_point, tasks(of, count, block_s, disturbed), chunksize=50)
            )
            for block_s, disturbed, count in (
                (0.01, False, points // 5),
                (0.01, True, points),
                (0.02, True, points // 5),
            )
        }
    save_figure(_draw(made, contacts, called), output / "calibrate.png")
    page = "\n".join(
        [
            "# A calibrated sensor, and what is known through it",
            "",
            *PREFACE,
            "",
            *_parameter_lines(made),
            "",
            "![errors over deviations; stiffness; time of decisions](calibrate.png)",
            "",
            *_contact_lines(contacts, benches * repeats),
            "",
            *_alarm_lines(alarms),
            "",
            *_decision_lines(called, of),
            "",
        ]
    )
    return page


def _cases(name: str, duration: tuple[float, int], benches: int, repeats: int) -> list[tuple]:
    return [(of, name, *duration, 1000 * of + k) for of in range(benches) for k in range(repeats)]


def _measured(case: tuple[int, str, float, int, int]) -> Measured:
    of, name, period_s, periods, seed = case
    return measure(calibrated(of), library()[name], period_s, periods, seed, False)


CHANGES = (
    "nothing",
    "10 mg of fluid",
    "20 mg of fluid",
    "third mode 1 %",
    "coupling of the mode 2 %",
)


def _changes(what: str, benches: int) -> list[tuple[int, str, float]]:
    return [(of, what, duration) for duration in (0.02, 0.1) for of in range(benches)]


def _contradicted(case: tuple[int, str, float]) -> tuple[float, bool]:
    """Whether a record on 12 % gelatine contradicts a calibration, the sensor or its tip changed since."""
    of, what, duration_s = case
    at, tissue = calibrated(of), library()["gel12"]
    contact = hertz_contact(tissue, at.bench.sensor.tip.radius_m, at.bench.contact)
    if "fluid" in what:
        mass_kg = contact.radiation_mass_kg + 1e-6 * float(what.split()[0])
        contact = replace(contact, radiation_mass_kg=mass_kg)
    coupled = CoupledBimorph(sensor_model(at.bench.sensor), contact)
    sensor = coupled.sensor
    if "third" in what:
        natural = sensor.natural_rad_s * np.where(np.arange(sensor.modes) == 2, 1.01, 1)
        coupled = replace(coupled, sensor=replace(sensor, natural_rad_s=natural))
    if "coupling" in what:
        chi = sensor.coupling_rad_s * np.where(np.arange(sensor.modes) == 1, 1.02, 1)
        coupled = replace(coupled, sensor=replace(sensor, coupling_rad_s=chi))
    run = BenchRun(at.bench.sensor, coupled, 7000 + of, BenchEffects())
    signal = excitation(duration_s)
    found = at.estimator(contact_record([run.block(signal)], signal), 0.01, 1e-4)
    return duration_s, found.status is ContactStatus.CONTRADICTED


def _share(inside: Any, digits: int = 3, confidence: float = 0.999) -> str:
    result = stats.binomtest(int(np.sum(inside)), int(np.size(inside)))
    limits = result.proportion_ci(confidence)
    return f"{result.statistic:.{digits}f} ({limits.low:.{digits}f} to {limits.high:.{digits}f})"


def _parameter_lines(made: Sequence[CalibratedBench]) -> list[str]:
    names = made[0].calibration.model.names
    wrong = [at for at in made if np.isnan(at.off).any()]
    right = [at for at in made if not np.isnan(at.off).any()]
    off = np.array([at.off for at in right])  # (benches, p)
    relative = np.median(
        [at.calibration.std / np.abs(at.calibration.model.values) for at in right], axis=0
    )
    determined = np.array([at.calibration.determined for at in right])
    kinds = [name.partition("[")[0] for name in names]
    rows = []
    for kind in dict.fromkeys(kinds):
        which = np.array([each == kind for each in kinds])
        low, high = relative[which].min(), relative[which].max()
        rows.append(
            f"| {kind} | {which.sum()} | {low:.1e} to {high:.1e} "
            f"| {determined[:, which].mean():.2f} | "
            f"{_share(np.abs(off[:, which]) < 1.96)} | {np.abs(off[:, which]).max():.2f} |"
        )
    tip = np.array([at.tip_mass_off for at in made])
    known = np.isfinite(tip)
    return [
        f"## Parameters of {len(made)} sensors",
        "",
        f"In {len(wrong)} of {len(made)} the number of modes is not ten. Coverage is that of 95 % intervals, "
        "with its 99.9 % limits. Not determined in any of them, and said so: capacitance and moduli, which "
        "voltages do not show; without a load the tip's deflections, without a loop-back the gain (tests).",
        "",
        "| parameter | modes | relative deviation, medians | determined | coverage | largest, in deviations |",
        "|---|---:|---|---:|---|---:|",
        *rows,
        f"| all | | | {determined.mean():.3f} | {_share(np.abs(off[determined]) < 1.96)} | "
        f"{np.abs(off[determined]).max():.2f} |",
        f"| tip mass | | | {known.mean():.2f} | {_share(np.abs(tip[known]) < 1.96)} | "
        f"{np.abs(tip[known]).max():.2f} |",
    ]


def _contact_lines(contacts: dict[tuple, list[Measured]], count: int) -> list[str]:
    lines = [
        "## Contacts",
        "",
        f"{count} records of each tissue from rest, force exact, through the estimated sensors. k* is in N/m "
        "at the mode; errors are standard deviations, stated ones medians of total deviations; "
        "coverage is that of 95 % intervals of four figures, with its 99.9 % limits.",
        "",
        "| tissue | record | k* | k' off by | stated | k'' off by | stated | f0 off by [mHz] | stated | "
        "coverage |",
        "|---|---|---|---:|---:|---:|---:|---:|---:|---|",
    ]
    for (name, period_s, periods), done in contacts.items():
        k = np.median([each.found.stiffness_n_per_m for each in done])
        error = np.array([each.error for each in done]).std(axis=0)
        stated = np.median([np.abs(each.error / each.off) for each in done], axis=0)
        off = np.array([each.off for each in done])
        record = f"{1e3 * period_s:g} ms" + (f" x {periods}" if periods > 1 else "")
        lines.append(
            f"| {name} | {record} | {k.real:.1f} + {k.imag:.1f}j | {error[0]:.2f} | {stated[0]:.2f} | "
            f"{error[1]:.2f} | {stated[1]:.2f} | {1e3 * error[2]:.0f} | {1e3 * stated[2]:.0f} | "
            f"{_share(np.abs(off) < 1.96)} |"
        )
    for duration in DURATIONS:
        off = np.array(
            [each.off for key, done in contacts.items() if key[1:] == duration for each in done]
        )
        record = f"{1e3 * duration[0]:g} ms" + (f" x {duration[1]}" if duration[1] > 1 else "")
        lines.append(
            f"| all, largest {np.abs(off).max():.2f} deviations | {record} | | | | | | | | "
            f"{_share(np.abs(off) < 1.96)} |"
        )
    return lines


def _alarm_lines(alarms: dict[str, list[tuple[float, bool]]]) -> list[str]:
    lines = [
        "## What contradicts a calibration",
        "",
        "Share of single records on 12 % gelatine that contradict it, since when something changed.",
        "",
        "| changed | 20 ms | 100 ms |",
        "|---|---:|---:|",
    ]
    for what, found in alarms.items():
        shares = [
            np.mean([alarm for at, alarm in found if at == duration]) for duration in (0.02, 0.1)
        ]
        lines.append(f"| {what} | {shares[0]:.2f} | {shares[1]:.2f} |")
    return lines


def _decision_lines(called: dict[tuple[float, bool], list[Called]], benches: int) -> list[str]:
    low, high = calibrate_decision.PERCENT
    lines = [
        f"## {low:g} against {high:g} % gelatine at 99 %",
        "",
        f"Points on {benches} of the sensors, through the calibration that was estimated of each; castings "
        f"spread by {calibrate_decision.PREPARATION_PERCENT:g} % w/w, contacts are 0.3 to 2 s old. Disturbed: "
        "the force is off by 0.15 mN, the sensor distorts, the contact creeps. Errors are calls of the other "
        "class, with 95 % limits; a casting near the middle stays undecided.",
        "",
        "| block | | points | vibration [ms], median | mean | 90 % | 99 % | errors | undecided | "
        "contradicted | coverage | at nominal contact |",
        "|---|---|---:|---:|---:|---:|---:|---|---|---:|---|---|",
    ]
    for (block_s, disturbed), done in called.items():
        time_ms = 1e3 * np.array([each.time_s for each in done])
        numbers = (np.median(time_ms), time_ms.mean(), *np.quantile(time_ms, (0.9, 0.99)))
        wrong = _share([each.called not in ("", each.truth) for each in done], 5, 0.95)
        lines.append(
            f"| {1e3 * block_s:g} ms | {'disturbed' if disturbed else 'noise alone'} | {len(done)} | "
            + " | ".join(f"{each:.0f}" for each in numbers)
            + f" | {wrong} | {_share([not each.called for each in done], 4, 0.95)} | "
            + f"{np.mean([each.contradicted for each in done]):.4f} | "
            + f"{np.mean([each.distance < INSIDE for each in done]):.3f} | "
            + f"{np.mean([each.nominal < INSIDE for each in done]):.3f} |"
        )
    return lines


def _draw(
    made: Sequence[CalibratedBench],
    contacts: dict[tuple, list[Measured]],
    called: dict[tuple[float, bool], list[Called]],
) -> Figure:
    """Errors over deviations by parameter; k* of each tissue; vibration until a decision."""
    figure = new_figure(15, 5)
    figure.suptitle(f"{len(made)} sensors calibrated from records ({SIMULATED})")
    left, middle, right = figure.subplots(1, 3)
    off = np.array([at.off for at in made if not np.isnan(at.off).any()])
    names = made[0].calibration.model.names
    for k in range(len(names)):
        left.plot(np.full(len(off), k), off[:, k], ".", ms=3, color=f"C{min(k // 10, 4)}")
    for level in (-1.96, 1.96):
        left.axhline(level, color="0.7", lw=0.8)
    labels = [*GROUPS, "electronics"]
    left.set_xticks([4.5, 14.5, 24.5, 34.5, 41.5], labels, rotation=20, fontsize="small")
    left.set(ylabel="error [standard deviations]", ylim=(-5, 5), title="parameters", xlim=(-1, 44))
    for k, name in enumerate(TISSUES):
        done = contacts[name, 0.02, 1]
        at = np.array([each.found.stiffness_n_per_m for each in done])
        middle.plot(at.real, at.imag, ".", ms=2, color=f"C{k}")
        true = np.median([each.found.stiffness_n_per_m - complex(*each.error[:2]) for each in done])
        middle.plot(true.real, true.imag, "k+", ms=9)
        middle.annotate(name, (true.real, true.imag), xytext=(6, 5), textcoords="offset points")
    middle.set(xlabel="k' [N/m]", ylabel="k'' [N/m]", title="contacts, 20 ms (+: median truth)")
    for (block_s, disturbed), done in called.items():
        time_ms = np.sort([1e3 * each.time_s for each in done])
        share = np.arange(1, time_ms.size + 1) / time_ms.size
        label = f"blocks of {1e3 * block_s:g} ms" + (", disturbed" if disturbed else "")
        right.step(time_ms, share, where="post", label=label)
    right.axvline(20, color="0.7", lw=0.8)
    right.set(xlabel="vibration [ms]", ylabel="share of points decided", ylim=(0.9, 1.002))
    right.set(title="10 against 12 % gelatine at 99 %", xscale="log")
    right.legend(loc="lower right")
    return figure
