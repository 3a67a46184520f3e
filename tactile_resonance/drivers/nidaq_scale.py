# SPDX-License-Identifier: Apache-2.0
"""Raw counts of an NI input as a channel."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.polynomial import polynomial

from tactile_resonance.drivers.acquisition import DeviceError
from tactile_resonance.record import Channel

_PROBES = 1001


class CountScale:
    """Counts to volts, ``volts = sum_k coefficients[k] * counts**k``.

    Parameters
    ----------
    channel : nidaqmx.task.channels.AIChannel
        Its ``ai_dev_scaling_coeff`` are the coefficients, two or more; a sample at the ends of its range, or
        beyond, is saturated.
    dtype : numpy.int16 or numpy.int32
        Of the raw samples.

    Raises
    ------
    DeviceError
        If the coefficients have no slope.
    """

    def __init__(self, channel: Any, dtype: type[np.signedinteger]) -> None:
        coefficients = np.array(channel.ai_dev_scaling_coeff, float)
        if coefficients.size < 2 or coefficients[1] == 0:
            raise DeviceError(f"nidaqmx: scaling coefficients {coefficients}, expected a slope")
        self._coefficients = coefficients
        self._limits_v = float(channel.ai_rng_low), float(channel.ai_rng_high)
        self._ends = np.iinfo(dtype)
        offset_v, slope_v = coefficients[:2]
        low, high = sorted((limit - offset_v) / slope_v for limit in self._limits_v)
        counts = np.linspace(max(low, self._ends.min), min(high, self._ends.max), _PROBES)
        bend_v = polynomial.polyval(counts, coefficients) - (offset_v + slope_v * counts)
        # a bend that no count could show is none
        self.is_straight = bool(np.max(np.abs(bend_v)) <= 0.5 * abs(slope_v))

    def channel(self, counts: npt.NDArray[np.signedinteger]) -> Channel:
        """(n,) counts as they are where a straight line converts them, else volts."""
        volts = polynomial.polyval(counts.astype(float), self._coefficients)
        saturated = bool(
            np.any((counts == self._ends.min) | (counts == self._ends.max))
            or np.any((volts <= self._limits_v[0]) | (volts >= self._limits_v[1]))
        )
        if self.is_straight:
            offset_v, slope_v = map(float, self._coefficients[:2])
            return Channel(counts.astype(np.int32), slope_v, offset_v, saturated)
        return Channel(volts, saturated=saturated)
