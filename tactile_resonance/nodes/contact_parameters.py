# SPDX-License-Identifier: Apache-2.0
"""Parameters of the contact controller as ROS parameters: same names, ranges, defaults, descriptions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from rclpy.node import Node

from tactile_resonance.contact.parameters import (
    STRICTER_ABOVE,
    STRICTER_BELOW,
    ContactParameters,
    Limits,
    Workspace,
    ranges_of,
    read_contact,
)
from tactile_resonance.fields import numbers, require
from tactile_resonance.nodes.parameters import Parameter

_GROUPS = {"contact": ContactParameters, "limits": Limits}
# The control loop's period is that of the running loop.
_READ_ONLY = frozenset({"contact.period_s"})
_LOW, _HIGH = "limits.workspace.low_m", "limits.workspace.high_m"
_CORNERS = "Opposite corners of the box in which the tip may be, in the base [m]."
_AT_MOST = frozenset(
    {
        *(
            f"{g}.{n}"
            for g, kind in _GROUPS.items()
            for n in ranges_of(kind)
            if n in STRICTER_BELOW
        ),
        _HIGH,
    }
)
_AT_LEAST = frozenset({*(f"limits.{name}" for name in STRICTER_ABOVE), _LOW})


def contact_parameters() -> tuple[Parameter, ...]:
    """One parameter for each number and corner, the defaults from ``config/contact.yaml``."""
    made = []
    for (group, kind), defaults in zip(_GROUPS.items(), _defaults(), strict=True):
        for name, accepted in ranges_of(kind).items():
            full = f"{group}.{name}"
            limits = (accepted.low, accepted.high)
            made.append(
                Parameter(
                    *(full, getattr(defaults, name), accepted.description, *limits),
                    read_only=full in _READ_ONLY,
                )
            )
    box = _defaults()[1].workspace
    corners = ((_LOW, box.low_m), (_HIGH, box.high_m))
    return (*made, *(Parameter(full, list(corner), _CORNERS) for full, corner in corners))


def limits_of_launch(node: Node) -> dict[str, Any]:
    """What may be made only stricter, by parameter, with the values of a node just made."""
    return {name: node.get_parameter(name).value for name in (*_AT_MOST, *_AT_LEAST)}


def require_stricter(changed: Mapping[str, Any], launched: Mapping[str, Any]) -> None:
    """Raise ``ValueError`` where what protects the tissue would admit more than at the launch."""
    for name in changed.keys() & launched.keys():
        value, limit = np.array(changed[name]), np.array(launched[name])
        at_most = name in _AT_MOST
        good = value.shape == limit.shape and bool(
            np.all(value <= limit if at_most else value >= limit)
        )
        accepted = (
            f"at {'most' if at_most else 'least'} {limit.tolist()}, as launched: it may be made "
        )
        require(
            good, name, value.tolist(), accepted + "stricter here, and laxer by a new launch only"
        )


def read_parameters(node: Node, **changed: Any) -> tuple[ContactParameters, Limits]:
    """Parameters and limits of a node, some with values about to be set (``**{"contact.x": 1}``).

    Raises
    ------
    ValueError
        If a value is out of range or beyond the limits.
    """

    def value(full: str) -> Any:
        return changed.get(full, node.get_parameter(full).value)

    read = []
    for (group, kind), defaults in zip(_GROUPS.items(), _defaults(), strict=True):
        given = {name: value(f"{group}.{name}") for name in ranges_of(kind)}
        read.append(replace(defaults, **given))
    parameters, limits = read
    corners = (numbers(list(value(full)), full, 3) for full in (_LOW, _HIGH))
    limits = replace(limits, workspace=Workspace(*corners))
    limits.check(parameters)
    return parameters, limits


@cache
def _defaults() -> tuple[ContactParameters, Limits]:
    """Of the file, read once: in a contact parsing would hold up the control loop."""
    return read_contact()
