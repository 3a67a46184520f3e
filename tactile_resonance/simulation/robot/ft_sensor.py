# SPDX-License-Identifier: Apache-2.0
"""The force/torque sensor in the tool flange of an e-series, and what the controller makes of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.simulation.plant import cross
from tactile_resonance.simulation.robot.poses import moved_wrench
from tactile_resonance.simulation.robot.target import CYCLE_S

FloatArray = NDArray[np.float64]

STANDARD_GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True)
class FtSpecification:
    """Errors of the built-in sensor.

    The UR5e data sheet states, without saying what the words mean, an accuracy of 4.0 N and 0.3 N m
    and a precision of 3.5 N and 0.2 N m. Here accuracy is read as two standard deviations of an offset
    that stays until the sensor is zeroed, precision as two standard deviations of what a sample
    carries, white noise and a slow drift together; how precision divides between the two is assumed.

    Attributes
    ----------
    accuracy : (6,) array
        Force [N] and torque [N m].
    precision : (6,) array
        The same.
    drift_share : float
        Share of the precision's variance that drifts.
    drift_time_s : float
        Correlation time of the drift [s].
    """

    accuracy: FloatArray = field(default_factory=lambda: np.array([4.0] * 3 + [0.3] * 3))
    precision: FloatArray = field(default_factory=lambda: np.array([3.5] * 3 + [0.2] * 3))
    drift_share: float = 0.5
    drift_time_s: float = 60.0


@dataclass(frozen=True)
class Payload:
    """A mass on the flange.

    Attributes
    ----------
    mass_kg : float
    cog_m : (3,) array
        Centre of gravity in the flange.
    inertia_kg_m2 : (6,) array
        Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the centre of gravity.
    """

    mass_kg: float = 0.0
    cog_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    inertia_kg_m2: FloatArray = field(default_factory=lambda: np.zeros(6))

    def weight(self, flange: FloatArray, gravity_m_s2: FloatArray) -> FloatArray:
        """Return its weight as a wrench (6,) on the flange, in the flange's frame.

        Parameters
        ----------
        flange : (4, 4) array
            Flange in the base.
        gravity_m_s2 : (3,) array
            Acceleration of free fall in the base.
        """
        force = flange[:3, :3].T @ gravity_m_s2 * self.mass_kg
        return np.concatenate([force, cross(self.cog_m, force)])


class FtSensor:
    """The sensor and the controller's compensation of payload and offset.

    Wrenches are what acts on the flange from outside.

    Attributes
    ----------
    raw : (6,) array
        Measured at the flange, in its frame, nothing compensated (``ft_raw_wrench``).
    """

    def __init__(self, specification: FtSpecification, rng: np.random.Generator) -> None:
        self._rng = rng
        self._offset = specification.accuracy / 2 * rng.standard_normal(6)
        sigma = specification.precision / 2
        self._noise = sigma * np.sqrt(1 - specification.drift_share)
        drift = sigma * np.sqrt(specification.drift_share)
        self._keep = float(np.exp(-CYCLE_S / specification.drift_time_s))
        self._kick = drift * np.sqrt(1 - self._keep**2)
        self._drift = drift * rng.standard_normal(6)
        self._zero = np.zeros(6)
        self._free = np.zeros(6)
        self.raw = np.zeros(6)

    def step(
        self, true: FloatArray, payload_weight: FloatArray, external: FloatArray | None = None
    ) -> None:
        """Measure for one cycle; all wrenches (6,) at and in the flange.

        Parameters
        ----------
        true : (6,) array
            What acts on the flange.
        payload_weight : (6,) array
            Weight to be compensated.
        external : (6,) array, optional
            Measured by another sensor, to be used in place of this one's reading.
        """
        noise = self._rng.standard_normal((2, 6))
        self._drift = self._drift * self._keep + self._kick * noise[0]
        self.raw = true + self._offset + self._drift + self._noise * noise[1]
        self._free = (self.raw if external is None else external) - payload_weight

    def zero(self) -> None:
        """Take the wrench without payload as zero (``zero_ftsensor``)."""
        self._zero = self._free.copy()

    def at_tcp(self, flange: FloatArray, tcp: FloatArray) -> FloatArray:
        """Return the compensated wrench (6,) at the TCP, along the axes of the base."""
        shift = np.eye(4)
        shift[:3, 3] = -tcp[:3, 3]
        wrench = moved_wrench(self._free - self._zero, shift)
        rotation = flange[:3, :3]
        return np.concatenate([rotation @ wrench[:3], rotation @ wrench[3:]])
