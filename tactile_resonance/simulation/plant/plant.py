# SPDX-License-Identifier: Apache-2.0
"""Everything mechanical on one clock: the tip at the robot, the tissue under it, the load cell.

The tip is a ball, rigid or at the end of the beam, on a flat tilted surface or on a sphere, from
outside or from inside. Along the surface normal the indenter says how tissue and beam answer; along
the surface acts Coulomb friction with the elastic slip of Mindlin's contact. Of tilts up to some ten
degrees only the lateral force is new: the beam is taken to bend along the surface normal.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.payload import GRAVITY_M_S2, Mount, Payload
from tactile_resonance.contact.vectors import (
    IDENTITY,
    ZERO,
    Six,
    Transform,
    Vector,
    added,
    beside,
    cross,
    difference,
    rotated,
    rotated_back,
    vector,
)
from tactile_resonance.fields import require
from tactile_resonance.simulation.plant.surfaces import PlantSurface, SurfaceMotion
from tactile_resonance.simulation.plant.tip import Tip, TipOnTissue
from tactile_resonance.simulation.tissue.library import Tissue

NEAR_M = 0.005
"""Below this height the tip is stepped on its tissue: a beam that swings before it touches."""

SAME_PLACE = 0.1
"""In ball radii: how near to the last touch the tissue remembers it."""

STANDING_M = 1e-5
"""A tip that moves less than this along the surface in a step is above the place that it will touch."""


POISSON_RATIO = 0.49
"""Of what is touched, where the contact slips; see `SLIP`."""

SLIP = 2 * (1 - POISSON_RATIO) / (2 - POISSON_RATIO)
"""Tangential over normal stiffness of the contact before it slips (Mindlin 1949)."""

_NOTHING = Payload(0.0, ZERO)


class Plant:
    """Tip, tissue and cell, moved by whoever steps it.

    Parameters
    ----------
    surface : PlantSurface
        May be exchanged while the plant runs (``plant.surface = ...``), for what is touched next.
    tissue_at : callable
        From a position (3,) [m] in the base to the tissue under it; None where there is nothing to
        touch. Asked when the tip comes near at a new place, and where it stops to come down.
    tip : Tip
    mount : Mount
        Of the cell, whose frame is that of the tip or the base.
    carried : Payload
        What else the cell carries: the tool beyond it, or the sample with its dish.
    friction : float
        Coefficient of Coulomb friction; 0.1 is chosen for a wet plastic ball, not measured.

    Attributes
    ----------
    motion : SurfaceMotion or None
        Of every point of the surface along its normal, over `time_s`; None: at rest. It may be exchanged
        while the plant runs. What carries the tissue moves it: no inertia of it is on the cell.
    time_s : float
        Since the start [s].
    force_n, torque_nm : Vector
        True wrench of the tissue on the ball, about its centre, in the base [N], [N m].
    depth_m : float
        Depth of the ball's lowest point below the undisturbed surface [m], 0 above it.
    contact_radius_m : float
        Of the ball on the tissue [m]; 0 out of contact.
    in_contact : bool
        Whether the tissue pushes on the ball.
    touches : int
        How often contact has begun.
    contact_s : float
        How long this contact has lasted [s]; 0 out of contact.
    tip_m : Vector
        Place of the frame `tip` in the base [m].
    site_m : Vector or None
        Where the tissue was asked for last.
    tissue : Tissue or None
        That was found there.
    normal_force_n : float
        True force along the normal [N], compression positive.
    """

    def __init__(
        self,
        surface: PlantSurface,
        tissue_at: Callable[[FloatArray], Tissue | None],
        tip: Tip,
        *,
        mount: Mount = Mount.TABLE,
        carried: Payload = _NOTHING,
        friction: float = 0.1,
    ) -> None:
        require(0 < tip.radius_m < math.inf, "tip.radius_m", tip.radius_m, "a number above 0")
        self.surface = surface
        self.motion: SurfaceMotion | None = None
        self.tissue_at = tissue_at
        self.tip = tip
        self.mount, self.carried = mount, carried
        self.friction = friction
        self.time_s = 0.0
        self.force_n = self.torque_nm = ZERO
        self.depth_m = self.contact_radius_m = 0.0
        self.in_contact = False
        self.touches = 0
        self.contact_s = 0.0
        self.tip_m = ZERO
        self.normal_force_n = 0.0
        self.tissue: Tissue | None = None
        self._on: TipOnTissue | None = None
        self.site_m: Vector | None = None
        self._site_touched = False
        self._slip = ZERO  # elastic displacement of the contact along the surface
        self._lateral_n_per_m = 0.0  # its stiffness there
        self._held_n = ZERO  # force on what holds the tip: the beam's, where there is one
        self._turn = IDENTITY[0]  # of the tip
        self._stepped = False
        self._gravity_m_s2 = vector(GRAVITY_M_S2)
        self._places: list[Vector] = []  # of the carried mass, newest last
        self._unloaded: Six | None = None  # what a cell that stands feels then
        self._period_s = 0.0

    def step(self, tip: Transform, dt_s: float) -> None:
        """Advance by `dt_s` [s], at whose end the frame `tip` is at `tip` in the base.

        For a beam that is where the undeflected tip would be.
        """
        self._turn, place = tip
        way = difference(place, self.tip_m) if self._stepped else ZERO
        self._stepped, self._period_s = True, dt_s
        self.time_s += dt_s
        height, normal = self.surface.height_of(place)
        if self.motion is not None:
            height -= self.motion.displacement_m(self.time_s)
        depth = self.tip.radius_m - height
        pushed = held = 0.0
        self._find_tissue(place, height, normal, way)
        if self._on is not None:
            ball, moved = self._on
            held = moved.step(depth, dt_s)
            pushed = ball.force_n
            self.depth_m = max(0.0, ball.depth_m)
            self.contact_radius_m = ball.contact_radius_m
        else:
            self.depth_m = self.contact_radius_m = 0.0
        touching = pushed > 0
        self._site_touched |= touching
        self.touches += touching and not self.in_contact
        self.in_contact = touching
        self.contact_s = self.contact_s + dt_s if touching else 0.0
        self.tip_m, self.normal_force_n = place, pushed
        if held == 0.0 == pushed:
            self.force_n = self._held_n = self.torque_nm = self._slip = ZERO
        else:
            x, y, z = self._friction(way, normal, pushed)
            nx, ny, nz = normal
            self.force_n = (pushed * nx + x, pushed * ny + y, pushed * nz + z)
            self._held_n = (held * nx + x, held * ny + y, held * nz + z)
            # the ball is touched at its lowest point
            radius = -self.tip.radius_m
            self.torque_nm = cross((radius * nx, radius * ny, radius * nz), (x, y, z))
        if self.mount is Mount.TOOL:
            carried_m = added(place, rotated(self._turn, self.carried.centre_m))
            self._places = [*self._places[-2:], carried_m]

    def wrench_at_cell(self) -> Six:
        """Force [N] and torque [N m] on the cell about its origin, in its frame, without noise.

        On the tool the cell feels the contact (through the beam), the weight of the tool beyond it
        and its inertia; under the sample the reaction of the contact and the sample's weight.
        """
        if not self._stepped:
            raise RuntimeError("wrench_at_cell: the plant has not been stepped yet")
        untouched = self.force_n is ZERO and self.mount is Mount.TABLE
        if untouched and self._unloaded is not None:
            return self._unloaded
        mass = self.carried.mass_kg
        gx, gy, gz = self._gravity_m_s2
        cx, cy, cz = self.torque_nm
        if self.mount is Mount.TABLE:
            turn, origin, centre = IDENTITY[0], ZERO, self.carried.centre_m
            fx, fy, fz = self.force_n
            fx, fy, fz, cx, cy, cz = -fx, -fy, -fz, -cx, -cy, -cz
        else:
            turn, origin, centre = self._turn, self.tip_m, self._places[-1]
            fx, fy, fz = self._held_n
            ax, ay, az = self._mass_acceleration()
            gx, gy, gz = gx - ax, gy - ay, gz - az
        load = (mass * gx, mass * gy, mass * gz)
        tx, ty, tz = cross(difference(self.tip_m, origin), (fx, fy, fz))
        lx, ly, lz = cross(difference(centre, origin), load)
        wrench = (
            *rotated_back(turn, (fx + load[0], fy + load[1], fz + load[2])),
            *rotated_back(turn, (cx + tx + lx, cy + ty + ly, cz + tz + lz)),
        )
        if untouched:
            self._unloaded = wrench
        return wrench

    def _find_tissue(self, place: Vector, height: float, normal: Vector, way: Vector) -> None:
        """Tissue remembers a touch at the same place; elsewhere it is fresh, and what lies exactly there."""
        if self.in_contact or height > self.tip.radius_m + NEAR_M:
            return
        if self.site_m is not None:
            away_m = math.hypot(*beside(difference(place, self.site_m), normal))
            if self._site_touched:
                known = away_m < SAME_PLACE * self.tip.radius_m
            else:  # it is not asked for all along the way: that may take longer than a step
                moved_m = math.hypot(*beside(way, normal))
                known = away_m < (STANDING_M if moved_m < STANDING_M else self.tip.radius_m)
            if known:
                return
        tissue = self.tissue_at(np.array(place))
        if tissue != self.tissue or self._site_touched:  # else the beam goes on swinging
            self._on = None if tissue is None else self.tip.on(tissue, self.surface)
        self.tissue = tissue
        self.site_m, self._site_touched = place, False

    def _friction(self, way: Vector, normal: Vector, pushed: float) -> Vector:
        """Force along the surface on the ball [N].

        A contact that grows keeps this force, since what has just touched is not displaced yet; one that
        shrinks keeps the displacement. So it gives no energy (Mindlin & Deresiewicz 1953).
        """
        if pushed <= 0 or self.depth_m <= 0:
            self._slip = ZERO
            return ZERO
        stiffness = SLIP * 1.5 * pushed / self.depth_m
        kept = min(1.0, self._lateral_n_per_m / stiffness)
        self._lateral_n_per_m = stiffness
        (x, y, z), (dx, dy, dz) = self._slip, way
        x, y, z = beside((kept * x + dx, kept * y + dy, kept * z + dz), normal)
        length, most = math.hypot(x, y, z), self.friction * pushed / stiffness
        if length > most:
            share = most / length
            x, y, z = x * share, y * share, z * share
        self._slip = (x, y, z)
        return -stiffness * x, -stiffness * y, -stiffness * z

    def _mass_acceleration(self) -> Vector:
        """Of the carried mass [m/s2], by differences over the last two periods."""
        if len(self._places) < 3:
            return ZERO
        first, second, third = self._places
        (x, y, z), (lx, ly, lz) = difference(third, second), difference(second, first)
        square = self._period_s**2
        return (x - lx) / square, (y - ly) / square, (z - lz) / square
