# SPDX-License-Identifier: Apache-2.0
"""First contact detected by the poles that arrive, against those in air."""

from __future__ import annotations

import numpy as np

from tactile_resonance import msg
from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.goal import State
from tactile_resonance.contact.resonance_touch import PolesTouch
from tactile_resonance.poles.result import Poles
from tactile_resonance.recording.messages import poles_from_message

IN_AIR = (State.IDLE, State.TRAVEL, State.TARE)
FORGOTTEN_NS = 1_000_000_000
"""So long after the tip left the tissue a record may still show it: stamps err, and the bench plays ahead."""


class TouchFromPoles:
    """Poles of a measurement taken in air are a reference, those of an approach are tested against them.

    Poles are those of all that a measurement has taken so far. So a touch is detected the sooner the shorter
    measurements are, and only the last poles of each are a reference: those before hold the same data.

    Parameters
    ----------
    false_alarm_probability : float
        Of one block.
    now_ns : int
        ROS time now [ns]: of what was before nothing is known.
    """

    def __init__(self, false_alarm_probability: float, now_ns: int) -> None:
        self._touch = PolesTouch(false_alarm_probability)
        self._air_ns = self._clear_ns = now_ns

    def moved(self, state: State, now_ns: int) -> None:
        """Where the contact is, in every cycle of the loop."""
        if state not in IN_AIR:
            self._air_ns = now_ns
            if state is not State.APPROACH:
                self._clear_ns = now_ns

    def hear(self, message: msg.Poles, state: State, now_ns: int) -> bool:
        """Take the poles of a measurement so far; whether they show a touch.

        Raises
        ------
        ValueError
            If they are not finite or their covariance is unknown.
        """
        poles, origin = poles_from_message(message)
        if not len(poles.f0_hz):
            return False
        # its middle is known; it ended before now, so it cannot have begun before this
        began_ns = 2 * origin.time_ns - now_ns - FORGOTTEN_NS
        if state in IN_AIR:
            if message.final and began_ns > self._air_ns:
                self._touch.add_air(*_pole(poles))
            return False
        if state is not State.APPROACH or not self._touch.ready or began_ns < self._clear_ns:
            return False
        return self._touch.touched(*_pole(poles))


def _pole(poles: Poles) -> tuple[FloatArray, FloatArray]:
    """f0 [Hz] and damping ratio (2,), and their covariance (2, 2) from noise.

    What the model lacks is the same in air and in the approach, noise is not. Where the noise is unknown, after
    one period, all that is known counts.
    """
    mode = poles.main
    covariance = mode.noise if np.all(np.isfinite(mode.noise)) else mode.covariance
    if not np.all(np.isfinite(covariance)):
        raise ValueError(f"covariance: unknown ({poles.message or poles.status.name.lower()})")
    return mode.estimate, covariance
