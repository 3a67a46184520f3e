# SPDX-License-Identifier: Apache-2.0
"""From the wrench on a cell, on the tool or under the sample, to that of the tissue on the tip."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from tactile_resonance.contact.interfaces import Mount
from tactile_resonance.contact.payload import Payload
from tactile_resonance.contact.samples import CellSample, Pose, WrenchSample
from tactile_resonance.contact.vectors import (
    ZERO,
    Six,
    Turn,
    Vector,
    cross,
    difference,
    rotated,
    rotated_back,
    transposed,
    turn_from_vector,
    turn_product,
    vector,
)


class Motion(NamedTuple):
    """Where the tip is and how it accelerates, in the base.

    Attributes
    ----------
    position_m : tuple of 3 floats
    turn : Turn
        Rotation from the frame `tip` into the base.
    acceleration_m_s2, angular_velocity_rad_s, angular_acceleration_rad_s2 : tuples of 3 floats
    """

    position_m: Vector
    turn: Turn
    acceleration_m_s2: Vector = ZERO
    angular_velocity_rad_s: Vector = ZERO
    angular_acceleration_rad_s2: Vector = ZERO

    def acceleration_of(self, arm_m: Vector) -> Vector:
        """Acceleration of a point of the tool, `arm_m` from the tip in the base [m/s2]."""
        spin = self.angular_velocity_rad_s
        x, y, z = self.acceleration_m_s2
        ax, ay, az = cross(self.angular_acceleration_rad_s2, arm_m)
        cx, cy, cz = cross(spin, cross(spin, arm_m))
        return x + ax + cx, y + ay + cy, z + az + cz


@dataclass(frozen=True)
class Mounting:
    """Where the cell sits and what it carries.

    Attributes
    ----------
    mount : Mount
    frame : Pose
        The cell's frame: given in the frame `tip` on the tool, in the base under the sample.
    payload : Payload or None
        Of a cell on the tool; what lies on a cell under the sample does not move and goes with the tare.

    Raises
    ------
    ValueError
        If a cell under the sample is given a payload.
    """

    mount: Mount
    frame: Pose
    payload: Payload | None = None

    def __post_init__(self) -> None:
        if self.mount is Mount.TABLE and self.payload is not None:
            raise ValueError(
                "payload: expected none for mount table: the sample goes with the tare"
            )

    @cached_property
    def _place_m(self) -> Vector:
        """Of the cell in what it sits on."""
        return vector(self.frame.position_m)

    @cached_property
    def _turn(self) -> Turn:
        """Rotation of the cell in what it sits on."""
        return turn_from_vector(vector(self.frame.rotation_rad))

    @cached_property
    def _centre_m(self) -> Vector:
        """Of the payload's mass, in the frame `tip`."""
        assert self.payload is not None
        x, y, z = self._place_m
        dx, dy, dz = rotated(self._turn, self.payload.centre_m)
        return x + dx, y + dy, z + dz

    def to_tip(self, samples: Iterable[CellSample], motion: Motion) -> list[WrenchSample]:
        """Wrenches of the tissue on the tip, from those on the cell.

        On the tool the payload's weight and inertia are taken off and the cell passes on what the tip
        feels; under the sample it feels the opposite.

        Parameters
        ----------
        samples : iterable of CellSample
        motion : Motion
            While they were measured.
        """
        carried: Six = (*ZERO, *ZERO)
        if self.mount is Mount.TOOL:
            turn, lever = self._turn, self._place_m
            if self.payload is not None:
                arm_m = rotated(motion.turn, self._centre_m)
                carried = self.payload.wrench(
                    turn_product(motion.turn, turn), motion.acceleration_of(arm_m)
                )
        else:
            a, b, c, d, e, f, g, h, i = turn_product(transposed(motion.turn), self._turn)
            turn = -a, -b, -c, -d, -e, -f, -g, -h, -i  # what acts on the sample, turned round
            lever = rotated_back(motion.turn, difference(self._place_m, motion.position_m))
        cfx, cfy, cfz, ctx, cty, ctz = carried
        felt = []
        for time_ns, (fx, fy, fz, tx, ty, tz), overload in samples:
            force = rotated(turn, (fx - cfx, fy - cfy, fz - cfz))
            x, y, z = rotated(turn, (tx - ctx, ty - cty, tz - ctz))
            dx, dy, dz = cross(lever, force)
            felt.append(WrenchSample(time_ns, force, (x + dx, y + dy, z + dz), overload))
        return felt
