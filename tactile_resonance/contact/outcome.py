# SPDX-License-Identifier: Apache-2.0
"""The course of one contact, kept as its result: reached, refined while held, ended and why."""

from __future__ import annotations

import math
from dataclasses import replace

from tactile_resonance.contact.estimator import ContactEstimate
from tactile_resonance.contact.observer import Observer
from tactile_resonance.contact.result import Breach, Cause, ContactResult

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
        result, mean = self._result, self._observer.mean_force()
        if result is not None and holding and mean is not None:
            return replace(result, force_n=mean[0], force_std_n=mean[1])
        return result

    def reached(
        self, now_ns: int, touched_ns: int, estimate: ContactEstimate, told_m: float | None
    ) -> None:
        """Note that the force is there."""
        self._observer.begin_mean()
        self._result = ContactResult(
            reached=True,
            cause=Cause.NONE,
            message="",
            force_n=estimate.force_n,
            force_std_n=math.hypot(estimate.force_std_n, self._observer.bias_std_n),
            depth_m=estimate.depth_m,
            stiffness_n_per_m=estimate.stiffness_n_per_m,
            surface_m=estimate.surface_m,
            told_m=told_m,
            surface_std_m=estimate.depth_std_m,
            contact_s=(now_ns - touched_ns) * 1e-9,
            total_s=(now_ns - self._start_ns) * 1e-9,
            peak_force_n=self._observer.watch.peak_n,
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
            self._result = replace(
                result,
                cause=breach.cause,
                message=breach.message + before,
                peak_force_n=self._observer.watch.peak_n,
            )

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
            # the second zero is a mean over as long as a lost contact is
            count = observer.limits.lost_s / observer.parameters.period_s
            zero_std_n = math.hypot(observer.bias_std_n, observer.noise_n / math.sqrt(count))
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
