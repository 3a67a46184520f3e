# SPDX-License-Identifier: Apache-2.0
"""From the wrench on a cell, on the tool or under the sample, to that of the tissue on the tip."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.contact.interfaces import Mount
from tactile_resonance.contact.payload import Payload
from tactile_resonance.contact.samples import Pose

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """Where the tip is and how it accelerates, in the base.

    Attributes
    ----------
    position_m : (3,) array
    rotation : (3, 3) array
        From the frame `tip` into the base.
    acceleration_m_s2, angular_velocity_rad_s, angular_acceleration_rad_s2 : (3,) arrays
    """

    position_m: FloatArray
    rotation: FloatArray
    acceleration_m_s2: FloatArray
    angular_velocity_rad_s: FloatArray
    angular_acceleration_rad_s2: FloatArray

    @classmethod
    def at_rest(cls, pose: Pose) -> Motion:
        """Return the motion of a tip that stands still."""
        zero = np.zeros(3)
        return cls(pose.position_m, pose.rotation.as_matrix(), zero, zero, zero)

    def acceleration_of(self, arm_m: FloatArray) -> FloatArray:
        """Acceleration (3,) of a point of the tool, `arm_m` (3,) from the tip in the base."""
        spin = self.angular_velocity_rad_s
        return (
            self.acceleration_m_s2
            + np.cross(self.angular_acceleration_rad_s2, arm_m)
            + np.cross(spin, np.cross(spin, arm_m))
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
    def _own(self) -> FloatArray:
        """Rotation (3, 3) of the cell in what it sits on."""
        return self.frame.rotation.as_matrix()

    def to_tip(self, wrench: FloatArray, motion: Motion) -> FloatArray:
        """Wrench of the tissue on the tip.

        On the tool the payload's weight and inertia are taken off and the cell passes on what the tip
        feels; under the sample it feels the opposite.

        Parameters
        ----------
        wrench : (..., 6) array
            On the cell, about its origin, in its frame [N], [N m].
        motion : Motion

        Returns
        -------
        (..., 6) array
            On the tip, about its origin, in its frame.
        """
        wrench = np.asarray(wrench, dtype=float)
        own = self._own
        if self.mount is Mount.TOOL:
            if self.payload is not None:
                arm = self.frame.position_m + own @ self.payload.centre_m  # in the frame tip
                wrench = wrench - self.payload.wrench(
                    motion.rotation @ own, motion.acceleration_of(motion.rotation @ arm)
                )
            turn, lever, sign = own, self.frame.position_m, 1.0
        else:
            turn = motion.rotation.T @ own
            lever = motion.rotation.T @ (self.frame.position_m - motion.position_m)
            sign = -1.0
        force = sign * wrench[..., :3] @ turn.T
        torque = sign * wrench[..., 3:] @ turn.T + np.cross(lever, force)
        return np.concatenate([force, torque], axis=-1)
