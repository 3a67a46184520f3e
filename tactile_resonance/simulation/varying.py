# SPDX-License-Identifier: Apache-2.0
"""Response of the sensor while its contact changes slowly.

Between two instants the response is blended from two exact ones: of the contact frozen at the
first, and at the second, which takes over the state of the first. With the contact at rest it is
exact. Otherwise, relative to the part of the response that a pole p makes, the blend leaves out the
lag of the resonance behind its steady state, at most ``|p'| / Re(p)^2``, and the curvature of the
change over the interval h, about ``(|p'| h / Re p)^2 / 8``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tactile_resonance.fields import require
from tactile_resonance.simulation.bimorph import CoupledBimorph
from tactile_resonance.simulation.lines import Lines
from tactile_resonance.simulation.modal import FloatArray
from tactile_resonance.simulation.response import ResponseStream

INTERVAL_S = 0.1  # between the instants blended


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

    def play(self, lines: Lines, samples: int | None = None) -> FloatArray:
        """Return the response to the next samples of an excitation, as `ResponseStream.play`."""
        samples = lines.samples_per_period if samples is None else samples
        return self._blend(samples, lines.sample_rate_hz, lambda s, n: s.play(lines, n))

    def silence(self, samples: int, sample_rate_hz: float) -> FloatArray:
        """Return the response over `samples` samples of zero excitation."""
        return self._blend(samples, sample_rate_hz, lambda s, n: s.silence(n, sample_rate_hz))

    def skip(self, lines: Lines, periods: int) -> None:
        """Advance whole periods."""
        require(periods >= 0, "periods", periods, "0 or above")
        for _ in range(periods):
            self.play(lines)

    def _blend(
        self, samples: int, rate_hz: float, act: Callable[[ResponseStream, int], FloatArray]
    ) -> FloatArray:
        count = max(1, int(np.ceil(samples / rate_hz / INTERVAL_S - 1e-9)))
        ends = np.linspace(0, samples, count + 1).astype(int)
        start, parts = self._time, []
        for length, end in zip(np.diff(ends), ends[1:], strict=True):
            after = self._coupled_at(start + float(end) / rate_hz)
            state = self._coupled.carry_state(self._stream.state, after)
            following = self._stream.continued(after.modal, state)
            share = np.arange(length) / max(1, length)
            before = act(self._stream, int(length))
            parts.append(before + share * (act(following, int(length)) - before))
            self._coupled, self._stream = after, following
        self._time = start + samples / rate_hz
        return np.concatenate(parts)
