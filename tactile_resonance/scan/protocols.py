# SPDX-License-Identifier: Apache-2.0
"""Mechanical tests of tissue that a scene asks for; what came of them is in `scan.tissue_tests`."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tactile_resonance.fields import require
from tactile_resonance.mechanics.indentation import Protocol

TYPE, TOPIC = "tactile_resonance/msg/Indentation", "indentation"
BESIDE_S = 30.0
"""Of a test beside its hold, at most: way, zero of the force, pressing and drawing back [s]."""


@dataclass(frozen=True)
class ProtocolRequest:
    """One test that a scene asks for, after the poles of a point are measured and in a contact of its own.

    Attributes
    ----------
    kind : Protocol
    hold_s : float
        For which place or force is kept [s]; 0 only for an indentation.
    force_n : float or None
        To be reached [N]; None: the scene's.
    press_speed_m_s : float or None
        Towards the tissue and into it, at most [m/s]; None: contact_node's.
    unload_speed_m_s : float or None
        With which the tip is drawn back [m/s]: of an indentation, 5e-4 where None.
    points : tuple of int
        Numbers of the points, 1 the first; empty: all.
    """

    kind: Protocol
    hold_s: float = 0.0
    force_n: float | None = None
    press_speed_m_s: float | None = None
    unload_speed_m_s: float | None = None
    points: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        drawn = self.kind is Protocol.INDENTATION
        good = 0 < self.hold_s <= 3600 or (drawn and self.hold_s == 0)
        require(good, "hold_s", self.hold_s, "above 0, at most 3600 (0 only for an indentation)")
        for name in ("force_n", "press_speed_m_s", "unload_speed_m_s"):
            value = getattr(self, name)
            require(value is None or 0 < value < math.inf, name, value, "a number above 0")
        alone = self.unload_speed_m_s is None or drawn
        require(alone, "unload_speed_m_s", self.unload_speed_m_s, f"none with {self.kind.value}")
        if drawn and self.unload_speed_m_s is None:
            object.__setattr__(self, "unload_speed_m_s", 5e-4)
        good = all(number >= 1 for number in self.points) and len(set(self.points)) == len(
            self.points
        )
        require(good, "points", list(self.points), "numbers of points, from 1, each once")

    def concerns(self, index: int) -> bool:
        """Whether it is asked for at the point of an index, which counts from 0."""
        return not self.points or index + 1 in self.points

    @property
    def longest_s(self) -> float:
        """How long it may take [s]."""
        return self.hold_s + BESIDE_S

    def __str__(self) -> str:
        held = f" of {self.hold_s:g} s" if self.hold_s else ""
        where = (
            f" at points {', '.join(map(str, self.points))}" if self.points else " at every point"
        )
        return f"{self.kind.value}{held}{where}"
