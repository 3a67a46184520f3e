# SPDX-License-Identifier: Apache-2.0
"""What people know of a session and no instrument of the package measures."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from tactile_resonance.fields import read_dataclass, require
from tactile_resonance.strict_yaml import parse_yaml


@dataclass(frozen=True)
class Notes:
    """Notes of a session; what is None or empty was not noted.

    Attributes
    ----------
    temperature_c : float or None
        Of the sample [degrees Celsius].
    tip_wetness : str
        dry or wet.
    adhesion : str
        Whether the tip sticks to the sample, in words.
    remarks : str
    """

    temperature_c: float | None = None
    tip_wetness: str | None = None
    adhesion: str | None = None
    remarks: str | None = None

    def __post_init__(self) -> None:
        warm = self.temperature_c
        good = warm is None or -50 <= warm <= 150
        require(good, "temperature_c", warm, "-50 to 150 degrees Celsius")
        good = self.tip_wetness in ("dry", "wet", "", None)
        require(good, "tip_wetness", self.tip_wetness, "one of dry, wet")

    def as_json(self) -> dict[str, float | str]:
        """What was noted, by name."""
        return {key: value for key, value in asdict(self).items() if value not in (None, "")}


def parse_notes(text: str, where: str) -> Notes:
    """Notes of a text like ``{temperature_c: 21.5, tip_wetness: wet}``; of an empty one none.

    Raises
    ------
    ValueError
        If it is no mapping, or a field is unknown or of the wrong kind.
    """
    try:
        given = parse_yaml(text) if text.strip() else {}
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    require(isinstance(given, dict), where, text, "a YAML mapping")
    return read_dataclass(Notes, given, where)
