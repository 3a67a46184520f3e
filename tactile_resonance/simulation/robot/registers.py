# SPDX-License-Identifier: Apache-2.0
"""General purpose registers, through which the RTDE client and the program talk."""

from __future__ import annotations

from dataclasses import dataclass, field

# Numbers 0 to 23 are the lower range, 24 to 47 the upper one.
REGISTER_COUNT = 48
# Larger figures are refused: sums and squares of them would not be finite.
LARGEST_FIGURE = 1e6


def _zeros() -> list[int]:
    return [0] * REGISTER_COUNT


def _float_zeros() -> list[float]:
    return [0.0] * REGISTER_COUNT


@dataclass
class Registers:
    """Registers of a controller.

    Attributes
    ----------
    input_int, input_double : lists of 48
        Written by clients.
    output_int, output_double : lists of 48
        Written by the program.
    refreshed : set of str
        Names of inputs written since the last cycle, with whatever value: what a watchdog watches.
    """

    input_int: list[int] = field(default_factory=_zeros)
    input_double: list[float] = field(default_factory=_float_zeros)
    output_int: list[int] = field(default_factory=_zeros)
    output_double: list[float] = field(default_factory=_float_zeros)
    refreshed: set[str] = field(default_factory=set)
