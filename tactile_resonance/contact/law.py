# SPDX-License-Identifier: Apache-2.0
"""The control law: how fast the tip goes, from what is known of the contact.

The estimated model says at which height the force asked for is reached; the rest of the way, less
what the arm will still do of earlier commands, is gone in a time constant. So the tip slows down
early on stiff tissue and late on soft, and the dead time does not make it oscillate. While the
stiffness is uncertain the aim stays below the force by that uncertainty. The speed of tissue that moves
is added to its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

from tactile_resonance.contact.estimator import hertz_depth
from tactile_resonance.contact.parameters import ContactParameters
from tactile_resonance.fields import require

if TYPE_CHECKING:  # numba takes a while to load
    from tactile_resonance.contact.contact_filter import ContactFilter

SURE_SHARE = 0.02
"""Uncertainty of the force, as a share of it, for which no caution is needed."""


class HoldMode(str, Enum):
    """What is kept once the force is reached."""

    FORCE = "force"
    INDENTATION = "indentation"


@dataclass(frozen=True)
class Aim:
    """What is asked of a contact: force [N] and what is held then."""

    force_n: float
    hold: HoldMode = HoldMode.FORCE

    def __post_init__(self) -> None:
        require(1e-3 <= self.force_n < math.inf, "force_n", self.force_n, "1 mN or above")


def force_speed(
    model: ContactFilter,
    height_m: float,
    pending_m: float,
    aim_n: float,
    parameters: ContactParameters,
    *,
    holding: bool,
) -> float:
    """Return the speed along the normal, away from the surface positive [m/s], towards a force.

    Parameters
    ----------
    model : ContactFilter
    height_m : float
        Of the tip now.
    pending_m : float
        Way that the arm will still go of earlier commands [m].
    aim_n : float
    parameters : ContactParameters
    holding : bool
        Whether the force has been reached: then without caution, and slower where the tissue is still.
    """
    depth = model.depth_for(aim_n)
    target = model.surface_m - depth
    if holding:
        time = parameters.time_constant_s if model.moving else parameters.hold_time_constant_s
    else:
        time = parameters.time_constant_s
        slope, std = model.slope_at(depth)
        target += parameters.caution * max(0.0, std - SURE_SHARE * aim_n) / slope
    # relaxation takes the force away: at constant force u goes as C^(-2/3)
    creep = 2 / 3 * model.c_rate_per_s * hertz_depth(aim_n, model.c)
    follow = creep + model.surface_speed_m_s
    # what is under way will be gone by then, and the target will have moved on
    target += follow * (parameters.arm_dead_time_s + parameters.arm_lag_s)
    return (target - height_m - pending_m) / time + follow


def place_speed(
    target_m: float, height_m: float, pending_m: float, parameters: ContactParameters
) -> float:
    """Return the speed along the normal that keeps a height [m/s]."""
    return (target_m - height_m - pending_m) / parameters.hold_time_constant_s
