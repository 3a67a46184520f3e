# SPDX-License-Identifier: Apache-2.0
"""Measurements of a scan, asked of excitation_node, with every message that comes of them in its file."""

from __future__ import annotations

import queue
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

from tactile_resonance import msg
from tactile_resonance.action import Measure
from tactile_resonance.frf.result import BandDistortion
from tactile_resonance.nodes.goals import POLL_S, GoalClient, Goals
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import NO_RECORDS, each_to_message
from tactile_resonance.nodes.node_watch import ScanTime
from tactile_resonance.nodes.running import EXCITATIONS, POLES, RESULTS, SERIES, TRUTHS
from tactile_resonance.recording.messages import GRIDS, each_from_message, time_from_message
from tactile_resonance.scan.failures import NodeAway, PointDisturbed, ScanEnded
from tactile_resonance.scan.hands import Check
from tactile_resonance.scan.measurement import MeasurementDesign
from tactile_resonance.scan.point_file import offered_qos
from tactile_resonance.scan.run_directory import PointRecording

DEVICE_BACK_WITHIN_S = 60.0
RESULTS_WITHIN_S = 10.0
"""After the last block of a measurement each further result of it comes within this, on the machine's clock; in
simulated time a slow machine may take as long as a node may be silent."""
NOT_READY_POLL_S = 0.2


