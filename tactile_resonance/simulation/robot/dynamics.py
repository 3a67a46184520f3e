# SPDX-License-Identifier: Apache-2.0
"""Weight and momentum of the arm's links.

Masses and centres of mass: Universal Robots, "Parameters for calculations of kinematics and dynamics"
(article 45257), table UR5e.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.simulation.robot.ft_sensor import Payload
from tactile_resonance.simulation.robot.kinematics import jacobian

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
    torque = np.zeros(6)
    for columns, mass in _mass_jacobians(frames, payload):
        torque -= columns.T @ (gravity_m_s2 * mass)
    return torque


def momentum(frames: FloatArray, qd: FloatArray, payload: Payload) -> float:
    """Return the norm of the linear momentum of links and payload [kg m/s]."""
    total = np.zeros(3)
    for columns, mass in _mass_jacobians(frames, payload):
        total += mass * (columns @ qd)
    return float(np.linalg.norm(total))


def _mass_jacobians(frames: FloatArray, payload: Payload) -> list[tuple[FloatArray, float]]:
    """Return how each mass moves with the joints, (3, 6), and the mass."""
    masses = []
    for link in range(6):
        frame = frames[link + 1]
        columns = jacobian(frames, frame[:3, 3] + frame[:3, :3] @ LINK_CENTRE_M[link])[:3]
        columns[:, link + 1 :] = 0.0  # joints beyond the link do not move it
        masses.append((columns, float(LINK_MASS_KG[link])))
    flange = frames[-1]
    point = flange[:3, 3] + flange[:3, :3] @ payload.cog_m
    masses.append((jacobian(frames, point)[:3], payload.mass_kg))
    return masses
