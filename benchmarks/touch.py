# SPDX-License-Identifier: Apache-2.0
"""First contact detected by the resonance and by the load cell, on the same approaches; simulated.

The beam comes down on tissue at a constant speed while it is driven at one line near its resonance. The
contact changes in steps of 2 ms; between them the response is exact, and the state is carried over.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.lock_in_touch import ScatterTouch, lock_in
from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.observer import TouchDetector
from tactile_resonance.report.drawing import SIMULATED, new_figure, save_figure
from tactile_resonance.simulation.plant.tip import SprungIndenter
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.sensor.bimorph import sensor_modes
from tactile_resonance.simulation.sensor.response import Lines, ResponseStream
from tactile_resonance.simulation.tissue.indenter import Indenter
from tactile_resonance.simulation.tissue.library import read_tissues

RATE_HZ, LINE_HZ, WINDOW_S, STEP_S = 50_000.0, 250.0, 0.008, 0.002
DRIVE_V, NOISE_V = 1.0, 5e-4
CELL_NOISE_N, TARE_S = 1e-3, 0.4
FALSE_ALARM = 1e-7
AIR_N = 1e-18  # a contact that is none, with the states of one
AIR_S, DEEPEST_M = 2.0, 0.6e-3
SPEEDS_M_S = (4e-3, 1e-3, 0.25e-3)
TISSUES = ("cortex", "liver", "gel10", "gel16")
REFERENCE_S = 0.4
HOLD_S = 0.1  # age of the contact in its stiffness: this is a young one


@dataclass(frozen=True)
class Approach:
    """What one approach gave: time after the touch, depth of the robot and true force, for each sensor."""

    resonance: tuple[float, float, float]
    cell: tuple[float, float, float]


def approach(bench: SimulatedBench, name: str, speed_m_s: float, seed: int) -> Approach:
    """Come down by DEEPEST_M past the first touch."""
    library, rng = read_tissues(), np.random.default_rng(seed)
    tissue = library[name]
    ball = Indenter(
        tissue,
        tip_radius_m=bench.sensor.tip.radius_m,
        poisson_ratio=library.contact.poisson_ratio,
    )
    tip = SprungIndenter(ball, sensor_modes(bench.sensor).spring)
    # the touch falls anywhere within a window
    air = round(AIR_S / STEP_S) + int(rng.integers(round(WINDOW_S / STEP_S)))
    after = round(DEEPEST_M / speed_m_s / STEP_S)
    depth = speed_m_s * STEP_S * (np.arange(after) + rng.random())
    force = np.array([max(0.0, (tip.step(d, STEP_S), ball.force_n)[1]) for d in depth])
    lines = Lines(np.array([2]), np.array([DRIVE_V + 0j]), RATE_HZ, round(WINDOW_S * RATE_HZ))
    y = _sensor(bench, tissue, np.concatenate([np.zeros(air), force]), lines)
    y = y + NOISE_V * rng.standard_normal(y.size)
    windows = lock_in(y, RATE_HZ, LINE_HZ, WINDOW_S)
    settled = round((AIR_S - REFERENCE_S) / WINDOW_S)  # the start from rest has died out
    last = air * STEP_S // WINDOW_S
    test = ScatterTouch(windows[settled : int(last)], FALSE_ALARM)
    told = np.flatnonzero(test.statistic(windows[int(last) :]) > test.threshold)
    ends = (int(last) + 1 + told) * WINDOW_S - air * STEP_S
    detector = TouchDetector(CELL_NOISE_N, CELL_NOISE_N / np.sqrt(TARE_S / STEP_S))
    measured = np.concatenate([np.zeros(60), force]) + CELL_NOISE_N * rng.standard_normal(
        60 + after
    )
    seen = next((n - 60 for n, f in enumerate(measured) if detector.add(f)), None)

    def at(time_s: float | None) -> tuple[float, float, float]:
        if time_s is None or time_s >= after * STEP_S:
            return np.nan, np.nan, np.nan
        step = max(0, round(time_s / STEP_S))
        return time_s, float(depth[step]), float(force[step])

    return Approach(
        at(float(ends[0]) if ends.size else None), at(None if seen is None else seen * STEP_S)
    )


def _sensor(bench: SimulatedBench, tissue, force: FloatArray, lines: Lines) -> FloatArray:
    """Sensor voltage while the force changes step by step."""
    coupled = bench.coupled(tissue, force_n=AIR_N, hold_time_s=HOLD_S)
    stream, parts, now = ResponseStream(coupled.modal), [], AIR_N
    for value in force:
        if value > 0 and abs(value - now) > 1e-9:
            after = bench.coupled(tissue, force_n=value, hold_time_s=HOLD_S)
            stream.become(after.modal, coupled.carry_state(stream.state, after))
            coupled, now = after, value
        parts.append(stream.play(lines, round(STEP_S * lines.sample_rate_hz)))
    return np.concatenate(parts)


def false_alarms(windows: int, probability: float) -> tuple[int, float]:
    """False alarms in so many windows in air at a probability, and how many are expected."""
    rng, block = np.random.default_rng(0), 400
    length = round(WINDOW_S * RATE_HZ)
    count = 0
    for _ in range(windows // block):
        noise = lock_in(
            NOISE_V * rng.standard_normal((block + 50) * length), RATE_HZ, LINE_HZ, WINDOW_S
        )
        test = ScatterTouch(noise[:50], probability)
        count += int(np.sum(test.statistic(noise[50:]) > test.threshold))
    return count, windows // block * block * probability


def run(output: Path, quick: bool) -> str:
    """Measure, draw ``touch.png`` into `output`, and return the page."""
    bench, repeats = SimulatedBench.from_configuration(), 2 if quick else 5
    found: dict[tuple[str, float], list[Approach]] = {}
    with tqdm(
        total=len(TISSUES) * len(SPEEDS_M_S) * repeats, desc="approaches", unit=""
    ) as progress:
        for name in TISSUES:
            for speed in SPEEDS_M_S:
                found[name, speed] = []
                for seed in range(repeats):
                    found[name, speed].append(approach(bench, name, speed, seed))
                    progress.update()
    count, expected = false_alarms(4_000 if quick else 40_000, 1e-3)
    text = _page(found, repeats, count, expected)
    _draw(found, output / "touch.png")
    return text


def _worst(row: list[Approach], sensor: str, which: int, scale: float) -> str:
    values = np.array([getattr(a, sensor)[which] for a in row])
    if np.isnan(values).any():
        return f"not told in {int(np.isnan(values).sum())}"
    return f"{scale * np.median(values):.3g} / {scale * values.max():.3g}"


def _page(
    found: dict[tuple[str, float], list[Approach]], repeats: int, count: int, expected: float
) -> str:
    rows = [
        "# First contact: resonance and load cell",
        "",
        f"Simulated, not measured: `tactile_resonance benchmark touch`, {repeats} approaches a row at constant",
        "speed, median / worst. Resonance: the beam is driven at 1 V peak on one line at 250 Hz, its",
        "amplitude is taken over windows of 8 ms (two periods) and tested against 0.4 s of free air, false",
        f"alarm probability {FALSE_ALARM:g} a window; 0.5 mV rms noise in 25 kHz. Load cell: 1 mN rms at",
        "500 Hz, means over 8, 24 and 72 ms against five standard deviations, as the controller takes them.",
        "Force: true, when the touch is told. Transport of samples and commands comes on top of either.",
        "",
        "| Tissue, speed | resonance: after ms | depth um | force mN | cell: after ms | depth um | force mN |",
        "|---|---|---|---|---|---|---|",
    ]
    for (name, speed), row in found.items():
        cells = [
            _worst(row, sensor, which, scale)
            for sensor in ("resonance", "cell")
            for which, scale in ((0, 1e3), (1, 1e6), (2, 1e3))
        ]
        rows.append(f"| {name}, {1e3 * speed:g} mm/s | {' | '.join(cells)} |")
    rows += [
        "",
        f"False alarms in air at a probability of 1e-3 a window: {count}, expected {expected:.0f}.",
        "",
        "What the sum leaves out: vibration of the robot that moves the clamp (the load cell does not see it",
        "under the sample, the beam does), drift of the resonance with temperature, films of liquid. The first",
        "two belong to the scatter in air, which raises the threshold by itself where they are there while the",
        "reference is taken; a film is a touch.",
        "",
        "Poles of whole blocks tell a touch only at the end of a block: with lines 2.5 Hz apart after 0.4 s,",
        "in which a tip at 4 mm/s goes 1.6 mm. Told from poles, a touch needs an approach at 0.25 mm/s or",
        "less (0.1 mm a block), or shorter blocks.",
        "",
        "Live (`touch_from_poles` of contact_node) that is the end of a record and what comes after it: the",
        "FRF, the poles, the messages. Measurements of one or two periods, asked for one after another, are",
        "what it needs: the poles of a longer one are those of all its periods, most of them of air. On",
        "gelatine the load cell is first, at 0.25 mm/s too; on softer tissue, where the cell takes a",
        "second, they may be level. One period of one realisation has no covariance from noise; that from",
        "the residuals of the fit is taken then.",
        "",
        "![First contact](touch.png)",
        "",
    ]
    return "\n".join(rows)


def _draw(found: dict[tuple[str, float], list[Approach]], path: Path) -> None:
    figure = new_figure(9, 4.5)
    axes = figure.subplots(1, 2)
    for (name, speed), row in found.items():
        for place, which, scale in ((axes[0], 2, 1e3), (axes[1], 1, 1e6)):
            for sensor, colour in (("resonance", "tab:blue"), ("cell", "tab:orange")):
                values = scale * np.array([getattr(a, sensor)[which] for a in row])
                label = f"{name}, {1e3 * speed:g} mm/s"
                place.plot(values, [label] * len(values), "|", color=colour, markersize=10)
    for place, label in zip(
        axes, ("true force when told [mN]", "depth when told [um]"), strict=True
    ):
        place.set_xscale("log")
        place.set_xlabel(label)
        place.invert_yaxis()
    axes[1].set_yticklabels([])
    figure.suptitle(f"First contact: resonance (blue), load cell (orange) ({SIMULATED})")
    save_figure(figure, path)
