# SPDX-License-Identifier: Apache-2.0
"""Disturbances that spoil an attempt but are not the point's fault, and how often an attempt is repeated."""

from __future__ import annotations

from collections import Counter

from tactile_resonance.scan.hands import PointDisturbed


class Disturbances:
    """Of one point, reference or touch."""

    def __init__(self) -> None:
        self._kinds: Counter[str] = Counter()
        self._attempts: Counter[int] = Counter()

    def again(self, error: PointDisturbed) -> bool:
        """Count an attempt that ended so; whether another may follow. The last one is not counted."""
        if self._attempts[error.attempts] + 1 >= error.attempts:
            return False
        self._attempts[error.attempts] += 1
        self._kinds[error.kind] += 1
        return True

    @property
    def total(self) -> int:
        """Attempts that were repeated."""
        return self._kinds.total()

    def __str__(self) -> str:
        return ", ".join(f"{kind} {count}" for kind, count in sorted(self._kinds.items()))
