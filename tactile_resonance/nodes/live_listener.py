# SPDX-License-Identifier: Apache-2.0
"""Hears what the page of a scan under way shows; publishes and asks for nothing."""

from __future__ import annotations

from tactile_resonance import msg
from tactile_resonance.nodes.client import NodeClient
from tactile_resonance.nodes.running import NEWEST, POINT_RESULTS, RESULTS, SERIES
from tactile_resonance.recording.messages import poles_from_message, time_from_message
from tactile_resonance.report.live_run import LiveRun
from tactile_resonance.scan.point_result import from_message


class LiveListener(NodeClient):
    """Context that joins the nodes' domain and passes on what it hears while it spins.

    Parameters
    ----------
    live : LiveRun
    namespace : str
        Of the nodes.
    """

    def __init__(self, live: LiveRun, namespace: str = "") -> None:
        super().__init__("live_page", lambda: None)
        self._live = live
        self._prefix = f"{namespace.rstrip('/')}/" if namespace else ""

    def join(self) -> None:
        """Topics: what scan_node, frf_node, poles_node and contact_node publish anyway."""
        for kind, topic, take, qos in (
            (msg.PointResult, "point_result", self._on_result, POINT_RESULTS),
            (msg.FRF, "frf", self._live.take_frf, NEWEST),
            (msg.Poles, "poles", self._on_poles, RESULTS),
            (msg.ContactState, "contact_state", self._on_state, SERIES),
        ):
            self._node.create_subscription(kind, f"{self._prefix}{topic}", take, qos)

    def _on_result(self, message: msg.PointResult) -> None:
        poles = poles_from_message(message.poles[0])[0] if message.poles else None
        self._live.take_result(from_message(message), poles)

    def _on_poles(self, message: msg.Poles) -> None:
        poles, origin = poles_from_message(message)
        self._live.take_poles(poles, origin.measurement_id, origin.label)

    def _on_state(self, message: msg.ContactState) -> None:
        time_s = 1e-9 * time_from_message(message.header.stamp)
        self._live.take_state(time_s, message.state, message.force_n, message.message)
