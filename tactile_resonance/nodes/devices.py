# SPDX-License-Identifier: Apache-2.0
"""What excitation_node reads, an acquisition device and the contact over a block, and where the records go."""

from __future__ import annotations

import os
import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geometry_msgs.msg import PoseStamped
from rclpy.client import Client
from rclpy.task import Future
from std_srvs.srv import Trigger

from tactile_resonance import msg
from tactile_resonance.clock import ClockLostError, SimulatedClock
from tactile_resonance.drivers.acquisition import AcquisitionDevice, DeviceError, DeviceInfo
from tactile_resonance.drivers.nidaq import NiDaqConfig, NiDaqDevice
from tactile_resonance.fields import read_file
from tactile_resonance.multisine import Excitation
from tactile_resonance.nodes.goals import answer_of, wait_for
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import excitation_to_message, time_message
from tactile_resonance.nodes.parameters import Fixed, values
from tactile_resonance.nodes.running import RESULTS, STREAM
from tactile_resonance.record import Contact, Record
from tactile_resonance.recording.messages import (
    contact_from_message,
    record_from_message,
    spread_from_message,
    time_from_message,
)
from tactile_resonance.recording.store import RecordStore
from tactile_resonance.srv import ForceOver, Play

if TYPE_CHECKING:
    from tactile_resonance.recording.store import StoredEntry

PARAMETERS = (
    Fixed(
        "device",
        "bench",
        "What plays and reads: the simulated bench, a recording, or NI hardware.",
        choices=("bench", "replay", "nidaqmx"),
    ),
    Fixed(
        "device_config",
        "",
        "For replay the folder or file of the recording, for nidaqmx its YAML file (see "
        "config/devices); empty for the bench.",
    ),
    Fixed(
        "replay_speed",
        1.0,
        "Signal time over real time of a replay; 0: as fast as possible.",
        0.0,
        1e3,
    ),
    Fixed(
        "record_folder",
        "",
        "Folder that receives every excitation and record before it is published; empty: "
        "tactile_resonance/records/DATE-TIME in $ROS_HOME (~/.ros where that is not set), UTC; for "
        "a replay, which is on disk already, none.",
    ),
    Fixed("frame_id", "tip", "Frame of the sensor's tip."),
    Fixed(
        "contact_source",
        "force_over",
        "Source of the tip's place and force over a block: the service force_over of contact_node (or of the "
        "simulated bench), or the topic tcp_pose where no force is measured.",
        choices=("force_over", "tcp_pose"),
    ),
)

ANSWER_TIMEOUT_S = 10.0
FORCE_WITHIN_S = 0.25
"""Longest time for which a record waits for its force, on the machine's clock; not in simulated time [s]."""
DISCOVERED_WITHIN_S = 10.0
"""In simulated time a node that has just come up, and is not known to all yet, is waited for so long [s]."""


def make_device(node: ManagedNode) -> tuple[AcquisitionDevice, Sequence[bytes]]:
    """The device that the node's parameters name, and serialised point results of a run that it plays again.

    Raises
    ------
    ValueError, OSError
        If the configuration is missing or wrong.
    DeviceError
        If what drives it is not installed.
    """
    device, config, speed, frame_id = values(
        node, "device", "device_config", "replay_speed", "frame_id"
    )
    if device == "bench":
        return BenchDevice(node, frame_id), ()
    if not config:
        raise ValueError(f"device_config: empty, expected a path for the device {device}")
    path = Path(config).expanduser().absolute()
    if device == "replay":
        # only here: it takes a node a tenth of a second more to start
        from tactile_resonance.drivers.replay import ReplayDevice

        entries, results = _content_of(path)
        return ReplayDevice(path, speed, entries), results
    return NiDaqDevice(read_file(NiDaqConfig, path)), ()


