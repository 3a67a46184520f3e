# SPDX-License-Identifier: Apache-2.0
"""Robot, tissue and load cell of the bench on one clock, each on the ports of a real one.

What was true of the tip at every step is kept: no instrument shows it, but the simulated sensor follows the
contact by it, and tests and benchmarks judge by it how deep, how hard and how long.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from itertools import takewhile
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.payload import Mount
from tactile_resonance.contact.samples import Pose
from tactile_resonance.contact.vectors import Six, Vector
from tactile_resonance.fields import number, read_dataclass, require
from tactile_resonance.sensor import SensorParameters
from tactile_resonance.simulation.cell.tcp_bus import TcpBus
from tactile_resonance.simulation.cell.transducer import LoadCell
from tactile_resonance.simulation.plant.defaults import MOST_STEPS
from tactile_resonance.simulation.plant.plant import Plant
from tactile_resonance.simulation.plant.simulated_robot import SimulatedRobot
from tactile_resonance.simulation.plant.surfaces import PlantSurface, SurfaceMotion
from tactile_resonance.simulation.plant.tip import Tip
from tactile_resonance.simulation.sensor.bimorph import sensor_modes
from tactile_resonance.simulation.tissue.library import Tissue, TissueLibrary

KEEP_STEPS = 30_000
"""A minute at 500 Hz; a block of the simulated sensor that is longer loses the beginning of its contact."""


class _PlantStep(NamedTuple):
    time_s: float
    tip_m: Vector
    normal_force_n: float
    contact_radius_m: float
    depth_m: float


_NOW = attrgetter(*_PlantStep._fields)  # of a plant


class PlantHistory:
    """Time, place of the tip and its contact, step by step.

    Parameters
    ----------
    plant : Plant

    Attributes
    ----------
    largest_force_n : float
        On the tissue along its normal, since the beginning.
    """

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self.largest_force_n = 0.0
        self._steps: deque[_PlantStep] = deque(maxlen=KEEP_STEPS)

    def step(self) -> None:
        """Note what is true now; to be called after each step of the plant."""
        plant = self._plant
        self.largest_force_n = max(self.largest_force_n, plant.normal_force_n)
        self._steps.append(_PlantStep._make(_NOW(plant)))

    def contact_over(self, fields: dict) -> dict:
        """Control port: the contact from field ``after_s`` to ``until_s``, means over so many equal ``parts``.

        Answers ``normal_force_n``, ``contact_radius_m`` and ``depth_m``, each (parts,); null for a part in
        which the plant stood still, or of which nothing is kept.
        """
        after_s = number(fields.get("after_s"), "after_s")
        until_s = number(fields.get("until_s"), "until_s")
        parts = fields.get("parts")
        require(after_s < until_s, "until_s", until_s, f"above after_s = {after_s:g}")
        good = type(parts) is int and 1 <= parts <= MOST_STEPS
        require(good, "parts", parts, f"an integer, 1 to {MOST_STEPS}")
        assert isinstance(parts, int)
        steps = [step for step in self._since(after_s) if step.time_s <= until_s]
        times = np.array([step.time_s for step in steps])
        # a step ends at its time
        at = np.ceil((times - after_s) / (until_s - after_s) * parts - 1e-6).astype(int) - 1
        at = at.clip(0, parts - 1)
        counts = np.bincount(at, minlength=parts)
        answer = {}
        for name in ("normal_force_n", "contact_radius_m", "depth_m"):
            sums = np.bincount(at, [getattr(step, name) for step in steps], parts)
            pairs = zip(sums.tolist(), counts.tolist(), strict=True)
            answer[name] = [total / count if count else None for total, count in pairs]
        return answer

    def since(self, fields: dict) -> dict:
        """Control port: the first steps after field ``after_s``, 250 at most, oldest first.

        Answers ``time_s`` (n,), ``tip_m`` (n, 3) in the base and ``normal_force_n`` (n,).
        """
        first = self._since(number(fields.get("after_s", 0.0), "after_s"))[:MOST_STEPS]
        return {
            name: [getattr(step, name) for step in first]
            for name in ("time_s", "tip_m", "normal_force_n")
        }

    def _since(self, after_s: float) -> list[_PlantStep]:
        """Steps after a time, oldest first."""
        return list(takewhile(lambda step: step.time_s > after_s, reversed(self._steps)))[::-1]


TIP_IN_FLANGE = Pose(np.array([0.0, 0.0, 0.12]), np.array([0.0, math.pi, 0.0]))
"""Where the tip sits: 0.12 m before the flange, its z against the flange's."""


