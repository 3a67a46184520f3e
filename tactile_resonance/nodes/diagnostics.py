# SPDX-License-Identifier: Apache-2.0
"""A node's report on its own health on `/diagnostics`, once a second."""

from __future__ import annotations

import time
import traceback
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from tactile_resonance.nodes.running import STEADY

PERIOD_S = 1.0
# How long after an error a node still warns of it.
ERROR_REMEMBERED_S = 10.0
MEAN, LONGEST = ": mean time [ms]", ": longest time [ms]"
"""After a topic's name: how long a message of it kept the node, since the last report."""


@dataclass
class _Flow:
    """Messages of one topic, in or out."""

    total: int = 0
    last_s: float = float("nan")
    took_s: list[float] = field(default_factory=list)  # of each since the last report


class Health:
    """Counts what goes in and out, remembers the last error, and publishes both.

    Parameters
    ----------
    node : Node
        With methods ``state_name``, and ``details`` for further figures by name.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._flows: dict[str, _Flow] = {}
        self._error = ""
        self._error_s = float("-inf")
        self._reported_s = time.monotonic()
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        node.create_timer(PERIOD_S, self._publish, clock=STEADY)

    def saw(self, topic: str, seconds: float) -> None:
        """Count one message of a topic, which kept the node busy for so long [s]."""
        flow = self._flows.setdefault(topic, _Flow())
        flow.total += 1
        flow.last_s = time.monotonic()
        flow.took_s.append(seconds)

    def error(self, text: str) -> None:
        """Log an error and remember it."""
        self._node.get_logger().error(text)
        self._error = text
        self._error_s = time.monotonic()

    def failed(self, what: str, error: Exception) -> str:
        """Report what `what` ended with; the reason, for whoever waits for an answer.

        Of a `ValueError` its message; of any other exception, a defect, also the type, and the
        traceback goes to the log.
        """
        reason = str(error)
        if not isinstance(error, ValueError):
            reason = f"{type(error).__name__}: {error}"
            self._node.get_logger().error("".join(traceback.format_exception(error)))
        self.error(f"{what}: {reason}")
        return reason

    def _publish(self) -> None:
        now_s, state = time.monotonic(), self._node.state_name()
        recent = now_s - self._error_s < ERROR_REMEMBERED_S
        message = f"{state}: {self._error}" if recent else state
        levels = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
        level = levels[recent + (state != "active")]
        values = {"state": state}
        for topic, flow in self._flows.items():
            rate_hz = len(flow.took_s) / (now_s - self._reported_s)
            if flow.took_s:
                mean_s = sum(flow.took_s) / len(flow.took_s)
                values[f"{topic}{MEAN}"] = f"{1e3 * mean_s:.3g}"
                values[f"{topic}{LONGEST}"] = f"{1e3 * max(flow.took_s):.3g}"
                flow.took_s.clear()
            values[f"{topic}: messages"] = str(flow.total)
            values[f"{topic}: rate [Hz]"] = f"{rate_hz:.3g}"
            values[f"{topic}: age [s]"] = f"{now_s - flow.last_s:.3g}"
        if self._error:
            values["last error"] = self._error
            values["last error: age [s]"] = f"{now_s - self._error_s:.3g}"
        values.update(self._node.details())
        self._reported_s = now_s
        name = self._node.get_fully_qualified_name()
        status = DiagnosticStatus(
            level=level,
            name=name,
            message=message,
            hardware_id=self._node.get_namespace(),
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)
