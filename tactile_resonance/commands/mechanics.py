# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance mechanics`: what mechanical tests say of tissue."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from tactile_resonance.commands.options import add_figure, add_option, add_output
from tactile_resonance.fields import require
from tactile_resonance.files import write_whole
from tactile_resonance.front import read_run

if TYPE_CHECKING:
    from tactile_resonance.mechanics.indentation import IndentationRecord
    from tactile_resonance.scan.tissue_tests import TissueTest

COLUMNS = ("time_s", "force_n", "indentation_m")
LARGEST_RADIUS_M = 0.1
"""Of a ball: a number beyond it is of millimetres."""


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of the command."""
    parser = commands.add_parser(
        "mechanics",
        help="viscoelastic constants from relaxation, creep, load and unload",
        description="Fit Prony series to mechanical tests with a ball: those of a run, or files with "
        "time_s, force_n and indentation_m (.csv, .npz, .mat). Constants that a record does not determine are "
        "declared so. Of a run mechanics.csv is written anew.",
    )
    add_option(parser, "paths RUN|FILE", Path, nargs="+")
    add_option(parser, "--terms N", 4, "most terms")
    text = "of the tissue on what is rigid: whether Hertz's force holds"
    add_option(parser, "--thickness-m M", math.nan, text)
    add_output(parser, "--json FILE", "write all figures", ".json")
    add_figure(parser, "--plot", "draw force and model")
    of_files = parser.add_argument_group("files only: a run knows these")
    protocols = ("relaxation", "creep", "indentation")
    add_option(of_files, "--protocol", "relaxation", choices=protocols)
    add_option(of_files, "--radius-m M", float, "of the ball")
    text = "between what indentation_m was measured on and the ball; without it --rigid is needed"
    add_option(of_files, "--stiffness-n-per-m K", float, text)
    text = "the ball is held rigidly: indentation_m is its depth"
    add_option(of_files, "--rigid", False, text)
    add_option(of_files, "--poisson-ratio NU", 0.49)
    parser.set_defaults(run=run, of_files=of_files._group_actions)


def run(options: argparse.Namespace) -> int:
    """Read, fit, print, write."""
    from tactile_resonance.mechanics.fit import check_options

    check_options(
        options.terms, options.thickness_m
    )  # before a run's mechanics.csv is written anew
    if all(path.is_dir() for path in options.paths):
        for option in options.of_files:
            value, (name,) = getattr(options, option.dest), option.option_strings
            require(value == option.default, name, value, "none beside a run, which knows it")
    found = {path: list(_tests(path, options)) for path in options.paths}
    tests = [one for of_path in found.values() for one in of_path]
    require(bool(tests), str(options.paths[0]), None, "mechanical tests, which `protocols` of a scene asks for")
    for path, of_path in found.items():
        for one in of_path:
            print("\n".join(_lines(one)))
        if not of_path:
            print(f"{path}: no mechanical test")
    if options.json is not None:
        text = json.dumps([one.as_json() for one in tests], indent=1, allow_nan=False)
        write_whole(options.json, (text + "\n").encode())
    if options.plot is not None:
        from tactile_resonance.report.drawing import draw_tests, save_figure

        save_figure(draw_tests(tests, "Mechanical tests"), options.plot)
    return 0 if any(one.fit is not None for one in tests) else 1


def _tests(path: Path, options: argparse.Namespace) -> Iterator[TissueTest]:
    # only here: the command answers --help without what is compiled for the fits
    from tactile_resonance.scan.tissue_tests import fits_of, fitted, write_fits

    terms, thickness_m = options.terms, options.thickness_m
    if not path.is_dir():
        yield fitted(_read(path, options), most_terms=terms, thickness_m=thickness_m)
        return
    content = read_run(path)
    tests = list(fits_of(content, most_terms=terms, thickness_m=thickness_m))
    if tests:
        write_fits(content.path, tests)
    yield from tests


def _read(path: Path, options: argparse.Namespace) -> IndentationRecord:
    """Record of a file."""
    from tactile_resonance.array_files import read_arrays
    from tactile_resonance.mechanics.indentation import BallTip, IndentationRecord, Protocol

    require(options.radius_m is not None, "--radius-m", None, "the radius of the ball [m]")
    accepted = f"metres, at most {LARGEST_RADIUS_M:g}: 1.5 mm are 1.5e-3"
    require(options.radius_m <= LARGEST_RADIUS_M, "--radius-m", options.radius_m, accepted)
    spring = options.stiffness_n_per_m
    accepted = "one of it and --rigid: behind a spring the indentation is not fixed while the stage is held"
    require(options.rigid == (spring is None), "--stiffness-n-per-m", spring, accepted)
    arrays, names = read_arrays(path, COLUMNS)
    missing = [name for name in COLUMNS if name not in arrays]
    if missing:
        raise ValueError(f"{path.name}: no {', '.join(missing)} among {', '.join(names)}")
    for name in COLUMNS:
        require(
            arrays[name].dtype.kind != "c", f"{path.name}: {name}", "complex numbers", "real ones"
        )
    stiffness = math.inf if options.rigid else spring
    time_s, force_n, indentation_m = (arrays[name].ravel().astype(float) for name in COLUMNS)
    ball = BallTip(options.radius_m, options.poisson_ratio, stiffness)
    try:
        protocol = Protocol(options.protocol)
        return IndentationRecord(
            protocol, time_s, force_n, indentation_m, ball, label=path.name, source=path.name
        )
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from error


def _lines(one: TissueTest) -> Iterator[str]:
    """What a test says, for people."""
    test, fit = one.test, one.fit
    simulated = ", simulated, not measured" if test.simulated else ""
    yield f"{test.label}: {test.protocol.value}{simulated}"
    if fit is None:
        yield f"  not fitted: {one.reason}"
        return
    yield (
        f"  peak {1e3 * fit.peak_force_n:.1f} mN, {100 * fit.relaxed_share:.0f} % lost at the end of the hold; "
        f"ramp {fit.ramp_s:.2f} s, hold {fit.hold_s:.1f} s, a/R {fit.contact_ratio:.2f}"
    )
    for at in (0.5, 1.0, 10.0, 60.0):
        value, std = fit.modulus(at)
        if math.isfinite(value):
            yield f"  E({at:g} s)   {_digits(value)} Pa  +- {100 * std:.1f} %"
    yield _constant("Einf", fit.equilibrium_pa, fit.equilibrium_std, fit.equilibrium_known.value)
    for k, term in enumerate(fit.terms, start=1):
        if term.known.value != "determined":
            yield f"  E{k}, tau{k}   {term.known.value} (about {term.time_s:.2g} s)"
            continue
        yield _constant(f"E{k}", term.modulus_pa, term.modulus_std, "determined")
        yield f"  tau{k}       {term.time_s:10.3g} s   +- {100 * term.time_std:.1f} %"
    for text in fit.status:
        yield f"  note: {text}"


def _constant(name: str, value: float, std: float, known: str) -> str:
    if known != "determined":
        return f"  {name:8s} {known}"
    return f"  {name:8s} {_digits(value)} Pa  +- {100 * std:.1f} %"


def _digits(pascal: float) -> str:
    """Whole, or three digits of a small one, as of a depth that is not in metres."""
    return f"{pascal:10.0f}" if pascal >= 100 else f"{pascal:10.3g}"
