# SPDX-License-Identifier: Apache-2.0
"""Mechanical tests on the bench in virtual time: controller, arm and cell of a contact on one tissue."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from tactile_resonance.contact.geometry import touch_pose
from tactile_resonance.contact.goal import Aim, ContactGoal, HoldMode, State
from tactile_resonance.contact.loop import ContactLoop, IndentationRecorder
from tactile_resonance.contact.machine import ContactController
from tactile_resonance.contact.parameters import read_contact
from tactile_resonance.contact.samples import Pose
from tactile_resonance.mechanics.indentation import BallTip, IndentationRecord, Protocol
from tactile_resonance.sensor import SensorParameters
from tactile_resonance.simulation.plant.contact_bench import ContactBench
from tactile_resonance.simulation.plant.surfaces import PlantSurface
from tactile_resonance.simulation.plant.tip import Tip
from tactile_resonance.simulation.sensor.bimorph import sensor_modes
from tactile_resonance.simulation.tissue.hertz import Tissue

START_M = 5e-3
"""Of the tip above the tissue."""
LONGER_S = 60.0
"""A test ends so long after its hold, or has failed."""


def indent_tissue(
    tissue: Tissue,
    sensor: SensorParameters,
    protocol: Protocol,
    *,
    hold_s: float,
    force_n: float = 0.01,
    unload_speed_m_s: float = 0.0,
    rigid: bool = True,
    seed: int = 0,
    poisson_ratio: float = 0.49,
    progress: Callable[[str], None] = lambda text: None,
) -> IndentationRecord:
    """Carry a test out as contact_node does, on tissue that was never touched and is known to be soft.

    Parameters
    ----------
    tissue : Tissue
    sensor : SensorParameters
        For ball and beam.
    protocol : Protocol
    hold_s, force_n, unload_speed_m_s : float
        As the action ``indent`` takes them; the limit of the hold is raised to what it needs.
    rigid : bool
        The ball on the robot itself; else at the end of the sensor's beam.
    seed : int
        Of arm and cell.
    poisson_ratio : float
    progress : callable
        Told what is done.

    Raises
    ------
    ValueError
        If a limit of the contact refuses it.
    RuntimeError
        If the test failed, with its cause.
    """
    progress(
        f"{protocol.value} of {tissue.label or tissue.name}, {hold_s:g} s at {1e3 * force_n:g} mN"
    )
    parameters, limits = read_contact()
    modes = sensor_modes(sensor)
    stiffness = math.inf if rigid else modes.static_stiffness_n_per_m
    parameters = replace(
        parameters,
        beam_stiffness_n_per_m=0.0 if rigid else stiffness,
        unknown_speed_m_s=parameters.approach_speed_m_s,  # it is no bone
    )
    limits = replace(limits, hold_s=max(limits.hold_s, hold_s + LONGER_S))
    radius_m = sensor.tip.radius_m
    touch = touch_pose([0, 0, 0], [0, 0, 1], [1, 0, 0], radius_m)
    bench = ContactBench(
        tissue,
        PlantSurface.tilted(0.0, 0.0),
        Pose(touch.position_m + [0, 0, START_M], touch.rotation_rad),
        tip=Tip(radius_m, None if rigid else modes, poisson_ratio),
        seed=seed,
    )
    hold = HoldMode.FORCE if protocol is Protocol.CREEP else HoldMode.INDENTATION
    goal = ContactGoal(touch, Aim(force_n, hold), hold_s=hold_s, unload_speed_m_s=unload_speed_m_s)
    ball = BallTip(radius_m, poisson_ratio, stiffness)
    recorder = IndentationRecorder(goal, protocol, ball, bench.cell.info.name, simulated=True)
    controller = ContactController(parameters, limits, under_sample=True)
    loop = ContactLoop(bench.arm, bench.cell, bench.clock, controller, recorder.take)
    loop.start(goal)
    ended = (State.IDLE, State.FAULT)
    loop.run_while(lambda: controller.state not in ended, hold_s + LONGER_S)
    result = controller.result
    if result is None or not result.reached or controller.state is not State.IDLE:
        raise RuntimeError(f"test of {tissue.name}: {controller.state.value}: {result}")
    return replace(recorder.record(result), label=tissue.label or tissue.name)
