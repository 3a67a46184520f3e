# SPDX-License-Identifier: Apache-2.0
"""Contact control in virtual time: how soon 1 cN is there, how far above it goes, how well it is kept.

Over tip radius, modulus, relaxation time, height and tilt of the surface, with 1 mN rms sensor noise at
500 Hz. Errors are of the true force along the tip's axis. Everything is simulated.
"""

from __future__ import annotations

import itertools
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from tqdm import tqdm

from benchmarks import contact_drivers, contact_living_table
from benchmarks.contact_case import (
    FORCE_N,
    Case,
    Outcome,
    Setup,
    contact_series,
    run_controller,
    stiff_peaks,
)
from benchmarks.contact_drivers import DriversResult
from benchmarks.contact_laws import LAWS, run_law
from tactile_resonance.contact.payload import Mount
from tactile_resonance.report.drawing import SIMULATED, new_figure, save_figure

RADII_M = (1.5e-3, 2.25e-3, 3e-3)
MODULI_PA = (2e3, 5e3, 10e3, 20e3, 40e3)
RELAXATIONS_S = (0.5, 1.0, 3.0)
HEIGHTS_M = (-1e-3, 0.0, 1e-3)
TILTS_RAD = (0.0, np.deg2rad(10.0))

REFERENCE = Setup("rigid tip, cell under the sample")
SETUPS = (
    REFERENCE,
    Setup("the same without robot jitter", jitter_m=0.0),
    Setup("beam in series, cell under the sample", beam=True),
    Setup("rigid tip, cell on the tool", mount=Mount.TOOL),
    Setup("beam in series, cell on the tool", beam=True, mount=Mount.TOOL),
    Setup("rigid tip, 3 mN noise", noise_n=3e-3),
)
GOALS = {
    REFERENCE.name: (0.5, 0.8, 0.10, 0.04),
    "the same without robot jitter": (0.5, 0.8, 0.05, 0.04),
}
"""Ready, median and p95 [s]; overshoot p95; error of the mean p95."""


REASONS = (
    "What bounds the time: the softest tissue is 1.75 mm deep at 1 cN, 0.35 s at the 5 mm/s that the limits",
    "allow in contact. The beam (14.8 N/m) bends 0.67 mm at 1 cN, 0.13 s more, and makes all tissue softer,",
    "hence the smaller overshoot. A tool of 30 g on the cell adds its inertia: the part of the robot's own",
    "commands is known and taken off (accelerations 0.3 m/s2, approach 3 mm/s), the part of its vibration",
    "is noise, which makes zero and estimate less certain.",
)


def cases(full: bool) -> list[Case]:
    """The grid of 270, or 25 spread over it."""
    grid = [
        Case(radius, modulus, relaxation, height, tilt, seed)
        for seed, (radius, modulus, relaxation, height, tilt) in enumerate(
            itertools.product(RADII_M, MODULI_PA, RELAXATIONS_S, HEIGHTS_M, TILTS_RAD)
        )
    ]
    return grid if full else grid[5::11]


def run(output: Path, quick: bool, full: bool = False) -> str:
    """Measure, draw ``contact.png`` into `output`, and return the page.

    Parameters
    ----------
    output : Path
        Folder for the figure.
    quick : bool
        Few cases: shows that everything works, figures are rough.
    full : bool
        All 270 cases, 100 a row on living tissue, and 1000 contacts in a row.
    """
    chosen = cases(full)[:: 3 if quick else 1]
    jobs = [(setup.name, setup, "") for setup in SETUPS]
    jobs += [(f"{law} *", REFERENCE, law) for law in LAWS]
    outcomes: dict[str, list[Outcome]] = {}
    drivers = contact_drivers.available() or contact_drivers.run()
    with (
        ProcessPoolExecutor(2, mp_context=get_context("fork")) as pool,
        tqdm(total=len(jobs) * len(chosen), desc="contacts", unit="") as progress,
    ):
        for name, setup, law in jobs:
            outcomes[name] = []
            for done in pool.map(_run_case, [(case, setup, law) for case in chosen]):
                outcomes[name].append(done)
                progress.update()
    living = contact_living_table.run(100 if full else 1 if quick else 6)
    series = contact_series(1000 if full else 20 if quick else 60)
    peaks = stiff_peaks(10 if quick else 60)
    text = _report(outcomes, series, peaks, drivers, len(chosen)) + "\n" + living
    _draw(outcomes, series, chosen, output / "contact.png")
    return text


def _run_case(job: tuple[Case, Setup, str]) -> Outcome:
    """One case, with our controller or with a simple law by its name."""
    case, setup, law = job
    return run_law(case, setup, LAWS[law]()) if law else run_controller(case, setup)


