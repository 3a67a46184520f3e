# SPDX-License-Identifier: Apache-2.0
"""A contact from its goal to its result: what is asked, where in its life it is, what each cycle comes to.

And what became of it: reached or why not, at which force and depth; what is kept of those before.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

from tactile_resonance.contact.samples import Pose
from tactile_resonance.contact.vectors import Six, Vector, vector
from tactile_resonance.fields import require

if TYPE_CHECKING:  # numba takes a while to load
    from tactile_resonance.contact.contact_filter import ContactEstimate
    from tactile_resonance.contact.observer import Observer, Zero


class State(str, Enum):
    """Where in its life a contact is."""

    IDLE = "idle"
    TRAVEL = "travel"
    TARE = "tare"
    APPROACH = "approach"
    CONTACT = "contact"
    SETTLE = "settle"
    HOLD = "hold"
    RETRACT = "retract"
    FAULT = "fault"


TOUCHING = (State.CONTACT, State.SETTLE, State.HOLD)
"""States in which the tip is taken to press on tissue."""

TARED = (State.APPROACH, *TOUCHING)
"""States in which the zero of the force is known."""

ENDED = (State.RETRACT, State.FAULT)
"""States in which forces do not count any more."""


LEAST_FORCE_N = 1e-3
"""That can be asked of a contact."""


class HoldMode(str, Enum):
    """What is kept once the force is reached."""

    FORCE = "force"
    INDENTATION = "indentation"


@dataclass(frozen=True)
class Aim:
    """What is asked of a contact: force [N] and what is held then."""

    force_n: float
    hold: HoldMode = HoldMode.FORCE

    def __post_init__(self) -> None:
        good = LEAST_FORCE_N <= self.force_n < math.inf
        require(good, "force_n", self.force_n, f"{1e3 * LEAST_FORCE_N:g} mN or above")


@dataclass(frozen=True)
class ContactGoal:
    """What is asked for.

    Attributes
    ----------
    touch : Pose
        Of the frame `tip` in the base where the ball just touches the expected surface, +z out of
        the tissue (see `geometry.touch_pose`).
    aim : Aim
    standoff_m : float
        Height above the touch where the approach begins and to which the tip is drawn back [m]; infinite: that
        of the parameters, which is never raised.
    press_speed_m_s : float
        Towards the surface and into it, at most [m/s]; those of the parameters are never raised.
    hold_s : float
        Time after which contact_node draws the held tip back without a request [s]; infinite: only on request.
    unload_speed_m_s : float
        With which it is then drawn back while it presses [m/s]; 0: as after any contact.
    """

    touch: Pose
    aim: Aim
    standoff_m: float = math.inf
    press_speed_m_s: float = math.inf
    hold_s: float = math.inf
    unload_speed_m_s: float = 0.0


class Cause(str, Enum):
    """Why a contact was not reached, or ended."""

    NONE = "none"
    CANCELLED = "cancelled"
    FORCE_ABORT = "force_abort"
    FORCE_HARD = "force_hard"
    FORCE_RATE = "force_rate"
    FORCE_PULL = "force_pull"
    FORCE_LATERAL = "force_lateral"
    FORCE_STALE = "force_stale"
    FORCE_STUCK = "force_stuck"
    FORCE_INVALID = "force_invalid"
    FORCE_OVERLOAD = "force_overload"
    FORCE_SOURCE = "force_source"
    TARE = "tare"
    DEPTH = "depth"
    SURFACE_MISSING = "surface_missing"
    SURFACE_EARLY = "surface_early"
    CONTACT_LOST = "contact_lost"
    WORKSPACE = "workspace"
    TILT = "tilt"
    MISALIGNED = "misaligned"
    HOUSING = "housing"
    SPEED = "speed"
    ARM_STALE = "arm_stale"
    ARM_STOPPED = "arm_stopped"
    ARM_LINK = "arm_link"
    ARM_INVALID = "arm_invalid"
    TIME = "time"
    HOLD_ENDED = "hold_ended"
    HELD = "held"
    REFUSED = "refused"
    BUSY = "busy"  # refused now, accepted once the tip is free
    STOPPED = "stopped"  # with the node that made it


class NotIdleError(ValueError):
    """A contact is under way, or its tip is being drawn back: the same request is accepted later."""


def refusal_cause(error: ValueError) -> Cause:
    """Why a goal was refused that raised this."""
    return Cause.BUSY if isinstance(error, NotIdleError) else Cause.REFUSED


@dataclass(frozen=True)
class Breach:
    """A limit that was exceeded, or a fault, in a sentence for people."""

    cause: Cause
    message: str


class Command(NamedTuple):
    """Command to the arm: a twist in the base and its acceleration limit, or to stop.

    Attributes
    ----------
    twist : tuple of 6 floats or None
        [m/s, rad/s]; None: stop.
    acceleration_m_s2 : float
    """

    twist: Six | None
    acceleration_m_s2: float


class Move(NamedTuple):
    """The wish of one state for one cycle.

    Attributes
    ----------
    twist : tuple of 6 floats or None
        In the base [m/s, rad/s]; None: stop.
    to : State or None
        That follows; None: the same.
    breach : Breach or None
        Why `to` is `State.FAULT`.
    """

    twist: Six | None
    to: State | None = None
    breach: Breach | None = None


REST = Move(None)
"""Stand still and stay in the state."""


def failed(cause: Cause, text: str) -> Move:
    """Stop, for a reason."""
    return Move(None, State.FAULT, Breach(cause, text))


@dataclass(frozen=True)
class ContactResult:
    """How a contact went; while it is held the figures of the force go on being refined.

    Attributes
    ----------
    reached : bool
        Whether the force asked for was reached and settled.
    cause : Cause
        Why not, or why the contact ended; `Cause.NONE` while all is well.
    message : str
        The same in a sentence.
    force_n, force_std_n : float or None
        Mean of the measured force since it was reached, and its standard deviation from noise and
        tare [N]; of the moment when it was, the force of the model, and the arm's vibration is in its
        deviation. None where it was not reached.
    depth_m : float or None
        Past the first touch when reached [m].
    stiffness_n_per_m : float or None
        When reached [N/m], the beam included.
    surface_m, surface_std_m : float or None
        Height of the first touch above the expected one, and its standard deviation from the force's
        noise [m].
    told_m : float or None
        Height at which another sensor detected the touch, on the same scale [m]; None where none did.
    contact_s : float or None
        From the detection of contact until the force was reached [s].
    total_s : float
        From the start until it was reached, or failed [s].
    peak_force_n : float
        Largest single measured force along the normal so far [N]; 0 before the tare.
    retracted : bool
        Whether the tip is back at the standoff.
    zero_change_n : float or None
        By how much the zero of the force has moved since the tare, once the tip is back [N]; 0 where that is
        within its noise, None where it is not known. What of it is no noise is in `force_std_n`, and in the
        message where it is much.
    """

    reached: bool
    cause: Cause
    message: str
    total_s: float
    peak_force_n: float
    retracted: bool = False
    force_n: float | None = None
    force_std_n: float | None = None
    depth_m: float | None = None
    stiffness_n_per_m: float | None = None
    surface_m: float | None = None
    surface_std_m: float | None = None
    contact_s: float | None = None
    told_m: float | None = None
    zero_change_n: float | None = None


def not_reached(cause: Cause, message: str) -> ContactResult:
    """Return what became of a contact of which no figure is known."""
    return ContactResult(False, cause, message, total_s=math.nan, peak_force_n=math.nan)


ZERO_MOVED = 4.0
"""Deviations by which two zeros of one contact differ, for the zero to have moved."""


class Outcome:
    """What has become of a contact so far.

    Parameters
    ----------
    observer : Observer
    start_ns : int
        When the contact was asked for.
    """

    def __init__(self, observer: Observer, start_ns: int) -> None:
        self._observer, self._start_ns = observer, start_ns
        self._result: ContactResult | None = None

    def result(self, holding: bool) -> ContactResult | None:
        """Once it was reached or failed; the force is the mean so far while it is held."""
        if self._result is None:
            return None
        # after a contact is given up the force still rises until the tip has turned round
        peak_n, hard_n = self._observer.watch.peak_n, self._observer.limits.hard_force_n
        result = replace(self._result, peak_force_n=peak_n)
        if peak_n > hard_n and result.cause in (Cause.FORCE_ABORT, Cause.FORCE_RATE):
            text = f"{1e3 * peak_n:.1f} mN on the tip, beyond the hard limit of {1e3 * hard_n:g} mN"
            text = f"{text}; before: {result.message}"
            result = replace(result, cause=Cause.FORCE_HARD, message=text)
        mean = self._observer.mean_force() if holding else None
        return result if mean is None else replace(result, force_n=mean[0], force_std_n=mean[1])

    def reached(
        self, now_ns: int, touched_ns: int, estimate: ContactEstimate, told_m: float | None
    ) -> None:
        """Note that the force is there."""
        observer = self._observer
        observer.begin_mean()
        # the tip shakes about the height at which the model knows the force
        shaken_n = estimate.stiffness_n_per_m * observer.parameters.arm_vibration_m
        self._result = ContactResult(
            reached=True,
            cause=Cause.NONE,
            message="",
            force_n=estimate.force_n,
            force_std_n=math.hypot(estimate.force_std_n, observer.bias_std_n, shaken_n),
            depth_m=estimate.depth_m,
            stiffness_n_per_m=estimate.stiffness_n_per_m,
            surface_m=estimate.surface_m,
            told_m=told_m,
            surface_std_m=estimate.depth_std_m,
            contact_s=(now_ns - touched_ns) * 1e-9,
            total_s=(now_ns - self._start_ns) * 1e-9,
            peak_force_n=observer.watch.peak_n,
        )

    def ended(self, breach: Breach, now_ns: int, told_m: float | None, holding: bool) -> None:
        """Note why it was not reached, or ended; the first cause stays."""
        result = self.result(holding)
        if result is None:
            self._result = ContactResult(
                reached=False,
                cause=breach.cause,
                message=breach.message,
                told_m=told_m,
                total_s=(now_ns - self._start_ns) * 1e-9,
                peak_force_n=self._observer.watch.peak_n,
            )
        elif result.cause is Cause.NONE or (
            breach.cause is Cause.HELD and result.cause is not Cause.HELD
        ):
            before = "" if result.cause is Cause.NONE else f"; before: {result.message}"
            message = breach.message + before
            self._result = replace(result, cause=breach.cause, message=message)

    def drawn_back(self, zero_n: float | None) -> None:
        """Note that the tip is back at the standoff, and what the force source shows there.

        Parameters
        ----------
        zero_n : float or None
            None: not known.
        """
        result, observer = self._result, self._observer
        if result is None:
            return
        message, std = result.message, result.force_std_n
        if zero_n is not None:
            # the second zero is a mean over as long as a lost contact is, or longer
            count = max(1, observer.watch.mean_count)
            zero_std_n = math.hypot(observer.bias_std_n, observer.scatter_n / math.sqrt(count))
            # of what is no noise, the mean may have any part between nothing and all
            moved_n = math.sqrt(max(0.0, zero_n**2 - zero_std_n**2))
            std = None if std is None else math.hypot(std, moved_n / 2)
            if abs(zero_n) > ZERO_MOVED * zero_std_n:
                text = f"the zero of the force moved by {1e3 * zero_n:.1f} mN in this contact"
                message = f"{message}; {text}" if message else text
            else:
                zero_n = 0.0
        self._result = replace(
            result, retracted=True, zero_change_n=zero_n, message=message, force_std_n=std
        )


SUCCEEDED, KNOWN_SHARE = 10_000, 1.25
"""Places of successful contacts that are kept, at most. Near one the tissue counts as known for forces up to
its own times the second."""

SAME_RAD = 1e-4
"""Goals turned by less against each other are turned alike: the weight of a dish turns with the tip."""


class Memory:
    """What contacts before have shown: where they succeeded and with how much force, and the zero of the last.

    Attributes
    ----------
    zero : tuple of Zero and 3 floats, or None
        Of the contact before, where it stayed, and the rotation vector of the tip [rad].
    """

    def __init__(self) -> None:
        self.zero: tuple[Zero, Vector] | None = None
        self._succeeded: deque[tuple[Vector, float]] = deque(maxlen=SUCCEEDED)  # place, force

    def zero_for(self, goal: ContactGoal) -> Zero | None:
        """The zero as the contact before left it, where the tip is turned alike."""
        if self.zero is None:
            return None
        zero, rotation_rad = self.zero
        return zero if math.dist(rotation_rad, goal.touch.rotation_rad) < SAME_RAD else None

    def knows(self, goal: ContactGoal, radius_m: float) -> bool:
        """Whether a contact so near to a goal has succeeded."""
        most_n = goal.aim.force_n / KNOWN_SHARE
        return any(force_n >= most_n for _, force_n in self._near(goal, radius_m))

    def keep(self, goal: ContactGoal, result: ContactResult | None, zero: Zero | None) -> None:
        """Keep where a contact was that ended as it should."""
        if result is None or not result.reached:
            return
        if result.cause in (Cause.CANCELLED, Cause.HOLD_ENDED):
            self._succeeded.append((vector(goal.touch.position_m), goal.aim.force_n))
            if result.zero_change_n == 0.0 and zero is not None:
                self.zero = zero, vector(goal.touch.rotation_rad)

    def forget(self, goal: ContactGoal, radius_m: float) -> None:
        """Near a contact that pressed too hard nothing is known, whatever becomes of it."""
        for entry in self._near(goal, radius_m):
            self._succeeded.remove(entry)

    def clear(self) -> None:
        """Forget all places."""
        self._succeeded.clear()

    def _near(self, goal: ContactGoal, radius_m: float) -> list[tuple[Vector, float]]:
        """Contacts near a goal that have succeeded."""
        place_m = vector(goal.touch.position_m)
        return [entry for entry in self._succeeded if math.dist(place_m, entry[0]) <= radius_m]
