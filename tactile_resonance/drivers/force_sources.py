# SPDX-License-Identifier: Apache-2.0
"""The force source that a configuration asks for."""

from __future__ import annotations

from collections.abc import Callable

from tactile_resonance.contact.interfaces import Cell, NodeArm
from tactile_resonance.contact.tip_force import TipForce
from tactile_resonance.drivers.force_config import CanForce, ForceConfig, TopicForce
from tactile_resonance.drivers.rtde_wrench import RtdeWrench


def force_source(
    config: ForceConfig, arm: NodeArm, topic: Callable[[TopicForce], Cell] | None = None
) -> TipForce:
    """Make the source; nothing is opened before its `start`.

    Parameters
    ----------
    config : ForceConfig
    arm : NodeArm
        That carries the tip; wrenches are dated on its clock.
    topic : callable or None
        Makes the cell of a topic; only a node can.

    Raises
    ------
    ValueError
        If python-can is not installed, or a topic is asked for outside of a node.
    """
    cell: Cell
    if isinstance(config, CanForce):
        try:
            from tactile_resonance.drivers.can_wrench import CanWrench
        except ImportError as error:
            raise ValueError("kind: can needs python-can: pip install python-can") from error
        cell = CanWrench(config, arm.clock)
    elif isinstance(config, TopicForce):
        if topic is None:
            raise ValueError("kind: topic is for nodes only")
        cell = topic(config)
    elif type(config) is ForceConfig:
        cell = RtdeWrench(config, arm)
    else:
        raise TypeError(f"no source of force for {type(config).__name__}")
    return TipForce(cell, config.mounting, arm.recent)
