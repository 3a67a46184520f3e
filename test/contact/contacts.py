# SPDX-License-Identifier: Apache-2.0
"""A contact on the bench in virtual time, started close to the surface so that it is soon made."""

from dataclasses import dataclass, field, replace

import numpy as np

from tactile_resonance.contact.geometry import touch_pose
from tactile_resonance.contact.goal import ContactGoal, HoldMode
from tactile_resonance.contact.loop import ContactLoop
from tactile_resonance.contact.machine import ContactController
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.samples import Pose
from tactile_resonance.simulation.plant.contact_bench import ContactBench
from tactile_resonance.simulation.plant.surfaces import PlantSurface
from tactile_resonance.simulation.plant.tip import Tip
from tactile_resonance.simulation.tissue.library import Tissue

RADIUS_M, FORCE_N = 2.5e-3, 0.01
SOFT = Tissue("soft", 4.5e3, (1.0,), (0.95,))  # 8.8 kPa at once, 4.5 after 1 s
# as where a contact near by has succeeded; in 0.1 s a drift is known to 4 mN/s only
QUICK = ContactParameters(
    tare_s=0.1,
    tare_drift_n_per_s=0.01,
    standoff_m=2.1e-3,
    early_m=2e-3,
    unknown_speed_m_s=5e-3,
)


@dataclass
class Contact:
    """Bench, controller, loop, and what truly happened, one entry per period."""

    bench: ContactBench
    controller: ContactController
    loop: ContactLoop
    goal: ContactGoal
    force_n: list = field(default_factory=list)
    speed_m_s: list = field(default_factory=list)

    def __post_init__(self):
        # a method, not a closure: a copy of the contact records into itself
        self.bench.on_step.append(self.record)

    def record(self):
        self.force_n.append(float(self.bench.plant.force_n[2]))
        self.speed_m_s.append(float(self.bench.motion.twist[2]))

    def run_until(self, state, longest_s=20.0):
        """Run until a state is reached; False where it is not."""
        self.loop.run_while(lambda: self.controller.state is not state, longest_s)
        return self.controller.state is state

    def run(self, duration_s):
        self.loop.run_while(lambda: True, duration_s)


def contact(
    tissue=SOFT,
    *,
    height_m=1e-3,
    tilt_rad=0.0,
    start_m=2.5e-3,
    parameters=QUICK,
    limits=None,
    force_n=FORCE_N,
    hold=HoldMode.FORCE,
    seed=0,
    tip=None,
    under_sample=False,
    calm_periods=1,
    **bench,
):
    touch = touch_pose([0, 0, 0], [0, 0, 1], [1, 0, 0], RADIUS_M)
    start = Pose(touch.position_m + [0, 0, start_m], touch.rotation_rad)
    rig = ContactBench(
        tissue,
        PlantSurface.tilted(height_m, tilt_rad),
        start,
        tip=tip or Tip(RADIUS_M),
        seed=seed,
        **bench,
    )
    limits = Limits() if limits is None else limits
    controller = ContactController(
        parameters, limits, under_sample=under_sample, calm_periods=calm_periods
    )
    loop = ContactLoop(rig.arm, rig.cell, rig, controller)
    goal = ContactGoal(touch, force_n, hold)
    return Contact(rig, controller, loop, goal)


def started(tissue=SOFT, **options):
    made = contact(tissue, **options)
    made.loop.start(made.goal)
    return made


def stiffer(tissue, factor):
    return replace(tissue, relaxation_modulus_1s_pa=factor * tissue.relaxation_modulus_1s_pa)


def lower(bench, by_m):
    """Take the tissue away downwards."""
    surface = bench.plant.surface
    bench.plant.surface = PlantSurface(surface.point_m - np.array([0, 0, by_m]), surface.normal)