def bench_surface(height_m: float, tilt_rad: float = 0.0, azimuth_rad: float = 0.0) -> PlantSurface:
    """Return `PlantSurface.tilted` in the robot's base; ValueError where a bench has no such surface."""
    require(-1 <= height_m <= 1, "surface_height_m", height_m, "-1 to 1")
    require(abs(tilt_rad) <= 0.35, "tilt_rad", tilt_rad, "-0.35 to 0.35 (20 degrees)")
    require(math.isfinite(azimuth_rad), "azimuth_rad", azimuth_rad, "a number")
    return PlantSurface.tilted(height_m, tilt_rad, azimuth_rad)


def table_plant(
    library: TissueLibrary,
    sensor: SensorParameters,
    surface: PlantSurface,
    tissue_at: Callable[[FloatArray], Tissue | None],
    motion: SurfaceMotion | None = None,
    *,
    rigid_tip: bool = False,
    mount: Mount = Mount.TABLE,
) -> Plant:
    """Return what the controller's tool touches, all of which can be exchanged while it runs.

    Parameters
    ----------
    library : TissueLibrary
    sensor : SensorParameters
    surface : PlantSurface
        The undisturbed surface in the robot's base.
    tissue_at : callable
        As a `Plant` asks for it.
    motion : SurfaceMotion or None
    rigid_tip : bool
        The ball on the robot itself; else at the end of the sensor's beam.
    mount : Mount
        Of the cell.
    """
    beam, nu = None if rigid_tip else sensor_modes(sensor), library.contact.poisson_ratio
    plant = Plant(surface, tissue_at, Tip(sensor.tip.radius_m, beam, nu), mount=mount)
    plant.motion = motion
    return plant


def place_surface(plant: Plant, fields: dict) -> None:
    """Control port: move the surface; fields ``height_m``, ``tilt_rad``, ``azimuth_rad``."""
    plant.surface = bench_surface(
        number(fields.get("height_m"), "height_m"),
        number(fields.get("tilt_rad", 0.0), "tilt_rad"),
        number(fields.get("azimuth_rad", 0.0), "azimuth_rad"),
    )


def move_surface(plant: Plant, fields: dict) -> None:
    """Control port: how the surface moves from now on; fields of `SurfaceMotion`, none: at rest."""
    asked = {name: value for name, value in fields.items() if name != "command"}
    plant.motion = read_dataclass(SurfaceMotion, asked, "") if asked else None


def truth(plant: Plant) -> dict:
    """Control port: the true state of the contact."""
    names = (
        *("time_s", "tip_m", "site_m", "force_n", "normal_force_n", "contact_s", "depth_m"),
        *("contact_radius_m", "in_contact", "touches"),
    )
    told = {name: getattr(plant, name) for name in names}
    return told | {"tissue": None if plant.tissue is None else plant.tissue.name}


def attach(robot: SimulatedRobot, plant: Plant, library: TissueLibrary) -> None:
    """Add the orders of the table to the robot's control port, and keep its history."""
    history = PlantHistory(plant)

    def place_tissue(fields: dict) -> None:
        """What the tip finds at its next new place; field ``name``, null for nothing."""
        name = fields.get("name")
        tissue = None if name is None else library[str(name)]
        plant.tissue_at = lambda _: tissue

    robot.after_step.append(history.step)
    robot.orders.update(
        place_surface=partial(place_surface, plant),
        move_surface=partial(move_surface, plant),
        place_tissue=place_tissue,
        truth=lambda _: {
            **truth(plant),
            "stalls": robot.time.stalls,
            "largest_force_n": history.largest_force_n,
        },
        history=history.since,
        contact_over=history.contact_over,
    )


def attach_cell(robot: SimulatedRobot, plant: Plant, cell: LoadCell, bus: TcpBus) -> None:
    """Step a load cell with the plant, on the bus that it sends to; its faults are orders to the control port.

    On the wall clock its frames are stamped with this machine's time, else with the plant's. Of steps that are
    made together those in which its load stays are one for the cell.
    """
    load: Six | None = None  # on the cell in the last step
    left_s: float | None = None  # when that was, where the cell has not been stepped up to it

    def step() -> None:
        nonlocal load, left_s
        before, load = load, plant.wrench_at_cell()
        if robot.time.to_follow and load is before:
            left_s = plant.time_s
            return
        if not robot.time.simulated:
            bus.keep_epoch(time.time(), plant.time_s)
        frames = []
        if left_s is not None and before is not None and load is not before:
            frames = cell.step(before, left_s)
        left_s = None
        bus.send(frames + cell.step(load, plant.time_s))

    def inject(fields: dict) -> None:
        """Fields ``fault`` and ``value``; 0 ends it. ``server_gone`` drops clients."""
        fault = fields.get("fault")
        if fault == "server_gone":
            bus.drop_clients()
        else:
            cell.faults.inject(str(fault), number(fields.get("value"), "value"))

    robot.after_step.append(step)
    robot.orders["cell_fault"] = inject
    robot.time.frames_sent = bus.frames_sent
