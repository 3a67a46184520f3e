# SPDX-License-Identifier: Apache-2.0
"""Response of the sensor while its contact changes slowly.

Over an interval h the contact is that of its middle, which takes over the state of the one before.
With the contact at rest this is exact. Otherwise the part of the response that a pole p makes is off by
at most ``|p'| h^2 / 12`` of itself, and on the mean over an interval by nothing: it lags behind its
steady state by ``|p'| / Re(p)^2``, as it has to.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from tactile_resonance.fields import require
from tactile_resonance.simulation.bimorph import CoupledBimorph
from tactile_resonance.simulation.lines import Lines
from tactile_resonance.simulation.modal import FloatArray
from tactile_resonance.simulation.response import ResponseStream

INTERVAL_S = 0.04


class VaryingStream:
    """Counterpart of `ResponseStream` for a sensor that is another at every time.

    Parameters
    ----------
    coupled_at : callable
        The linear sensor at a time [s] since the start.
    delay_s, negligible_v : float
        As in `ResponseStream`.
    """

    def __init__(
        self,
        coupled_at: Callable[[float], CoupledBimorph],
        *,
        delay_s: float = 0.0,
        negligible_v: float = 0.0,
    ) -> None:
        self._coupled_at = coupled_at
        self._coupled = coupled_at(0.0)
        self._stream = ResponseStream(
            self._coupled.modal, delay_s=delay_s, negligible_v=negligible_v
        )
        self._time = 0.0

    def play(self, lines: Lines) -> FloatArray:
        """Return the response to the next period of an excitation, as `ResponseStream.play`."""
        samples, rate_hz = lines.samples_per_period, lines.sample_rate_hz
        count = max(1, int(np.ceil(samples / rate_hz / INTERVAL_S - 1e-9)))
        ends = np.linspace(0, samples, count + 1).astype(int)
        start, parts = self._time, []
        for begin, end in pairwise(ends):
            middle_s = start + float(begin + end) / 2 / rate_hz
            contact = self._coupled_at(middle_s)
            state = self._coupled.carry_state(self._stream.state, contact)
            self._coupled, self._stream = contact, self._stream.continued(contact.modal, state)
            parts.append(self._stream.play(lines, int(end - begin)))
        self._time = start + samples / rate_hz
        return np.concatenate(parts)

    def skip(self, lines: Lines, periods: int) -> None:
        """Advance whole periods."""
        require(periods >= 0, "periods", periods, "0 or above")
        for _ in range(periods):
            self.play(lines)
