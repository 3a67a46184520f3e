# SPDX-License-Identifier: Apache-2.0
"""Progress of a scan, its summary at the end, and the requests that it takes meanwhile."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from enum import Enum

from tactile_resonance.poles.result import Poles
from tactile_resonance.scan.hands import Interrupted
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.references import SensorHealth


class Phase(str, Enum):
    """What a scan does; the values are those of ``action/Scan.action``."""

    SURFACE = "surface"  # found by touch
    REFERENCE = "reference"  # in free air
    WAITING = "waiting"  # for a node
    PAUSED = "paused"
    CONTACT = "contact"
    MEASURE = "measure"
    RETRACT = "retract"


@dataclass(frozen=True)
class Progress:
    """Where a scan is.

    Attributes
    ----------
    point : ScanPoint or None
        Under way; None before the first and after the last.
    phase : Phase
    finished, points : int
    blocks : int
        At this point so far.
    poles : Poles or None
        At this point so far.
    time_left_s : float
        Estimated from the points so far, or the plan.
    repeats : int
        Attempts so far that were disturbed and repeated.
    waiting_for : str
        What keeps the scan waiting, for people; empty: nothing.
    """

    point: ScanPoint | None
    phase: Phase
    finished: int
    points: int
    blocks: int = 0
    poles: Poles | None = None
    time_left_s: float = float("nan")
    repeats: int = 0
    waiting_for: str = ""


@dataclass(frozen=True)
class Summary:
    """How a scan ended.

    Attributes
    ----------
    complete : bool
        Every point of the plan is finished.
    message : str
    done, failed, skipped : int
        Points by their latest outcome.
    blocks, blocks_saved : int
    saved_s : float
        Measuring time saved by ending points early.
    repeats : int
        Attempts that were disturbed and repeated.
    health : SensorHealth
    health_sentence : str
        What the references in air say of the sensor.
    """

    complete: bool
    message: str
    done: int
    failed: int
    skipped: int
    blocks: int
    blocks_saved: int
    saved_s: float
    repeats: int
    health: SensorHealth
    health_sentence: str


class Request(Enum):
    """Requests to a running scan."""

    SKIP = "skip"
    REPEAT = "repeat"
    CANCEL = "cancel"


class Controls:
    """What is asked of a running scan, from any thread."""

    def __init__(self) -> None:
        self._requests: deque[Request] = deque(maxlen=1)
        self.paused = threading.Event()
        self.cancelled = threading.Event()

    def ask(self, request: Request) -> None:
        """Skip or repeat the point under way (between two: the next, the last), or end the scan."""
        if request is Request.CANCEL:
            self.cancelled.set()
        else:
            self._requests.append(request)

    def take(self) -> Request | None:
        """Request that waits, once."""
        return self._requests.pop() if self._requests else None

    def check(self) -> None:
        """Raise `Interrupted` where the point under way shall be left."""
        self.check_cancelled()
        if self._requests:
            raise Interrupted

    def check_cancelled(self) -> None:
        """Raise `Interrupted` where the scan shall end; a request about a point waits for the next one."""
        if self.cancelled.is_set():
            raise Interrupted
