# SPDX-License-Identifier: Apache-2.0
"""A process that does nothing but sleep, on every processor, and notes when one let it sleep too long.

Tests in which processes meet on the wall clock say nothing about the code while the machine stands still.
This witness tells such runs from failures: it has no part in what is tested. A shared machine takes away one
processor at a time, and with it whoever runs there: so each is watched by a thread that does not leave it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from tactile_resonance.processes import end_with_parent

NAP_S = 0.002
LONG_S = 0.010  # beyond the nap: what the simulated robot counts as a stall


class StallWitness:
    """Starts the process; `stalls` asks it."""

    def __init__(self) -> None:
        self._notes = tempfile.NamedTemporaryFile("r", prefix="stalls-")  # noqa: SIM115 - lives as long
        self._process = subprocess.Popen(
            [sys.executable, __file__, self._notes.name],
            preexec_fn=end_with_parent if sys.platform == "linux" else None,
        )

    def stalls(self, start_s: float) -> list[float]:
        """Lengths [s] of the stalls that ended after `start_s` (monotonic)."""
        time.sleep(2 * LONG_S)  # one under way is noted when it ends
        self._notes.seek(0)
        pairs = [tuple(map(float, line.split())) for line in self._notes if line.endswith("\n")]
        return [length_s for end_s, length_s in pairs if end_s >= start_s]

    def end(self) -> None:
        """End the process."""
        self._process.terminate()
        self._process.wait()
        self._notes.close()


def watch(path: Path, processor: int | None) -> None:
    """Note end and length of every stall of a processor (None: of any), for ever."""
    if processor is not None:
        os.sched_setaffinity(0, {processor})  # of this thread
    with path.open("a", buffering=1) as notes:
        last_s = time.monotonic()
        while True:
            time.sleep(NAP_S)
            now_s = time.monotonic()
            if now_s - last_s > NAP_S + LONG_S:
                notes.write(f"{now_s} {now_s - last_s - NAP_S}\n")
            last_s = now_s


def main() -> None:
    """Watch every processor that this process may use."""
    places = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else [None]
    for place in places:
        threading.Thread(target=watch, args=(Path(sys.argv[1]), place)).start()


if __name__ == "__main__":
    main()
