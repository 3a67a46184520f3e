# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance compare`: which points of maps differ, and in which groups they fall."""

from __future__ import annotations

import argparse
from collections import Counter
from typing import TYPE_CHECKING

from tactile_resonance.commands.options import add_file, add_output, add_runs
from tactile_resonance.fields import counted, require
from tactile_resonance.files import csv_text, write_whole

if TYPE_CHECKING:
    from tactile_resonance.tissue.nominal_contact import NominalContact

MOST_PAIRED = 1000
"""Points of which all pairs are compared: half a million."""

COLUMNS = (
    *("run", "index", "x_m", "y_m", "f0_hz", "damping_ratio"),
    *("p_rest", "adjusted_p_rest", "differs", "group", "group_probability", "pairs_that_differ"),
)


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of the command."""
    parser = commands.add_parser(
        "compare",
        help="which points of runs differ, and in which groups they fall",
        description="Which points of one or several runs differ from the rest and from one another, at a false "
        "discovery rate, and groups of alike points, found without references; as OUTPUT.csv and OUTPUT.png.",
    )
    add_runs(parser)
    add_output(
        parser, "--output", "write OUTPUT.csv and OUTPUT.png", required=True, metavar="OUTPUT"
    )
    spread = parser.add_mutually_exclusive_group()
    add_file(
        spread,
        "--library",
        "of `references build`: points of a tissue scatter as those of one preparation do there "
        "(default: by their noise alone)",
    )
    spread.add_argument(
        "--spread",
        type=float,
        nargs=2,
        metavar=("F0_HZ", "DAMPING"),
        help="standard deviations by which points of one tissue scatter beside their noise",
    )
    parser.add_argument(
        "--rate",
        type=float,
        default=0.05,
        help="part of the points said to differ that do not (default: 0.05)",
    )
    parser.add_argument("--most", type=int, default=6, help="groups (default: 6)")
    add_file(
        parser,
        "--nominal",
        "with nominal_contact (default: that of the library, else of the runs' scenes)",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Compare, group, write both files."""
    import numpy as np

    from tactile_resonance.commands.references import print_left_out, read_runs
    from tactile_resonance.report.drawing import save_figure
    from tactile_resonance.report.tissue_figures import draw_comparison
    from tactile_resonance.scan.labels import nominal_of, read_nominal, referred, run_names
    from tactile_resonance.scan.point_result import PointKind
    from tactile_resonance.tissue.comparison import (
        differences_from_rest,
        find_clusters,
        pairs_that_differ,
    )
    from tactile_resonance.tissue.references import read_classes, read_sources
    from tactile_resonance.tissue.spread import within_preparation

    good = all(0 <= each < np.inf for each in options.spread or ())
    require(good, "--spread", options.spread, "two finite numbers, 0 or above")
    runs = read_runs(options.runs)
    names = run_names(runs)
    if options.nominal:
        nominal: NominalContact | None = read_nominal(options.nominal)
    else:
        nominal = read_classes(options.library)[1] if options.library else nominal_of(runs)
    kept, rows, left_out = [], [], Counter[str]()
    for name, content in zip(names, runs, strict=True):
        for result in content.latest:
            if result.kind is PointKind.TISSUE:
                at = referred(result, nominal)
                if isinstance(at, str):
                    left_out[at] += 1
                else:
                    kept.append((name, result))
                    rows.append(at)
    if not rows:
        raise ValueError(f"points: {dict(left_out)}, expected one with poles or more")
    x, noise = (np.array(column) for column in list(zip(*rows, strict=True))[:2])
    spread = np.zeros((2, 2))
    if options.library:
        spread = within_preparation(read_sources(options.library).values())
    elif options.spread:
        spread = np.diag(np.square(options.spread))
    found = differences_from_rest(x, noise, spread, options.rate)
    groups = find_clusters(x, noise, spread if spread.any() else None, options.most)
    pairs = pairs_that_differ(x, noise, spread, options.rate) if len(x) <= MOST_PAIRED else None
    print_left_out(left_out)
    if nominal is None:
        print("warning: no nominal_contact: points that were pressed otherwise differ for that")
    std = np.sqrt(np.diag(spread))
    print(f"points of one tissue scatter by {std[0]:.3g} Hz and {std[1]:.2g} beside their noise")
    print(
        f"{int(found.differs.sum())} of {len(x)} points differ from the rest, at f0 {found.rest[0]:.3f} Hz, "
        f"damping ratio {found.rest[1]:.5f}; {options.rate:.0%} of them are expected not to"
    )
    if pairs is not None:
        print(f"{int(pairs.sum()) // 2} of {len(x) * (len(x) - 1) // 2} pairs differ")
    print(f"{counted(len(groups.mean), 'group')}, by the Bayesian information criterion:")
    for k, (mean, covariance) in enumerate(zip(groups.mean, groups.covariance, strict=True)):
        own = np.sqrt(np.diag(covariance))
        print(
            f"  {k + 1}: {counted(int(np.sum(groups.of_point == k)), 'point')}, "
            f"f0 {mean[0]:.3f} +- {own[0]:.2g} Hz, damping ratio {mean[1]:.5f} +- {own[1]:.2g}"
        )
    table: list[list[object]] = [[*COLUMNS]]
    for k, (name, result) in enumerate(kept):
        group = int(groups.of_point[k])
        table.append(
            [
                *(name, result.index, result.x_m, result.y_m, *x[k]),
                *(found.p[k], found.adjusted[k], bool(found.differs[k]), group + 1),
                groups.probability[k, group],
                "" if pairs is None else int(pairs[k].sum()),
            ]
        )
    write_whole(options.output.with_name(options.output.name + ".csv"), csv_text(table).encode())
    position_m = np.array([result.position_m[:2] for _, result in kept])
    simulated = any(result.simulated for _, result in kept)
    figure = draw_comparison(position_m, x, noise, found, groups, simulated)
    save_figure(figure, options.output.with_name(options.output.name + ".png"))
    print(f"{options.output}.csv, {options.output}.png")
    return 0