def _quantiles(values: list[float], share: float = 100.0) -> tuple[float, float]:
    known = np.array(values)
    known = share * known[~np.isnan(known)]
    if known.size == 0:
        return np.nan, np.nan
    # a contact that failed counts as infinitely late
    middle, high = np.quantile(known, [0.5, 0.95], method="higher")
    return float(middle), float(high)


def _row(name: str, row: list[Outcome]) -> str:
    ready = _quantiles([o.ready_s for o in row], 1.0)
    over = _quantiles([o.overshoot for o in row])
    error = _quantiles([o.mean_error for o in row])
    bounces = sum(o.bounces for o in row)
    failed = sum(not np.isfinite(o.ready_s) for o in row)
    return (
        f"| {name} | {ready[0]:.2f} / {ready[1]:.2f} | {over[0]:.1f} / {over[1]:.1f} | "
        f"{error[0]:.1f} / {error[1]:.1f} | {bounces} | {failed} |"
    )


def _drivers(result: DriversResult | str) -> list[str]:
    if isinstance(result, str):
        return [f"Through the drivers: not run, {result}."]
    return [
        f"Through the drivers: {len(result.outcomes)} contacts on the wall clock, over ur_rtde and python-can,",
        "with a simulated robot and cell at 500 Hz and 1 kHz, rigid tip, on four tissues of the library,",
        f"surface +-1 mm, tilt 0 and 10 degrees. The simulation stalled {result.stalls} times, "
        f"{result.repeated} runs were repeated;",
        f"{result.overruns} of {result.cycles} cycles of the loop began more than a period late.",
    ]


def _report(
    outcomes: dict[str, list[Outcome]],
    series: np.ndarray,
    peaks: np.ndarray,
    drivers: DriversResult | str,
    count: int,
) -> str:
    rows = [
        "# Contact control",
        "",
        f"Simulated, not measured: `tactile_resonance benchmark contact` (`--full` for 270 cases), "
        f"{count} cases a row.",
        "Tip radius 1.5-3 mm, modulus of a sudden step 2-40 kPa of which 60 % relax in 0.5-3 s, surface",
        "+-1 mm from where it is expected, tilted by up to 10 degrees that the controller does not know;",
        "noise 1 mN rms at 500 Hz, robot with 4 ms dead time, 10 ms lag and 3 um rms vibration (but where",
        f"a row says otherwise). Aim {1e3 * FORCE_N:g} mN. Ready: from the first touch until the contact "
        "is called ready.",
        "Overshoot: largest true force until a second after that. Error: of the mean true force over that",
        "second. Failed: never ready. Rows with * are simple laws on the first setup.",
        "",
        "| Setup | ready, median / p95 s | overshoot, median / p95 % | error, median / p95 % | bounces "
        "| failed |",
        "|---|---|---|---|---|---|",
    ]
    shown = dict(outcomes)
    if not isinstance(drivers, str):
        shown["through the drivers"] = drivers.outcomes
    for name, row in shown.items():
        rows.append(_row(name, row))
    rows += ["", *_drivers(drivers)]
    rows += ["", *REASONS]
    rows += ["", "| Goal | asked for | found | |", "|---|---|---|---|"]
    for name, (middle, high, overshoot, error_goal) in GOALS.items():
        row = outcomes[name]
        ready = _quantiles([o.ready_s for o in row], 1.0)
        found = (
            ("ready, median", middle, ready[0], "s"),
            ("ready, p95", high, ready[1], "s"),
            ("overshoot, p95", 100 * overshoot, _quantiles([o.overshoot for o in row])[1], "%"),
            (
                "error of the mean, p95",
                100 * error_goal,
                _quantiles([o.mean_error for o in row])[1],
                "%",
            ),
            ("bounces", 0, sum(o.bounces for o in row), ""),
        )
        for what, goal, value, unit in found:
            verdict = "met" if value <= goal else "missed"
            rows.append(f"| {name}: {what} | {goal:g} {unit} | {value:.2f} {unit} | {verdict} |")
    causes = Counter(
        f"{name}: {o.cause}" for name, row in shown.items() for o in row if o.cause != "none"
    )
    rows += ["", *(f"Failed, {cause} ({count})." for cause, count in causes.items())]
    stated = np.array([o.stated_error for name in outcomes for o in outcomes[name]])
    stated = stated[~np.isnan(stated)]
    std = np.array([o.stated_std for o in outcomes[REFERENCE.name]])
    slope, slope_std = _trend(series)
    rows += [
        "",
        f"The mean force that a result states has a stated standard deviation of "
        f"{100 * np.nanmedian(std):.2f} % (median,",
        f"first row); its errors are {np.sqrt(np.mean(stated**2)):.2f} of the stated deviation (rms, all "
        "rows; 1: honest).",
        "",
        f"{len(series)} contacts in a row at one place: mean true force {1e3 * series.mean():.3f} mN, "
        f"standard deviation {1e3 * series.std(ddof=1):.3f} mN,",
        f"drift {1e6 * slope * len(series):.1f} +- {1e6 * slope_std * len(series):.1f} uN over all of them "
        f"({abs(slope) / slope_std:.1f} standard deviations: {_verdict(slope, slope_std)}).",
        "",
        f"On tissue of 400 kPa (370 N/m at 1 cN, ten times the stiffest expected) the true force reached "
        f"{1e3 * np.median(peaks):.0f} mN in",
        f"the median and {1e3 * peaks.max():.0f} mN at most, in {len(peaks)} contacts; abort 30 mN, hard "
        "limit 50 mN.",
        "",
        "![Contact control](contact.png)",
        "",
    ]
    return "\n".join(rows) + "\n"