def _content_of(path: Path) -> tuple[list[StoredEntry] | None, Sequence[bytes]]:
    """Measurements and point results of a scan's run; None for a folder that the device reads itself."""
    if not (path / "run.json").is_file():
        return None, ()
    try:
        # only here: everything else works without the library for recordings
        from tactile_resonance.scan.recorded import recorded_results, run_entries
        from tactile_resonance.scan.run_content import read_run
    except ImportError as error:
        raise ValueError(
            f"device: replay of a run: {error.name} not found; pip install rosbags"
        ) from error
    run = read_run(path)
    return run_entries(run), tuple(recorded_results(run))


def open_store(folder: str, device: str) -> RecordStore | None:
    """The store of a node's records.

    Parameters
    ----------
    folder, device : str
        The parameters ``record_folder`` and ``device``.

    Returns
    -------
    RecordStore or None
        In a folder that no other node uses where none is named; None for a replay that names none.

    Raises
    ------
    OSError
        If the folder cannot be made.
    """
    if folder:
        return RecordStore(Path(folder).expanduser().absolute())
    if device == "replay":
        return None
    home = Path(os.environ.get("ROS_HOME") or Path.home() / ".ros")
    parent = home / "tactile_resonance" / "records"
    parent.mkdir(parents=True, exist_ok=True)
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    number = 1
    while True:
        # several nodes may start in the same second
        path = parent / (stamp if number == 1 else f"{stamp}-{number}")
        try:
            path.mkdir()
        except FileExistsError:
            number += 1
        else:
            return RecordStore(path)


class BenchDevice(AcquisitionDevice):
    """The simulated bench; called from a thread other than the executor's.

    In simulated time it lets time go on to the end of each block, where a conductor's `go` ends.
    """

    def __init__(self, node: ManagedNode, frame_id: str) -> None:
        self._node = node
        self._frame_id = frame_id
        self._play_client = node.create_client(Play, "bench/play")
        self._stop_client = node.create_client(Trigger, "bench/stop")
        self._blocks: queue.SimpleQueue[msg.Record | None] = queue.SimpleQueue()  # None: wake up
        self._interrupted = False
        self._playing: Excitation | None = None
        self._next_index = 0
        self._clock: SimulatedClock | None = None
        self._start_ns = 0
        self._answer_s = node.hung_after_s if node.time_server else ANSWER_TIMEOUT_S
        topic = "bench/block"
        self._heard = node.create_subscription(msg.Record, topic, self._blocks.put, RESULTS)

    def configure(self, sample_rate_hz: float) -> DeviceInfo:
        """Wait for the bench."""
        if not self._play_client.wait_for_service(timeout_sec=self._answer_s):
            raise DeviceError(
                f"device: no bench answers on {self._play_client.srv_name}, start fake_hardware_node"
            )
        return DeviceInfo("simulated bench", float("inf"))

    def play(self, excitation: Excitation) -> None:
        """Ask the bench to play."""
        self._playing = excitation
        self._next_index = 0
        self._interrupted = False
        if self._node.time_server and self._clock is None:
            try:
                self._clock = SimulatedClock(
                    self._node.time_server, self._node.get_name(), hands_over=True
                )
            except ClockLostError as error:
                raise DeviceError(f"device: {error}") from error
        message = excitation_to_message(excitation, self._node.ros_now_ns(), self._frame_id)
        answer = self._call(self._play_client, Play.Request(excitation=message))
        if not answer.accepted:
            raise DeviceError(f"device: the bench refuses: {answer.message}")
        self._start_ns = time_from_message(answer.start)

    def interrupt(self) -> None:
        """End the wait for a block."""
        self._interrupted = True
        self._blocks.put(None)
        if (clock := self._clock) is not None:
            clock.interrupt()

    def read_block(self, timeout_s: float) -> Record:
        """Next block of what is played; blocks of what was stopped before are passed over."""
        if self._playing is not None and self._clock is not None:
            # time goes on to the end of the next block, and stands there until the one after
            end_ns = self._start_ns + round((self._next_index + 1) * self._playing.period_s * 1e9)
            try:
                self._clock.wait_until(end_ns)
            except ClockLostError as error:
                self._check()
                raise DeviceError(f"device: {error}") from error
            timeout_s = self._answer_s
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                message = self._blocks.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise DeviceError(f"device: no block within {timeout_s:g} s") from None
            self._check()
            if message is None:
                continue
            # blocks of an excitation that was stopped may still be under way
            if self._playing and message.excitation_id == self._playing.excitation_id:
                break
        if message.block_index != self._next_index:
            raise DeviceError(f"device: block {self._next_index + 1} lost, got {message.block_index + 1}")
        self._next_index += 1
        return record_from_message(message)

    def stop(self) -> None:
        """Silence the bench, where there is one."""
        self._playing = None
        if self._clock is not None:
            self._clock.close()
            self._clock = None
        if self._stop_client.service_is_ready():
            self._call(self._stop_client, Trigger.Request())

    def close(self) -> None:
        """Hear no more blocks; a measurement that is still under way ends, and stops the bench itself."""
        self._node.destroy_subscription(self._heard)
        self.interrupt()

    def _check(self) -> None:
        if self._interrupted:
            raise DeviceError("device: interrupted")

    def _call(self, client: Client, request: object) -> Any:
        """Answer of the bench, asked from a worker thread while the executor's thread spins."""
        answer = answer_of(client, request, self._answer_s)
        if answer is None:
            raise DeviceError(f"device: no answer on {client.srv_name}")
        return answer


