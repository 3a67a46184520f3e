# SPDX-License-Identifier: Apache-2.0
"""For commands and tests: spins around a `TactileClient`, and knows when all nodes are up."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from tactile_resonance.client import CalibrationOutcome, ScanOutcome, TactileClient
from tactile_resonance.nodes.client import NodeClient

SCAN_WITHIN_S = 24 * 3600.0
CANCELLED_WITHIN_S = 130.0  # as long as a tip may take to be drawn back


class ScanClient(NodeClient):
    """Context that joins the nodes' domain; not for use beside another executor.

    Parameters
    ----------
    check : callable
        Called while waiting; raises when waiting has become pointless.
    name : str
        Of its node.
    namespace : str
        Of scan_node.

    Attributes
    ----------
    tactile : TactileClient
    states : dict
        The latest diagnostics of each node, by its name.
    """

    def __init__(
        self, check: Callable[[], None], name: str = "scan_client", namespace: str = ""
    ) -> None:
        super().__init__(name, check)
        self._namespace = namespace
        self.states: dict[str, str] = {}
        self._details: dict[str, dict[str, str]] = {}

    def join(self) -> None:
        """The client, and a reader of the diagnostics."""
        self.tactile = TactileClient(self._node, self._namespace)
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)

    def why(self) -> str:
        """State of each node from the diagnostics."""
        told = "; ".join(f"{name}: {state}" for name, state in sorted(self.states.items()))
        return told or "no diagnostics"

    def details(self, node: str) -> dict[str, str]:
        """Figures of a node's diagnostics, as heard last."""
        return self._details.get(node, {})

    def wait_until_up(self, timeout_s: float) -> None:
        """Wait until the manager reports that all nodes are active.

        Raises
        ------
        NoAnswer
            If they are not in time, with what the diagnostics say.
        """

        def up() -> bool:
            return self.states.get("manager_node", "").startswith("active")

        self.wait(up, timeout_s, "the nodes to come up")

    def scan(self, timeout_s: float = SCAN_WITHIN_S, **wanted: Any) -> ScanOutcome:
        """Ask for a scan as `TactileClient.scan` does, and wait for its outcome."""
        future = self.tactile.scan(**wanted)
        self.wait(future.done, timeout_s, "the scan")
        return future.result()

    def calibrate_table(self, timeout_s: float, **wanted: Any) -> CalibrationOutcome:
        """As `TactileClient.calibrate_table`, waiting for its outcome; an interrupt has the tip drawn back."""
        future = self.tactile.calibrate_table(**wanted)
        try:
            self.wait(future.done, timeout_s, "the calibration")
        except KeyboardInterrupt:
            self.tactile.cancel()
            self.wait(future.done, CANCELLED_WITHIN_S, "the calibration to end")
            raise
        return future.result()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if str(Path(status.name).parent) != self._node.get_namespace():
                continue  # of another sensor
            name = Path(status.name).name
            self._details[name] = {value.key: value.value for value in status.values}
            # a node reports for seconds why it does not come up, then only that it has not
            refused = self.states.get(name, "").startswith(f"{status.message}: ")
            if status.level == DiagnosticStatus.ERROR or not refused:
                self.states[name] = status.message
