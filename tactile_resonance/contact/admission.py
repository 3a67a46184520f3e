# SPDX-License-Identifier: Apache-2.0
"""Whether a contact may be begun at all: a goal against limits, before anything moves."""

from __future__ import annotations

import math

import numpy as np

from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.goal import ContactGoal
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.vectors import rotated

FORCE_SHARE = 2 / 3
"""Of the abort force that may be asked for."""


def check_goal(
    goal: ContactGoal,
    parameters: ContactParameters,
    limits: Limits,
    tip: TipGeometry | None = None,
) -> None:
    """Raise ``ValueError`` where a goal lies beyond the limits.

    Parameters
    ----------
    goal : ContactGoal
    parameters : ContactParameters
    limits : Limits
    tip : TipGeometry, optional
        Its housing must stay clear of the surface as deep as the limits allow, the tip as far off its
        orientation as they allow.
    """
    if not np.isfinite(goal.touch.vector).all():
        raise ValueError(f"touch: got {goal.touch.vector}; accepted are finite numbers")
    most = FORCE_SHARE * limits.abort_force_n
    if goal.aim.force_n > most * (1 + 1e-9):  # two thirds are no round number
        raise ValueError(
            f"force_n: got {goal.aim.force_n}; accepted is up to {most:g}, two thirds of abort_force_n"
        )
    box, normal = limits.workspace, np.array(rotated(goal.touch.turn, (0.0, 0.0, 1.0)))
    for name, height in (
        ("standoff", parameters.standoff_m),
        ("deepest place", -parameters.search_m - limits.depth_m),
    ):
        place = goal.touch.position_m + height * normal
        if (place < box.low_m).any() or (place > box.high_m).any():
            raise ValueError(f"touch: its {name} {place} lies outside the workspace {box}")
    if normal[2] < math.cos(limits.tilt_rad):
        raise ValueError(f"touch: tilted by more than tilt_rad = {limits.tilt_rad}")
    if tip is not None:
        height = tip.worst_height(limits.depth_m, limits.misalignment_rad)
        if height < limits.clearance_m:
            raise ValueError(
                f"depth_m: at {1e3 * limits.depth_m:g} mm, the tip off by misalignment_rad = "
                f"{limits.misalignment_rad:g}, the housing is {1e3 * height:.2f} mm above the surface; "
                f"accepted is clearance_m = {1e3 * limits.clearance_m:g} mm or more: less depth, or a "
                "larger beam_tilt_rad"
            )
