# SPDX-License-Identifier: Apache-2.0
"""What one cycle of a state comes to: where the tip goes, and which state follows."""

from __future__ import annotations

from typing import NamedTuple

from tactile_resonance.contact.estimator import ContactEstimate
from tactile_resonance.contact.goal import State
from tactile_resonance.contact.result import Breach, Cause
from tactile_resonance.contact.vectors import Six


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
    estimate : ContactEstimate or None
        With which the force was reached, where `to` is `State.HOLD`.
    """

    twist: Six | None
    to: State | None = None
    breach: Breach | None = None
    estimate: ContactEstimate | None = None


REST = Move(None)
"""Stand still and stay in the state."""


def failed(cause: Cause, text: str) -> Move:
    """Stop, for a reason."""
    return Move(None, State.FAULT, Breach(cause, text))
