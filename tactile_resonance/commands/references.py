# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance references` and `compare`: points of runs whose tissue is known, and those without labels.

Of known ones tissue classes follow, on trial, and the variance by source; of others which of them differ, and
in which groups they fall.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tactile_resonance.commands.options import YAML, add_figure, add_option, add_output, add_runs
from tactile_resonance.fields import counted, require
from tactile_resonance.files import csv_text, write_whole
from tactile_resonance.front import read_run

if TYPE_CHECKING:
    from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
    from tactile_resonance.frf.variance_analysis import NestedMeans
    from tactile_resonance.scan.labels import LabelOf
    from tactile_resonance.scan.point_result import PointResult
    from tactile_resonance.scan.run_content import RunContent
    from tactile_resonance.tissue.nominal_contact import NominalContact
    from tactile_resonance.tissue.spread import TissueSpread
    from tactile_resonance.tissue.trial import ReliabilityBin, Trial

SCENE = "scene"
FEW = 8.0
"""Degrees of freedom: with fewer a class is much wider than its tissue."""
MOST_PAIRED = 1000
"""Points of which all pairs are compared: half a million."""
COLUMNS = (
    *("run", "index", "x_m", "y_m", "f0_hz", "damping_ratio"),
    *("p_rest", "adjusted_p_rest", "differs", "group", "group_probability", "pairs_that_differ"),
)


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of `references build`, `check` and `variance`, and of `compare`."""
    parser = commands.add_parser(
        "references",
        help="tissue classes from runs of one's own",
        description="Tissue classes from runs whose tissues are known (docs/references.md).",
    )
    kinds = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    build = kinds.add_parser(
        "build",
        help="write a library of classes",
        description="Separate the spread of poles by repetition, position, preparation and force, write the "
        "classes that follow as a file for `tissue_classes` of scenes, and try them on points left out.",
    )
    _add_runs(build)
    add_output(build, "--output FILE", "the library", *YAML, required=True)
    text = "tissues scatter alike: estimate spreads from all together (few preparations of each)"
    add_option(build, "--pool", False, text)
    text = "what is left out of the classes that call it"
    add_option(build, "--leave", "preparation", text, choices=("preparation", "run"))
    build.set_defaults(run=_build)
    check = kinds.add_parser(
        "check",
        help="try a library on runs that it does not rest on",
        description="Call labelled points by a library: errors, points called unknown, and whether the stated "
        "probabilities hold.",
    )
    _add_runs(check)
    text = "of `references build`, or any file with tissue_classes"
    add_option(check, "--library FILE", Path, text, required=True)
    check.set_defaults(run=_check)
    for each in (build, check):
        text = "a point farther from each class than this part of its members is unknown"
        add_option(each, "--unknown-level P", 0.01, text)
        add_option(
            each, "--nominal FILE", Path,
            "with nominal_contact, to which poles are referred (default: that of the runs' scenes; "
            "of check that of the library)",
        )
    variance = kinds.add_parser(
        "variance",
        help="variance of the FRF by source",
        description="Variance of the frequency response over periods, repetitions, positions and preparations "
        "(figure 9 of arXiv 1805.00682), of the labelled points of runs.",
    )
    _add_runs(variance)
    variance.set_defaults(run=_variance)
    for each in (build, check, variance):
        add_figure(each, "--figure", "draw it here")
    parser = commands.add_parser(
        "compare",
        help="which points of runs differ, and in which groups they fall",
        description="Which points of one or several runs differ from the rest and from one another, at a false "
        "discovery rate, and groups of alike points, found without references; as OUTPUT.csv and OUTPUT.png.",
    )
    add_runs(parser)
    add_output(parser, "--output OUTPUT", "write OUTPUT.csv and OUTPUT.png", required=True)
    spread = parser.add_mutually_exclusive_group()
    add_option(
        spread, "--library FILE", Path,
        "of `references build`: points of a tissue scatter as those of one preparation do there "
        "(default: by their noise alone)",
    )
    text = "standard deviations by which points of one tissue scatter beside their noise"
    add_option(spread, "--spread F0_HZ DAMPING", float, text)
    add_option(parser, "--rate", 0.05, "part of the points said to differ that do not")
    add_option(parser, "--most", 6, "groups")
    text = "with nominal_contact (default: that of the library, else of the runs' scenes)"
    add_option(parser, "--nominal FILE", Path, text)
    parser.set_defaults(run=_compare)


def _add_runs(parser: argparse.ArgumentParser) -> None:
    add_runs(parser)
    add_option(
        parser, "--labels FILE", str,
        f"CSV with tissue and at will run, index, preparation, position; or '{SCENE}': the regions of "
        "each run's scene, of which each is a preparation",
        required=True,
    )


def _build(options: argparse.Namespace) -> int:
    from tactile_resonance.report.drawing import draw_references, save_figure
    from tactile_resonance.scan.labels import nominal_of, read_nominal, reference_points
    from tactile_resonance.tissue.references import library_text
    from tactile_resonance.tissue.spread import smallest_steps, spreads_of
    from tactile_resonance.tissue.trial import leave_out, reliability

    _check_level(options.unknown_level)
    runs = _read_runs(options.runs)
    nominal = read_nominal(options.nominal) if options.nominal else nominal_of(runs)
    points, left_out = reference_points(runs, _labels(options.labels, runs), nominal)
    spreads = spreads_of(points, options.pool)
    comment = [
        f"{len(points.run)} points of {', '.join(dict.fromkeys(points.run.tolist()))}, by tactile_resonance "
        "references build",
        *(["simulated, not measured"] if _simulated(runs) else []),
        *(
            f"{s.name}: spread of {', '.join(s.undetermined)} not determined"
            for s in spreads
            if s.undetermined
        ),
    ]
    _print_left_out(left_out)
    for spread in spreads:
        print("\n".join(_spread_lines(spread)))
    write_whole(options.output, library_text(spreads, nominal, comment).encode())
    if nominal is None:
        print("warning: no nominal_contact: force and age of contact are part of the spread")
    bins: Sequence[ReliabilityBin] = ()
    try:
        trial = leave_out(points, options.leave, options.pool, options.unknown_level)
        bins = reliability(trial)
        print(f"\none {options.leave} left out at a time:")
        _print_trial(trial, bins, options.unknown_level)
        outside = leave_out(points, "tissue", options.pool, options.unknown_level)
        for name in dict.fromkeys(outside.tissue.tolist()):
            of = outside.where(outside.tissue == name)
            print(f"were {name} not in it: {of.share(of.called == 'unknown')} unknown")
    except ValueError as error:  # too few of something
        print(f"not tried: {error}")
    steps = smallest_steps(spreads)
    for step in steps:
        outer = list(step.one_block)[-1]
        own = [spread for spread in spreads if spread.name in (step.first, step.second)]
        missing = dict.fromkeys(name for spread in own for name in spread.undetermined)
        but = f" but {', '.join(missing)}, not determined," if missing else ""
        print(
            f"smallest step from {step.from_percent:g} to {step.to_percent:g} %, separated at 99 %: "
            f"{step.one_block['noise']:.2g} % by noise of one block, {step.one_block[outer]:.2g} % with all "
            f"sources{but or ','} {step.limit[outer]:.2g} % without noise"
        )
    if options.figure:
        save_figure(draw_references(points, spreads, bins, steps, _simulated(runs)), options.figure)
    print(
        f"library in {options.output}: tissue_classes: {options.output.name} in a scene beside it"
    )
    return 0


def _check(options: argparse.Namespace) -> int:
    from tactile_resonance.report.drawing import draw_reliability, new_figure, save_figure
    from tactile_resonance.scan.labels import read_nominal, reference_points
    from tactile_resonance.tissue.references import read_classes
    from tactile_resonance.tissue.trial import call_points, reliability

    _check_level(options.unknown_level)
    runs = _read_runs(options.runs)
    classes, nominal = read_classes(options.library)
    if options.nominal:
        nominal = read_nominal(options.nominal)
    points, left_out = reference_points(runs, _labels(options.labels, runs), nominal)
    trial = call_points(points, classes, options.unknown_level)
    bins = reliability(trial)
    _print_left_out(left_out)
    _print_trial(trial, bins, options.unknown_level)
    if options.figure:
        figure = new_figure(6, 5)
        draw_reliability(figure.subplots(), bins)
        save_figure(figure, options.figure)
    return 0


def _variance(options: argparse.Namespace) -> int:
    from tactile_resonance.report.drawing import SIMULATED, draw_variance, save_figure
    from tactile_resonance.scan.labels import labelled_frfs
    from tactile_resonance.scan.reidentify import scene_band

    runs = _read_runs(options.runs)
    band_hz = scene_band(options.runs[0]).ends_hz
    g, lines_hz, groups, left_out = labelled_frfs(runs, _labels(options.labels, runs))
    _print_left_out(left_out)
    found = print_variance(g, lines_hz, groups, band_hz)
    if options.figure:
        title = "Variance of the FRF by source" + (f", {SIMULATED}" if _simulated(runs) else "")
        save_figure(draw_variance(found, lines_hz, band_hz, title), options.figure)
    return 0


def print_variance(
    g: ComplexArray, frequency_hz: FloatArray, groups: IntArray, band_hz: tuple[float, float]
) -> NestedMeans:
    """Variance by source, of which it prints those of a band."""
    from tactile_resonance.frf.variance_analysis import PAPER_AXES, nested_means

    inside = (frequency_hz >= band_hz[0]) & (frequency_hz <= band_hz[1])
    found = nested_means(g, groups, PAPER_AXES)
    for source in reversed(found.levels):
        level_db = found.rms_level_db(source, inside)
        print(
            f"over {source.name}: {level_db:.1f} dB of rms |G| at {band_hz[0]:g}-{band_hz[1]:g} Hz, "
            f"{source.dof} degrees of freedom"
            if source.dof
            else f"over {source.name}: not determined, one of each"
        )
    return found


def _compare(options: argparse.Namespace) -> int:
    """Compare, group, write both files."""
    from tactile_resonance.report.drawing import draw_comparison, save_figure
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
    runs = _read_runs(options.runs)
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
    require(bool(rows), "points", dict(left_out), "one with poles or more")
    x, noise = (np.array(column) for column in list(zip(*rows, strict=True))[:2])
    spread, degrees = np.zeros((2, 2)), np.inf
    if options.library:
        spread, degrees = within_preparation(read_sources(options.library).values())
    elif options.spread:
        spread = np.diag(np.square(options.spread))
    found = differences_from_rest(x, noise, spread, options.rate, degrees)
    given = spread if spread.any() else None
    groups = find_clusters(x, noise, given, options.most, degrees_of_freedom=degrees)
    paired = len(x) <= MOST_PAIRED
    pairs = pairs_that_differ(x, noise, spread, options.rate, degrees) if paired else None
    _print_left_out(left_out)
    if nominal is None:
        print("warning: no nominal_contact: points that were pressed otherwise differ for that")
    std = np.sqrt(np.diag(spread))
    known = "" if np.isinf(degrees) else f", by {degrees:.3g} degrees of freedom"
    print(f"points of one tissue scatter by {std[0]:.3g} Hz and {std[1]:.2g} beside their noise{known}")
    print(
        f"{int(found.differs.sum())} of {len(x)} points differ from the rest, at f0 {found.rest[0]:.3f} Hz, "
        f"damping ratio {found.rest[1]:.5f}; {100 * options.rate:g} % of them or fewer are expected not to"
    )
    if pairs is not None:
        print(f"{int(pairs.sum()) // 2} of {len(x) * (len(x) - 1) // 2} pairs differ")
    print(f"{counted(len(groups.mean), 'group')}, by the Bayesian information criterion:")
    for k, (mean, covariance) in enumerate(zip(groups.mean, groups.covariance, strict=True)):
        own = np.sqrt(np.diag(covariance))
        print(
            f"  {k + 1}: {counted(int(np.sum(groups.of_point == k)), 'point')}, "
            f"f0 {mean[0]:.3f} Hz, damping ratio {mean[1]:.5f}; they scatter by {own[0]:.2g} Hz and "
            f"{own[1]:.2g} beside their noise"
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


def _check_level(level: float) -> None:
    require(0 < level < 1, "--unknown-level", level, "a number above 0, below 1")


def _read_runs(paths: Sequence[Path]) -> list[RunContent]:
    """Runs, of which what is damaged is printed, and another sensor or band than that of the first."""
    from tactile_resonance.report.comparison import unlike

    runs = [read_run(path) for path in paths]
    for run in runs:
        for problem in run.problems:
            print(f"{run.path.name}: damaged: {problem}")
        if apart := [text for text in unlike(runs[0], run) if text.startswith(("sensor", "band"))]:
            print(f"warning: {run.path.name} beside {runs[0].path.name}: {'; '.join(apart)}")
    return runs


def _simulated(runs: Sequence[RunContent]) -> bool:
    return any(result.simulated for run in runs for result in run.latest)


def _labels(given: str, runs: Sequence[RunContent]) -> LabelOf:
    """Of a CSV file, or of the regions of each run's scene."""
    from tactile_resonance.scan.labels import Label, read_labels

    if given != SCENE:
        return read_labels(Path(given), runs)
    from tactile_resonance.simulation.tissue.library import read_tissues
    from tactile_resonance.simulation.tissue.scene import read_scene

    library = read_tissues()
    scenes = {run.path: read_scene(library, run.path / "scene.yaml") for run in runs}

    def of(run: RunContent, result: PointResult) -> Label | None:
        scene = scenes[run.path]
        index = int(scene.region_index(result.position_m))
        name = run.path.resolve().name
        return (
            None if index < 0 else Label(scene.regions[index].name, f"{name}, region {index + 1}")
        )

    return of


