# SPDX-License-Identifier: Apache-2.0
"""Everything mechanical on one clock: the tip at the robot, the tissue under it, the load cell.

The tip is a ball, rigid or at the end of the beam, on a flat tilted surface. Along the surface
normal the indenter says how tissue and beam answer; along the surface acts Coulomb friction with
the elastic slip of Mindlin's contact. Of tilts up to some ten degrees only the lateral force is
new: the beam is taken to bend along the surface normal.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.contact.interfaces import Mount
from tactile_resonance.contact.payload import GRAVITY_M_S2
from tactile_resonance.contact.samples import Pose
from tactile_resonance.fields import require
from tactile_resonance.simulation.indenter import Indenter
from tactile_resonance.simulation.tissue import Tissue

FloatArray = NDArray[np.float64]

NEAR_M = 0.005
"""Below this height the tip is stepped on its tissue: a beam that swings before it touches."""


class Surface(Protocol):
    """The undisturbed surface of what lies on the table."""

    def height_of(self, position_m: FloatArray) -> tuple[float, FloatArray]:
        """Height of a position above the surface [m], along the outward normal (3,) there."""
        ...


@dataclass(frozen=True)
class Plane:
    """A flat surface through a point; `normal` points out of the tissue and has length 1."""

    point_m: FloatArray
    normal: FloatArray

    @classmethod
    def tilted(cls, height_m: float, tilt_rad: float = 0.0, azimuth_rad: float = 0.0) -> Plane:
        """Return the plane through (0, 0, height), its normal tilted from +z towards an azimuth."""
        sine = math.sin(tilt_rad)
        normal = [sine * math.cos(azimuth_rad), sine * math.sin(azimuth_rad), math.cos(tilt_rad)]
        return cls(np.array([0.0, 0.0, height_m]), np.array(normal))

    def height_of(self, position_m: FloatArray) -> tuple[float, FloatArray]:
        """Height of a position above the plane [m], and the normal (3,)."""
        return float(self.normal @ (position_m - self.point_m)), self.normal


class TipOnTissue(Protocol):
    """A tip on one tissue through time: `RigidTip`, `SprungIndenter`."""

    @property
    def indenter(self) -> Indenter:
        """The ball."""
        ...

    def step(self, depth_m: float, dt_s: float, /) -> float:
        """Advance with the depth of what holds the tip [m]; return the force on that [N]."""
        ...


@dataclass(frozen=True)
class RigidTip:
    """A ball that moves as the robot does."""

    indenter: Indenter

    def step(self, depth_m: float, dt_s: float, /) -> float:
        """Advance with the depth of the ball [m]; return the force on it [N]."""
        return self.indenter.step(depth_m, dt_s)


@dataclass(frozen=True)
class CellMounting:
    """Where the load cell sits and what else it carries.

    Attributes
    ----------
    mount : Mount
    frame : Pose
        Frame of the cell: in the frame `tip` on the tool, in the base under the sample.
    carried_kg : float
        Mass that the cell carries: tool beyond it, or the sample with its dish.
    centre_m : (3,) array
        Centre of that mass: in the frame `tip` on the tool, in the base under the sample.
    """

    mount: Mount = Mount.TABLE
    frame: Pose = field(default_factory=lambda: Pose(np.zeros(3), np.zeros(3)))
    carried_kg: float = 0.0
    centre_m: FloatArray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        good = 0 <= self.carried_kg < math.inf
        require(good, "carried_kg", self.carried_kg, "a mass, 0 or above")


@dataclass(frozen=True)
class Friction:
    """Contact along the surface.

    Attributes
    ----------
    coefficient : float
        Of Coulomb friction; 0.1 is chosen for a wet plastic ball, not measured.
    poisson_ratio : float
        Tangential over normal stiffness is ``2 (1 - nu) / (2 - nu)`` (Mindlin 1949).
    """

    coefficient: float = 0.1
    poisson_ratio: float = 0.49

    @property
    def stiffness_ratio(self) -> float:
        """Tangential over normal stiffness of the contact before it slips."""
        return 2 * (1 - self.poisson_ratio) / (2 - self.poisson_ratio)


class Plant:
    """Tip, tissue and cell, moved by whoever steps it.

    Parameters
    ----------
    surface : Surface
        May be exchanged while the plant runs (``plant.surface = ...``): tissue that moves.
    tissue_at : callable
        From a position (3,) [m] in the base to the tissue under it; None where there is nothing to
        touch. Asked when the tip comes near at a new place.
    tip : callable
        From a tissue to a `TipOnTissue` at rest on it.
    tip_radius_m : float
    mounting : CellMounting
    friction : Friction

    Attributes
    ----------
    time_s : float
        Since the start [s].
    force_n, torque_nm : (3,) arrays
        True wrench of the tissue on the ball, about its centre, in the base [N], [N m].
    depth_m : float
        Depth of the ball's lowest point below the undisturbed surface [m], 0 above it.
    in_contact : bool
        Whether the tissue pushes on the ball.
    touches : int
        How often contact has begun.
    contact_s : float
        How long this contact has lasted [s]; 0 out of contact.
    tip_m : (3,) array
        Place of the frame `tip` in the base [m].
    normal_force_n : float
        True force along the normal [N], compression positive.
    """

    def __init__(
        self,
        surface: Surface,
        tissue_at: Callable[[FloatArray], Tissue | None],
        tip: Callable[[Tissue], TipOnTissue],
        *,
        tip_radius_m: float,
        mounting: CellMounting | None = None,
        friction: Friction | None = None,
    ) -> None:
        require(0 < tip_radius_m < math.inf, "tip_radius_m", tip_radius_m, "a number above 0")
        self.surface = surface
        self.tissue_at = tissue_at
        self.tip_radius_m = tip_radius_m
        self.mounting = CellMounting() if mounting is None else mounting
        self.friction = Friction() if friction is None else friction
        self.time_s = 0.0
        self.force_n, self.torque_nm = np.zeros(3), np.zeros(3)
        self.depth_m = 0.0
        self.in_contact = False
        self.touches = 0
        self.contact_s = 0.0
        self.tip_m = np.zeros(3)
        self.normal_force_n = 0.0
        self._tip = tip
        self._on: TipOnTissue | None = None
        self._site: FloatArray | None = None  # where the tissue was last asked for
        self._slip = np.zeros(3)  # elastic displacement of the contact along the surface
        self._held_n = np.zeros(3)  # force on what holds the tip: the beam's, where there is one
        self._pose: Pose | None = None
        self._turned: tuple[FloatArray, FloatArray] = (np.zeros(3), np.eye(3))
        self._places: list[FloatArray] = []  # of the carried mass, newest last
        self._period_s = 0.0

    def step(self, tip_pose: Pose, dt_s: float) -> None:
        """Advance by `dt_s` [s], at whose end the frame `tip` is at `tip_pose` in the base.

        For a beam the pose is where the undeflected tip would be.
        """
        before, self._pose, self._period_s = self._pose, tip_pose, dt_s
        self.time_s += dt_s
        place = tip_pose.position_m
        height, normal = self.surface.height_of(place)
        depth = self.tip_radius_m - height
        pushed = held = 0.0
        self._find_tissue(place, height, normal)
        if self._on is not None:
            held = self._on.step(depth, dt_s)
            pushed = self._on.indenter.force_n
            self.depth_m = max(0.0, self._on.indenter.depth_m)
        else:
            self.depth_m = 0.0
        touching = pushed > 0
        self.touches += touching and not self.in_contact
        self.in_contact = touching
        self.contact_s = self.contact_s + dt_s if touching else 0.0
        self.tip_m, self.normal_force_n = place, pushed
        way = np.zeros(3) if before is None else place - before.position_m
        along = self._friction(way, normal, pushed)
        self.force_n = pushed * normal + along
        self._held_n = held * normal + along
        # the ball is touched at its lowest point
        self.torque_nm = cross(-self.tip_radius_m * normal, along)
        if self.mounting.mount is Mount.TOOL:
            self._places = [*self._places[-2:], self._mass_place(tip_pose)]

    def wrench_at_cell(self) -> tuple[FloatArray, FloatArray]:
        """Force [N] and torque [N m] on the cell about its origin, in its frame, without noise.

        On the tool the cell feels the contact (through the beam), the weight of the tool beyond it
        and its inertia; under the sample the reaction of the contact and the sample's weight.
        """
        mounting, pose = self.mounting, self._pose
        if pose is None:
            raise RuntimeError("wrench_at_cell: the plant has not been stepped yet")
        turn = self._matrix(mounting.frame.rotation_rad, pose)
        mass = mounting.carried_kg
        if mounting.mount is Mount.TABLE:
            origin, centre = mounting.frame.position_m, mounting.centre_m
            contact, couple = -self.force_n, -self.torque_nm
            load = mass * GRAVITY_M_S2
        else:
            origin = pose.position_m + self._tip_matrix(pose) @ mounting.frame.position_m
            centre = self._places[-1]
            contact, couple = self._held_n, self.torque_nm
            load = mass * (GRAVITY_M_S2 - self._mass_acceleration())
        force = contact + load
        torque = couple + cross(pose.position_m - origin, contact)
        torque += cross(centre - origin, load)
        return turn.T @ force, turn.T @ torque

    def _find_tissue(self, place: FloatArray, height: float, normal: FloatArray) -> None:
        """Tissue remembers the last touch within a ball's radius; further away it is fresh."""
        if self.in_contact or height > self.tip_radius_m + NEAR_M:
            return
        if self._site is not None:
            way = place - self._site
            if math.dist(way, (normal @ way) * normal) < self.tip_radius_m:
                return
        tissue = self.tissue_at(place)
        self._on = None if tissue is None else self._tip(tissue)
        self._site = place

    def _friction(self, way: FloatArray, normal: FloatArray, pushed: float) -> FloatArray:
        """Force along the surface on the ball (3,) [N]."""
        if pushed <= 0 or self.depth_m <= 0:
            self._slip = np.zeros(3)
            return self._slip
        slip = self._slip + way
        slip = slip - (normal @ slip) * normal
        stiffness = self.friction.stiffness_ratio * 1.5 * pushed / self.depth_m
        length, most = math.sqrt(slip @ slip), self.friction.coefficient * pushed / stiffness
        self._slip = slip * (most / length) if length > most else slip
        return -stiffness * self._slip

    def _mass_place(self, pose: Pose) -> FloatArray:
        return pose.position_m + self._tip_matrix(pose) @ self.mounting.centre_m

    def _mass_acceleration(self) -> FloatArray:
        """Of the carried mass (3,) [m/s2], by differences over the last two periods."""
        if len(self._places) < 3:
            return np.zeros(3)
        first, second, third = self._places
        return (third - 2 * second + first) / self._period_s**2

    def _tip_matrix(self, pose: Pose) -> FloatArray:
        """Rotation of the tip (3, 3); kept while the rotation vector stays the same object."""
        if pose.rotation_rad is not self._turned[0]:
            self._turned = (pose.rotation_rad, pose.rotation.as_matrix())
        return self._turned[1]

    def _matrix(self, frame_rad: FloatArray, pose: Pose) -> FloatArray:
        """Rotation of the cell in the base (3, 3)."""
        own = np.eye(3)
        if frame_rad.any():
            own = self.mounting.frame.rotation.as_matrix()
        return self._tip_matrix(pose) @ own if self.mounting.mount is Mount.TOOL else own


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Vector product of two (3,) arrays, without the overhead of the general one."""
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )
