# SPDX-License-Identifier: Apache-2.0
"""One simulated contact: tissue, tip, mount; run with our controller or with a simple law."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tactile_resonance.contact.geometry import touch_pose
from tactile_resonance.contact.interfaces import Mount
from tactile_resonance.contact.law import Aim
from tactile_resonance.contact.loop import ContactLoop
from tactile_resonance.contact.machine import ContactController, ContactGoal, State
from tactile_resonance.contact.mounting import Mounting
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.payload import Payload
from tactile_resonance.contact.samples import Pose
from tactile_resonance.contact.tip_force import TipForce
from tactile_resonance.simulation.beam import sensor_modes
from tactile_resonance.simulation.indenter import Indenter, SprungIndenter
from tactile_resonance.simulation.parameters import read_sensor
from tactile_resonance.simulation.plant import CellMounting, Plane, Plant, RigidTip, TipOnTissue
from tactile_resonance.simulation.tissue import Tissue
from tactile_resonance.simulation.tracking import TrackingParameters
from tactile_resonance.simulation.virtual import (
    CellParameters,
    VirtualArm,
    VirtualBench,
    VirtualCell,
)

FORCE_N, POISSON_RATIO, RELAXATION = 0.01, 0.49, 0.6
TOOL_KG = 0.03
TOOL = {
    "carried_kg": TOOL_KG,
    "cell_noise_n": 1.6e-3,
    "acceleration_m_s2": 0.3,
    "approach_speed_m_s": 3e-3,
}
"""A tool on the cell: its inertia is known, it shakes with the robot, and it is started gently."""

DEEPEST_M = 4.5e-3
"""The softest tissue creeps deeper than the default limit allows, and the beam bends."""

MODES = sensor_modes(read_sensor())


@dataclass(frozen=True)
class Setup:
    """What is on the robot, and how it shakes."""

    name: str
    beam: bool = False
    mount: Mount = Mount.TABLE
    jitter_m: float = 3e-6
    noise_n: float = 1e-3


@dataclass(frozen=True)
class Case:
    """One tissue at one place."""

    radius_m: float
    modulus_pa: float
    relaxation_s: float
    height_m: float
    tilt_rad: float
    seed: int

    def tissue(self) -> Tissue:
        """One relaxation time; `modulus_pa` is that of a sudden step, 60 % of it relax."""
        left = 1 - RELAXATION * (1 - np.exp(-1 / self.relaxation_s))
        return Tissue(
            "case",
            self.modulus_pa * left,
            (self.relaxation_s,),
            (RELAXATION / left,),
        )


@dataclass(frozen=True)
class Outcome:
    """What became of it, from the true force along the tip's axis.

    Attributes
    ----------
    ready_s : float
        From the first touch; infinite where never.
    overshoot, mean_error : float
        Share of the force: largest force until 1 s after ready; mean over that second.
    bounces : int
    cause : str
    stated_std : float
        Stated standard deviation of the mean force, as a share; NaN for simple laws.
    """

    ready_s: float
    overshoot: float
    mean_error: float
    bounces: int
    cause: str
    stated_std: float


class Rig:
    """Bench, arm and cell of one case, and the record of its true force."""

    def __init__(self, case: Case, setup: Setup) -> None:
        radius = case.radius_m

        def tip(tissue: Tissue) -> TipOnTissue:
            ball = Indenter(tissue, tip_radius_m=radius, poisson_ratio=POISSON_RATIO)
            return SprungIndenter.on_beam(ball, MODES) if setup.beam else RigidTip(ball)

        tissue = case.tissue()
        carried = TOOL_KG if setup.mount is Mount.TOOL else 0.2
        centre = [-0.03, 0, 0.01] if setup.mount is Mount.TOOL else [0, 0, -0.01]
        self.plant = Plant(
            Plane.tilted(case.height_m, case.tilt_rad, 2.0 * case.seed),
            lambda _: tissue,
            tip,
            tip_radius_m=radius,
            mounting=CellMounting(setup.mount, carried_kg=carried, centre_m=np.array(centre)),
        )
        self.touch = touch_pose([0, 0, 0], [0, 0, 1], [1, 0, 0], radius)
        start = Pose(self.touch.position_m + [0, 0, 3e-3], self.touch.rotation_rad)
        self.bench = VirtualBench(
            self.plant,
            start,
            tracking=TrackingParameters(jitter_rms_m=setup.jitter_m),
            seed=case.seed,
        )
        self.arm = VirtualArm(self.bench)
        parameters = replace(CellParameters.from_yaml(), force_noise_rms_n=setup.noise_n)
        self.cell = VirtualCell(self.bench, parameters, seed=case.seed)
        payload = None
        if setup.mount is Mount.TOOL:  # the cell's frame lies in the frame tip
            payload = Payload(TOOL_KG, np.array(centre))
        frame = self.plant.mounting.frame
        self.force = TipForce(self.cell, Mounting(setup.mount, frame, payload), self.arm.state)
        self.arm.connect()
        self.force.start()
        self.force_n: list[float] = []
        self.bench.on_step.append(lambda: self.force_n.append(float(self.plant.force_n[2])))

    def outcome(self, ready_n: int | None, cause: str, stated_std: float) -> Outcome:
        """Judge the record; `ready_n` periods after the start the contact was called ready."""
        force, dt = np.array(self.force_n), self.bench.motion.period_s
        touched = int(np.argmax(force > 0)) if (force > 0).any() else 0
        if ready_n is None:
            return Outcome(np.inf, force.max() / FORCE_N - 1, np.nan, 0, cause, stated_std)
        second = force[ready_n : ready_n + round(1 / dt)]
        return Outcome(
            ready_s=(ready_n - touched) * dt,
            overshoot=force[: ready_n + round(1 / dt)].max() / FORCE_N - 1,
            mean_error=abs(second.mean() / FORCE_N - 1),
            bounces=self.plant.touches - 1,
            cause=cause,
            stated_std=stated_std,
        )


def run_controller(
    case: Case,
    setup: Setup,
    parameters: ContactParameters | None = None,
    listener: Callable | None = None,
) -> Outcome:
    """Run our controller, told what is on the robot but nothing of the tissue."""
    rig = Rig(case, setup)
    if parameters is None:
        parameters = ContactParameters(
            beam_stiffness_n_per_m=MODES.static_stiffness_n_per_m if setup.beam else 0.0,
            **(TOOL if setup.mount is Mount.TOOL else {}),
        )
    controller = ContactController(parameters, Limits(depth_m=DEEPEST_M))
    loop = ContactLoop(rig.arm, rig.force, rig.bench, controller, listener)
    loop.start(ContactGoal(rig.touch, Aim(FORCE_N)))
    loop.run_while(lambda: controller.result is None)
    ready = len(rig.force_n) if controller.state is State.HOLD else None
    loop.run_while(lambda: controller.state is State.HOLD, 1.0)
    result = controller.result
    assert result is not None
    std = np.nan if result.force_std_n is None else result.force_std_n / FORCE_N
    return rig.outcome(ready, result.cause.value, std)
