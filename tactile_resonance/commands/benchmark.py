# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance figures` and `benchmark`: what docs/figures and docs/benchmarks show, made anew.

Figures are the paper's experiments on the simulated bench; benchmarks state run time against error.
"""

from __future__ import annotations

import argparse
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from tactile_resonance.commands.options import add_option
from tactile_resonance.fields import require
from tactile_resonance.files import write_whole

BAND_HZ = (200.0, 300.0)  # around the mode that is fitted
# of mechanical tests: what relaxes by four fifths is still more than the limit of a lost contact
FORCE_N = 0.018
NAMES = (
    *("frf", "poles", "bench", "contact", "touch", "robot"),
    *("twist", "cell", "recording", "pipeline", "live", "load"),
    *("truth", "skip", "references", "report", "mechanics", "calibrate"),
    *("stability", "hostile", "faults", "endurance", "overview"),
)
OF_SOME = {"full": ("contact", "hostile"), "part": ("poles",), "row": ("faults",), "guard": ("overview",)}
"""Options, by the benchmarks that know them."""
PARTS = ("methods", "bias", "grid", "realisations", "reidentify")
"""Tables of `poles`, each of which can be renewed alone."""
PAGES = {"overview": "README.md", "faults": "../reliability.md"}
"""Of a benchmark, where it is another than that of its name."""


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of both commands."""
    parser = commands.add_parser(
        "figures",
        help="figures of the simulated bench, its distortion and its variance",
        description="Draw what the simulated bench is made of (docs/simulation.md), distortion over drive "
        "level (figures 5 and 6 of arXiv 1805.00682), variance by source (figure 9), and force that relaxes "
        "(figure 7), creep and unloading with their fits, from the simulated bench. Nothing here is a "
        "measurement.",
    )
    add_option(parser, "name", str, "default: all", nargs="?", choices=tuple(DRAW))
    add_option(parser, "--output DIR", Path("docs/figures"))
    parser.set_defaults(run=_draw)
    parser = commands.add_parser(
        "benchmark",
        help="run time against error",
        description="Measure run time as a ratio to something known, and error against truth. Needs the "
        "source tree (tools/run.sh).",
    )
    add_option(parser, "name", str, "default: all", nargs="?", choices=NAMES)
    add_option(parser, "--quick", False, "fewer repetitions")
    add_option(parser, "--full", False, f"the whole grid ({', '.join(OF_SOME['full'])})")
    add_option(parser, "--part", str, "renew this table of poles alone; default: all", choices=PARTS)
    text = "renew the rows of faults whose names hold this; default: all"
    add_option(parser, "--row TEXT", str, text)
    add_option(
        parser, "--guard", False,
        "overview: compare what follows from seeds alone with the figures kept, write nothing, and fail "
        "where one has become worse",
    )
    add_option(parser, "--output DIR", Path("docs/benchmarks"), "where table and figure go")
    parser.set_defaults(run=_benchmark)


def _draw(options: argparse.Namespace) -> int:
    """Simulate, analyse, draw."""
    options.output.mkdir(parents=True, exist_ok=True)
    for name in DRAW if options.name is None else (options.name,):
        DRAW[name](options.output)
    return 0


def _progress(text: str) -> None:
    print(text, file=sys.stderr)


def _simulation(output: Path) -> None:
    from tactile_resonance.configuration import share_path
    from tactile_resonance.report import simulation_figures
    from tactile_resonance.report.drawing import save_figure
    from tactile_resonance.scan.scene import read_scan_scene
    from tactile_resonance.simulation.sensor.bench import SimulatedBench
    from tactile_resonance.simulation.tissue.library import read_tissues
    from tactile_resonance.simulation.tissue.scene import read_scene

    bench, library = SimulatedBench.from_configuration(), read_tissues()
    path = share_path("config/scenes/inclusion.yaml")
    scene, positions_m = read_scene(library, path), read_scan_scene(path).positions_m
    gels = ("gel10", "gel12", "gel14", "gel16")
    organs = ("cortex", "white", "liver")
    figures = {
        "tissues": simulation_figures.draw_tissues(bench, library, (*gels, *organs)),
        "indentation": simulation_figures.draw_indentation(
            bench, library, ("gel10", "cortex", "liver")
        ),
        "scene": simulation_figures.draw_scene(bench, scene, positions_m[:, :2]),
        "creep": simulation_figures.draw_creep(bench, library, ("gel10", "cortex", "liver")),
    }
    for name, figure in figures.items():
        save_figure(figure, output / f"{name}.png")
    print(f"figures in {output}: {', '.join(f'{name}.png' for name in figures)}")


