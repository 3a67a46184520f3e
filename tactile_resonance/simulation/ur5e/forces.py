# SPDX-License-Identifier: Apache-2.0
"""Forces of the arm: what the sensor in its flange makes of a wrench, and force mode, which gives way to it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tactile_resonance.contact.vectors import (
    ZERO,
    ZEROS,
    Numbers,
    Transform,
    Turn,
    Vector,
    beside,
    cross,
    rotated,
    rotated_back,
)
from tactile_resonance.simulation.noise import ROWS
from tactile_resonance.simulation.ur5e.target import CYCLE_S, ScriptError, Target

STANDARD_GRAVITY_M_S2 = 9.80665


# Of force [N] and torque [N m], as the UR5e data sheet states them without saying what the words mean. Here
# accuracy is read as two standard deviations of an offset that stays until the sensor is zeroed, precision as
# two standard deviations of what a sample carries, white noise and a slow drift together.
ACCURACY, PRECISION = np.array([4.0] * 3 + [0.3] * 3), np.array([3.5] * 3 + [0.2] * 3)
# Share of the precision's variance that drifts, and correlation time of the drift [s] (assumed).
DRIFT_SHARE, DRIFT_TIME_S = 0.5, 60.0


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
    cog_m: Vector = ZERO
    inertia_kg_m2: Numbers = ZEROS


class FtSensor:
    """The sensor: what it says beside the wrench that acts on the flange from outside.

    Parameters
    ----------
    random : numpy.random.Generator
    errors : float
        Size of its errors over those of the data sheet; 0: none.
    """

    def __init__(self, random: np.random.Generator, errors: float = 1.0) -> None:
        self._offset = errors * ACCURACY / 2 * random.standard_normal(6)
        sigma = errors * PRECISION / 2
        self._drift_rms = sigma * np.sqrt(DRIFT_SHARE)
        keep = np.exp(-CYCLE_S / DRIFT_TIME_S)
        self._keep = keep ** np.arange(1.0, ROWS + 1)[:, None]
        kick = self._drift_rms * np.sqrt(1 - keep**2)
        self._rms = np.concatenate([kick, sigma * np.sqrt(1 - DRIFT_SHARE)])
        self.reseed(random)

    def reseed(self, random: np.random.Generator) -> None:
        """Take all noise from the next step on from a generator, drift drawn anew; the offset stays."""
        self._random = random
        self._drift = self._drift_rms * random.standard_normal(6)
        self._errors: list[Numbers] = []  # what is read beside the truth, that of the next cycle last

    def _draw(self) -> None:
        """Find offset, drift and noise of the next cycles."""
        numbers = self._rms * self._random.standard_normal((ROWS, 12))
        drifts = self._keep * (self._drift + np.cumsum(numbers[:, :6] / self._keep, axis=0))
        self._drift = drifts[-1]
        errors = self._offset + drifts + numbers[:, 6:]
        self._errors = [*map(tuple, errors[::-1].tolist())]

    def error(self) -> Numbers:
        """Return what it reads in the next cycle beside the truth, at and in the flange [N], [N m]."""
        if not self._errors:
            self._draw()
        return self._errors.pop()


# Speed per missing force or torque at a gain scaling of 1 [m/s/N, rad/s/(N m)], and the time constant
# without damping [s]. The robot's own figures are not published: these are the model's, stable on
# contacts up to about 10 kN/m at the scaling of 0.5 that the client's program sets.
GAIN = (0.004,) * 3 + (0.04,) * 3
SETTLE_S = 0.02


@dataclass(frozen=True)
class ForceTask:
    """What ``force_mode`` was asked for.

    Attributes
    ----------
    frame : Transform
        The task frame in the base.
    selection : 6 bool
        Compliant axes of the task frame.
    wrench : 6 floats
        What the arm exerts along compliant axes [N, N m].
    kind : int
        1: the task frame's y axis points from the TCP to its origin; 2: as given; 3: its x axis is
        the TCP's velocity in the frame's x-y plane.
    limits : 6 floats
        Largest speed of the TCP along compliant axes [m/s, rad/s]. Limits of other axes, deviations
        before a protective stop, are not modelled: the arm does not deviate there.
    """

    frame: Transform
    selection: tuple[bool, ...]
    wrench: Numbers
    kind: int
    limits: Numbers

    def __post_init__(self) -> None:
        if self.kind not in (1, 2, 3):
            raise ScriptError(f"force_mode: type {self.kind}; accepted are 1, 2, 3")
        if any(limit <= 0 for limit, on in zip(self.limits, self.selection, strict=True) if on):
            limits = [round(limit, 6) for limit in self.limits]
            raise ScriptError(f"force_mode: limits {limits}; accepted are speeds above 0")


class ForceMode:
    """Admittance along the compliant axes: speed from the missing wrench, first order.

    Attributes
    ----------
    task : ForceTask or None
        None outside of force mode.
    gain_scaling, damping : float
        As set by ``force_mode_set_gain_scaling`` (0 to 2) and ``force_mode_set_damping`` (0 to 1).
    """

    def __init__(self, target: Target) -> None:
        self.task: ForceTask | None = None
        self._target = target
        self.gain_scaling = 1.0
        self.damping = 0.005
        self._speed = ZEROS

    def begin(self, task: ForceTask) -> None:
        """Enter force mode, or go on with another task."""
        if self.task is None:
            self._target.yield_began_q = self._target.yielded_q
        self.task = task

    def end(self) -> None:
        """Leave force mode."""
        self.task = None
        self._target.yield_began_q = None
        self._speed = ZEROS

    def step(self, measured: Numbers) -> None:
        """Move the target aside for one cycle of force mode; raises as `Target.command`.

        Parameters
        ----------
        measured : 6 floats
            Wrench on the TCP from outside, along the axes of the base.
        """
        task, target = self.task, self._target
        assert task is not None
        axes = self._axes(task, target)
        fx, fy, fz, mx, my, mz = measured
        outside = (*rotated_back(axes, (fx, fy, fz)), *rotated_back(axes, (mx, my, mz)))
        share = CYCLE_S / (SETTLE_S * (1.0 - self.damping) + CYCLE_S)
        speeds = []
        for axis, limit in enumerate(task.limits):
            # what the arm exerts is the opposite of what it feels
            wanted = GAIN[axis] * self.gain_scaling * (task.wrench[axis] + outside[axis])
            speed = self._speed[axis] + (wanted - self._speed[axis]) * share
            speeds.append(max(-limit, min(limit, speed)) if task.selection[axis] else 0.0)
        self._speed = tuple(speeds)
        x, y, z, rx, ry, rz = (speed * (CYCLE_S * target.pace) for speed in speeds)
        target.shift(rotated(axes, (x, y, z)), rotated(axes, (rx, ry, rz)))

    def _axes(self, task: ForceTask, target: Target) -> Turn:
        """Return the rotation of the task frame in the base."""
        turn, (x, y, z) = task.frame
        upright = (turn[2], turn[5], turn[8])
        if task.kind == 1:
            tx, ty, tz = target.tool[1]
            axis, place = (x - tx, y - ty, z - tz), 1
        elif task.kind == 3:
            vx, vy, vz = target.twist[:3]
            axis, place = beside((vx, vy, vz), upright), 0
        else:
            return turn
        if math.hypot(*axis) < 1e-6:  # no direction to point to: the frame stays as given
            return turn
        return _completed(_unit(axis), place, upright)


def _completed(axis: Vector, place: int, upright: Vector) -> Turn:
    """Return right-handed axes with one at a place and z as near to `upright` as can be."""
    z = beside(upright, axis)
    if math.hypot(*z) < 1e-6:  # parallel: any perpendicular direction serves
        sizes = [abs(value) for value in axis]
        least = sizes.index(min(sizes))
        z = cross(axis, (float(least == 0), float(least == 1), float(least == 2)))
    z = _unit(z)
    first, second = (axis, cross(z, axis)) if place == 0 else (cross(axis, z), axis)
    return (
        first[0], second[0], z[0],
        first[1], second[1], z[1],
        first[2], second[2], z[2],
    )  # fmt: skip


def _unit(vector: Vector) -> Vector:
    """Return a vector of length 1 along another."""
    length = math.hypot(*vector)
    return vector[0] / length, vector[1] / length, vector[2] / length
