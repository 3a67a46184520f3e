# SPDX-License-Identifier: Apache-2.0
"""A contact from its goal to its result: what is asked, where in its life it is, what each cycle comes to.

And what became of it: reached or why not, at which force and depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from tactile_resonance.contact.samples import Pose
from tactile_resonance.contact.vectors import Six
from tactile_resonance.fields import require


class State(str, Enum):
    """Where in its life a contact is."""

    IDLE = "idle"
    TRAVEL = "travel"
    TARE = "tare"
    APPROACH = "approach"
    CONTACT = "contact"
    SETTLE = "settle"
    HOLD = "hold"
    RETRACT = "retract"
    FAULT = "fault"


TOUCHING = (State.CONTACT, State.SETTLE, State.HOLD)
"""States in which the tip is taken to press on tissue."""

TARED = (State.APPROACH, *TOUCHING)
"""States in which the zero of the force is known."""

ENDED = (State.RETRACT, State.FAULT)
"""States in which forces do not count any more."""


LEAST_FORCE_N = 1e-3
"""That can be asked of a contact."""


class HoldMode(str, Enum):
    """What is kept once the force is reached."""

    FORCE = "force"
    INDENTATION = "indentation"


@dataclass(frozen=True)
class ContactGoal:
    """What is asked for.

    Attributes
    ----------
    touch : Pose
        Of the frame `tip` in the base where the ball just touches the expected surface, +z out of
        the tissue (see `geometry.touch_pose`).
    force_n : float
    hold : HoldMode
    standoff_m : float
        Height above the touch where the approach begins and to which the tip is drawn back [m]; infinite: that
        of the parameters, which is never raised.
    press_speed_m_s : float
        Towards the surface and into it, at most [m/s]; those of the parameters are never raised.
    hold_s : float
        Time after which contact_node draws the held tip back without a request [s]; infinite: only on request.
    unload_speed_m_s : float
        With which it is then drawn back while it presses [m/s]; 0: as after any contact.
    """

    touch: Pose
    force_n: float
    hold: HoldMode = HoldMode.FORCE
    standoff_m: float = math.inf
    press_speed_m_s: float = math.inf
    hold_s: float = math.inf
    unload_speed_m_s: float = 0.0

    def __post_init__(self) -> None:
        good = LEAST_FORCE_N <= self.force_n < math.inf
        require(good, "force_n", self.force_n, f"{1e3 * LEAST_FORCE_N:g} mN or above")


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


class Command(NamedTuple):
    """Command to the arm: a twist in the base and its acceleration limit, or to stop.

    Attributes
    ----------
    twist : tuple of 6 floats or None
        [m/s, rad/s]; None: stop.
    acceleration_m_s2 : float
    """

    twist: Six | None
    acceleration_m_s2: float


class Move(NamedTuple):
    """The wish of one state for one cycle.

    Attributes
    ----------
    twist : tuple of 6 floats or None
        In the base [m/s, rad/s]; None: stop.
    to : State or None
        That follows; None: the same.
    breach : Breach or None
        Why `to` is `State.FAULT`.
    """

    twist: Six | None
    to: State | None = None
    breach: Breach | None = None


REST = Move(None)
"""Stand still and stay in the state."""


def failed(cause: Cause, text: str) -> Move:
    """Stop, for a reason."""
    return Move(None, State.FAULT, Breach(cause, text))


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
        tare [N]; of the moment when it was, the force of the model, and the arm's vibration is in its
        deviation. None where it was not reached.
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
        Largest single measured force along the normal so far [N]; 0 before the tare.
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
