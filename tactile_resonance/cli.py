# SPDX-License-Identifier: Apache-2.0
"""The tactile_resonance command."""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import NoReturn

from tactile_resonance.processes import ENDING, keep_memory

COMMANDS = {
    "plan": ("plan",),
    "bench_scan": ("demo", "scan", "resume"),
    "report": ("report", "live"),
    "analyze": ("analyze",),
    "reidentify": ("reidentify",),
    "calibrate": ("calibrate",),
    "references": ("references", "compare"),
    "mechanics": ("mechanics",),
    "benchmark": ("figures", "benchmark"),
    "calibrate_table": ("calibrate-table",),
    "simulate": ("simulate-ur", "simulate-cell"),
    "first_use": ("check-robot", "compile"),
}
"""Modules of `commands`, in the order in which help lists them, and the commands of each."""


class OneLineParser(argparse.ArgumentParser):
    """Reports wrong arguments in one line, as all other errors are reported."""

    def error(self, message: str) -> NoReturn:
        """End with status 2."""
        self.exit(2, f"tactile_resonance: {message} (see {self.prog} --help)\n")


class Version(argparse.Action):
    """Prints the version, and ends; no other command needs the file in which it stands, package.xml."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        """End with status 0."""
        from tactile_resonance.configuration import package_version

        print(f"tactile_resonance {package_version()}")
        parser.exit()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; its exit status, 0 or 1 with one line on stderr, 130 when interrupted."""
    given = sys.argv[1:] if arguments is None else arguments
    try:
        parsed = _parser(given[:1]).parse_args(given)
        return parsed.run(parsed)
    except (ValueError, OSError) as error:
        print(f"tactile_resonance: {_one_line(error)}", file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        if str(error.name).split(".")[0] != "rosbags":
            raise
        from tactile_resonance.front import WITHOUT_ROSBAGS

        print(f"tactile_resonance: {WITHOUT_ROSBAGS}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as error:
        print(f"tactile_resonance: interrupted{error}", file=sys.stderr)
        return 130


def command() -> NoReturn:
    """Run one command, and end this process with its status.

    Without the interpreter's own end: an interrupt during it kills the process without a message, and one that
    was caught within an import makes it end by SIGINT.
    """
    status = 130
    keep_memory()
    if isinstance(sys.stdout, io.TextIOWrapper):  # a letter of a name that the terminal does not have
        sys.stdout.reconfigure(errors="backslashreplace")
    with contextlib.suppress(KeyboardInterrupt):  # one that came as the command ended
        for number in ENDING[1:]:
            signal.signal(number, signal.default_int_handler)
        status = main()
        for number in ENDING:
            signal.signal(number, signal.SIG_IGN)
    for stream in filter(None, (sys.stdout, sys.stderr)):  # none where the process began without
        with contextlib.suppress(OSError):  # its reader has gone
            stream.flush()
    os._exit(status)


def _parser(asked: Sequence[str]) -> OneLineParser:
    """Parser of the command asked for, of all where it is none; loads them here: an interrupt ends in order.

    To load all of them takes longer than most commands do.
    """
    # One thread: the arrays are small, and BLAS threads that wait for a second core cost more than they
    # give. Before numpy is imported, which reads it once.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    parser = OneLineParser(
        prog="tactile_resonance",
        description="Tactile resonance sensing: from an excited bimorph to the poles of the tissue it touches.",
    )
    parser.add_argument("--version", action=Version, nargs=0, help="print the version and end")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name in [name for name, own in COMMANDS.items() if {*own}.intersection(asked)] or COMMANDS:
        import_module(f"tactile_resonance.commands.{name}").add_parser(commands)
    return parser


def _one_line(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror if error.filename is None else f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


if __name__ == "__main__":
    command()
