# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance benchmark`: run time against error, as tables and figures."""

from __future__ import annotations

import argparse
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from tactile_resonance.files import write_whole

NAMES = (
    *("frf", "poles", "bench", "contact", "touch", "robot"),
    *("twist", "cell", "recording", "pipeline", "live", "load"),
    *("truth", "skip", "references", "report", "mechanics", "calibrate"),
    *("stability", "hostile", "faults", "endurance", "overview"),
)
WITH_FULL = ("contact", "hostile")
"""Those with a larger grid than they run by default."""
PARTS = ("methods", "bias", "grid", "realisations", "reidentify")
"""Tables of `poles`, each of which can be renewed alone."""


PAGES = {"overview": "README.md", "faults": "../reliability.md"}
"""Of a benchmark, where it is another than that of its name."""


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of the command."""
    parser = commands.add_parser(
        "benchmark",
        help="run time against error",
        description="Measure run time as a ratio to something known, and error against truth. Needs the "
        "source tree (tools/run.sh).",
    )
    parser.add_argument("name", nargs="?", choices=NAMES, help="default: all")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions")
    parser.add_argument(
        "--full", action="store_true", help=f"the whole grid ({', '.join(WITH_FULL)})"
    )
    parser.add_argument(
        "--part", choices=PARTS, help="renew this table of poles alone; default: all"
    )
    parser.add_argument(
        "--row", metavar="TEXT", help="renew the rows of faults whose names hold this; default: all"
    )
    parser.add_argument(
        "--guard",
        action="store_true",
        help="overview: compare what follows from seeds alone with the figures kept, write nothing, and fail "
        "where one has become worse",
    )
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("docs/benchmarks"),
        metavar="DIR",
        help="where table and figure go (default: docs/benchmarks)",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run one or all: page and figure of each are written, and the page printed."""
    if find_spec("benchmarks") is None:
        raise ValueError(
            "benchmark: no benchmarks found, run it from the source tree: tools/run.sh"
        )
    if options.part is not None and options.name != "poles":
        raise ValueError(f"--part: {options.part} is a table of `benchmark poles`")
    if options.row is not None and options.name != "faults":
        raise ValueError(f"--row: {options.row} is a row of `benchmark faults`")
    if options.guard:
        if options.name != "overview":
            raise ValueError("--guard: accepted is `benchmark overview --guard`")
        text, good = import_module("benchmarks.overview").guard()
        print(text)
        return 0 if good else 1
    options.output.mkdir(parents=True, exist_ok=True)
    for name in NAMES if options.name is None else (options.name,):
        extra = {"full": True} if options.full and name in WITH_FULL else {}
        if options.part is not None:
            extra["part"] = options.part
        if options.row is not None:
            extra["row"] = options.row
        page = import_module(f"benchmarks.{name}").run(options.output, options.quick, **extra)
        write_page(options.output, name, page)
        print(page)
    return 0


def write_page(output: Path, name: str, page: str) -> None:
    """Write what a benchmark returned; it calls this itself before it fails for what the page states."""
    write_whole(output / PAGES.get(name, f"{name}.md"), page.encode())
