# SPDX-License-Identifier: Apache-2.0
"""What was true of the tip at every step of the plant, kept for those who ask later.

No instrument shows it: the simulated sensor follows the contact by it, tests and benchmarks judge by it how
deep, how hard and how long.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import takewhile

import numpy as np

from tactile_resonance.contact.vectors import Vector
from tactile_resonance.fields import number, require
from tactile_resonance.simulation.plant import Plant

KEEP_STEPS = 30_000
"""A minute at 500 Hz."""

MOST_STEPS = 250
"""In one answer: to write more would hold the plant up."""


@dataclass(frozen=True, slots=True)
class _PlantStep:
    time_s: float
    tip_m: Vector
    normal_force_n: float
    contact_radius_m: float
    depth_m: float


class PlantHistory:
    """Time, place of the tip and its contact, step by step.

    Parameters
    ----------
    plant : Plant
    """

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self._steps: deque[_PlantStep] = deque(maxlen=KEEP_STEPS)

    def step(self) -> None:
        """Note what is true now; to be called after each step of the plant."""
        plant = self._plant
        self._steps.append(
            _PlantStep(
                plant.time_s,
                plant.tip_m,
                plant.normal_force_n,
                plant.contact_radius_m,
                plant.depth_m,
            )
        )

    def contact_over(self, fields: dict) -> dict:
        """Control port: the contact from field ``after_s`` to ``until_s``, means over so many equal ``parts``.

        Answers ``normal_force_n``, ``contact_radius_m`` and ``depth_m``, each (parts,); null for a part in
        which the plant stood still, or of which nothing is kept.
        """
        after_s = number(fields.get("after_s"), "after_s")
        until_s = number(fields.get("until_s"), "until_s")
        parts = fields.get("parts")
        require(after_s < until_s, "until_s", until_s, f"above after_s = {after_s:g}")
        good = type(parts) is int and 1 <= parts <= MOST_STEPS
        require(good, "parts", parts, f"an integer, 1 to {MOST_STEPS}")
        assert isinstance(parts, int)
        steps = [step for step in self._since(after_s) if step.time_s <= until_s]
        times = np.array([step.time_s for step in steps])
        # a step ends at its time
        at = np.ceil((times - after_s) / (until_s - after_s) * parts - 1e-6).astype(int) - 1
        at = at.clip(0, parts - 1)
        counts = np.bincount(at, minlength=parts)
        answer = {}
        for name in ("normal_force_n", "contact_radius_m", "depth_m"):
            sums = np.bincount(at, [getattr(step, name) for step in steps], parts)
            pairs = zip(sums.tolist(), counts.tolist(), strict=True)
            answer[name] = [total / count if count else None for total, count in pairs]
        return answer

    def since(self, fields: dict) -> dict:
        """Control port: the first steps after field ``after_s``, 250 at most, oldest first.

        Answers ``time_s`` (n,), ``tip_m`` (n, 3) in the base and ``normal_force_n`` (n,).
        """
        first = self._since(number(fields.get("after_s", 0.0), "after_s"))[:MOST_STEPS]
        return {
            name: [getattr(step, name) for step in first]
            for name in ("time_s", "tip_m", "normal_force_n")
        }

    def _since(self, after_s: float) -> list[_PlantStep]:
        """Steps after a time, oldest first."""
        return list(takewhile(lambda step: step.time_s > after_s, reversed(self._steps)))[::-1]
