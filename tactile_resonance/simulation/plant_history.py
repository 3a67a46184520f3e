# SPDX-License-Identifier: Apache-2.0
"""What was true of the tip at every step of the plant, kept for those who ask later.

No instrument shows it: tests and benchmarks judge by it how deep, how hard and how long.
"""

from __future__ import annotations

import math
from collections import deque

from tactile_resonance.contact.vectors import Vector
from tactile_resonance.fields import number
from tactile_resonance.simulation.plant import Plant

KEEP_STEPS = 30_000
"""A minute at 500 Hz."""

MOST_STEPS = 250
"""In one answer: to write more would hold the plant up."""


class PlantHistory:
    """Time, place of the tip and force on it, step by step.

    Parameters
    ----------
    plant : Plant
    """

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self._steps: deque[tuple[float, Vector, float]] = deque(maxlen=KEEP_STEPS)

    def step(self) -> None:
        """Note what is true now; to be called after each step of the plant."""
        plant = self._plant
        self._steps.append((plant.time_s, plant.tip_m, plant.normal_force_n))

    def mean_force(self, fields: dict) -> dict:
        """Control port: mean force from after field ``after_s`` to ``until_s``.

        Answers ``normal_force_n``; raises ValueError where nothing of that time is kept.
        """
        after_s = number(fields.get("after_s"), "after_s")
        until_s = number(fields.get("until_s"), "until_s")
        forces = []
        for time_s, _, force_n in reversed(self._steps):
            if time_s <= after_s:
                break
            if time_s <= until_s:
                forces.append(force_n)
        if not forces:
            raise ValueError(f"after_s, until_s: nothing is known of {after_s:g} to {until_s:g} s")
        return {"normal_force_n": math.fsum(forces) / len(forces)}

    def since(self, fields: dict) -> dict:
        """Control port: the first steps after field ``after_s``, 250 at most, oldest first.

        Answers ``time_s`` (n,), ``tip_m`` (n, 3) in the base and ``normal_force_n`` (n,).
        """
        after_s = number(fields.get("after_s", 0.0), "after_s")
        found: list[tuple[float, Vector, float]] = []
        for step in reversed(self._steps):
            if step[0] <= after_s:
                break
            found.append(step)
        first = found[::-1][:MOST_STEPS]
        return {
            "time_s": [step[0] for step in first],
            "tip_m": [step[1] for step in first],
            "normal_force_n": [step[2] for step in first],
        }
