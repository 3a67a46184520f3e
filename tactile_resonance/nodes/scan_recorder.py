# SPDX-License-Identifier: Apache-2.0
"""Every message of a point into its file, as it travelled; what the scan waits for is counted."""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

from tactile_resonance import msg
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.running import EXCITATIONS, LATCHED, RESULTS, SERIES
from tactile_resonance.scan.runner import Recording


@dataclass(frozen=True)
class Recorded:
    """A topic that is recorded; `counted` where the scan needs to know what came."""

    kind: type
    qos: QoSProfile
    latched: bool = False
    counted: bool = False


TOPICS = {
    "excitation": Recorded(msg.Excitation, EXCITATIONS, latched=True),
    "record": Recorded(msg.Record, RESULTS, counted=True),
    "frf": Recorded(msg.FRF, RESULTS, counted=True),
    "poles": Recorded(msg.Poles, RESULTS, counted=True),
    "bench/truth": Recorded(msg.Poles, LATCHED, latched=True),
    "wrench": Recorded(WrenchStamped, SERIES),
    "tcp_pose": Recorded(PoseStamped, SERIES),
    "contact_state": Recorded(msg.ContactState, SERIES),
    "/diagnostics": Recorded(DiagnosticArray, RESULTS),
}


class ScanRecorder:
    """Listens to all topics; what comes while a recording is set goes into it.

    Attributes
    ----------
    poles : queue of Poles messages
        In the order of their arrival, for the scan's own thread.
    """

    def __init__(self, node: ManagedNode) -> None:
        self.poles: queue.SimpleQueue[msg.Poles] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._recording: Recording | None = None
        self._counts: Counter[tuple[str, int]] = Counter()
        self._latched: dict[str, list[tuple[int, bytes]]] = {}
        for topic, recorded in TOPICS.items():
            self._listen(node, topic, recorded)

    def record_into(self, recording: Recording | None) -> None:
        """Write what comes from now on there; None: nowhere."""
        with self._lock:
            self._recording = recording
            self._counts.clear()
        while not self.poles.empty():
            self.poles.get()

    def counts(self, measurement_id: int) -> tuple[int, ...]:
        """Records, FRFs and poles of a measurement that came."""
        with self._lock:
            return tuple(
                self._counts[(topic, measurement_id)] for topic, r in TOPICS.items() if r.counted
            )

    def _listen(self, node: ManagedNode, topic: str, recorded: Recorded) -> None:
        full = node.resolve_topic_name(topic)
        name = f"{recorded.kind.__module__.split('.')[0]}/msg/{recorded.kind.__name__}"

        def heard(cdr: bytes) -> None:
            with self._lock:
                if self._recording is not None:
                    self._recording.write(full, name, time.time_ns(), cdr, recorded.latched)
                if not recorded.counted:
                    return
                message = deserialize_message(cdr, recorded.kind)
                self._counts[(topic, message.measurement_id)] += 1
            if topic == "poles":
                self.poles.put(message)

        node.listen(recorded.kind, topic, heard, recorded.qos, raw=True)
