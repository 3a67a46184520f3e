# SPDX-License-Identifier: Apache-2.0
"""The force/torque sensor in the tool flange of an e-series, and what the controller makes of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.contact.vectors import Turn, Vector, cross, rotated, rotated_back
from tactile_resonance.simulation.noise import NormalRows
from tactile_resonance.simulation.ur5e.poses import ORIGIN, ZERO, Six, difference
from tactile_resonance.simulation.ur5e.target import CYCLE_S

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
class ToolPayload:
    """A mass on the flange.

    Attributes
    ----------
    mass_kg : float
    cog_m : Vector
        Centre of gravity in the flange.
    inertia_kg_m2 : 6 floats
        Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the centre of gravity.
    """

    mass_kg: float = 0.0
    cog_m: Vector = ORIGIN
    inertia_kg_m2: Six = ZERO

    def weight(self, flange: Turn, gravity_m_s2: Vector) -> Six:
        """Return its weight as a wrench on the flange, in the flange's frame.

        Parameters
        ----------
        flange : Turn
            Rotation of the flange in the base.
        gravity_m_s2 : Vector
            Acceleration of free fall in the base.
        """
        if self.mass_kg == 0.0:
            return ZERO
        x, y, z = rotated_back(flange, gravity_m_s2)
        force = (x * self.mass_kg, y * self.mass_kg, z * self.mass_kg)
        return *force, *cross(self.cog_m, force)


class FtSensor:
    """The sensor and the controller's compensation of payload and offset.

    Wrenches are what acts on the flange from outside.

    Attributes
    ----------
    raw : 6 floats
        Measured at the flange, in its frame, nothing compensated (``ft_raw_wrench``).
    """

    def __init__(self, specification: FtSpecification, random: np.random.Generator) -> None:
        self._offset = (specification.accuracy / 2 * random.standard_normal(6)).tolist()
        sigma = specification.precision / 2
        self._noise = (sigma * np.sqrt(1 - specification.drift_share)).tolist()
        self._drift_rms = sigma * np.sqrt(specification.drift_share)
        self._keep = float(np.exp(-CYCLE_S / specification.drift_time_s))
        self._kick = (self._drift_rms * np.sqrt(1 - self._keep**2)).tolist()
        self.reseed(random)
        self._zero = ZERO
        self._free = ZERO
        self.raw = ZERO

    def reseed(self, random: np.random.Generator) -> None:
        """Take all noise from the next step on from a generator, drift drawn anew; the offset stays."""
        self._drift: list[float] = (self._drift_rms * random.standard_normal(6)).tolist()
        self._rows = NormalRows(random, [*self._kick, *self._noise])

    def step(self, true: Six, payload_weight: Six, external: Six | None = None) -> None:
        """Measure for one cycle; all wrenches at and in the flange.

        Parameters
        ----------
        true : 6 floats
            What acts on the flange.
        payload_weight : 6 floats
            Weight to be compensated.
        external : 6 floats, optional
            Measured by another sensor, to be used in place of this one's reading.
        """
        noise, keep = self._rows.take(), self._keep
        self._drift = [
            keep * drift + kick for drift, kick in zip(self._drift, noise[:6], strict=True)
        ]
        parts = zip(true, self._offset, self._drift, noise[6:], strict=True)
        self.raw = tuple([t + offset + drift + n for t, offset, drift, n in parts])
        self._free = difference(self.raw if external is None else external, payload_weight)

    def zero(self) -> None:
        """Take the wrench without payload as zero (``zero_ftsensor``)."""
        self._zero = self._free

    def at_tcp(self, flange: Turn, tcp_m: Vector) -> Six:
        """Return the compensated wrench at the TCP, along the axes of the base.

        Parameters
        ----------
        flange : Turn
            Rotation of the flange in the base.
        tcp_m : Vector
            Place of the TCP in the flange.
        """
        fx, fy, fz, mx, my, mz = difference(self._free, self._zero)
        force = (fx, fy, fz)
        x, y, z = cross(force, tcp_m)
        return *rotated(flange, force), *rotated(flange, (mx + x, my + y, mz + z))
