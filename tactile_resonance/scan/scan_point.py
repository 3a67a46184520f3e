# SPDX-License-Identifier: Apache-2.0
"""One place where a scan touches."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from tactile_resonance.fields import require


@dataclass(frozen=True)
class ScanPoint:
    """A point of a plan.

    Attributes
    ----------
    index : int
        Place in the plan, from 0.
    position_m : (3,) tuple
        On the surface, in the scan's frame [m]. The ball's centre is one ball radius further along the
        normal when they touch.
    normal : (3,) tuple
        Outward unit normal of the surface.
    orientation_xyzw : (4,) tuple
        Unit quaternion of the frame `tip` there: +z along the normal, +x from clamp to tip.
    label : str
        For people.
    height_std_m : float
        Standard deviation of the surface along z, where it is estimated [m].
    """

    index: int
    position_m: tuple[float, float, float]
    normal: tuple[float, float, float]
    orientation_xyzw: tuple[float, float, float, float]
    label: str = ""
    height_std_m: float = 0.0

    def __post_init__(self) -> None:
        require(self.index >= 0, "index", self.index, "0 or above")

    def as_json(self) -> dict[str, Any]:
        """Plain values; `fields.read_dataclass` takes them back without loss."""
        return {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in asdict(self).items()
        }


@dataclass(frozen=True)
class LeftOut:
    """A point that is left out of a plan, and why."""

    point: ScanPoint
    why: str
