# SPDX-License-Identifier: Apache-2.0
"""How contact_node uses the sensor, from its parameters: a scan checks the way with the same figures."""

from __future__ import annotations

from rcl_interfaces.srv import GetParameters
from rclpy.parameter import parameter_value_to_python

from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.nodes.goals import answer_of
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.scan.clearance import TipUse
from tactile_resonance.sensor import sensor_named

SERVICE = "contact_node/get_parameters"
ANSWERED_WITHIN_S = 5.0
GEOMETRY = ("beam_tilt_rad", "housing_below_m")
PARAMETERS = ("standoff_m", "early_m")
LIMITS = ("depth_m", "near_m", "misalignment_rad", "clearance_m")
NAMES = (*GEOMETRY, *(f"contact.{n}" for n in PARAMETERS), *(f"limits.{n}" for n in LIMITS))


class TipUseClient:
    """Asks contact_node, from a thread beside the one that spins the node."""

    def __init__(self, node: ManagedNode) -> None:
        self._client = node.create_client(GetParameters, SERVICE)
        node.resources.callback(node.destroy_client, self._client)

    def ask(self, sensor: str) -> TipUse | None:
        """The use of a sensor of ``config/sensors``; None where no node of ours answers in time."""
        answer = answer_of(self._client, GetParameters.Request(names=NAMES), ANSWERED_WITHIN_S)
        if answer is None:
            return None
        told = [parameter_value_to_python(value) for value in answer.values]
        if len(told) != len(NAMES) or None in told:
            return None
        values = dict(zip((name.rpartition(".")[2] for name in NAMES), told, strict=True))
        described = sensor_named(sensor)
        ball, beam = described.tip.radius_m, described.beam.free_length_m
        return TipUse(
            TipGeometry(ball, beam, **{name: values[name] for name in GEOMETRY}),
            ContactParameters(**{name: values[name] for name in PARAMETERS}),
            Limits(**{name: values[name] for name in LIMITS}),
        )
