# SPDX-License-Identifier: Apache-2.0
"""Measuring only while the force is quiet, as between two breaths.

The blocks of a measurement are one record from rest, whose transient is estimated along: none can be left out
of it. So a measurement during which the force moved too much is ended and repeated in the same contact.
"""

from __future__ import annotations

import math

from tactile_resonance.scan.hands import Measured, PointFailed
from tactile_resonance.scan.scene import Gate


class GateKeeper:
    """Which measurements of one contact count.

    Parameters
    ----------
    gate : Gate or None
        None: every one.
    force_n : float
        Asked for.

    Attributes
    ----------
    left_out : list of (float, float)
        Of each measurement that does not count, mean of the force and rms of its motion [N].
    """

    def __init__(self, gate: Gate | None, force_n: float) -> None:
        self._gate, self._force_n = gate, force_n
        self.left_out: list[tuple[float, float]] = []
        self._shut = False

    def shuts(self, measured: Measured) -> bool:
        """Whether the measurement under way is to be ended: the force has moved too much, or is another.

        Raises
        ------
        PointFailed
            If it is not known how the force moved.
        """
        if self._gate is None:
            return False
        contact = measured.origin.contact
        if math.isnan(contact.spread.rms_n):
            reason = contact.reason or "too few forces were measured"
            raise PointFailed(f"gate: how the force moved is unknown: {reason}")
        off_n = abs(contact.force_n - self._force_n)
        loud = contact.spread.rms_n > self._gate.force_rms_n or off_n > self._gate.force_error_n
        self._shut = self._shut or loud
        return self._shut

    def counts(self, measured: Measured) -> bool:
        """Whether a measurement that has ended counts.

        Raises
        ------
        PointFailed
            If it does not, and no other may be begun.
        """
        if not self.shuts(measured):
            return True
        assert self._gate is not None
        contact = measured.origin.contact
        self.left_out.append((contact.force_n, contact.spread.rms_n))
        self._shut = False
        if len(self.left_out) < self._gate.measurements:
            return False
        raise PointFailed(f"gate: the force was never quiet: {self}")

    def __str__(self) -> str:
        """What was left out, for people; empty: nothing."""
        gate = self._gate
        if gate is None or not self.left_out:
            return ""
        each = ", ".join(f"{1e3 * mean:.2f} (rms {1e3 * rms:.2f})" for mean, rms in self.left_out)
        accepted = f"rms up to {1e3 * gate.force_rms_n:g} mN"
        if gate.force_error_n < math.inf:
            low, high = (1e3 * (self._force_n + s * gate.force_error_n) for s in (-1, 1))
            accepted = f"{low:g} to {high:g} mN, {accepted}"
        return f"measurements left out: {len(self.left_out)}, with a force of {each} mN; accepted is {accepted}"
