# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance plan`: what a scan of a scene will do, before anything moves."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from tactile_resonance.commands.options import add_figure, add_option
from tactile_resonance.fields import counted, read_yaml

if TYPE_CHECKING:
    from tactile_resonance.poles.result import Poles
    from tactile_resonance.scan.decision import Decision
    from tactile_resonance.scan.plan import Plan
    from tactile_resonance.simulation.tissue.library import Tissue
    from tactile_resonance.simulation.tissue.scene import PhantomScene

HELD_S = 1.0
"""Age of a contact on which a plan is tried."""


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of the command."""
    parser = commands.add_parser(
        "plan",
        help="what a scan of a scene will do, and what it leaves out",
        description="Print what a scan of a scene will excite, compute, publish and draw, what it leaves out "
        "and why, the touches and the time. Where the scene has regions, the simulated bench measures the "
        "first point of each as planned, and its precision and blocks are printed as expected.",
    )
    add_option(parser, "scene SCENE", Path, "scene file")
    add_figure(parser, "--figure", "draw points and lines")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read the scene, compile it, print, draw."""
    # only here: the command answers --help without the libraries of scans
    from tactile_resonance.scan.plan import make_plan, plan_rows
    from tactile_resonance.scan.scene import read_scan_scene

    plan = make_plan(read_scan_scene(options.scene))
    phantoms = read_phantoms(options.scene)
    print(f"plan of {plan.scene.name}")
    for name, text in plan_rows(plan):
        print(f"{name:>12}  {text}")
    for text in _expected(phantoms, plan):
        print(f"{'expected':>12}  {text}")
    if options.figure is not None:
        _draw(plan, options.figure)
        print(f"figure in {options.figure}")
    return 0


def read_phantoms(path: Path) -> PhantomScene | None:
    """What a scene file has for the simulated bench; None where it has nothing of that.

    Raises
    ------
    ValueError
        If a part of it is missing or wrong.
    """
    from tactile_resonance.scan.scene import BENCH_KEYS
    from tactile_resonance.simulation.tissue.library import read_tissues
    from tactile_resonance.simulation.tissue.scene import read_scene

    if BENCH_KEYS.isdisjoint(read_yaml(path)):
        return None
    return read_scene(read_tissues(), path)


def _expected(phantoms: PhantomScene | None, plan: Plan) -> list[str]:
    """Precision and blocks at the first point of each tissue, as the simulated bench measures them."""
    from tactile_resonance.scan.decision import Verdict

    if phantoms is None:
        return [
            "precision unknown: the scene has no regions to try it on; a simulated scan needs them"
        ]
    if plan.scene.sensor.calibrated:
        return ["precision unknown: it follows from the calibration, which the scene does not name"]
    lines, blocks, points = [], dict[str, int](), Counter[str]()
    for point in plan.first_points:
        tissue = phantoms.tissue_at(point.position_m)
        if tissue is None:
            continue
        points[tissue.name] += 1
        if tissue.name in blocks:
            continue
        poles, decision = _rehearsed(plan, tissue)
        blocks[tissue.name] = decision.blocks
        found = ", ".join(map(_found, poles.bands))
        ended = "" if decision.verdict is Verdict.PRECISE else f"; {decision.verdict.value}"
        after = counted(decision.blocks, "block")
        lines.append(f"on {tissue.name} (simulated), {HELD_S:g} s old, after {after}: {found}{ended}")
    if blocks:
        mean = round(sum(blocks[name] * count for name, count in points.items()) / points.total())
        at_most = "at most " if plan.scene.adaptive else ""
        lines.append(f"time {at_most}{plan.duration_s(mean) + plan.search_s:.0f} s")
    return lines or ["precision unknown: no point lies on a region of the scene"]


def _found(poles: Poles) -> str:
    """The main mode of a band, and what speaks against it."""
    from tactile_resonance.poles.result import PolesStatus

    mode, status = poles.main, poles.status
    if status is PolesStatus.FAILED:
        return f"no poles: {poles.message}"
    if not mode.found:
        return f"no pole from {poles.band_hz[0]:g} to {poles.band_hz[1]:g} Hz: {status.value}"
    remark = "" if status in (PolesStatus.OK, PolesStatus.NO_COVARIANCE) else f", {status.value}"
    f0, damping = f"{mode.f0_hz:.2f} +- {mode.std[0]:.2g} Hz", f"{mode.damping_ratio:.5f} +- {mode.std[1]:.1g}"
    return f"f0 {f0}, damping ratio {damping}{remark}"


def _rehearsed(plan: Plan, tissue: Tissue) -> tuple[Poles, Decision]:
    """Poles of one point measured block by block, and the decision that ended it."""
    from tactile_resonance.frf.measurement import MeasurementFrf
    from tactile_resonance.poles.estimator import poles_of_bands
    from tactile_resonance.poles.result import Poles, PolesStatus
    from tactile_resonance.scan.decision import decide
    from tactile_resonance.scan.measurement import excitation_of
    from tactile_resonance.simulation.sensor.bench import SimulatedBench
    from tactile_resonance.tissue.nominal_contact import ContactLoad

    scene, design, frf = plan.scene, plan.measurement, MeasurementFrf(0)
    pressed = ContactLoad(scene.force_n, 0.0, HELD_S)
    excitation = excitation_of(design, seed=1)
    bench = SimulatedBench.from_configuration()
    at_rest = bench.start(tissue, force_n=scene.force_n, hold_time_s=HELD_S, seed=1)
    for blocks, record in enumerate(at_rest.play(excitation, excitation.periods), 1):
        try:
            poles = poles_of_bands(frf.add(record, excitation), design.bands)
        except ValueError as error:  # as poles_node answers
            poles = Poles(status=PolesStatus.FAILED, message=str(error))
        wanted = scene.nominal_contact, blocks, scene.precision, design.blocks, design.block_s
        decision = decide(poles, pressed, *wanted)
        if decision.stop:
            break
    return poles, decision


def _draw(plan: Plan, path: Path) -> None:
    """Points in their order, seen from above, and the lines that are excited."""
    from tactile_resonance.report.drawing import new_figure, save_figure
    from tactile_resonance.scan.measurement import excitation_of

    figure = new_figure(13, 5, f"plan of {plan.scene.name}")
    above, lines = figure.subplots(1, 2)
    x_mm, y_mm = ([1e3 * point.position_m[k] for point in plan.first_points] for k in range(2))
    title = counted(len(plan.points), "point")
    if plan.scene.adaptive is not None:
        title = f"{counted(len(x_mm), 'point')} first, then at most {plan.most_points - len(x_mm)} of the dots"
        places_mm = ([1e3 * point.position_m[k] for point in plan.points] for k in range(2))
        above.plot(*places_mm, ".", color="0.8", ms=2)
    above.plot(x_mm, y_mm, "-", color="0.7", lw=0.8)
    above.plot(x_mm, y_mm, "o", ms=5)
    above.plot(x_mm[0], y_mm[0], "s", ms=9, mfc="none", color="C3")
    above.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal", title=f"{title}; square: the first")
    first = excitation_of(plan.measurement, seed=1)
    lines.vlines(first.frequency_hz, 0, 1e3 * first.amplitude_v, lw=0.8)
    for k, band in enumerate(plan.measurement.bands):
        lines.axvspan(band.low_hz, band.high_hz, color=f"C{k + 1}", alpha=0.2)
    lines.set(xlabel="frequency [Hz]", ylabel="amplitude of each line [mV]")
    lines.set_title("excited lines; shaded: bands in which poles are identified")
    save_figure(figure, path)
