# SPDX-License-Identifier: Apache-2.0
"""The force source at the tip: from the wrench on a cell, on the tool or under the sample, to the tissue's."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from operator import mul
from typing import NamedTuple

from tactile_resonance.contact.interfaces import Cell, ForceInfo, Mount
from tactile_resonance.contact.payload import Payload
from tactile_resonance.contact.samples import ArmSample, CellSample, Pose, WrenchSample
from tactile_resonance.contact.vectors import (
    NO_TURN,
    ZERO,
    Turn,
    Vector,
    cross,
    difference,
    rotated,
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
        cfx = cfy = cfz = ctx = cty = ctz = 0.0  # what the cell carries
        if self.mount is Mount.TOOL:
            turn, lever = self._turn, self._place_m
            if self.payload is not None:
                arm_m = rotated(motion.turn, self._centre_m)
                cfx, cfy, cfz, ctx, cty, ctz = self.payload.wrench(
                    turn_product(motion.turn, turn), motion.acceleration_of(arm_m)
                )
        else:
            back = transposed(motion.turn)
            turn = back if self._turn == NO_TURN else turn_product(back, self._turn)
            lever = rotated(back, difference(self._place_m, motion.position_m))
        (a, b, c, d, e, f, g, h, i), (lx, ly, lz) = turn, lever
        if self.mount is Mount.TABLE:  # what acts on the sample, turned round
            a, b, c, d, e, f, g, h, i = -a, -b, -c, -d, -e, -f, -g, -h, -i
        felt = []
        for time_ns, (fx, fy, fz, tx, ty, tz), overload in samples:
            # written out: this is done for every wrench
            fx, fy, fz, tx, ty, tz = fx - cfx, fy - cfy, fz - cfz, tx - ctx, ty - cty, tz - ctz
            x, y, z = a * fx + b * fy + c * fz, d * fx + e * fy + f * fz, g * fx + h * fy + i * fz
            torque = (
                a * tx + b * ty + c * tz + (ly * z - lz * y),
                d * tx + e * ty + f * tz + (lz * x - lx * z),
                g * tx + h * ty + i * tz + (lx * y - ly * x),
            )
            felt.append(WrenchSample(time_ns, (x, y, z), torque, overload))
        return felt


class TipForce:
    """Wrenches at the tip (a `ForceSource`).

    Parameters
    ----------
    cell : Cell
    mounting : Mounting
    arm_state : callable
        Newest state of the arm, without waiting; what it raises is passed on.
    inertia_window_s : float
        The tip's acceleration, for the inertia of the payload, is the slope of its velocity over this long;
        it is half of that late, and its noise is that of the velocity times ``sqrt(12 / n) / window`` for n
        states. 0: inertia is left in the force.

    Attributes
    ----------
    cell : Cell

    Raises
    ------
    ValueError
        If the cell says that it is mounted elsewhere.
    """

    def __init__(
        self,
        cell: Cell,
        mounting: Mounting,
        arm_state: Callable[[], ArmSample],
        inertia_window_s: float = 0.0,
    ) -> None:
        if cell.info.mount is not mounting.mount:
            raise ValueError(
                f"mount: {cell.info.mount.value} for the cell, {mounting.mount.value} for its frame"
            )
        if not 0 <= inertia_window_s <= 1:
            raise ValueError(f"inertia_window_s: {inertia_window_s!r}, expected 0 to 1 s")
        self.cell, self._mounting, self._arm_state = cell, mounting, arm_state
        # without a payload there is no inertia to take off
        self._window_ns = 0.0 if mounting.payload is None else inertia_window_s * 1e9
        self._states: deque[ArmSample] = deque()

    @property
    def info(self) -> ForceInfo:
        """What the cell can do."""
        return self.cell.info

    def start(self) -> None:
        """Start the cell. Raises `ForceError`."""
        self._states.clear()
        self.cell.start()

    def read(self) -> list[WrenchSample]:
        """Wrenches since the last call, oldest first, with the newest pose. Raises `ForceError`."""
        samples = self.cell.read()
        state = self._arm_state()
        if self._window_ns:
            self._remember(state)
        if not samples:
            return []
        return self._mounting.to_tip(samples, self._motion(state))

    def close(self) -> None:
        """Close the cell."""
        self.cell.close()

    def _remember(self, state: ArmSample) -> None:
        states = self._states
        if not states or state.time_ns > states[-1].time_ns:
            states.append(state)
        while state.time_ns - states[0].time_ns > self._window_ns:
            states.popleft()

    def _motion(self, state: ArmSample) -> Motion:
        turn, states = turn_from_vector(state.rotation_rad), self._states
        if len(states) < 3:
            return Motion(state.position_m, turn)
        times_s = [(other.time_ns - state.time_ns) * 1e-9 for other in states]
        middle_s = sum(times_s) / len(times_s)
        times_s = [time_s - middle_s for time_s in times_s]
        power = sum(map(mul, times_s, times_s))
        axes = zip(*(other.velocity for other in states), strict=True)
        ax, ay, az, bx, by, bz = (sum(map(mul, times_s, axis)) / power for axis in axes)
        spin = states[-1].velocity[3:]
        return Motion(state.position_m, turn, (ax, ay, az), spin, (bx, by, bz))
