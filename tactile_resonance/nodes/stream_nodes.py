# SPDX-License-Identifier: Apache-2.0
"""Whether the nodes behind topics are at work, from who publishes and what those tell of themselves."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from diagnostic_msgs.msg import DiagnosticArray

from tactile_resonance.nodes.diagnostics import PERIOD_S
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.running import RESULTS

FRESH_S = 5 * PERIOD_S  # what a node told before that is no longer believed


class StreamNodes:
    """Listens to the diagnostics of those who publish some topics.

    A publisher in the graph does not say that its node is there: one that was killed stays in it for as long
    as its lease lasts, one that was started anew publishes nothing before it is active. A node that never
    told a lifecycle state, somebody else's, is taken to be at work while it publishes.

    Parameters
    ----------
    node : ManagedNode
    topics : sequence of str
    """

    def __init__(self, node: ManagedNode, topics: Sequence[str]) -> None:
        self._node = node
        self._topics = tuple(topics)
        self._lock = threading.Lock()
        self._told: dict[str, tuple[str, float]] = {}
        node.listen(DiagnosticArray, "/diagnostics", self._on_diagnostics, RESULTS)

    def missing(self) -> str | None:
        """A topic that nobody at work publishes, as a sentence; None: there is none."""
        for topic in self._topics:
            name = self._node.resolve_topic_name(topic)
            infos = self._node.get_publishers_info_by_topic(name)
            if not infos:
                return f"{topic}: nobody publishes it"
            nodes = {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos}
            if not any(self._at_work(node) for node in nodes):
                return f"{topic}: {' and '.join(sorted(nodes))} is not active"
        return None

    @contextmanager
    def doubted_after(self, error: type[Exception]) -> Iterator[None]:
        """After such an error believe only what is told from then on: one of them may be another by now."""
        try:
            yield
        except error:
            with self._lock:
                self._told = {
                    name: (state, float("-inf")) for name, (state, _) in self._told.items()
                }
            raise

    def _at_work(self, node: str) -> bool:
        with self._lock:
            told = self._told.get(node)
        if told is None:
            return True
        state, told_s = told
        return state == "active" and time.monotonic() < told_s + FRESH_S

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        now_s = time.monotonic()
        for status in message.status:
            state = next((value.value for value in status.values if value.key == "state"), None)
            if state is not None:
                with self._lock:
                    self._told[status.name] = state, now_s
