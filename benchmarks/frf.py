# SPDX-License-Identifier: Apache-2.0
"""FRF estimation: run time against a bare Fourier transform, error against truth.

Simulated records, 50 kHz, 20000 samples per period, 3997 lines from 10 Hz to 10 kHz, 8 periods from
rest, ``G = 0.1 + 2 zeta w0^2 / (s^2 + 2 zeta w0 s + w0^2)`` with f0 = 250 Hz, white noise on the
output and 20 dB less on the input.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
import scipy.fft

from tactile_resonance._typing import FloatArray, IntArray
from tactile_resonance.frf.estimate import frf_of_realisations, frf_of_record
from tactile_resonance.frf.measurement import MeasurementFrf
from tactile_resonance.frf.result import FRF
from tactile_resonance.frf.spectra import (
    Spectrum,
    averaged_spectra,
    mean_spectra,
    transient_free_spectra,
)
from tactile_resonance.multisine import Excitation, design_multisine
from tactile_resonance.record import Channel, Record

matplotlib.use("Agg")
import matplotlib.pyplot as plt

Array = FloatArray

RATE_HZ, SAMPLES, PERIODS = 50e3, 20000, 8
BAND_HZ = (200.0, 300.0)
F0_HZ = 250.0
CASES = ((0.02, 40.0), (0.02, 60.0), (0.01, 20.0), (0.01, 60.0), (0.05, 40.0))
"""Damping ratio and output signal-to-noise ratio [dB]."""


class Plant:
    """Records of one realisation from rest, with the exact initial transient."""

    def __init__(self, damping_ratio: float, snr_db: float, realisation: int = 0) -> None:
        self.excitation: Excitation = design_multisine(
            sample_rate_hz=RATE_HZ, samples_per_period=SAMPLES, realisation=realisation
        )
        w0 = 2 * np.pi * F0_HZ
        gain = 2 * damping_ratio * w0**2
        pole = w0 * (-damping_ratio + 1j * np.sqrt(1 - damping_ratio**2))
        s = 2j * np.pi * self.excitation.frequency_hz
        self.g = 0.1 + gain / ((s - pole) * (s - pole.conjugate()))  # (F,)
        spectrum = self.excitation.spectrum()
        u = spectrum[self.excitation.harmonics]
        self.u_power = np.abs(u) ** 2
        spectrum[self.excitation.harmonics] = u * self.g
        self.steady = np.stack(
            [np.fft.irfft(spectrum * SAMPLES, SAMPLES), self.excitation.period()]
        )  # (2, N), [Y; U]
        # the steady response of the pole at t = 0 is what a start from rest lacks
        residue = gain / (pole - pole.conjugate())
        state = np.sum(u / (s - pole) + u.conj() / (-s - pole))
        self.decay, self.pole = -2 * residue * state, pole
        self.sigma_y = np.std(self.steady[0]) * 10 ** (-snr_db / 20)
        self.sigma_u = np.std(self.steady[1]) * 10 ** (-(snr_db + 20) / 20)

    def records(self, rng: np.random.Generator, periods: int) -> tuple[Array, Array]:
        """Noisy u and y, (P, N) each."""
        t = np.arange(periods * SAMPLES) / RATE_HZ
        y, u = np.tile(self.steady, periods)
        y = y + np.real(self.decay * np.exp(self.pole * t))
        y = y + self.sigma_y * rng.standard_normal(y.size)
        u = u + self.sigma_u * rng.standard_normal(u.size)
        return u.reshape(periods, SAMPLES), y.reshape(periods, SAMPLES)

    @property
    def bound(self) -> Array:
        """(F,) least variance of G from 8 periods without transient."""
        noise = self.sigma_y**2 + np.abs(self.g) ** 2 * self.sigma_u**2
        return noise / (SAMPLES * PERIODS) / self.u_power


def run(output: Path, quick: bool) -> str:
    """Measure, draw ``frf.png`` into `output`, and return the page.

    Parameters
    ----------
    output : Path
        Folder for the figure.
    quick : bool
        Few repetitions: shows that everything works, figures are rough.
    """
    timing = measure_timing(10 if quick else 150)
    accuracy = {case: measure_accuracy(*case, runs=2 if quick else 40) for case in CASES}
    text = _report(timing, accuracy)
    _draw(timing, accuracy, output / "frf.png")
    return text


def measure_timing(repetitions: int) -> dict[str, tuple[float, Array, float | None]]:
    """Per task: median time [s], its ratios to the bare transform run just before, and the goal."""
    # The allocator keeps what a process has once used; without this, fresh pages for every call
    # would double the time of the bare transform and flatter all ratios.
    np.ones(4_000_000)
    u, y = Plant(0.02, 40.0).records(np.random.default_rng(0), PERIODS)
    u_single, y_single = u.astype(np.float32)[None], y.astype(np.float32)[None]
    lines = design_multisine(sample_rate_hz=RATE_HZ, samples_per_period=SAMPLES).harmonics
    frequency = lines * (RATE_HZ / SAMPLES)
    inside = lines[(frequency >= BAND_HZ[0]) & (frequency <= BAND_HZ[1])]

    def transform() -> tuple:
        return scipy.fft.rfft(u.ravel()), scipy.fft.rfft(y.ravel())

    excitation = design_multisine(
        sample_rate_hz=RATE_HZ, samples_per_period=SAMPLES, periods=PERIODS
    )
    blocks = [
        Record(Channel(u[k]), Channel(y[k]), RATE_HZ, SAMPLES, block_index=k)
        for k in range(PERIODS)
    ]
    live: list[MeasurementFrf] = []

    def begin() -> None:
        live[:] = [MeasurementFrf(1, bins_band_hz=BAND_HZ)]
        for block in blocks[:-1]:
            live[0].add(block, excitation)

    record = Spectrum.of(u, y)
    transient_free_spectra(record, lines)

    def frf(u: Array, y: Array, lines: IntArray) -> FRF:
        return frf_of_record(Spectrum.of(u, y), lines, sample_rate_hz=RATE_HZ)

    nothing: Callable = lambda: None  # noqa: E731
    tasks: dict[str, tuple[Callable, Callable, float | None]] = {
        "bare real FFT, 2 channels": (nothing, transform, None),
        "spectra of the record, 2 channels": (nothing, lambda: Spectrum.of(u, y).bins, None),
        "local polynomial part alone": (nothing, lambda: transient_free_spectra(record, lines), None),
        "whole FRF with covariance": (
            nothing,
            lambda: frf(u[None], y[None], lines),
            1.3,
        ),
        "the same from float32 records": (
            nothing,
            lambda: frf(u_single, y_single, lines),
            1.3,
        ),
        "FRF of 200-300 Hz": (
            nothing,
            lambda: frf(u[None], y[None], inside),
            1.3,
        ),
        "live, 8th block: FRF, bins of 200-300 Hz, faults": (
            begin,
            lambda: live[0].add(blocks[-1], excitation),
            None,
        ),
    }
    seconds: dict[str, list[float]] = {name: [] for name in tasks}
    ratios: dict[str, list[float]] = {name: [] for name in tasks}
    for repetition in range(repetitions + 3):
        for name, (prepare, task, _) in tasks.items():
            reference = _best_call(nothing, transform)
            own = _best_call(prepare, task)
            if repetition >= 3:
                seconds[name].append(own)
                ratios[name].append(own / reference)
    return {
        name: (float(np.median(seconds[name])), np.array(ratios[name]), goal)
        for name, (_, _, goal) in tasks.items()
    }


def _best_call(prepare: Callable, task: Callable) -> float:
    """Least seconds of four calls in a row: without interruptions, in memory already its own."""
    seconds = []
    for _ in range(4):
        prepare()
        start = time.perf_counter()
        task()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def measure_accuracy(
    damping_ratio: float, snr_db: float, runs: int
) -> dict[str, tuple[float, float, float]]:
    """Per method: MSE over bound in 200-300 Hz, over all lines, and stated variance over MSE."""
    plants = [Plant(damping_ratio, snr_db, realisation) for realisation in range(2)]
    plant = plants[0]
    lines = plant.excitation.harmonics
    f = plant.excitation.frequency_hz
    inside = (f >= BAND_HZ[0]) & (f <= BAND_HZ[1])
    squares: dict[str, list[Array]] = {}
    stated: dict[str, list[Array]] = {}
    for seed in range(runs):
        rng = np.random.default_rng([seed, int(snr_db)])
        record = Spectrum.of(*(x[None] for x in plant.records(rng, PERIODS)))
        estimates: dict[str, FRF] = {
            f"mean of {PERIODS - skip} periods" + (
                ", the first dropped" if skip else ""
            ): frf_of_realisations(
                averaged_spectra(record, lines, unsettled_periods=skip), sample_rate_hz=RATE_HZ
            )
            for skip in (0, 1)
        }
        for order in (2, 4, 6):
            estimates[f"fast, order {order}"] = frf_of_realisations(
                mean_spectra(record, lines, order=order), sample_rate_hz=RATE_HZ
            )
        halves = [p.records(rng, PERIODS // 2) for p in plants]
        u, y = (np.stack(channel) for channel in zip(*halves, strict=True))
        estimates[f"robust, 2 realisations of {PERIODS // 2} periods, order 2"] = frf_of_record(
            Spectrum.of(u, y), lines, sample_rate_hz=RATE_HZ
        )
        for name, frf in estimates.items():
            variance = frf.variance_noise
            assert variance is not None  # every method here has two periods or more
            squares.setdefault(name, []).append(np.abs(frf.g - plant.g) ** 2 / plant.bound)
            stated.setdefault(name, []).append(variance / plant.bound)
    result = {}
    for name in squares:
        error, variance = np.mean(squares[name], axis=0), np.mean(stated[name], axis=0)  # (F,)
        result[name] = (
            float(error[inside].mean()),
            float(error.mean()),
            float(variance[inside].mean() / error[inside].mean()),
        )
    return result


def _report(timing: dict, accuracy: dict) -> str:
    rows = [
        "# FRF estimation",
        "",
        "Simulated records: 3997 lines, 8 periods of 20000 samples, two channels, one thread.",
        "Each time is the best of four calls in a row, set against that of a bare real FFT of both",
        "channels (double precision) just before; medians over repetitions, and the middle half of",
        "the ratios.",
        "",
        "| Task | ms | x FFT | middle half | goal |",
        "|---|---|---|---|---|",
    ]
    for name, (seconds, ratios, goal) in timing.items():
        low, middle, high = np.quantile(ratios, [0.25, 0.5, 0.75])
        verdict = "" if goal is None else f"<= {goal:g}: {'met' if middle <= goal else 'missed'}"
        rows.append(
            f"| {name} | {1e3 * seconds:.2f} | {middle:.2f} | {low:.2f}-{high:.2f} | {verdict} |"
        )
    rows += [
        "",
        "Mean square error over the least variance possible from 8 periods in steady state, in",
        "200-300 Hz around the mode / over all lines; in brackets the stated noise variance over",
        "the mean square error in 200-300 Hz (1: honest). Columns: damping ratio, output",
        "signal-to-noise ratio.",
        "",
    ]
    titles = [f"{100 * zeta:g} %, {snr:g} dB" for zeta, snr in accuracy]
    rows += ["| Method | " + " | ".join(titles) + " |", "|---|" + "---|" * len(titles)]
    for method in next(iter(accuracy.values())):
        cells = [
            f"{_short(case[method][0])} / {_short(case[method][1])} ({_short(case[method][2])})"
            for case in accuracy.values()
        ]
        rows.append(f"| {method} | " + " | ".join(cells) + " |")
    return "\n".join(rows) + "\n"


def _short(value: float) -> str:
    return f"{value:.2f}" if 0.01 <= value < 10 else f"{value:.2g}"


def _draw(timing: dict, accuracy: dict, path: Path) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 5.2), layout="constrained")
    names = list(timing)[1:]
    for row, name in enumerate(names):
        _, ratios, goal = timing[name]
        low, middle, high = np.quantile(ratios, [0.25, 0.5, 0.75])
        left.barh(row, middle, color="tab:blue", height=0.6)
        left.plot([low, high], [row, row], color="black", linewidth=1)
        if goal is not None:
            left.plot([goal, goal], [row - 0.4, row + 0.4], color="tab:red", linewidth=2)
    left.set_yticks(range(len(names)), names)
    left.invert_yaxis()
    left.axvline(1, color="grey", linewidth=0.8, linestyle=":")
    left.set_xlabel("time / bare real FFT of the record (red: goal, black: middle half)")
    left.set_title("Run time")
    x = np.arange(len(accuracy))
    methods = list(next(iter(accuracy.values())))
    for k, method in enumerate(methods):
        values = [case[method][0] for case in accuracy.values()]
        right.plot(x, values, marker="osv^D*"[k % 6], label=method, linestyle=":")
    right.axhline(1, color="grey", linewidth=0.8)
    right.set_yscale("log")
    right.set_xticks(x, [f"{100 * zeta:g} %\n{snr:g} dB" for zeta, snr in accuracy])
    right.set_xlabel("damping ratio and output signal-to-noise ratio")
    right.set_ylabel("mean square error / bound, 200-300 Hz")
    right.set_title("Error against truth (simulated)")
    figure.legend(loc="outside lower right", ncols=2, fontsize=8)
    figure.savefig(path, dpi=130)
    plt.close(figure)
