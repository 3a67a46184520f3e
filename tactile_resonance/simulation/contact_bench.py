# SPDX-License-Identifier: Apache-2.0
"""A whole contact bench in virtual time: tissue, tip, arm and load cell, ready for a contact loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tactile_resonance.contact.interfaces import Mount
from tactile_resonance.contact.payload import Payload
from tactile_resonance.contact.samples import Pose
from tactile_resonance.contact.tip_force import Mounting, TipForce
from tactile_resonance.contact.vectors import vector
from tactile_resonance.simulation.beam import BeamModes
from tactile_resonance.simulation.indenter import Ball, Indenter
from tactile_resonance.simulation.plant import CellMounting, Plant, RigidTip, TipOnTissue
from tactile_resonance.simulation.sprung_indenter import SprungIndenter
from tactile_resonance.simulation.surfaces import PlantSurface, relative_radius_m
from tactile_resonance.simulation.tissue import Tissue
from tactile_resonance.simulation.tracking import TrackingParameters
from tactile_resonance.simulation.transducer import CellParameters
from tactile_resonance.simulation.virtual import VirtualArm, VirtualBench, VirtualCell

DISH_KG = 0.2
"""Of the sample with its dish on a cell under it (chosen)."""


@dataclass(frozen=True)
class Tip:
    """The ball, and the beam that holds it where there is one.

    Attributes
    ----------
    radius_m : float
    beam : BeamModes or None
        None: held rigidly.
    poisson_ratio : float
        Of the tissue.
    adhesion_j_per_m2 : float
        See `Indenter`.
    meets : callable, optional
        From the ball on the tissue to what it meets: `OnBone`, `Clinging`.
    """

    radius_m: float = 2.5e-3
    beam: BeamModes | None = None
    poisson_ratio: float = 0.49
    adhesion_j_per_m2: float = 0.0
    meets: Callable[[Indenter], Ball] | None = None

    def on(self, tissue: Tissue, surface: PlantSurface) -> TipOnTissue:
        """Return the tip at rest over a tissue with that surface."""
        radius_m = relative_radius_m(self.radius_m, surface)
        soft = Indenter(
            tissue,
            tip_radius_m=radius_m,
            poisson_ratio=self.poisson_ratio,
            adhesion_j_per_m2=self.adhesion_j_per_m2,
        )
        ball: Ball = soft if self.meets is None else self.meets(soft)
        return RigidTip(ball) if self.beam is None else SprungIndenter.on_beam(ball, self.beam)


class ContactBench:
    """The bench; connected and streaming.

    Parameters
    ----------
    tissue : Tissue
        Everywhere under the surface.
    surface : PlantSurface
        What takes its place later must be curved alike.
    start : Pose
        Of the tip.
    tip : Tip
    mount : Mount
        Where the cell sits.
    tool_kg : float
        Mass beyond a tool-mounted cell [kg].
    tracking : TrackingParameters
    cell_parameters : CellParameters
    period_s : float
        Of robot and cell [s].
    seed : int

    Attributes
    ----------
    plant : Plant
    clock : VirtualBench
    arm : VirtualArm
    cell : VirtualCell
    force : TipForce
        The cell as a force source at the tip.
    """

    def __init__(
        self,
        tissue: Tissue,
        surface: PlantSurface,
        start: Pose,
        *,
        tip: Tip | None = None,
        mount: Mount = Mount.TABLE,
        tool_kg: float = 0.03,
        tracking: TrackingParameters | None = None,
        cell_parameters: CellParameters | None = None,
        period_s: float = 0.002,
        seed: int = 0,
    ) -> None:
        tip = Tip() if tip is None else tip
        on_tool = mount is Mount.TOOL
        centre = np.array([-0.03, 0.0, 0.01] if on_tool else [0.0, 0.0, -0.01])
        mounting = CellMounting(mount, carried_kg=tool_kg if on_tool else DISH_KG, centre_m=centre)
        self.plant = Plant(
            surface,
            lambda _: tissue,
            lambda found: tip.on(found, surface),
            tip_radius_m=tip.radius_m,
            mounting=mounting,
        )
        self.clock = VirtualBench(
            self.plant, start, tracking=tracking, period_s=period_s, seed=seed
        )
        self.arm = VirtualArm(self.clock)
        self.cell = VirtualCell(self.clock, cell_parameters, seed=seed)
        payload = Payload(tool_kg, vector(centre)) if on_tool else None
        self.force = TipForce(self.cell, Mounting(mount, mounting.frame, payload), self.arm.state)
        self.arm.connect()
        self.force.start()
