# SPDX-License-Identifier: Apache-2.0
"""Weight and momentum of the arm's links.

Masses and centres of mass: Universal Robots, "Parameters for calculations of kinematics and dynamics"
(article 45257), table UR5e.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.simulation.robot.ft_sensor import Payload

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


def gravity_torque(frames: FloatArray, gravity_m_s2: FloatArray, payload: Payload) -> FloatArray:
    """Return the torques (6,) [N m] that hold links and payload against gravity.

    Parameters
    ----------
    frames : (7, 4, 4) array
        Base and links.
    gravity_m_s2 : (3,) array
        Acceleration of free fall in the base.
    payload : Payload
    """
    return -_momentum_per_speed(frames, payload) @ gravity_m_s2


def momentum(frames: FloatArray, qd: FloatArray, payload: Payload) -> float:
    """Return the norm of the linear momentum of links and payload [kg m/s]."""
    return float(np.linalg.norm(qd @ _momentum_per_speed(frames, payload)))


def _momentum_per_speed(frames: FloatArray, payload: Payload) -> FloatArray:
    """Return the linear momentum that a unit speed of each joint carries, shape (6, 3)."""
    mass = np.append(LINK_MASS_KG, payload.mass_kg)
    links = np.concatenate([frames[1:], frames[-1:]])  # the payload sits on the last link
    centre = np.concatenate([LINK_CENTRE_M, payload.cog_m[None]])
    point = links[:, :3, 3] + (links[:, :3, :3] @ centre[..., None])[..., 0]  # (7, 3)
    # first moment of all that a joint carries, about a point of its axis
    carried = np.cumsum(mass[::-1])[::-1][:6]
    moment = np.cumsum((mass[:, None] * point)[::-1], axis=0)[::-1][:6]
    lever = moment - carried[:, None] * frames[:6, :3, 3]
    return np.cross(frames[:6, :3, 2], lever)
