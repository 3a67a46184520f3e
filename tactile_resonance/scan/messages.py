# SPDX-License-Identifier: Apache-2.0
"""Types and definitions of the package's messages, read from ``msg/`` without ROS."""

from __future__ import annotations

from functools import cache

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from tactile_resonance.configuration import PACKAGE_NAME, share_path


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
