# SPDX-License-Identifier: Apache-2.0
"""Where the time of a scan's point goes, phase by phase, and what each way of shortening it takes off.

Contacts in virtual time at the points of a grid, as scan_node asks for them and contact_node makes them:
controller, loop, beam and parameters of ``config/contact.yaml``, plant, robot and load cell of `benchmark
contact`. The blocks are a time for which the force is held. Everything is simulated.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from tactile_resonance.contact.geometry import touch_pose
from tactile_resonance.contact.goal import ContactGoal, State
from tactile_resonance.contact.loop import ContactLoop, Cycle
from tactile_resonance.contact.machine import ContactController
from tactile_resonance.contact.parameters import read_contact
from tactile_resonance.contact.samples import Pose
from tactile_resonance.scan.clearance import Standoffs
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.surface import Plane
from tactile_resonance.sensor import read_sensor
from tactile_resonance.simulation.plant.contact_bench import ContactBench
from tactile_resonance.simulation.plant.surfaces import PlantSurface
from tactile_resonance.simulation.plant.tip import Tip
from tactile_resonance.simulation.sensor.bimorph import sensor_modes
from tactile_resonance.simulation.tissue.library import read_tissues

FORCE_N, SIDE, SPACING_M, BLOCKS_S, START_M = 0.01, 4, 0.005, 0.8, 0.02
UP, TURN = (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)
PHASES = [s for s in State if s not in (State.IDLE, State.FAULT)]


@dataclass(frozen=True)
class Skipping:
    """What is left out between two points.

    Attributes
    ----------
    tare : bool
        The rest for the tare, where the zero is known from the contact before.
    way : bool
        Of the way down and up what the surface, as it was touched near by, does not ask for.
    """

    tare: bool = True
    way: bool = True


@dataclass(frozen=True)
class PointTimes:
    """Of all points of one scan.

    Attributes
    ----------
    phases_s : dict of State to (points,) array
    force_n : (points,) array
        Mean true force while it was held.
    peak_n : float
        Largest true force of all.
    """

    phases_s: dict[State, np.ndarray]
    force_n: np.ndarray
    peak_n: float

    @property
    def total_s(self) -> np.ndarray:
        """(points,) all phases."""
        return np.sum(list(self.phases_s.values()), axis=0)


def grid() -> list[ScanPoint]:
    """Points of a square in serpentine order, as in the demo."""
    places = []
    for row in range(SIDE):
        along = [(column * SPACING_M, row * SPACING_M, 0.0) for column in range(SIDE)]
        places += along if row % 2 == 0 else along[::-1]
    return [ScanPoint(index, place, UP, TURN) for index, place in enumerate(places)]


def point_times(skipping: Skipping, seed: int = 1) -> PointTimes:
    """Contacts with 10 % gelatine at all points of `grid`, each held for its blocks."""
    points = grid()
    parameters, limits = read_contact()
    if not skipping.tare:
        parameters = replace(parameters, zero_std_n=0.0)
    sensor = read_sensor()
    radius_m = sensor.tip.radius_m
    touches = [touch_pose(p.position_m, UP, [1.0, 0.0, 0.0], radius_m) for p in points]
    bench = ContactBench(
        read_tissues().gelatine(10.0),
        PlantSurface.tilted(0.0, 0.0),
        Pose(touches[0].position_m + [0, 0, START_M], touches[0].rotation_rad),
        tip=Tip(radius_m, sensor_modes(sensor)),
        seed=seed,
    )
    controller = ContactController(parameters, limits, under_sample=True)
    spent: list[Counter[State]] = []
    forces_n: list[list[float]] = []
    peak_n = 0.0

    def note(cycle: Cycle) -> None:
        nonlocal peak_n
        force_n = float(bench.plant.force_n[2])
        peak_n = max(peak_n, force_n)
        spent[-1][cycle.state] += 1
        if cycle.state is State.HOLD:
            forces_n[-1].append(force_n)

    loop = ContactLoop(bench.arm, bench.cell, bench, controller, note)
    standoffs = Standoffs(Plane())
    for point, touch in zip(points, touches, strict=True):
        spent.append(Counter())
        forces_n.append([])
        lowest_m = standoffs.lowest_m(point) if skipping.way else np.inf
        result = loop.make(ContactGoal(touch, FORCE_N, standoff_m=lowest_m))
        if not result.reached:
            raise RuntimeError(f"point {point.index + 1}: {result.cause.value}: {result.message}")
        standoffs.add(point, result.surface_m, result.surface_std_m)
        loop.run_while(lambda: controller.state is State.HOLD, BLOCKS_S)
        loop.retract()
    phases_s = {
        phase: parameters.period_s * np.array([each[phase] for each in spent]) for phase in PHASES
    }
    return PointTimes(phases_s, np.array([np.mean(each) for each in forces_n]), peak_n)


SKIPPINGS = {
    "nothing": Skipping(tare=False, way=False),
    "the tare": Skipping(way=False),
    "the way": Skipping(tare=False),
    "both": Skipping(),
}


def table(scans: int = 4) -> list[str]:
    """Markdown: mean time of a point but the first, by phase, for each way of skipping.

    Parameters
    ----------
    scans : int
        Of the grid, of each kind; their noise differs.
    """
    head = ["skipped", *(phase.value for phase in PHASES), "point [s]", "force [%]", "peak [mN]"]
    rows = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    for name, skipping in SKIPPINGS.items():
        made = [point_times(skipping, seed=1 + k) for k in range(scans)]
        mean_s = [np.mean([each.phases_s[phase][1:] for each in made]) for phase in PHASES]
        off = np.concatenate([each.force_n for each in made]) / FORCE_N - 1
        texts = [name, *(f"{value:.2f}" for value in mean_s), f"{sum(mean_s):.2f}"]
        texts += [f"{100 * np.sqrt(np.mean(off**2)):.1f}"]
        texts += [f"{1e3 * max(each.peak_n for each in made):.1f}"]
        rows.append(f"| {' | '.join(texts)} |")
    return rows
