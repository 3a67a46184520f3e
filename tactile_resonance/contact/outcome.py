# SPDX-License-Identifier: Apache-2.0
"""What has become of the contact under way, as it is observed; what is kept of those before."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

from tactile_resonance.contact.contact_filter import ContactEstimate
from tactile_resonance.contact.goal import Breach, Cause, ContactGoal, ContactResult
from tactile_resonance.contact.observer import Observer, Zero
from tactile_resonance.contact.vectors import Vector, vector

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
        most_n = goal.force_n / KNOWN_SHARE
        return any(force_n >= most_n for _, force_n in self._near(goal, radius_m))

    def keep(self, goal: ContactGoal, result: ContactResult | None, zero: Zero | None) -> None:
        """Keep where a contact was that ended as it should."""
        if result is None or not result.reached:
            return
        if result.cause in (Cause.CANCELLED, Cause.HOLD_ENDED):
            self._succeeded.append((vector(goal.touch.position_m), goal.force_n))
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
