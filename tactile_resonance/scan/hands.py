# SPDX-License-Identifier: Apache-2.0
"""What a scan and its robot, node and operator tell each other."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, Any, Protocol

from tactile_resonance.scan.failures import Interrupted

if TYPE_CHECKING:  # nodes that take goals need what may go wrong, and load nothing of scenes and runs for it
    from tactile_resonance.contact.goal import HoldMode
    from tactile_resonance.contact.samples import Pose
    from tactile_resonance.frf.result import BandDistortion
    from tactile_resonance.poles.result import Poles
    from tactile_resonance.record import Origin
    from tactile_resonance.scan.clearance import Standoffs
    from tactile_resonance.scan.measurement import MeasurementDesign
    from tactile_resonance.scan.points import ScanPoint
    from tactile_resonance.scan.run_directory import PointRecording
    from tactile_resonance.scan.tissue_tests import ProtocolRequest

Check = Callable[[], None]


@dataclass(frozen=True)
class Measured:
    """What a measurement gave.

    Attributes
    ----------
    poles : Poles
        Of all blocks.
    origin : Origin
        Of the poles; its contact is that of the measurement.
    contact_age_s : float
        From the first touch until the middle of the measurement [s]; NaN where unknown.
    distortion : tuple of BandDistortion
        In each band, where it is measured.
    """

    poles: Poles
    origin: Origin
    contact_age_s: float = float("nan")
    distortion: tuple[BandDistortion, ...] = ()

    def with_zero_moved(self, moved_n: float) -> Measured:
        """The same, its force uncertain by half of what its zero moved in the contact."""
        contact = self.origin.contact
        std_n = math.hypot(contact.force_std_n, moved_n / 2)
        contact = replace(contact, force_std_n=std_n)
        return replace(self, origin=replace(self.origin, contact=contact))


@dataclass(frozen=True)
class Touch:
    """One touch from above.

    Attributes
    ----------
    ball_m : (3,) tuple
        Centre of the ball at the first touch, in the scan's frame [m].
    std_m : float
        Standard deviation of its height [m].
    force_n : float
        That was reached [N].
    """

    ball_m: tuple[float, float, float]
    std_m: float
    force_n: float


class Hands(Protocol):
    """Robot and sensor, as a scan uses them.

    All raise `PointFailed`, or `ScanEnded` where no other point would fare better; while they wait they
    call `check`, which may raise `Interrupted`.

    Attributes
    ----------
    free_air : bool
        Whether the tip is in free air between points, so that references can be taken there: the tip is moved
        and forces are measured.
    frame_in_base : Pose
        Frame of the scan's points in the robot's base, to be set before a scan.
    standoffs : Standoffs
        Of the scan's surface, to be set before a scan.
    """

    free_air: bool
    frame_in_base: Pose
    standoffs: Standoffs

    def now_s(self) -> float:
        """Time by which limits and durations of a scan count [s]: simulated, where the bench's is."""
        ...

    def begin(self, *integers: int) -> None:
        """Let simulated noise follow from integers, three at the most, from now on; nothing else has any."""
        ...

    def missing(self) -> str | None:
        """What points need and is not there now, for people; None: nothing. Asked with the tip free."""
        ...

    def held(self) -> bool:
        """Whether somebody keeps what is missing from its work, and will let it go on."""
        ...

    def touch(self, point: ScanPoint, force_n: float, hold: HoldMode, check: Check) -> None:
        """Bring the tip there and press until the force is held."""
        ...

    def find(self, point: ScanPoint, force_n: float, ball_radius_m: float, check: Check) -> Touch:
        """Touch a point of the surface as it is expected and draw back; return where the ball met it."""
        ...

    def measure(
        self,
        design: MeasurementDesign,
        label: str,
        seed: int,
        enough: Callable[[Measured, int], bool],
        recording: PointRecording,
        check: Check,
    ) -> Measured:
        """Measure; every message of it, and its id, goes into the recording.

        After each block `enough` is asked with what all blocks so far gave and their number.
        """
        ...

    def offers_tests(self) -> bool:
        """Whether `test` can be carried out by what is there."""
        ...

    def test(
        self,
        point: ScanPoint,
        asked: ProtocolRequest,
        force_n: float,
        recording: PointRecording,
        check: Check,
    ) -> None:
        """Carry a mechanical test out, the tip free before and after; its record goes into the recording."""
        ...

    def retract(self) -> float:
        """Draw the tip back; harmless where it is free.

        Returns by how much the zero of the force moved in the contact [N]: 0 where it did not, or where nobody
        knows.
        """
        ...

    def spent_s(self) -> Mapping[str, Any]:
        """Where the time of the newest contact went, as fields of `PointResult`; empty: unknown."""
        ...


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
    """How a scan ended: `complete` with every point finished; other fields are those of the action's result."""

    complete: bool
    message: str
    done: int
    failed: int
    skipped: int
    blocks: int
    blocks_saved: int
    saved_s: float
    repeats: int
    sensor_drifted: bool
    sensor_health: str


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
