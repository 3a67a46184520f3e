# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance reidentify`: poles of all points of runs, again, with another model or band."""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

from tactile_resonance.commands.options import (
    ProgressBar,
    add_band,
    add_option,
    add_output,
    add_runs,
)
from tactile_resonance.fields import band, counted, require
from tactile_resonance.poles.structure import ModelStructure


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of the command."""
    parser = commands.add_parser(
        "reidentify",
        help="poles of all points of scans' runs again, with another model or band",
        description="Identify the poles of every finished point of one or several runs again, from the bins of "
        "the band of its records, and write them as OUTPUT.csv and OUTPUT.npz. The bins are kept in each run's "
        "folder (bins.npz) and taken from the records once.",
    )
    add_runs(parser)
    text = "write OUTPUT.csv and OUTPUT.npz (default: reidentified in the folder of the only run)"
    add_output(parser, "--output OUTPUT", text)
    add_band(parser, "that of each run's scene")
    text = "of the denominator, two per mode (default: that of each run's scene)"
    add_option(parser, "--order N", int, text)
    add_option(
        parser, "--numerator-order", int,
        "with --order; default: six residual terms beside the modes, order + 5; 2 with --order 2 is the "
        "bare second-order model",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Identify, show how far it is, write both files, count."""
    # only here: the command answers --help without the library for recordings
    from tactile_resonance.scan.reidentify import reidentify
    from tactile_resonance.scan.run_content import RECORDING

    order, terms = options.order, options.numerator_order
    require(order is not None or terms is None, "--numerator-order", terms, "one beside --order")
    structure = None if order is None else ModelStructure.with_residual(order)
    if structure is not None and terms is not None:
        structure = replace(structure, numerator_order=terms)
    band_hz = None if options.band_hz is None else band(options.band_hz, "--band")
    different = len({run.resolve() for run in options.runs})
    require(different == len(options.runs), "RUN", [str(run) for run in options.runs], "each run once")
    output = options.output
    if output is None:
        several = len(options.runs) > 1
        require(not several, "--output", None, "one name for the result of several runs")
        output = options.runs[0] / "reidentified"
    csv, npz = (output.with_name(output.name + ending) for ending in (".csv", ".npz"))
    folder, taken = output.absolute().parent, output.name in ("results", "mechanics", "bins", "surface")
    if folder.name == RECORDING:
        folder, taken = folder.parent, True
    of_run = taken and (folder / "run.json").is_file()
    accepted = "a name that no file of the run itself has, not in its recording"
    require(not of_run, "--output", str(output), accepted)
    begun_s = time.monotonic()
    with ProgressBar(unit_scale=True) as bar:

        def show(what: str, done: int, of: int) -> None:
            tenth = f"{what}: {done} of {of} points"
            bar.show(what, done, of, (what, 10 * done // of), tenth)

        counts, left_out = reidentify(options.runs, csv, npz, band_hz, structure, show)
    print(f"{counted(counts.total(), 'point')} in {time.monotonic() - begun_s:.1f} s: {csv}, {npz}")
    for status, count in counts.most_common():
        print(f"{status}: {count}")
    for text in left_out:
        print(f"left out: {text}")
    return 0
