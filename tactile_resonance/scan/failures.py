# SPDX-License-Identifier: Apache-2.0
"""How a point, or a scan, may end without a result, and how often a point is tried again."""

from __future__ import annotations

from collections import Counter

ATTEMPTS = 6  # at what is disturbed: a point, a reference, a touch
# A point that lost its node is repeated when the node is back, so often at most: it may be what ends the node.
ATTEMPTS_WITHOUT_NODE = 24
NODE_BACK_WITHIN_S = 120.0


class PointFailed(Exception):
    """A point gave no result; the message says why. The scan may go on with the next."""


class SurfaceMissing(PointFailed):
    """Nothing was touched, as far down as the tip may search."""


class SurfaceEarly(PointFailed):
    """Something was touched above where the surface may be."""


class PointDisturbed(PointFailed):
    """A point was spoiled by something that says nothing of it, a late sensor for example.

    Parameters
    ----------
    message : str
    kind : str
        The same in one or two words, to be counted.

    Attributes
    ----------
    attempts : int
        How often it is tried in all.
    """

    attempts = ATTEMPTS

    def __init__(self, message: str, kind: str = "disturbed") -> None:
        super().__init__(message)
        self.kind = kind


class NodeAway(PointDisturbed):
    """A node that the point needs went away, or was restarted and knows nothing of what was asked."""

    attempts = ATTEMPTS_WITHOUT_NODE


class Stopped(PointDisturbed):
    """Somebody keeps the tip out of the tissue until further notice."""

    attempts = ATTEMPTS_WITHOUT_NODE

    def __init__(self) -> None:
        super().__init__("contact: the tip is stopped (service or topic stop)", "stopped")


class ScanEnded(Exception):
    """The scan cannot or shall not go on; the message says why."""


class Interrupted(Exception):
    """The point was left on request."""


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
