# SPDX-License-Identifier: Apache-2.0
"""Whether a node that publishes was started anew: its topics then have a publisher that was not there."""

from __future__ import annotations

import time
from collections.abc import Sequence

from rclpy.node import Node

LOOK_EVERY_S = 0.2


class PublisherWatch:
    """Remembers who publishes now.

    A node that was killed stays in the graph for as long as its lease lasts, with its actions and services;
    what was asked of it is never answered, not by the node that was started in its place either.

    Parameters
    ----------
    node : Node
    topics : sequence of str
    """

    def __init__(self, node: Node, topics: Sequence[str]) -> None:
        self._node = node
        self._known = {topic: self._publishers(topic) for topic in topics}
        self._looked_s = time.monotonic()

    def renewed(self) -> str | None:
        """A topic with a publisher that was not there, looked for every `LOOK_EVERY_S`; else None."""
        now_s = time.monotonic()
        if now_s < self._looked_s + LOOK_EVERY_S:
            return None
        self._looked_s = now_s
        for topic, known in self._known.items():
            if self._publishers(topic) - known:
                return topic
        return None

    def _publishers(self, topic: str) -> frozenset[bytes]:
        name = self._node.resolve_topic_name(topic)
        infos = self._node.get_publishers_info_by_topic(name)
        return frozenset(bytes(info.endpoint_gid) for info in infos)
