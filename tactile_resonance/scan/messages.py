# SPDX-License-Identifier: Apache-2.0
"""Types and definitions of the package's messages, read from ``msg/`` without ROS."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from tactile_resonance.configuration import PACKAGE_NAME, share_path
from tactile_resonance.recording.messages import write_header


class OtherVersionError(ValueError):
    """Messages of another version that cannot be read as those of today."""


@cache
def message_types() -> Typestore:
    """ROS 2's common messages and those of this package; same definitions as ROS itself has.

    Raises
    ------
    FileNotFoundError
        If the package's ``msg`` folder is not there.
    """
    store = get_typestore(Stores.ROS2_KILTED)
    types = {}
    for path in sorted(share_path("msg").glob("*.msg")):
        name = f"{PACKAGE_NAME}/msg/{path.stem}"
        types.update(get_types_from_msg(path.read_text(encoding="utf-8"), name))
    store.register(types)
    return store


def make_message(type_name: str, **content: Any) -> Any:
    """Message as rosbags knows it, ready for `to_cdr`; fields that are not given are zero or empty.

    Types with arrays of a fixed length are not supported.
    """
    store = message_types()
    fields: Any = store.fielddefs[type_name][1]
    for field, (node, detail) in fields:
        if field in content:
            continue
        if node is Nodetype.NAME:
            content[field] = make_message(detail)
        elif node is Nodetype.BASE:
            content[field] = _ZEROS.get(detail[0], 0)
        else:
            node, element = detail[0]
            content[field] = [] if node is Nodetype.NAME else np.zeros(0, element[0])
    return store.types[type_name](**content)


def header_message(frame_id: str, time_ns: int) -> Any:
    """Header of a frame and a UNIX time [ns]."""
    header = make_message("std_msgs/msg/Header")
    write_header(header, time_ns, frame_id)
    return header


_ZEROS: dict[str, Any] = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}


def to_cdr(message: Any) -> bytes:
    """A message of rosbags as it travels, which a publisher of rclpy takes too."""
    return bytes(message_types().serialize_cdr(message, message.__msgtype__))


@cache
def reader_of(type_name: str, definition: MessageDefinition) -> Callable[[bytes], Any]:
    """Function that reads a message from CDR bytes by the definition in their file.

    Fields of today's definition that the file's does not have are NaN, an empty text or an empty array.

    Parameters
    ----------
    type_name : str
        Of this package or common in ROS 2.
    definition : MessageDefinition
        As rosbags finds it in the file.

    Raises
    ------
    OtherVersionError
        If the file holds no definition, or one in which a field has another type than today, or lacks a field
        that has no value for unknown.
    """
    store = _types_of(type_name, definition)
    today, own = message_types().fielddefs[type_name][1], dict(store.fielddefs[type_name][1])
    absent: dict[str, Any] = {}
    for field, kind in today:
        if field not in own:
            absent[field] = _unknown(type_name, field, kind)
        elif own[field] != kind:
            raise OtherVersionError(
                f"{type_name}: recorded by a version whose field {field} has another type"
            )

    def read(cdr: bytes) -> Any:
        message: Any = store.deserialize_cdr(cdr, type_name)
        for field, value in absent.items():
            setattr(message, field, value)
        return message

    return read


@cache
def hash_of(type_name: str, definition: MessageDefinition) -> str:
    """Hash (REP-2011) of a type as a file defines it.

    Raises
    ------
    OtherVersionError
        If the file holds no definition.
    """
    return _types_of(type_name, definition).hash_rihs01(type_name)


def _types_of(type_name: str, definition: MessageDefinition) -> Typestore:
    """A type, and all that it needs, as a file defines them."""
    if definition.format is not MessageDefinitionFormat.MSG:
        raise OtherVersionError(
            f"{type_name}: definition of format {definition.format.name}, accepted is MSG"
        )
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition.data, type_name))
    return store


def _unknown(type_name: str, field: str, kind: Any) -> Any:
    """What stands for a field that was not recorded."""
    node, detail = kind
    if node is Nodetype.SEQUENCE:
        return np.zeros(0)
    if node is Nodetype.BASE and detail[0] in ("float32", "float64"):
        return float("nan")
    if node is Nodetype.BASE and detail[0] == "string":
        return ""
    raise OtherVersionError(f"{type_name}: recorded by a version without the field {field}")


@cache
def definition_and_hash(type_name: str) -> tuple[str, str]:
    """Definition with all that it needs, and the type's hash (REP-2011).

    Raises
    ------
    ValueError
        If the type is neither common in ROS 2 nor of this package.
    """
    store = message_types()
    if type_name not in store.types:
        raise ValueError(
            f"type_name: got {type_name!r}; accepted are ROS 2's common messages and those of {PACKAGE_NAME}"
        )
    definition, _ = store.generate_msgdef(type_name, ros_version=2)
    return definition, store.hash_rihs01(type_name)
