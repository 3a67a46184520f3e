# SPDX-License-Identifier: Apache-2.0
"""Every message of a point into its file, as it travelled; and what of a measurement has not come."""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

from tactile_resonance import msg
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.running import EXCITATIONS, POLES, RESULTS, SERIES, TRUTHS
from tactile_resonance.scan.point_file import offered_qos
from tactile_resonance.scan.run_directory import PointRecording


@dataclass(frozen=True)
class Recorded:
    """A topic that is recorded.

    `qos` is asked for; `offered`, by its publisher, is recorded where it is more than that. `measured` where
    its messages belong to a measurement: only those of the scan's own are kept. `each_block` names, in the
    plural, what comes once with each block: the scan waits for all of them.
    """

    kind: type
    qos: QoSProfile
    measured: bool = False
    each_block: str = ""
    offered: QoSProfile | None = None


TOPICS = {
    "excitation": Recorded(msg.Excitation, EXCITATIONS, measured=True),
    "record": Recorded(msg.Record, RESULTS, measured=True, each_block="records"),
    "frf": Recorded(msg.FRF, RESULTS, measured=True, each_block="FRFs"),
    "poles": Recorded(msg.Poles, RESULTS, measured=True, each_block="poles", offered=POLES),
    "bench/truth": Recorded(msg.Poles, TRUTHS, measured=True),
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
    force_reason : str
        Why the force of a block is unknown, of the newest one of which it is; empty: of none.
    """

    def __init__(self, node: ManagedNode) -> None:
        self.poles: queue.SimpleQueue[msg.Poles] = queue.SimpleQueue()
        self.force_reason = ""
        self._lock = threading.Lock()
        self._recording: PointRecording | None = None
        self._measurement_id = 0
        self._counts: Counter[str] = Counter()
        self._played: set[int] = set()  # excitation ids of the records that came
        self._described: set[int] = set()  # and of the excitations
        for topic, recorded in TOPICS.items():
            self._listen(node, topic, recorded)

    def record_into(self, recording: PointRecording, measurement_id: int) -> None:
        """Write what comes from now on there; of measurements only this one."""
        with self._lock:
            self._recording, self._measurement_id = recording, measurement_id
            for kept in (self._counts, self._played, self._described):
                kept.clear()
            self.force_reason = ""
            while not self.poles.empty():
                self.poles.get()

    def stop(self) -> None:
        """Write no more."""
        with self._lock:
            self._recording = None

    def missing(self, blocks: int) -> str:
        """What has not come yet of a measurement of so many blocks; empty where all has.

        A record without its excitation could not be evaluated again.
        """
        with self._lock:
            counts = {r.each_block: self._counts[t] for t, r in TOPICS.items() if r.each_block}
            undescribed = len(self._played - self._described)
        if undescribed == 0 and all(count >= blocks for count in counts.values()):
            return ""
        came = ", ".join(f"{count} {name}" for name, count in counts.items())
        return f"of {blocks} blocks came {came}; excitations without a message: {undescribed}"

    def _listen(self, node: ManagedNode, topic: str, recorded: Recorded) -> None:
        full = node.resolve_topic_name(topic)
        offered = recorded.offered or recorded.qos
        qos = offered_qos(
            offered.depth,
            reliable=offered.reliability is ReliabilityPolicy.RELIABLE,
            latched=offered.durability is DurabilityPolicy.TRANSIENT_LOCAL,
        )
        name = f"{recorded.kind.__module__.split('.')[0]}/msg/{recorded.kind.__name__}"

        def heard(cdr: bytes) -> None:
            with self._lock:
                if self._recording is None:
                    return
                if recorded.measured:
                    message = deserialize_message(cdr, recorded.kind)
                    if message.measurement_id != self._measurement_id:
                        return
                self._recording.write(full, name, time.time_ns(), cdr, qos)
                self._counts[topic] += 1
                if topic == "poles":
                    self.poles.put(message)
                elif topic == "excitation":
                    self._described.add(message.excitation_id)
                elif topic == "record":
                    self._played.add(message.excitation_id)
                    self.force_reason = message.contact_reason or self.force_reason

        node.listen(recorded.kind, topic, heard, recorded.qos, raw=True)