def make_contact_source(node: ManagedNode) -> MeasuredContact | PublishedPlace:
    """The source that the node's parameter names, for a thread other than the executor's."""
    (name,) = values(node, "contact_source")
    return MeasuredContact(node) if name == "force_over" else PublishedPlace(node)


class MeasuredContact:
    """Place and force over a past interval by the service `force_over`."""

    def __init__(self, node: ManagedNode) -> None:
        self._client = node.client_of(ForceOver, "force_over")
        self._within_s = node.hung_after_s if node.time_server else FORCE_WITHIN_S

    def ask(self, start_ns: int, end_ns: int) -> Callable[[], Contact]:
        """Ask for the contact from one ROS time to another [ns].

        What it gives waits for the answer: a contact, with a reason where the force is unknown.
        """
        # rclpy's own wait looks four times a second
        within_s = min(self._within_s, DISCOVERED_WITHIN_S)
        if not wait_for(self._client.service_is_ready, within_s):
            return partial(Contact, reason=f"no node serves {self._client.srv_name}")
        request = ForceOver.Request(start=time_message(start_ns), end=time_message(end_ns))
        answered = threading.Event()
        future = self._client.call_async(request)
        future.add_done_callback(lambda _: answered.set())
        return partial(self._answer, future, answered)

    def _answer(self, future: Future, answered: threading.Event) -> Contact:
        if not answered.wait(self._within_s):
            self._client.remove_pending_request(future)
            return Contact(
                reason=f"no answer on {self._client.srv_name} within {self._within_s:g} s"
            )
        over: ForceOver.Response = future.result()
        contact = contact_from_message(over.tip_pose, over.force_n, over.force_std_n)
        spread = spread_from_message(over, "force_")
        return replace(contact, coverage=over.coverage, reason=over.reason, spread=spread)


class PublishedPlace:
    """By the topic `tcp_pose`; the force is not measured."""

    def __init__(self, node: ManagedNode) -> None:
        self._pose = PoseStamped()
        node.listen(PoseStamped, "tcp_pose", self._on_pose, STREAM)

    def ask(self, start_ns: int, end_ns: int) -> Callable[[], Contact]:
        """What gives the newest place, whatever the interval."""
        nan = float("nan")
        contact = contact_from_message(self._pose, nan, nan)
        return partial(replace, contact, reason="the force is not measured (contact_source)")

    def _on_pose(self, message: PoseStamped) -> None:
        self._pose = message
