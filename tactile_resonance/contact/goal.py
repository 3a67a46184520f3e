# SPDX-License-Identifier: Apache-2.0
"""What a contact is asked to do, where in its life it is, what one cycle comes to, and what is commanded."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from tactile_resonance.contact.result import Breach, Cause
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
class Aim:
    """What is asked of a contact: force [N] and what is held then."""

    force_n: float
    hold: HoldMode = HoldMode.FORCE

    def __post_init__(self) -> None:
        good = LEAST_FORCE_N <= self.force_n < math.inf
        require(good, "force_n", self.force_n, f"{1e3 * LEAST_FORCE_N:g} mN or above")


@dataclass(frozen=True)
class ContactGoal:
    """What is asked for.

    Attributes
    ----------
    touch : Pose
        Of the frame `tip` in the base where the ball just touches the expected surface, +z out of
        the tissue (see `geometry.touch_pose`).
    aim : Aim
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
    aim: Aim
    standoff_m: float = math.inf
    press_speed_m_s: float = math.inf
    hold_s: float = math.inf
    unload_speed_m_s: float = 0.0


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
