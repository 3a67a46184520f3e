# SPDX-License-Identifier: Apache-2.0
"""Weight and momentum of the arm's links.

Masses and centres of mass: Universal Robots, "Parameters for calculations of kinematics and dynamics"
(article 45257), table UR5e.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.contact.vectors import Vector
from tactile_resonance.simulation.robot.ft_sensor import ToolPayload
from tactile_resonance.simulation.robot.kinematics import Posture
from tactile_resonance.simulation.robot.poses import Six

FloatArray = NDArray[np.float64]

LINK_MASS_KG = np.array([3.761, 8.058, 2.846, 1.37, 1.3, 0.365])
# In the frames of the links 1 to 6.
LINK_CENTRE_M = np.array(
    [
        [0.0, -0.02561, 0.00193],
        [0.2125, 0.0, 0.11336],
        [0.15, 0.0, 0.0265],
        [0.0, -0.0018, 0.01634],
        [0.0, 0.0018, 0.01634],
        [0.0, 0.0, -0.001159],
    ]
)


def gravity_torque(posture: Posture, gravity_m_s2: Vector, payload: ToolPayload) -> Six:
    """Return the torques [N m] that hold links and payload against gravity.

    Parameters
    ----------
    posture : Posture
    gravity_m_s2 : Vector
        Acceleration of free fall in the base.
    payload : ToolPayload
    """
    return tuple((_momentum_per_speed(posture, payload) @ np.negative(gravity_m_s2)).tolist())


def momentum(posture: Posture, qd: Six, payload: ToolPayload) -> float:
    """Return the norm of the linear momentum of links and payload [kg m/s]."""
    return float(np.linalg.norm(np.array(qd) @ _momentum_per_speed(posture, payload)))


def _momentum_per_speed(posture: Posture, payload: ToolPayload) -> FloatArray:
    """Return the linear momentum that a unit speed of each joint carries, shape (6, 3)."""
    frames = posture.frames()
    turn = np.array([frame[0] for frame in frames]).reshape(7, 3, 3)
    origin = np.array([frame[1] for frame in frames])
    mass = np.append(LINK_MASS_KG, payload.mass_kg)
    centre = np.concatenate([LINK_CENTRE_M, [payload.cog_m]])
    carrier = [1, 2, 3, 4, 5, 6, 6]  # the payload sits on the last link
    point = origin[carrier] + (turn[carrier] @ centre[..., None])[..., 0]  # (7, 3)
    # first moment of all that a joint carries, about a point of its axis
    carried = np.cumsum(mass[::-1])[::-1][:6]
    moment = np.cumsum((mass[:, None] * point)[::-1], axis=0)[::-1][:6]
    return np.cross(turn[:6, :, 2], moment - carried[:, None] * origin[:6])
