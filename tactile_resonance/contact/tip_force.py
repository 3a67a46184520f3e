# SPDX-License-Identifier: Apache-2.0
"""The force source at the tip: from the wrench on a cell, on the tool or under the sample, to the tissue's."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

from tactile_resonance.contact.interfaces import Cell, ForceInfo, Mount
from tactile_resonance.contact.payload import Payload
from tactile_resonance.contact.samples import ArmSample, CellSample, Pose, WrenchSample
from tactile_resonance.contact.vectors import (
    NO_TURN,
    Turn,
    Vector,
    difference,
    rotated,
    transposed,
    turn_from_vector,
    turn_product,
    vector,
)


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
    def _seat(self) -> tuple[Vector, Turn]:
        """Place and rotation of the cell in what it sits on."""
        return vector(self.frame.position_m), self.frame.turn

    def to_tip(
        self, samples: Iterable[CellSample], tip_m: Vector, tip_turn: Turn
    ) -> list[WrenchSample]:
        """Wrenches of the tissue on the tip, from those on the cell.

        On the tool the payload's weight is taken off and the cell passes on what the tip feels; under the
        sample it feels the opposite.

        Parameters
        ----------
        samples : iterable of CellSample
        tip_m, tip_turn : Vector, Turn
            Place and orientation of the frame `tip` in the base while they were measured.
        """
        cfx = cfy = cfz = ctx = cty = ctz = 0.0  # what the cell carries
        place, seat_turn = self._seat
        if self.mount is Mount.TOOL:
            turn, lever = seat_turn, place
            if self.payload is not None:
                cfx, cfy, cfz, ctx, cty, ctz = self.payload.wrench(turn_product(tip_turn, turn))
        else:
            back = transposed(tip_turn)
            turn = back if seat_turn == NO_TURN else turn_product(back, seat_turn)
            lever = rotated(back, difference(place, tip_m))
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

    Attributes
    ----------
    cell : Cell
    """

    def __init__(self, cell: Cell, mounting: Mounting, arm_state: Callable[[], ArmSample]) -> None:
        self.cell, self._mounting, self._arm_state = cell, mounting, arm_state

    @property
    def info(self) -> ForceInfo:
        """What the cell can do."""
        return self.cell.info

    def start(self) -> None:
        """Start the cell. Raises `ForceError`."""
        self.cell.start()

    def read(self) -> list[WrenchSample]:
        """Wrenches since the last call, oldest first, with the newest pose. Raises `ForceError`."""
        samples = self.cell.read()
        state = self._arm_state()
        if not samples:
            return []
        return self._mounting.to_tip(samples, state.position_m, turn_from_vector(state.rotation_rad))

    def close(self) -> None:
        """Close the cell."""
        self.cell.close()