def _distortion(output: Path) -> None:
    from tactile_resonance.frf.distortion import estimate_distortion
    from tactile_resonance.frf.spectra import Spectrum
    from tactile_resonance.report.drawing import (
        SIMULATED,
        draw_distortion,
        draw_distortion_levels,
        save_figure,
    )
    from tactile_resonance.simulation.sensor.experiments import records_at_levels

    cases = {
        level_v: estimate_distortion(Spectrum.of(u, y), sample_rate_hz=rate_hz, harmonics=harmonics)
        for level_v, (u, y, harmonics, rate_hz) in records_at_levels(
            (1.0, 2.0, 3.0, 4.0), progress=_progress
        ).items()
    }
    for level_v, distortion in cases.items():
        print(f"{level_v:g} V rms: {distortion.summary()}")
    tissue = f"gelatine 10 %, {SIMULATED}"
    figure = draw_distortion(
        {f"{level_v:g} V rms": distortion for level_v, distortion in cases.items()},
        f"Output and its nonlinear distortion ({tissue})",
    )
    save_figure(figure, output / "distortion.png")
    figure = draw_distortion_levels(cases, f"Distortion over drive level ({tissue})")
    save_figure(figure, output / "distortion_levels.png")
    print(f"figures in {output}: distortion.png, distortion_levels.png")


def _variance(output: Path) -> None:
    from tactile_resonance.commands.references import print_variance
    from tactile_resonance.frf.spectra import Spectrum
    from tactile_resonance.report.drawing import SIMULATED, draw_variance, save_figure
    from tactile_resonance.simulation.sensor.experiments import repeated_records

    u, y, harmonics, rate_hz = repeated_records(progress=_progress)
    lines = Spectrum.of(u, y).by_period[..., harmonics]  # (..., 2, P, F)
    g = lines[..., 0, :, :] / lines[..., 1, :, :]
    frequency_hz = harmonics * rate_hz / u.shape[-1]
    places = np.indices(g.shape[:-1]).reshape(g.ndim - 1, -1)
    groups, g = np.stack([0 * places[0], *places[:-1]], axis=1), g.reshape(-1, frequency_hz.size)
    found = print_variance(g, frequency_hz, groups, BAND_HZ)
    title = f"Variance of the FRF by source (gelatine 12 %, {SIMULATED})"
    save_figure(draw_variance(found, frequency_hz, BAND_HZ, title), output / "variance.png")
    print(f"figure in {output}: variance.png")


def _mechanics(output: Path) -> None:
    from tactile_resonance.mechanics.indentation import Protocol
    from tactile_resonance.report.drawing import draw_tests, save_figure
    from tactile_resonance.scan.tissue_tests import fitted
    from tactile_resonance.sensor import sensor_named
    from tactile_resonance.simulation.plant.contact_bench import indent_tissue
    from tactile_resonance.simulation.tissue.library import read_tissues

    library, sensor = read_tissues(), sensor_named("bimorph")
    for protocol, hold_s, unload_speed_m_s in (
        (Protocol.RELAXATION, 180.0, 0.0),
        (Protocol.CREEP, 60.0, 0.0),
        (Protocol.INDENTATION, 2.0, 5e-4),
    ):
        tests = [
            fitted(
                indent_tissue(
                    library[tissue],
                    sensor,
                    protocol,
                    hold_s=hold_s,
                    force_n=FORCE_N,
                    unload_speed_m_s=unload_speed_m_s,
                    progress=_progress,
                )
            )
            for tissue in ("cortex", "liver", "gel10")
        ]
        title = f"{protocol.value.capitalize()} of tissue under a rigid ball of 5 mm"
        save_figure(draw_tests(tests, title), output / f"test_{protocol.value}.png")
    print(f"figures in {output}: test_relaxation.png, test_creep.png, test_indentation.png")


DRAW = {
    "simulation": _simulation,
    "distortion": _distortion,
    "variance": _variance,
    "mechanics": _mechanics,
}


def _benchmark(options: argparse.Namespace) -> int:
    """Run one or all: page and figure of each are written, and the page printed."""
    if find_spec("benchmarks") is None:
        raise ValueError(
            "benchmark: no benchmarks found, run it from the source tree: tools/run.sh"
        )
    given = {name: value for name in OF_SOME if (value := getattr(options, name))}
    for name, value in given.items():
        known = (*OF_SOME[name], *([None] if name == "full" else []))
        require(options.name in known, f"--{name}", value, f"with {', '.join(OF_SOME[name])} only")
    if options.guard:
        text, good = import_module("benchmarks.overview").guard()
        print(text)
        return 0 if good else 1
    options.output.mkdir(parents=True, exist_ok=True)
    for name in NAMES if options.name is None else (options.name,):
        extra = {option: value for option, value in given.items() if name in OF_SOME[option]}
        page = import_module(f"benchmarks.{name}").run(options.output, options.quick, **extra)
        write_page(options.output, name, page)
        print(page)
    return 0


def write_page(output: Path, name: str, page: str) -> None:
    """Write what a benchmark returned; it calls this itself before it fails for what the page states."""
    write_whole(output / PAGES.get(name, f"{name}.md"), page.encode())
