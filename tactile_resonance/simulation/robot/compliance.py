# SPDX-License-Identifier: Apache-2.0
"""Force mode: the arm gives way along chosen axes until it presses with the wrench asked for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.simulation.robot.poses import matrix_from_pose
from tactile_resonance.simulation.robot.target import CYCLE_S, ScriptError, Target

FloatArray = NDArray[np.float64]

# Speed per missing force or torque at a gain scaling of 1 [m/s/N, rad/s/(N m)], and the time constant
# without damping [s]. The robot's own figures are not published: these are the model's, stable on
# contacts up to about 10 kN/m at the scaling of 0.5 that the client's program sets.
GAIN = np.array([0.004] * 3 + [0.04] * 3)
SETTLE_S = 0.02


@dataclass(frozen=True)
class ForceTask:
    """What ``force_mode`` was asked for.

    Attributes
    ----------
    frame : (6,) array
        Pose of the task frame in the base.
    selection : (6,) array of bool
        Compliant axes of the task frame.
    wrench : (6,) array
        What the arm exerts along compliant axes [N, N m].
    kind : int
        1: the task frame's y axis points from the TCP to its origin; 2: as given; 3: its x axis is
        the TCP's velocity in the frame's x-y plane.
    limits : (6,) array
        Largest speed of the TCP along compliant axes [m/s, rad/s]. Limits of other axes, deviations
        before a protective stop, are not modelled: the arm does not deviate there.
    """

    frame: FloatArray
    selection: NDArray[np.bool_]
    wrench: FloatArray
    kind: int
    limits: FloatArray

    def __post_init__(self) -> None:
        if self.kind not in (1, 2, 3):
            raise ScriptError(f"force_mode: type {self.kind}; accepted are 1, 2, 3")
        if np.any(self.limits[self.selection] <= 0):
            raise ScriptError(f"force_mode: limits {self.limits}; accepted are speeds above 0")


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
        self._speed = np.zeros(6)

    def begin(self, task: ForceTask) -> None:
        """Enter force mode, or go on with another task."""
        if self.task is None:
            self._target.yield_began_q = self._target.yielded_q
        self.task = task

    def end(self) -> None:
        """Leave force mode."""
        self.task = None
        self._target.yield_began_q = None
        self._speed = np.zeros(6)

    def step(self, measured: FloatArray) -> None:
        """Move the target aside for one cycle; raises as `Target.command`.

        Parameters
        ----------
        measured : (6,) array
            Wrench on the TCP from outside, along the axes of the base.
        """
        if self.task is None:
            return
        task, target = self.task, self._target
        axes = self._axes(task, target)
        outside = np.concatenate([axes.T @ measured[:3], axes.T @ measured[3:]])
        # what the arm exerts is the opposite of what it feels
        missing = task.wrench + outside
        wanted = GAIN * self.gain_scaling * missing
        settle = SETTLE_S * (1.0 - self.damping) + CYCLE_S
        self._speed += (wanted - self._speed) * (CYCLE_S / settle)
        self._speed = np.clip(self._speed, -task.limits, task.limits)
        self._speed[~task.selection] = 0.0
        way = self._speed * (CYCLE_S * target.pace)
        target.shift(axes @ way[:3], axes @ way[3:])

    def _axes(self, task: ForceTask, target: Target) -> FloatArray:
        """Return the axes of the task frame in the base, columns of a (3, 3) array."""
        frame = matrix_from_pose(task.frame)
        axes = frame[:3, :3]
        if task.kind == 1:
            axis, place = frame[:3, 3] - target.tool[:3, 3], 1
        elif task.kind == 3:
            velocity = target.twist[:3]
            axis, place = velocity - axes[:, 2] * (axes[:, 2] @ velocity), 0
        else:
            return axes
        length = float(np.linalg.norm(axis))
        if length < 1e-6:  # no direction to point to: the frame stays as given
            return axes
        first = axis / length
        return _completed(first, place, axes[:, 2])


def _completed(axis: FloatArray, place: int, upright: FloatArray) -> FloatArray:
    """Return right-handed axes (3, 3) with one at a place and z as near to `upright` as can be."""
    z = upright - axis * (axis @ upright)
    if np.linalg.norm(z) < 1e-6:  # parallel: any perpendicular direction serves
        z = np.cross(axis, np.eye(3)[int(np.abs(axis).argmin())])
    z = z / np.linalg.norm(z)
    if place == 0:
        return np.column_stack([axis, np.cross(z, axis), z])
    return np.column_stack([np.cross(axis, z), axis, z])