class MeasureClient:
    """Client of excitation_node, for a thread of its own.

    Parameters
    ----------
    node : ManagedNode
    scan_time : ScanTime

    Attributes
    ----------
    recorder : ScanRecorder
        Of the scan that `listen` was called for.
    """

    def __init__(self, node: ManagedNode, scan_time: ScanTime) -> None:
        self._node, self._time = node, scan_time
        client = GoalClient(node, Measure, "measure")
        node.resources.callback(client.destroy)
        self._goals = Goals(client, "measure")

    def listen(self) -> None:
        """Hear all topics that are recorded, for one scan."""
        self.recorder = ScanRecorder(self._node)

    def measure(
        self,
        design: MeasurementDesign,
        label: str,
        seed: int,
        enough: Callable[[msg.Poles, int], bool],
        recording: PointRecording,
        check: Check,
        held: Check,
    ) -> msg.Poles | None:
        """The last poles of a measurement all of whose messages are in the recording; None where none came.

        `check` is called while waiting; `held` while it is measured, and raises where the contact was lost.
        """
        # its own id: another measurement may be under way, begun by a scan that was killed
        recording.measurement_id = time.time_ns() // 1000
        goal = Measure.Goal(
            measurement_id=recording.measurement_id,
            label=label,
            grid=GRIDS[design.grid],
            level_v=0.0 if design.silent else design.level_v,
            silent=design.silent,
            excited_low_hz=[low_hz for low_hz, _ in design.stretches_hz],
            excited_high_hz=[high_hz for _, high_hz in design.stretches_hz],
            sample_rate_hz=design.sample_rate_hz,
            samples_per_period=design.samples,
            periods=design.periods,
            realisations=1,
            seed=seed,
            sweep=design.sweep,
            bands=each_to_message(msg.Band, design.bands),
        )
        with self.recorder.recording(recording):
            return self._follow(goal, enough, check, held)

    def _follow(
        self,
        goal: Measure.Goal,
        enough: Callable[[msg.Poles, int], bool],
        check: Check,
        held: Check,
    ) -> msg.Poles | None:
        seen: list[msg.Poles] = []
        stopping = False
        news_s = time.monotonic()

        def take_poles() -> None:
            nonlocal stopping, news_s
            while not self.recorder.poles.empty():
                message = self.recorder.poles.get()
                seen.append(message)
                news_s = time.monotonic()
                if stopping:
                    continue
                if enough(message, len(seen)):
                    stopping = True
                    handle.cancel_goal_async()
                else:
                    self._time.go()

        def each_poll() -> None:
            take_poles()
            check()
            held()
            if self._time.simulated and time.monotonic() - news_s > self._time.silent_s:
                raise PointDisturbed("no poles of a block came", "messages lost")

        deadline = time.monotonic() + DEVICE_BACK_WITHIN_S
        while True:
            # once before the measurement and once after each block: every block that is handed over ends it
            self._time.go()
            # refused while somebody else measures, whose blocks end a go too
            handle = self._goals.send(goal, check, refused=self._time.go)
            result = self._goals.follow(handle, each_poll)
            if result.outcome != Measure.Result.NOT_READY or time.monotonic() > deadline:
                break
            time.sleep(NOT_READY_POLL_S)
        if result.message.startswith(NO_RECORDS):  # nor would any other point be measured
            raise ScanEnded(f"measurement: {result.message}; the run can be resumed")
        if result.outcome not in (Measure.Result.DONE, Measure.Result.CANCELLED):
            raise PointDisturbed(f"measurement: {result.message}", "measurement failed")
        self._wait_for_results(result, check)
        held()  # that a contact was lost in the last block is known once its mean force has sunk
        take_poles()
        return seen[-1] if seen else None

    def _wait_for_results(self, result: Measure.Result, check: Check) -> None:
        """Until every block's record, FRF and poles are in the recording, and all excitations."""
        before, deadline = "", 0.0
        while missing := self.recorder.missing(result.blocks):
            if missing != before:  # fits may take longer than the blocks did
                before, deadline = missing, time.monotonic() + self._time.patience_s(RESULTS_WITHIN_S)
            elif time.monotonic() > deadline:
                raise PointDisturbed(missing, "messages lost")
            try:
                check()
            except NodeAway as error:
                raise NodeAway(f"{error}; {missing}", error.kind) from error
            time.sleep(POLL_S)


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
    """Listens to all topics; what comes within `recording` goes into a point's file.

    Attributes
    ----------
    poles : queue of Poles messages
        In the order of their arrival, for the scan's own thread.
    force_reason : str
        Why the force of a block is unknown, of the newest one of which it is; empty: of none.
    distortion : tuple of BandDistortion
        Of all blocks so far.
    """

    def __init__(self, node: ManagedNode) -> None:
        self.poles: queue.SimpleQueue[msg.Poles] = queue.SimpleQueue()
        self.force_reason = ""
        self.distortion: tuple[BandDistortion, ...] = ()
        self._lock = threading.Lock()
        self._recording: PointRecording | None = None
        # what came on each topic of a measurement: excitation id, stamp [ns]
        self._came: dict[str, set[tuple[int, int]]] = defaultdict(set)
        for topic, recorded in TOPICS.items():
            self._listen(node, topic, recorded)

    @contextmanager
    def recording(self, recording: PointRecording) -> Iterator[None]:
        """Write what comes meanwhile there; of measurements only its own."""
        with self._lock:
            self._recording = recording
            self._came.clear()
            self.force_reason, self.distortion = "", ()
            while not self.poles.empty():
                self.poles.get()
        try:
            yield
        finally:
            with self._lock:
                self._recording = None

    def missing(self, blocks: int) -> str:
        """What has not come yet of a measurement of so many blocks; empty where all has.

        A record without its excitation could not be evaluated again.
        """
        with self._lock:
            counts = {r.each_block: len(self._came[t]) for t, r in TOPICS.items() if r.each_block}
            played, described = ({i for i, _ in self._came[t]} for t in ("record", "excitation"))
        undescribed = len(played - described)
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
                    if message.measurement_id != self._recording.measurement_id:
                        return
                    what = message.excitation_id, time_from_message(message.header.stamp)
                    if recorded.each_block and what in self._came[topic]:
                        return  # it came twice, and would count as another one
                self._recording.write(full, name, time.time_ns(), cdr, qos)
                if not recorded.measured:
                    return
                self._came[topic].add(what)
                if topic == "poles":
                    self.poles.put(message)
                elif topic == "frf":
                    self.distortion = each_from_message(BandDistortion, message.distortion)
                elif topic == "record":
                    self.force_reason = message.contact_reason or self.force_reason

        node.listen(recorded.kind, topic, heard, recorded.qos, raw=True)
