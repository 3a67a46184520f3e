# SPDX-License-Identifier: Apache-2.0
"""Where the time of a point goes: added up from the states of its contact, and told of all points of a run."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterable, Mapping

import numpy as np

from tactile_resonance.contact.goal import State
from tactile_resonance.scan.point_result import PointOutcome, PointResult

FIELD_OF = {
    State.TRAVEL: "travel_s",
    State.TARE: "tare_s",
    State.APPROACH: "approach_s",
    State.CONTACT: "press_s",
    State.SETTLE: "press_s",
    State.HOLD: "hold_s",
    State.RETRACT: "retract_s",
}
"""Of `PointResult`, by the state of a contact whose time it holds."""


class StateTimes:
    """Of one contact, from its states and the times at which each was seen; for several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.begin()

    def begin(self) -> None:
        """Forget what was before."""
        with self._lock:
            self._spent_ns: Counter[str] = Counter()
            self._before: tuple[str, int] | None = None

    def take(self, state: str, time_ns: int) -> None:
        """The contact was in a state at a time; until then in the one before."""
        with self._lock:
            if self._before is not None:
                known = {each.value: name for each, name in FIELD_OF.items()}
                before, since_ns = self._before
                if before in known and time_ns > since_ns:
                    self._spent_ns[known[before]] += time_ns - since_ns
            self._before = state, time_ns

    @property
    def fields(self) -> dict[str, float]:
        """As fields of `PointResult` [s]; empty where no state was seen."""
        if not self._spent_ns:
            return {}
        return {name: 1e-9 * self._spent_ns[name] for name in FIELD_OF.values()}


PARTS = {
    "vibration": "vibration_s",
    "waiting in contact": "",
    "contact until ready": "press_s",
    "approach": "approach_s",
    "rest for the tare": "tare_s",
    "travel": "travel_s",
    "drawing back": "retract_s",
    "requests and answers": "",
}
"""What `duration_s` is made of, and the field that holds it; empty: what is left."""
BETWEEN = "between points"


def time_budget(results: Iterable[PointResult]) -> Mapping[str, np.ndarray]:
    """Parts of the time of each measured point whose contact was seen [s], (n,) by their name for people."""
    known = [
        r for r in results if r.outcome is PointOutcome.DONE and np.isfinite(r.travel_s + r.hold_s)
    ]

    def of(field: str) -> np.ndarray:
        return np.array([getattr(result, field) for result in known])

    told = {name: of(field) for name, field in PARTS.items() if field}
    told["waiting in contact"] = of("hold_s") - of("vibration_s")
    in_contact = sum((of(name) for name in dict.fromkeys(FIELD_OF.values())), np.zeros(len(known)))
    told["requests and answers"] = of("duration_s") - in_contact
    return {**{name: told[name] for name in PARTS}, BETWEEN: np.nan_to_num(of("between_s"))}


def budget_sentence(results: Iterable[PointResult]) -> str:
    """Mean time of a point and its parts, the longest first; empty where none is known."""
    budget = time_budget(results)
    mean_s = {name: float(np.mean(each)) for name, each in budget.items() if each.size}
    if not mean_s:
        return ""
    parts = sorted(mean_s.items(), key=lambda part: -part[1])
    named = ", ".join(f"{name} {seconds:.2f}" for name, seconds in parts if seconds >= 0.005)
    return f"A point took {sum(mean_s.values()):.2f} s (mean): {named}."
