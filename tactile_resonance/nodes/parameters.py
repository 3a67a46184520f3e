# SPDX-License-Identifier: Apache-2.0
"""Declaring ROS parameters with description, range and a reason where a value is refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node

from tactile_resonance.configuration import share_path
from tactile_resonance.contact.samples import Pose
from tactile_resonance.fields import numbers


@dataclass(frozen=True)
class Parameter:
    """One parameter of a node, which may be set while it runs.

    Attributes
    ----------
    name : str
        With its unit.
    default : bool, int, float, str or list of str or float
    description : str
    low, high : float or None
        Range of a number, ends included.
    choices : tuple of str
        What a string may be; any where empty.
    """

    name: str
    default: bool | int | float | str | list[str] | list[float]
    description: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    read_only: ClassVar[bool] = False

    def descriptor(self) -> ParameterDescriptor:
        """What `ros2 param describe` shows; ROS itself enforces the range."""
        descriptor = ParameterDescriptor(description=self.description, read_only=self.read_only)
        if self.choices:
            descriptor.additional_constraints = f"one of {', '.join(self.choices)}"
        if self.low is not None and self.high is not None:
            if isinstance(self.default, int):
                descriptor.integer_range = [
                    IntegerRange(from_value=int(self.low), to_value=int(self.high))
                ]
            else:
                descriptor.floating_point_range = [
                    FloatingPointRange(from_value=float(self.low), to_value=float(self.high))
                ]
        return descriptor


class Fixed(Parameter):
    """One that only the launch decides."""

    read_only = True


def declare(node: Node, parameters: Sequence[Parameter]) -> None:
    """Declare all, and warn of others that are given; what is set later is checked against the choices."""
    choices = {p.name: p.choices for p in parameters if p.choices}

    def check(changes: Sequence) -> SetParametersResult:
        for change in changes:
            accepted = choices.get(change.name)
            if accepted and change.value not in accepted:
                reason = f"{change.name}: {change.value!r}, accepted are {', '.join(accepted)}"
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(check)
    for parameter in parameters:
        node.declare_parameter(parameter.name, parameter.default, parameter.descriptor())
    if unknown := sorted(node._parameter_overrides.keys() - node._parameters.keys()):
        text = f"parameters that {node.get_name()} does not have are given, and ignored: "
        node.get_logger().warning(text + ", ".join(unknown))


def values(node: Node, *names: str) -> tuple:
    """Present values of several parameters."""
    return tuple(node.get_parameter(name).value for name in names)


def file_of(name: str) -> Path:
    """Path of a file that a parameter names, absolute or in the package's share folder."""
    path = Path(name).expanduser()
    return path if path.is_absolute() else share_path(name)


def pose_of(values: list[float], name: str) -> Pose:
    """Pose of a parameter of six numbers."""
    return Pose.from_vector(np.array(numbers(list(values), name, 6)))
