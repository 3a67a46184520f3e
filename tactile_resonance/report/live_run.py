# SPDX-License-Identifier: Apache-2.0
"""A scan that is going on, as its page sees it: what is heard goes in, events for the page come out.

Without ROS: `nodes.client.LiveListener` hears the topics, `live_server` sends the events.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from tactile_resonance.fields import known
from tactile_resonance.poles.result import Poles
from tactile_resonance.report.page import (
    MN,
    listed,
    map_entry,
    point_entry,
)
from tactile_resonance.report.point_details import MOST_DETAILED, PointDetails
from tactile_resonance.scan.point_result import PointKind, PointOutcome, PointResult, mode_columns
from tactile_resonance.scan.pole_map import GrowingMap

Publish = Callable[[str, Any], None]
HOLDING = "hold"  # state of a contact in which is measured
MOST_OF_A_MAP = 500
"""Points up to which the map between them is kriged while a scan goes on."""
_CELLS = 40
_BUSY_SHARE = 0.02  # of the time, at most, that maps are kriged
_LINES = 150  # of an FRF
_MOST_FORCES = 2000  # of one contact
_UNHEARD_S = 3.0


@dataclass
class _Measuring:
    """What was heard of the measurement under way."""

    measurement_id: int = 0
    label: str = ""
    frf: Any = None
    poles: Poles | None = None
    new: bool = False

    def result(self) -> PointResult:
        """The point as far as it is known."""
        if self.poles is None:
            return PointResult(0)
        mode = self.poles.main
        return PointResult(
            0,
            **mode_columns(mode.estimate, mode.covariance),
            poles_status=self.poles.status.value,
        )

    def entry(self, force: list[tuple[float, float]]) -> dict[str, Any]:
        """What a click on its point shows."""
        return PointDetails(self.frf, self.poles, tuple(force)).entry(_LINES)


class LiveRun:
    """Takes what is heard, in whatever thread, and publishes events.

    Parameters
    ----------
    publish : callable
        Of the name of an event and its data; called while nothing else changes.
    clock_s : callable
        Time that goes on steadily [s].
    """

    def __init__(self, publish: Publish, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._publish, self._clock_s = publish, clock_s
        self._lock = threading.RLock()
        self._begin()

    def _begin(self) -> None:
        """Forget the scan before."""
        self._results: dict[int, PointResult] = {}
        self._details: dict[int, dict[str, Any]] = {}
        self._maps = [GrowingMap()]
        self._measuring = _Measuring()
        self._newest: int | None = None
        self._state, self._heard_s, self._message = "", -1e9, ""
        self._forces: deque[tuple[float, float]] = deque(maxlen=_MOST_FORCES)  # not sent yet
        self._contact: list[tuple[float, float]] = []  # since it was held
        self._held_from_s = 0.0
        self._map_is_old, self._map_from_s = False, 0.0

    def snapshot(self) -> dict[str, Any]:
        """All of the run, as `run_report.run_entry` gives that of one that ended."""
        with self._lock:
            results = [self._results[k] for k in sorted(self._results)]
            return {
                "name": next((r.label for r in results if r.label), "scan"),
                "simulated": any(r.simulated for r in results),
                "force_mn": None,
                "newest": self._newest,
                "bands": [
                    {
                        "name": f"band {k + 1}",
                        "points": [point_entry(r.of_band(k)) for r in results],
                        "boundary": None,
                        "surface": self._surface(k)["surface"],
                    }
                    for k in range(len(self._maps))
                ],
                "details": {str(index): each for index, each in self._details.items()},
            }

    def take_result(self, result: PointResult, poles: Poles | None) -> None:
        """One attempt at a point; what is discarded, or measured in air, is not shown."""
        if result.kind is not PointKind.TISSUE or result.outcome is PointOutcome.DISCARDED:
            return
        with self._lock:
            before = self._results.get(result.index)
            if before is not None and before.time_ns == result.time_ns:
                return  # published again
            another = before is not None and before.attempt >= result.attempt
            if another:
                self._begin()
            self._results[result.index], self._newest = result, result.index
            bands = max(1 + len(result.further), len(self._maps))
            wider = bands > len(self._maps)
            self._maps += [self._map_of(k) for k in range(len(self._maps), bands)]
            for k, grown in enumerate(self._maps):
                grown.take(result.of_band(k))
            self._map_is_old = True
            measured = self._measuring
            if measured.measurement_id != result.measurement_id:
                measured = _Measuring(result.measurement_id, poles=poles)
            measured = replace(measured, poles=poles or measured.poles)
            if result.measurement_id:
                self._details.pop(result.index, None)
                self._details[result.index] = measured.entry(self._contact)
            while len(self._details) > MOST_DETAILED:
                del self._details[next(iter(self._details))]
            if another or wider:
                self._publish("run", self.snapshot())
                return
            points = [point_entry(result.of_band(k)) for k in range(len(self._maps))]
            details = {str(k): each for k, each in self._details.items() if k == result.index}
            self._publish("point", {"bands": points, "details": details})

    def _map_of(self, band: int) -> GrowingMap:
        return GrowingMap(result.of_band(band) for result in self._results.values())

    def take_frf(self, message: Any) -> None:
        """FRF of the measurement under way, the latest counts; of ROS or of rosbags."""
        with self._lock:
            now = self._of_measurement(message.measurement_id, message.label)
            now.frf, now.new = message, True

    def take_poles(self, poles: Poles, measurement_id: int, label: str) -> None:
        """Poles of the measurement under way, the latest count."""
        with self._lock:
            now = self._of_measurement(measurement_id, label)
            now.poles, now.new = poles, True

    def _of_measurement(self, measurement_id: int, label: str) -> _Measuring:
        if self._measuring.measurement_id != measurement_id:
            self._measuring = _Measuring(measurement_id, label)
        return self._measuring

    def take_state(self, time_s: float, state: str, force_n: float, message: str = "") -> None:
        """State of the contact at a time [s] of its clock, and its force [N]; NaN: not in contact."""
        with self._lock:
            self._heard_s = self._clock_s()
            if state == HOLDING and self._state != HOLDING:
                self._contact, self._held_from_s = [], time_s
            if state == HOLDING and math.isfinite(force_n) and len(self._contact) < _MOST_FORCES:
                self._contact.append((time_s - self._held_from_s, force_n))
            self._state, self._message = state, message
            self._forces.append((time_s, force_n))

    def tick(self) -> None:
        """Publish what is new since the last one; to be called a few times a second."""
        with self._lock:
            forces = [[*listed([t], 12), known(MN * f)] for t, f in self._forces]
            self._forces.clear()
            failed = sum(r.failed for r in self._results.values())
            simulated = any(r.simulated for r in self._results.values())
            counts = {"points": len(self._results), "failed": failed, "simulated": simulated}
            self._publish("now", {"text": self._text(), "forces": forces, **counts})
            measuring = self._measuring
            if measuring.new:
                measuring.new = False
                self._publish(
                    "measuring",
                    {
                        "title": measuring.label or f"measurement {measuring.measurement_id}",
                        "point": {**point_entry(measuring.result()), "outcome": "under way"},
                        "detail": measuring.entry(self._contact),
                    },
                )
            if self._map_is_old and self._clock_s() >= self._map_from_s:
                self._map_is_old = False
                begun_s = self._clock_s()
                for band in range(len(self._maps)):
                    self._publish("surface", self._surface(band))
                ended_s = self._clock_s()
                self._map_from_s = ended_s + (ended_s - begun_s) / _BUSY_SHARE

    def _surface(self, band: int) -> dict[str, Any]:
        pole_map = self._maps[band].map
        surface = pole_map.surface(_CELLS) if len(pole_map.points) <= MOST_OF_A_MAP else None
        return {"band": band, "surface": map_entry(surface, None)["surface"]}

    def _text(self) -> str:
        """What goes on, for people."""
        if self._clock_s() - self._heard_s > _UNHEARD_S:
            return "nothing is heard of contact_node"
        told = f"contact: {self._state}"
        return f"{told}; {self._message}" if self._message else told
