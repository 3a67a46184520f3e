# SPDX-License-Identifier: Apache-2.0
"""Parameters of the contact controller as ROS parameters: same names, ranges, defaults, descriptions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from rcl_interfaces.msg import SetParametersResult
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
from tactile_resonance.nodes.parameters import Fixed, Parameter, values

_GROUPS = {"contact": ContactParameters, "limits": Limits}
_LOW, _HIGH = "limits.workspace.low_m", "limits.workspace.high_m"
_CORNERS = "Opposite corners of the box in which the tip may be, in the base [m]."
# Last parts of the names of what a launch limits.
_AT_MOST, _AT_LEAST = STRICTER_BELOW | {"high_m"}, STRICTER_ABOVE | {"low_m"}


def contact_parameters() -> tuple[Parameter, ...]:
    """One parameter for each number and corner, the defaults from ``config/contact.yaml``."""
    made = []
    for (group, kind), defaults in zip(_GROUPS.items(), _defaults(), strict=True):
        for name, (low, high, description) in ranges_of(kind).items():
            full = f"{group}.{name}"
            # that of the loop which runs
            make = Fixed if full == "contact.period_s" else Parameter
            made.append(make(full, getattr(defaults, name), description, low, high))
    box = _defaults()[1].workspace
    corners = ((_LOW, box.low_m), (_HIGH, box.high_m))
    return (*made, *(Parameter(full, list(corner), _CORNERS) for full, corner in corners))


class ContactSettings:
    """Parameters and limits of a node, as they are set while it runs: limits no laxer than at the launch.

    Parameters
    ----------
    node : Node
        Just made, with `contact_parameters` and ``simulated_stalls_s`` declared.
    take : callable
        Receives what is new; raises ``ValueError`` where arm or loop cannot take it.

    Attributes
    ----------
    parameters, limits : ContactParameters, Limits
        As `read` last.
    """

    def __init__(self, node: Node, take: Callable[[ContactParameters, Limits], None]) -> None:
        self._node, self._take = node, take
        names = [p.name for p in contact_parameters() if _last(p.name) in _AT_MOST | _AT_LEAST]
        self._launched = {name: node.get_parameter(name).value for name in names}
        node.add_on_set_parameters_callback(self._on_change)

    def read(self, **changed: Any) -> None:
        """Read all, some with values about to be set (``**{"contact.x": 1}``).

        Raises
        ------
        ValueError
            If a value is out of range or beyond the limits.
        """

        def value(full: str) -> Any:
            return changed.get(full, self._node.get_parameter(full).value)

        read = []
        for (group, kind), defaults in zip(_GROUPS.items(), _defaults(), strict=True):
            given = {name: value(f"{group}.{name}") for name in ranges_of(kind)}
            read.append(replace(defaults, **given))
        parameters, limits = read
        corners = (numbers(list(value(full)), full, 3) for full in (_LOW, _HIGH))
        limits = replace(limits, workspace=Workspace(*corners))
        limits.check(parameters)
        (longer_s,) = values(self._node, "simulated_stalls_s")
        ages_s = {name: getattr(limits, name) + longer_s for name in ("force_age_s", "arm_age_s")}
        limits = replace(limits, **ages_s)
        self._take(parameters, limits)
        self.parameters, self.limits = parameters, limits

    def _on_change(self, changes: Sequence) -> SetParametersResult:
        """Take what is in range, and of limits what is stricter than the launch's."""
        changed = {c.name: c.value for c in changes if c.name.startswith(("contact.", "limits."))}
        if not changed:
            return SetParametersResult(successful=True)
        try:
            self._require_stricter(changed)
            self.read(**changed)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _require_stricter(self, changed: Mapping[str, Any]) -> None:
        """Raise ``ValueError`` where what protects the tissue would admit more than at the launch."""
        for name in changed.keys() & self._launched.keys():
            value, limit = np.array(changed[name]), np.array(self._launched[name])
            at_most = _last(name) in _AT_MOST
            stricter = value.shape == limit.shape and (
                value <= limit if at_most else value >= limit
            )
            accepted = (
                f"at {'most' if at_most else 'least'} {limit.tolist()}, as launched: it may be "
            )
            accepted += "made stricter here, and laxer by a new launch only"
            require(bool(np.all(stricter)), name, value.tolist(), accepted)


def _last(name: str) -> str:
    return name.rpartition(".")[2]


@cache
def _defaults() -> tuple[ContactParameters, Limits]:
    """Of the file, read once: in a contact parsing would hold up the control loop."""
    return read_contact()
