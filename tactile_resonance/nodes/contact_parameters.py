# SPDX-License-Identifier: Apache-2.0
"""Parameters of the contact controller as ROS parameters: same names, ranges, defaults, descriptions."""

from __future__ import annotations

import inspect
import re
from dataclasses import replace
from functools import cache

from rclpy.node import Node

from tactile_resonance.contact.parameters import (
    LIMIT_RANGES,
    RANGES,
    ContactParameters,
    Limits,
    read_contact,
)
from tactile_resonance.nodes.parameters import Parameter

_GROUPS = {"contact": (ContactParameters, RANGES), "limits": (Limits, LIMIT_RANGES)}
# The control loop's period is that of the running loop.
_READ_ONLY = frozenset({"contact.period_s"})


def contact_parameters() -> tuple[Parameter, ...]:
    """One parameter for each number, the defaults from ``config/contact.yaml``."""
    made = []
    for (group, (kind, ranges)), defaults in zip(_GROUPS.items(), _defaults(), strict=True):
        descriptions = _descriptions(kind)
        for name, (low, high) in ranges.items():
            full = f"{group}.{name}"
            made.append(
                Parameter(
                    full,
                    getattr(defaults, name),
                    descriptions[name],
                    low,
                    high,
                    read_only=full in _READ_ONLY,
                )
            )
    return tuple(made)


def read_parameters(node: Node, **changed: float) -> tuple[ContactParameters, Limits]:
    """Parameters and limits of a node, some with values about to be set (``**{"contact.x": 1}``).

    Raises
    ------
    ValueError
        If a value is out of range or beyond the limits.
    """
    read = []
    for (group, (_, ranges)), defaults in zip(_GROUPS.items(), _defaults(), strict=True):
        names = {name: f"{group}.{name}" for name in ranges}
        given = {
            name: changed.get(full, node.get_parameter(full).value) for name, full in names.items()
        }
        read.append(replace(defaults, **given))
    parameters, limits = read
    limits.check(parameters)
    return parameters, limits


@cache
def _defaults() -> tuple[ContactParameters, Limits]:
    """Of the file, read once: in a contact parsing would hold up the control loop."""
    return read_contact()


def _descriptions(kind: type) -> dict[str, str]:
    """What the class's docstring says of each attribute."""
    text = (inspect.getdoc(kind) or "").split("Attributes\n----------\n", 1)[1]
    descriptions = {}
    for names, body in re.findall(r"^(\S.*?) : .*\n((?:    .*\n?)+)", text + "\n", re.MULTILINE):
        for name in names.split(", "):
            descriptions[name] = " ".join(body.split())
    return descriptions
