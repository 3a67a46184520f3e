# SPDX-License-Identifier: Apache-2.0
"""Where the shared files (``config/``, ``launch/`` ...) are, and YAML that says what it means.

That is version 1.2, each key once, neither tags nor deep nesting, few aliases. PyYAML alone reads YAML 1.1
(``010`` is 8 there, ``1:30`` is 90, ``1e-3`` a text), lets the last of two equal keys win, and ends the process
at some deeply nested texts.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

PACKAGE_NAME = "tactile_resonance"

MOST_DEPTH = 20
MOST_ALIASES = 10
MOST_DIGITS = 1000
"""Of an integer: those beyond all floats are still shown in messages, not those beyond all measure."""

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_NULL = {"", "~", "null", "Null", "NULL"}
_BOOL = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}
_SPECIAL = re.compile(r"[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)")
_INTEGER = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
# The core schema: https://yaml.org/spec/1.2.2/#1032-tag-resolution


def share_path(relative: str | Path) -> Path:
    """Return the path of a shared file or directory, e.g. ``share_path("config/tissues.yaml")``.

    Looked for, in this order: beside the package in the source tree; in
    ``share/tactile_resonance`` of every prefix in the environment variable ``AMENT_PREFIX_PATH``
    (the ament index, read without importing ament); in ``share/tactile_resonance`` of
    ``sys.prefix``.

    Parameters
    ----------
    relative : str or Path
        Path relative to the share directory; must not be absolute nor contain ``..``.

    Raises
    ------
    ValueError
        If `relative` is absolute or climbs out of the share directory.
    FileNotFoundError
        If no candidate exists; the message lists every place looked at.
    """
    relative = Path(relative)
    if relative.is_absolute() or ".." in relative.parts:
        raise ValueError(
            f"relative: got {str(relative)!r}; accepted is a path inside the share directory, "
            "such as 'config/tissues.yaml'"
        )
    prefixes = [*filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]
    installed = [Path(prefix) / "share" / PACKAGE_NAME for prefix in prefixes]
    candidates = [root / relative for root in (Path(__file__).resolve().parent.parent, *installed)]
    for candidate in candidates:
        if candidate.exists():
            return candidate
    places = "\n  ".join(str(candidate) for candidate in candidates)
    raise FileNotFoundError(f"shared file {str(relative)!r} not found; looked at:\n  {places}")


def package_version() -> str:
    """Version of this package, which stands in package.xml."""
    from xml.etree import ElementTree  # a node that does not ask need not load it

    return str(ElementTree.parse(share_path("package.xml")).findtext("version"))


def shared_file(path: Path, folder: str) -> Path:
    """Return a path as it is, or, for a bare name that is no file here, that of a shared folder.

    Raises
    ------
    ValueError
        If it is in neither place.
    """
    if len(path.parts) != 1 or path.is_file():
        return path
    try:
        return share_path(Path(folder) / path)
    except FileNotFoundError:
        raise ValueError(f"{path}: neither a file here nor one of {folder}") from None


def parse_yaml(text: str) -> Any:
    """Content of a YAML document: mappings, lists, text, numbers, true, false and None.

    Raises
    ------
    ValueError
        With the line of what is wrong.
    """
    try:
        events = yaml.parse(text, Loader=_LOADER)
        content, documents = None, 0
        for event in events:
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                _require(documents == 1, event, "a second document", "one")
                content = _Document(events).value(next(events), 0)
        return content
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from error


def dump_yaml(content: Any) -> str:
    """Text of plain values that `parse_yaml`, and readers of YAML 1.1, take back unchanged."""
    return yaml.dump(
        content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None
    )


class _Document:
    """A document that is read event by event: how deep it is and what it repeats is known before it costs."""

    def __init__(self, events: Iterator[yaml.Event]) -> None:
        self._events = events
        self._anchored: dict[str, Any] = {}
        self._aliases = 0

    def value(self, event: yaml.Event, depth: int) -> Any:
        """Value that begins with an event."""
        if isinstance(event, yaml.AliasEvent):
            self._aliases += 1
            _require(self._aliases <= MOST_ALIASES, event, "one more alias", f"{MOST_ALIASES}")
            known = event.anchor in self._anchored
            _require(known, event, f"*{event.anchor}", "an anchor that stands before, complete")
            return self._anchored[event.anchor]
        _require(event.tag is None, event, f"the tag {event.tag}", "no tag")
        if isinstance(event, yaml.ScalarEvent):
            content = _scalar(event) if event.implicit[0] else event.value
        else:
            _require(depth < MOST_DEPTH, event, "a deeper level", f"{MOST_DEPTH} levels")
            mapping = isinstance(event, yaml.MappingStartEvent)
            content = self._mapping(depth + 1) if mapping else self._list(depth + 1)
        if event.anchor is not None:
            self._anchored[event.anchor] = content
        return content

    def _list(self, depth: int) -> list[Any]:
        content = []
        while not isinstance(event := next(self._events), yaml.SequenceEndEvent):
            content.append(self.value(event, depth))
        return content

    def _mapping(self, depth: int) -> dict[Any, Any]:
        content: dict[Any, Any] = {}
        while not isinstance(event := next(self._events), yaml.MappingEndEvent):
            key = self.value(event, depth)
            _require(not isinstance(key, (list, dict)), event, "a key of several parts", "a name")
            _require(key not in content, event, f"{key!r} again", "each key once")
            content[key] = self.value(next(self._events), depth)
        return content


def _scalar(event: yaml.ScalarEvent) -> Any:
    """Value of a text that is not quoted."""
    text = event.value
    if text in _NULL:
        return None
    if text in _BOOL:
        return _BOOL[text]
    if _INTEGER.fullmatch(text):
        _require(len(text) <= MOST_DIGITS, event, f"{len(text)} digits", f"at most {MOST_DIGITS}")
        padded = re.fullmatch(r"[-+]?0+[0-9]+", text)  # 010 is 8 in YAML 1.1 and for ROS, 10 in 1.2
        _require(not padded, event, text, "a number without zeros before it, or a text in quotes")
        return int(text, 0)
    if _FLOAT.fullmatch(text):
        return float(text)
    return float(text.replace(".", "")) if _SPECIAL.fullmatch(text) else text


def _require(good: bool, event: yaml.Event, got: str, accepted: str) -> None:
    if not good:
        raise ValueError(f"line {event.start_mark.line + 1}: got {got}; accepted is {accepted}")


class _Dumper(yaml.SafeDumper):
    """Quotes what YAML 1.1 or 1.2 would not read as text."""

    def ignore_aliases(self, data: Any) -> bool:
        """What stands twice is written twice."""
        return True


_Dumper.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(rf"(?:{_INTEGER.pattern}|{_FLOAT.pattern})$"),
    list("-+.0123456789"),
)
