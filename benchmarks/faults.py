# SPDX-License-Identifier: Apache-2.0
"""The fault matrix: real scans on the simulated bench, each with one fault, all judged by the same checks.

`tools/run.sh tactile_resonance benchmark faults` runs it and writes `docs/reliability.md`; `--row TEXT` runs
the rows whose names hold that, `--quick` a few.
"""

from __future__ import annotations

import json
import math
import os
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import mkdtemp

from benchmarks import faults_command, faults_session
from benchmarks.faults_command import command_row
from benchmarks.faults_inject import HELD_S
from benchmarks.faults_session import (
    HARD_FORCE_N,
    HUNG_AFTER_S,
    MOST_DEVIATIONS,
    FaultyScan,
    Row,
    session_rows,
)
from tactile_resonance.commands.benchmark import write_page
from tactile_resonance.processes import free_domain_id

RESULTS = "faults.json"
HEAD = f"""# Reliability

What becomes of a scan when something goes wrong. Simulated: real nodes as processes, a simulated robot,
load cell and sensor; nothing here is a measurement on hardware, and what a robot does by itself is in
[safety.md](safety.md).

`tools/run.sh tactile_resonance benchmark faults` runs every row and writes this page; `--row poles_node`
only the rows whose names hold that text, `--quick` a few. Rows that were not run again keep what they gave
before (`docs/benchmarks/faults.json`). Times are of a machine that had other work: they distinguish what is
soon from what waits for a limit, no more. In CI `test/integration/test_faults.py` runs some of them.

Each fault meets a scan that has finished a point, in the middle of the next one, and is judged from
outside:

- every point of the scan is there once, with poles, and what was finished before is unchanged, byte by byte;
- a finished file holds one record, FRF and set of poles for each block, and passes its checksum;
- the poles agree with the truth of the simulation within {MOST_DEVIATIONS:g} of their standard deviations;
- no true force on the tissue was above {1e3 * HARD_FORCE_N:.0f} mN, since the start of the robot;
- a command that ends early says so in one line, with how to go on, and leaves no process behind; `resume`
  then finishes all points.

*Reported*: from the fault until the feedback of the scan, or the command, reported it; empty where there was
nothing to report. *Ended*: until the point, or of a command the process, had ended. A node is `hung` by
SIGSTOP and `killed` by SIGKILL; it is `flooded` by a process that publishes on what it listens to, and asks
for its services and goals, as fast as it can. Messages pass a relay, which drops, doubles, holds for
{HELD_S:g} s or reorders them, or makes each of their floating point numbers NaN: one block of a
measurement, or 40 messages of a stream. Rows of nodes and messages wait {HUNG_AFTER_S:g} s for what hangs
(`hung_after_s`), those of commands the default of 60 s.

Not tried: messages of two blocks in the other order, since in simulated time one block is under way at a
time; steps of the monotonic clock; a wall clock that steps in real time; faults of the robot and of the
load cell, which `test/integration/test_contact_faults.py` has. Clocks are stepped by a preloaded library in
all processes of the command; `/clock` by a second publisher. Disks and folders are those of a mount
namespace (`unshare`), so that no rights are needed.

A fault of the middleware that cannot be injected: in Fast DDS 3.2 the thread of timers and one that removes
what another process had can wait for each other (eProsima/Fast-DDS issue 6502, open in November 2026). That
process then does nothing more; a node like this is `hung` and treated so, but whoever waits in it, a test
for example, waits until it is ended. Seen once, in a process that had three participants, on one processor
with twenty processes waiting for it.

Nor can this one be injected: a node that was killed and started again does not hear the others, most likely
because they go on writing to the port in shared memory that the killed process left and the middleware
removed (eProsima/Fast-DDS issues 5053 and 5469). The manager reports every three seconds that the node `does
not answer`; all nodes must be started again. Seen once, beside two other test runs, and not in 140 restarts
tried for it. Without shared memory, which takes `ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET` and
`FASTDDS_BUILTIN_TRANSPORTS=UDPv4`, it has no cause; with `LOCALHOST` ROS 2 uses shared memory whatever the
latter says.
"""


def run(output: Path, quick: bool, row: str = "") -> str:
    """Rows of the matrix, and its page beside the folder of the benchmarks.

    Raises
    ------
    ValueError
        If no row has that name, or something that a row found is wrong.
    """
    of_session, of_command = [*session_rows()], [*faults_command.ROWS]
    names = [*of_command, *of_session]
    wanted = [name for name in names if row in name]
    if quick:
        wanted = [name for name in wanted if name in (*faults_session.QUICK, *faults_command.QUICK)]
    if not wanted:
        raise ValueError(f"--row: no row has {row!r} in its name; they are {'; '.join(names)}")
    results = output / RESULTS
    known = json.loads(results.read_text(encoding="utf-8")) if results.exists() else {}

    def keep(of: Row) -> None:
        known[of.name] = asdict(of)
        results.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")

    for name in wanted:
        if name in of_command:
            keep(command_row(name, Path(mkdtemp()), "127.0.93.1"))
    for made in session([name for name in wanted if name in of_session]):
        keep(made)
    found = [Row(**known[name]) for name in names if name in known]
    page = _page(found, [name for name in names if name not in known])
    wrong = [f"{each.name}: {each.wrong}" for each in found if each.wrong and each.name in wanted]
    if wrong:
        write_page(output, "faults", page)
        raise ValueError("benchmark faults: " + "; ".join(wrong))
    return page


def session(names: Sequence[str]) -> Iterator[Row]:
    """These rows of nodes and messages; after one that does not end, or is wrong, nodes are started anew."""
    rows, left = session_rows(), [*names]
    while left:
        domain = free_domain_id({})
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        try:
            with FaultyScan(Path(mkdtemp()), f"127.0.92.{domain + 1}") as scan:
                sound = True
                while left and sound:
                    row = rows[left[0]](scan)
                    del left[0]
                    sound = not row.wrong
                    yield row
        except (AssertionError, RuntimeError) as error:
            name = left.pop(0)
            yield Row(name, "the scan does not end, or does not begin", wrong=str(error))


def _page(rows: Sequence[Row], left_out: Sequence[str]) -> str:
    lines = [
        HEAD,
        "| fault | what happens | one goes on by | reported [s] | ended [s] | largest true force [mN] |",
        "|---|---|---|---:|---:|---:|",
    ]
    for row in rows:
        happened = row.happened + (f" **Wrong: {row.wrong}**" if row.wrong else "")
        figures = (_figure(row.reported_s), _figure(row.ended_s), _figure(1e3 * row.force_n))
        cells = (row.name, happened.replace("|", "/"), row.way_on or "nothing", *figures)
        lines.append(f"| {' | '.join(cells)} |")
    good = sum(not row.wrong for row in rows)
    text = f"{good} of {len(rows)} rows end where a person can go on with nothing lost."
    if left_out:
        text += f" Not run yet: {'; '.join(left_out)}."
    return "\n".join([*lines, "", *textwrap.wrap(text, 112)]) + "\n"


def _figure(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.1f}"
