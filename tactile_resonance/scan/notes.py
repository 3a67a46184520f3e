# SPDX-License-Identifier: Apache-2.0
"""What people know of a session and no instrument of the package tells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import yaml

from tactile_resonance.fields import known_keys, number, require

TIPS = ("dry", "wet")


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
    tip_wetness: str = ""
    adhesion: str = ""
    remarks: str = ""

    def as_json(self) -> dict[str, float | str]:
        """What was noted, by name."""
        return {key: value for key, value in asdict(self).items() if value not in (None, "")}


def read_notes(given: Mapping[str, Any], where: str) -> Notes:
    """Notes of a scene's section.

    Raises
    ------
    ValueError
        If a field is unknown or of the wrong kind.
    """
    known_keys(given, {field.name for field in fields(Notes)}, where)
    temperature_c = None
    if given.get("temperature_c") is not None:
        temperature_c = number(given["temperature_c"], f"{where}.temperature_c")
        good = -50 <= temperature_c <= 150
        require(good, f"{where}.temperature_c", temperature_c, "-50 to 150 degrees Celsius")
    texts = {name: given.get(name) or "" for name in ("tip_wetness", "adhesion", "remarks")}
    for name, text in texts.items():
        require(isinstance(text, str), f"{where}.{name}", text, "a text")
    wetness = texts["tip_wetness"]
    good = wetness in ("", *TIPS)
    require(good, f"{where}.tip_wetness", wetness, f"one of {', '.join(TIPS)}")
    return Notes(temperature_c, **texts)


def parse_notes(text: str, where: str) -> Notes:
    """Notes of a text like ``{temperature_c: 21.5, tip_wetness: wet}``; of an empty one none."""
    try:
        given = yaml.safe_load(text) if text.strip() else {}
    except yaml.YAMLError as error:
        raise ValueError(f"{where}: got {text!r}; accepted is a YAML mapping") from error
    require(isinstance(given, dict), where, text, "a YAML mapping")
    return read_notes(given, where)