def _trend(series: np.ndarray) -> tuple[float, float]:
    """Slope per contact and its standard deviation [N]."""
    n = np.arange(len(series)) - (len(series) - 1) / 2
    slope = float(n @ series / (n @ n))
    residual = series - series.mean() - slope * n
    return slope, float(residual.std(ddof=2) / np.sqrt(n @ n))


def _verdict(slope: float, slope_std: float) -> str:
    return "none to be seen" if abs(slope) < 2.58 * slope_std else "drift, at 99 %"


def _draw(
    outcomes: dict[str, list[Outcome]], series: np.ndarray, chosen: list[Case], path: Path
) -> None:
    figure = new_figure(13, 9)
    axes = figure.subplots(2, 2)
    names = list(outcomes)
    parts = (
        ("from touch to ready [s]", lambda o: o.ready_s, 1.0, 0.5),
        ("overshoot [% of the force]", lambda o: o.overshoot, 100.0, 10.0),
        ("error of the mean over 1 s [% of the force]", lambda o: o.mean_error, 100.0, 4.0),
    )
    for place, (label, value, scale, goal) in zip(axes.flat[:3], parts, strict=True):
        for row, name in enumerate(names):
            made = [o for o in outcomes[name] if np.isfinite(o.ready_s)]
            values = np.array([scale * value(o) for o in made])
            values = values[np.isfinite(values)]
            if values.size == 0:
                continue
            colour = "tab:grey" if name.endswith("*") else "tab:blue"
            place.plot(
                values, np.full(values.size, row), "|", color=colour, alpha=0.4, markersize=12
            )
            place.plot(np.median(values), row, "o", color=colour)
            place.plot(np.quantile(values, 0.95), row, ">", color=colour)
        place.axvline(goal, color="tab:red", linewidth=1)
        place.set_yticks(range(len(names)), names if place is not axes[0, 1] else [])
        place.invert_yaxis()
        place.set_xlabel(label)
        if label.startswith("from"):
            place.set_xscale("log")
    _draw_example(axes[1, 1], chosen)
    figure.suptitle(
        f"Contact at 1 cN: dot median, arrow p95, red the goal of the first row ({SIMULATED})"
    )
    save_figure(figure, path)


def _draw_example(place: Axes, chosen: list[Case]) -> None:
    """Force through time on the softest and the stiffest tissue, ours and PI."""
    soft = Case(1.5e-3, 2e3, 1.0, 0.0, 0.0, 1)
    stiff = Case(3e-3, 40e3, 1.0, 0.0, 0.0, 1)
    for case, colour in ((soft, "tab:green"), (stiff, "tab:orange")):
        for law, style in ((None, "-"), (LAWS["fixed PI"], ":")):
            record: list[float] = []
            if law is None:
                run_controller(case, REFERENCE, record=record)
            else:
                run_law(case, REFERENCE, law(), record=record)
            force = np.array(record)
            touch = int(np.argmax(force > 0))
            time = (np.arange(force.size) - touch) * 0.002
            name = f"{case.modulus_pa / 1e3:g} kPa, {'ours' if law is None else 'fixed PI'}"
            place.plot(time, 1e3 * force, style, color=colour, label=name, linewidth=1)
    place.axhline(1e3 * FORCE_N, color="grey", linewidth=0.8)
    place.set_xlim(-0.05, 1.2)
    place.set_xlabel("time since the first touch [s]")
    place.set_ylabel("true force [mN]")
    place.legend(fontsize=8)
