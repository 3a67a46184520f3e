# SPDX-License-Identifier: Apache-2.0
"""What the set-up says: a line per step with its time, a line per failure; more goes to logs."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LOGS = ROOT / "log"
_SHOWN_LINES = 15


class SetupError(Exception):
    """What stops the set-up, as one line for the user; `log` tells more where there is one."""

    def __init__(self, message: str, log: Path | None = None):
        super().__init__(message)
        self.log = log


@contextmanager
def step(title: str) -> Iterator[None]:
    """Announce a step and, once it is done, the time it took [s]."""
    print(f"-- {title} ...", end="", flush=True)
    start = time.monotonic()
    try:
        yield
    except BaseException:
        print(" not done", flush=True)
        raise
    print(f" {time.monotonic() - start:.1f} s", flush=True)


@contextmanager
def running(
    command: Sequence[str | Path], log_name: str, failure: str, env: Mapping[str, str] | None = None
) -> Iterator[None]:
    """Run a command from the repository beside the body, with its output in log/<log_name>; wait for its end.

    Where the body raises, the command is ended.

    Raises
    ------
    SetupError
        With the line `failure` and the log, when the command ends with another status than 0.
    """
    LOGS.mkdir(exist_ok=True)
    log = LOGS / log_name
    with log.open("w") as output:
        process = subprocess.Popen(
            [str(part) for part in command],
            cwd=ROOT,
            env=dict(os.environ if env is None else env),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            # A group of its own, to be ended as a whole; the inherited lock of the set-up is held
            # for as long as it lives, even if we are killed.
            start_new_session=True,
            close_fds=False,
        )
        try:
            yield
            status = process.wait()
        except BaseException:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            raise
    if status != 0:
        raise SetupError(failure, log)


def run(
    command: Sequence[str | Path], log_name: str, failure: str, env: Mapping[str, str] | None = None
) -> None:
    """Run a command, and wait for its end: see `running`."""
    with running(command, log_name, failure, env):
        pass


def last_lines(log: Path) -> str:
    """The end of a log."""
    lines = log.read_text(errors="replace").splitlines()
    return "\n".join(f"   | {line}" for line in lines[-_SHOWN_LINES:])
