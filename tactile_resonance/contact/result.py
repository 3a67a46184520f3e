# SPDX-License-Identifier: Apache-2.0
"""What became of a contact: reached or why not, and at which force and depth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum


class Cause(str, Enum):
    """Why a contact was not reached, or ended."""

    NONE = "none"
    CANCELLED = "cancelled"
    FORCE_ABORT = "force_abort"
    FORCE_HARD = "force_hard"
    FORCE_RATE = "force_rate"
    FORCE_PULL = "force_pull"
    FORCE_LATERAL = "force_lateral"
    FORCE_STALE = "force_stale"
    FORCE_STUCK = "force_stuck"
    FORCE_INVALID = "force_invalid"
    FORCE_OVERLOAD = "force_overload"
    FORCE_SOURCE = "force_source"
    TARE = "tare"
    DEPTH = "depth"
    SURFACE_MISSING = "surface_missing"
    SURFACE_EARLY = "surface_early"
    CONTACT_LOST = "contact_lost"
    WORKSPACE = "workspace"
    TILT = "tilt"
    MISALIGNED = "misaligned"
    HOUSING = "housing"
    SPEED = "speed"
    ARM_STALE = "arm_stale"
    ARM_STOPPED = "arm_stopped"
    ARM_LINK = "arm_link"
    ARM_INVALID = "arm_invalid"
    TIME = "time"
    HOLD_ENDED = "hold_ended"
    HELD = "held"
    REFUSED = "refused"
    BUSY = "busy"  # refused now, accepted once the tip is free
    STOPPED = "stopped"  # with the node that made it


class NotIdleError(ValueError):
    """A contact is under way, or its tip is being drawn back: the same request is accepted later."""


def refusal_cause(error: ValueError) -> Cause:
    """Why a goal was refused that raised this."""
    return Cause.BUSY if isinstance(error, NotIdleError) else Cause.REFUSED


@dataclass(frozen=True)
class Breach:
    """A limit that was exceeded, or a fault, in a sentence for people."""

    cause: Cause
    message: str


@dataclass(frozen=True)
class ContactResult:
    """How a contact went; while it is held the figures of the force go on being refined.

    Attributes
    ----------
    reached : bool
        Whether the force asked for was reached and settled.
    cause : Cause
        Why not, or why the contact ended; `Cause.NONE` while all is well.
    message : str
        The same in a sentence.
    force_n, force_std_n : float or None
        Mean of the measured force since it was reached, and its standard deviation from noise and
        tare [N]; None where it was not reached.
    depth_m : float or None
        Past the first touch when reached [m].
    stiffness_n_per_m : float or None
        When reached [N/m], the beam included.
    surface_m, surface_std_m : float or None
        Height of the first touch above the expected one, and its standard deviation from the force's
        noise [m].
    told_m : float or None
        Height at which another sensor detected the touch, on the same scale [m]; None where none did.
    contact_s : float or None
        From the detection of contact until the force was reached [s].
    total_s : float
        From the start until it was reached, or failed [s].
    peak_force_n : float
        Largest single measured force along the normal [N]; 0 before the tare.
    retracted : bool
        Whether the tip is back at the standoff.
    zero_change_n : float or None
        By how much the zero of the force has moved since the tare, once the tip is back [N]; 0 where that is
        within its noise, None where it is not known. What of it is no noise is in `force_std_n`, and in the
        message where it is much.
    """

    reached: bool
    cause: Cause
    message: str
    total_s: float
    peak_force_n: float
    retracted: bool = False
    force_n: float | None = None
    force_std_n: float | None = None
    depth_m: float | None = None
    stiffness_n_per_m: float | None = None
    surface_m: float | None = None
    surface_std_m: float | None = None
    contact_s: float | None = None
    told_m: float | None = None
    zero_change_n: float | None = None


def not_reached(cause: Cause, message: str) -> ContactResult:
    """Return what became of a contact of which no figure is known."""
    return ContactResult(False, cause, message, total_s=math.nan, peak_force_n=math.nan)
