# SPDX-License-Identifier: Apache-2.0
"""How low the housing comes over the surface's plane while the tip travels to its standoff and turns.

The tip is turned at a steady rate while it goes straight to a place above the touch (`TipPath.travel`);
the housing, far out at the clamp, sweeps through an arc. What is left of the turn near the surface is
the business of `TipGeometry.worst_height`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.goal import ContactGoal
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.samples import ArmSample
from tactile_resonance.contact.tip_path import LIFTED_M, RIGHTING_S, TipPath
from tactile_resonance.contact.vectors import cross, dot, rotated, scaled, turn_from_vector

INSTANTS = 200
"""Of the turn that are looked at."""

TURN_LATE_S = 0.2
"""By which the turn may lag behind the tip's way: the arm's dead time, lag and acceleration [s]."""


@dataclass(frozen=True)
class LowestPoint:
    """The housing where it comes lowest.

    Attributes
    ----------
    housing_m : float
        Its height above the plane [m].
    tip_m : float
        Height of the tip above its first touch then [m].
    off_rad : float
        Angle that the tip still has to turn then [rad].
    """

    housing_m: float
    tip_m: float
    off_rad: float


def lowest_on_the_way(
    tip: TipGeometry,
    goal: ContactGoal,
    start: ArmSample,
    parameters: ContactParameters,
    limits: Limits,
) -> LowestPoint | None:
    """Lowest place of the housing from a start to the standoff; None where nothing much is turned.

    The way down is taken as faster and the turn as later than they are, a way up as none, so that the
    true height is not below. Lifting the tip from where it may press comes first and is not judged.
    """
    path = TipPath(goal, tip)
    turn, angle = path.turn_rad(start), path.off_rad(start)
    if angle <= limits.misalignment_rad / 2:
        return None
    began, standoff = path.height_m(start), parameters.standoff_m
    if path.must_lift(start, standoff):
        began = standoff - LIFTED_M
    target = path.turning_height_m(parameters, limits)
    way = math.dist(path.place_at(target), start.position_m)
    # the rate falls off over the last bit; nobody turns faster than brings it there in RIGHTING_S
    rate = min(limits.angular_speed_rad_s, angle / RIGHTING_S)
    turned = np.linspace(0.0, angle, INSTANTS)  # (t,)
    time_s = turned / max(rate, 1e-9) + TURN_LATE_S
    share = np.minimum(1.0, parameters.travel_speed_m_s * time_s / max(way, 1e-9))
    height = began + min(0.0, target - began) * share  # (t,)
    axis = scaled(1 / angle, turn)
    edge = rotated(turn_from_vector(start.rotation_rad), tip.housing_m)
    # Rodrigues' formula, its part along the normal
    out, across = dot(path.normal, edge), dot(path.normal, cross(axis, edge))
    along = dot(path.normal, axis) * dot(axis, edge)
    swept = out * np.cos(turned) + across * np.sin(turned) + along * (1 - np.cos(turned))
    housing = tip.ball_radius_m + height + swept
    lowest = int(np.argmin(housing))
    return LowestPoint(float(housing[lowest]), float(height[lowest]), float(angle - turned[lowest]))