def _print_left_out(reasons: Counter[str]) -> None:
    """How many points, and why."""
    for reason, count in reasons.most_common():
        print(f"left out: {counted(count, 'point')}, {reason}")


def _spread_lines(spread: TissueSpread) -> list[str]:
    """One tissue, for people."""
    def std(covariance: np.ndarray) -> str:
        f0_hz, damping = np.sqrt(np.diag(covariance))
        return f"{f0_hz:8.4f} Hz  {damping:9.2e}"

    lines = [
        f"{spread.name}: {counted(spread.points, 'point')}, f0 {spread.mean[0]:.3f} Hz, damping ratio "
        f"{spread.mean[1]:.5f}",
        f"  {'noise':<12} {std(spread.noise)}  of a measurement",
        f"  {'force, age':<12} {std(spread.force)}  what they add to it",
    ]
    held = {name: source.name for source in spread.sources for name in source.holds}
    for source in reversed(spread.sources):
        degrees = source.degrees_of_freedom
        if degrees:
            text = f"{std(source.covariance)}  {degrees} degrees of freedom"
        elif source.name in held:
            text = f"part of that of {held[source.name]}s, one each"
        else:
            text = f"not determined: one {source.name}"
        lines.append(f"  {source.name:<12} {text}")
    degrees_text = f"{spread.degrees_of_freedom:.1f} degrees of freedom"
    lines.append(
        f"  {'next point':<12} {std(spread.covariance)}  {degrees_text}, without its noise"
    )
    for name in spread.undetermined:
        lines.append(
            f"  warning: the class does not hold for another {name}, whose spread is not determined"
        )
    if spread.degrees_of_freedom < FEW:
        lines.append(
            "  warning: few degrees of freedom make a wide class, and calls too sure where another is near: "
            "more preparations, or --pool"
        )
    return lines


def _print_trial(trial: Trial, bins: Sequence[ReliabilityBin], unknown_level: float) -> None:
    known = trial.where(trial.known)
    right = known.called == known.tissue
    unknown = known.called == "unknown"
    print("points in their preparations; 95 % limits, as if each preparation counted once")
    print(f"called right: {known.share(right)}")
    print(f"called another: {known.share(~right & ~unknown)}")
    print(f"unknown though known: {known.share(unknown)}; {unknown_level:.2%} or less is stated")
    outside = trial.where(~trial.known)
    for name in np.unique(outside.tissue):
        of = outside.where(outside.tissue == name)
        print(f"{name}, not in the library: {of.share(of.called == 'unknown')} unknown")
    for each in bins:
        print(
            f"stated {each.stated:7.2%}, right {each.right:7.2%} of {each.points} points, "
            f"{each.low:.2%} to {each.high:.2%} expected{'' if each.holds else ': does not hold'}"
        )
