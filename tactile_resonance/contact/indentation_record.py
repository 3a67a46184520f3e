# SPDX-License-Identifier: Apache-2.0
"""Force and depth through one contact, from the approach until the tip is back: what a test records."""

from __future__ import annotations

import math

import numpy as np

from tactile_resonance.contact.geometry import TipPath
from tactile_resonance.contact.goal import TOUCHING, ContactGoal, State
from tactile_resonance.contact.loop import Cycle
from tactile_resonance.contact.result import ContactResult
from tactile_resonance.mechanics.indentation import BallTip, IndentationRecord, Protocol

RECORDED = (State.APPROACH, *TOUCHING, State.RETRACT)


class IndentationRecorder:
    """Takes the cycles of one contact; one thread adds, another asks once the contact has ended.

    Parameters
    ----------
    goal : ContactGoal
    protocol : Protocol
    ball : BallTip
    source : str
        Of the forces.
    simulated : bool

    Attributes
    ----------
    begun_ns : int or None
        First touch, by the clock of the samples [ns]; None before `record`.
    """

    def __init__(
        self, goal: ContactGoal, protocol: Protocol, ball: BallTip, source: str, *, simulated: bool
    ) -> None:
        self._path, self._protocol, self._ball = TipPath(goal), protocol, ball
        self._source, self._simulated = source, simulated
        self._forces: list[tuple[int, float]] = []
        self._heights: list[tuple[int, float]] = []
        self._zero_std_n = math.nan
        self.begun_ns: int | None = None

    def take(self, cycle: Cycle) -> None:
        """Take a cycle; those before the approach and after the retraction are left out."""
        if cycle.state not in RECORDED:
            return
        self._zero_std_n = cycle.bias_std_n
        if cycle.arm is not None:
            self._heights.append((cycle.arm.time_ns, self._path.height_m(cycle.arm)))
        zero_n = cycle.bias_n[2]
        self._forces.extend((w.time_ns, w.force_n[2] - zero_n) for w in cycle.wrenches)

    def record(self, result: ContactResult | None) -> IndentationRecord:
        """All so far.

        Raises
        ------
        ValueError
            If the tissue was not touched, or too little was recorded.
        """
        if result is None or result.surface_m is None or not self._forces:
            raise ValueError(
                "indentation: the tissue was not touched; accepted is a contact that was reached"
            )
        forces, heights = np.array(self._forces), np.array(self._heights)
        ns = forces[:, 0].astype(np.int64)
        begin_ns = int(ns[0])
        time_s = (ns - begin_ns) * 1e-9
        arm_s = (heights[:, 0] - begin_ns) * 1e-9
        depth_m = result.surface_m - np.interp(time_s, arm_s, heights[:, 1])
        kept = np.concatenate([[True], np.diff(ns) > 0])
        kept &= np.isfinite(forces[:, 1]) & (time_s >= arm_s[0]) & (time_s <= arm_s[-1])
        touched_s = float(time_s[np.argmax(depth_m >= 0)])
        self.begun_ns = begin_ns + round(1e9 * touched_s)
        return IndentationRecord(
            self._protocol,
            time_s[kept] - touched_s,
            forces[kept, 1],
            depth_m[kept],
            self._ball,
            force_std_n=self._zero_std_n,
            source=self._source,
            simulated=self._simulated,
        )
