# SPDX-License-Identifier: Apache-2.0
"""Tables of the contacts on living tissue: all rows are run, two cases at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
from tqdm import tqdm

from benchmarks.contact_laws import LIVING_LAWS
from benchmarks.contact_living import (
    BONE_ROWS,
    CLINGING_ROWS,
    MOTION_ROWS,
    OTHER_ROWS,
    Held,
    run_case,
)

SIMPLE_CASES = 30
"""Of a row, so many are run with each of the simple laws."""


def run(count: int) -> str:
    """Run all rows with so many cases each; return the tables."""
    jobs = [(row, "") for row in (*MOTION_ROWS, *BONE_ROWS, *CLINGING_ROWS, *OTHER_ROWS)]
    jobs += [(row, law) for row in MOTION_ROWS for law in LIVING_LAWS]
    outcomes: dict[tuple[str, str], list[Held]] = {}
    with (
        ProcessPoolExecutor(2, mp_context=get_context("fork")) as pool,
        tqdm(desc="living", unit="") as progress,
    ):
        for row, law in jobs:
            done = []
            cases = min(count, SIMPLE_CASES) if law else count
            for held in pool.map(run_case, [(row, seed, law) for seed in range(cases)]):
                done.append(held)
                progress.update()
            outcomes[row.name, law] = done
    return _report(outcomes, count)


def _report(outcomes: dict[tuple[str, str], list[Held]], count: int) -> str:
    rows = [
        "## Living tissue",
        "",
        f"{count} cases a row, each drawn by its seed: ball of 1.5 to 3 mm, modulus of a sudden step 3 to",
        "30 kPa of which 60 % relax in .5 to 3 s, surface +-.5 mm from where it is expected, 1 mN rms noise at",
        "500 Hz. Heart: a sine of that amplitude at 1 to 2 Hz; breath: cos^6, peak to peak, at .2 to .3 Hz.",
        "Held: for 4 s after it was ready. rms: of the true force about its aim while held, median / p95.",
        "Peak: largest true force. Without a beam these are contacts near one that has succeeded. The simple",
        f"laws: {min(count, SIMPLE_CASES)} cases.",
        "",
        "| Tissue that moves | held % | ready, median / p95 s | rms % | peak mN "
        + "".join(f"| {law}: held %, rms % " for law in LIVING_LAWS)
        + "|",
        "|---|---|---|---|---|" + "---|" * len(LIVING_LAWS),
    ]
    for row in MOTION_ROWS:
        simple = ""
        for law in LIVING_LAWS:
            other = outcomes[row.name, law]
            simple += f"| {_share(other)}, {_rms(other)} "
        rows.append(f"| {row.name} {_middle(outcomes[row.name, ''])} {simple}|")
    rows += [
        "",
        "10 MPa, met where nothing is known of the tissue: without a beam at .3 mm/s.",
        "",
        "| Bone | peak, median / largest mN | ended as |",
        "|---|---|---|",
    ]
    for row in BONE_ROWS:
        done = outcomes[row.name, ""]
        peaks = 1e3 * np.array([o.peak_n for o in done])
        rows.append(
            f"| {row.name} | {np.median(peaks):.0f} / {peaks.max():.0f} | {_causes(done)} |"
        )
    rows += [
        "",
        "Pull beyond what adhesion itself needs (1.5 pi w R); a film pulls with .3 to 1 N s/m and tears, a",
        "hook with 5 to 40 N/m and does not.",
        "",
        "| What clings | pull beyond, median / largest mN | ended as |",
        "|---|---|---|",
    ]
    for row in CLINGING_ROWS:
        done = outcomes[row.name, ""]
        beyond_mn = 1e3 * np.array([o.pull_n - o.needed_n for o in done])
        rows.append(
            f"| {row.name} | {np.median(beyond_mn):.1f} / {beyond_mn.max():.1f} | {_causes(done)} |"
        )
    rows += [
        "",
        "| Other | held % | ready, median / p95 s | rms % | peak mN |",
        "|---|---|---|---|---|",
    ]
    rows += [f"| {row.name} {_middle(outcomes[row.name, ''])} |" for row in OTHER_ROWS]
    rows += ["", "Stated mean force within 4 of its deviations of the true mean while held:", ""]
    worst = [
        (share, name)
        for (name, law), done in outcomes.items()
        if not law and np.isfinite(share := _stated(done))
    ]
    rows.append(
        f"all rows {100 * np.mean([share for share, _ in worst]):.1f} % of the cases; least "
        + ", ".join(f"{100 * share:.0f} % {name}" for share, name in sorted(worst)[:3])
        + "."
    )
    return "\n".join(rows) + "\n"


def _share(done: Sequence[Held]) -> str:
    return f"{100 * np.mean([o.held for o in done]):.0f}"


def _rms(done: Sequence[Held]) -> str:
    rms = 100 * np.array([o.rms for o in done if o.held])
    return f"{np.median(rms):.1f} / {np.quantile(rms, 0.95):.1f}" if rms.size else "-"


def _middle(done: Sequence[Held]) -> str:
    ready = np.quantile([o.ready_s for o in done], [0.5, 0.95], method="higher")
    peak = 1e3 * max(o.peak_n for o in done)
    return f"| {_share(done)} | {ready[0]:.2f} / {ready[1]:.2f} | {_rms(done)} | {peak:.0f}"


def _stated(done: Sequence[Held]) -> float:
    errors = np.array([o.stated_error for o in done])
    errors = np.abs(errors[np.isfinite(errors)])
    return float(np.mean(errors < 4)) if errors.size else np.nan


def _causes(done: Sequence[Held]) -> str:
    return ", ".join(f"{cause} {n}" for cause, n in Counter(o.cause for o in done).most_common())
