# SPDX-License-Identifier: Apache-2.0
"""One place where a scan touches."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

from tactile_resonance.fields import known_keys, number, numbers, require


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

    def as_json(self) -> dict[str, Any]:
        """Plain values; `from_json` takes them back without loss."""
        return {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in asdict(self).items()
        }

    @classmethod
    def from_json(cls, content: dict[str, Any], where: str) -> ScanPoint:
        """Point of `as_json`; ValueError that names what is wrong."""
        known_keys(content, {field.name for field in fields(cls)}, where)
        index = content.get("index")
        require(type(index) is int and index >= 0, f"{where}.index", index, "0 or above")
        assert isinstance(index, int)

        def vector(name: str, count: int) -> Any:
            return numbers(content.get(name), f"{where}.{name}", count)

        return cls(
            index,
            vector("position_m", 3),
            vector("normal", 3),
            vector("orientation_xyzw", 4),
            str(content.get("label", "")),
            number(content.get("height_std_m", 0.0), f"{where}.height_std_m"),
        )


@dataclass(frozen=True)
class LeftOut:
    """A point that is left out of a plan, and why."""

    point: ScanPoint
    why: str
