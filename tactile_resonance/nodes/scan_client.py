# SPDX-License-Identifier: Apache-2.0
"""A client of scan_node: one goal, its progress, its result."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle

from tactile_resonance.action import Scan
from tactile_resonance.nodes.client import NoAnswer, NodeClient
from tactile_resonance.nodes.goals import TAKEN_WITHIN_S, Goals
from tactile_resonance.scan.hands import NodeAway, ScanEnded


class ScanClient(NodeClient):
    """Context that joins the nodes' domain; not for use beside another executor.

    Parameters
    ----------
    check : callable
        Called while waiting; raises when waiting has become pointless.
    """

    def __init__(self, check: Callable[[], None]) -> None:
        super().__init__("scan_client", check)
        self.states: dict[str, str] = {}
        self._details: dict[str, dict[str, str]] = {}

    def join(self) -> None:
        """Client of the action, reader of the diagnostics."""
        self._goals = Goals(ActionClient(self._node, Scan, "scan"), "scan", self.spin)
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

    def start(self, goal: Scan.Goal, feedback: Callable[[Scan.Feedback], None]) -> ClientGoalHandle:
        """Ask for a scan until a node takes it.

        A node that was killed stays in the graph for seconds: a goal that went to it is asked for again
        when it has left, under a new id.

        Raises
        ------
        NoAnswer
            If no node takes it within `TAKEN_WITHIN_S`.
        """
        deadline = time.monotonic() + TAKEN_WITHIN_S
        while True:
            try:
                return self._goals.send(
                    goal, self._check, lambda: None, lambda message: feedback(message.feedback)
                )
            except NodeAway as error:
                if time.monotonic() > deadline:
                    raise NoAnswer(str(error)) from error
            except ScanEnded as error:
                raise NoAnswer(str(error)) from error

    def result(self, handle: ClientGoalHandle, timeout_s: float) -> Scan.Result:
        """Result of a scan."""
        future = handle.get_result_async()
        self.wait(future.done, timeout_s, "the scan")
        return future.result().result

    def scan(
        self, goal: Scan.Goal, feedback: Callable[[Scan.Feedback], None], timeout_s: float
    ) -> Scan.Result:
        """Ask for a scan and wait for its result."""
        return self.result(self.start(goal, feedback), timeout_s)

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
