# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance reidentify`: poles of all points of runs, again, with another model or band."""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

from tactile_resonance.counted import counted
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
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="folder of a run")
    parser.add_argument(
        "--output",
        type=Path,
        metavar="OUTPUT",
        help="write OUTPUT.csv and OUTPUT.npz (default: reidentified in the folder of the only run)",
    )
    parser.add_argument(
        "--band",
        type=float,
        nargs=2,
        metavar=("LO", "HI"),
        help="[Hz] of the fit; default: that of each run's scene",
    )
    parser.add_argument(
        "--order",
        type=int,
        metavar="N",
        help="of the denominator, two per mode (default: that of each run's scene)",
    )
    parser.add_argument(
        "--numerator-order",
        type=int,
        help="with --order; default: six residual terms beside the modes, order + 5; 2 with --order 2 is the "
        "bare second-order model",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Identify, show how far it is, write both files, count."""
    # only here: the command answers --help without the library for recordings
    try:
        from tactile_resonance.scan.reidentify import reidentify
    except ImportError as error:
        raise ValueError(f"reidentify: {error.name} not found; pip install rosbags") from error
    structure = None if options.order is None else ModelStructure.with_residual(options.order)
    if options.numerator_order is not None:
        if structure is None:
            raise ValueError(f"numerator-order: {options.numerator_order}, expected beside --order")
        structure = replace(structure, numerator_order=options.numerator_order)
    band_hz = None
    if options.band is not None:
        band_hz = options.band[0], options.band[1]
        if not 0 < band_hz[0] < band_hz[1] < float("inf"):
            raise ValueError(f"band: {band_hz[0]:g} {band_hz[1]:g}, expected 0 < LO < HI, finite")
    output = options.output
    if output is None:
        if len(options.runs) > 1:
            raise ValueError("output: not given, expected one name for the result of several runs")
        output = options.runs[0] / "reidentified"
    elif not output.parent.is_dir() or not os.access(output.parent, os.W_OK):
        raise ValueError(f"output: {output}, expected a file in a folder that can be written")
    csv, npz = (output.with_name(output.name + ending) for ending in (".csv", ".npz"))
    begun_s = time.monotonic()
    with _Progress() as bar:
        counts, left_out = reidentify(options.runs, csv, npz, band_hz, structure, bar.show)
    print(f"{counted(counts.total(), 'point')} in {time.monotonic() - begun_s:.1f} s: {csv}, {npz}")
    for status, count in counts.most_common():
        print(f"{status}: {count}")
    for text in left_out:
        print(f"left out: {text}")
    return 0


class _Progress:
    """How far it is: a bar on a terminal, a line every tenth elsewhere."""

    def __init__(self) -> None:
        from tqdm import tqdm

        self._bar = tqdm(unit="point", unit_scale=True, file=sys.stderr, leave=False, disable=None)
        self._told = ("", 0)

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def show(self, what: str, done: int, of: int) -> None:
        """Take how many points are done."""
        bar = self._bar
        if bar.disable:
            now = (what, 10 * done // of)
            if now != self._told:
                self._told = now
                print(f"{what}: {done} of {of} points", flush=True)
            return
        if bar.desc != f"{what}: " or done < bar.n:
            bar.reset(of)
            bar.set_description(what, refresh=False)
        bar.total = of
        bar.update(done - bar.n)
