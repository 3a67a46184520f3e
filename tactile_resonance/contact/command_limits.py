# SPDX-License-Identifier: Apache-2.0
"""What an arm's configuration allows of a command; every driver refuses the rest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

from tactile_resonance.contact.vectors import Six, six


class CommandLimits(Protocol):
    """Fields that the configuration of every arm has."""

    @property
    def max_speed_m_s(self) -> float:
        """Of the tip [m/s]."""
        ...

    @property
    def max_turn_rad_s(self) -> float:
        """Of the tip [rad/s]."""
        ...

    @property
    def max_acceleration_m_s2(self) -> float:
        """Of a command or a stop [m/s2]."""
        ...


def checked_twist(twist: Sequence[float], limits: CommandLimits) -> Six:
    """Return a twist [m/s, rad/s] as floats; ``ValueError`` where it is not finite or beyond a limit."""
    values = tuple(map(float, twist))
    if len(values) != 6 or not all(map(math.isfinite, values)):
        raise ValueError(f"twist: {values}, expected 6 finite numbers")
    for name, part, most in (
        ("speed", values[:3], limits.max_speed_m_s),
        ("turn", values[3:], limits.max_turn_rad_s),
    ):
        if math.hypot(*part) > most:
            raise ValueError(f"{name}: {math.hypot(*part):g}, the configuration allows {most:g}")
    return six(values)


def check_acceleration(value: float, limits: CommandLimits) -> None:
    """Raise ``ValueError`` where an acceleration [m/s2] is not above 0 or beyond the limit."""
    if not 0 < value <= limits.max_acceleration_m_s2:
        raise ValueError(
            f"acceleration: {value:g}, the configuration allows above 0 to "
            f"{limits.max_acceleration_m_s2:g}"
        )
