# SPDX-License-Identifier: Apache-2.0
"""The simulated bench as an acquisition device: plays through the services of fake_hardware_node."""

from __future__ import annotations

import queue
import time
from collections.abc import Sequence
from typing import Any

from rclpy.client import Client
from std_srvs.srv import Trigger

from tactile_resonance import msg
from tactile_resonance.clock import ClockLostError, SimulatedClock
from tactile_resonance.drivers.acquisition import AcquiredBlock, DeviceError, DeviceInfo
from tactile_resonance.multisine import Excitation
from tactile_resonance.nodes.goals import answer_of
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import excitation_to_message
from tactile_resonance.nodes.running import RESULTS
from tactile_resonance.record import BetweenSamples, InputKind
from tactile_resonance.recording.messages import record_from_message, time_from_message
from tactile_resonance.srv import Play

ANSWER_TIMEOUT_S = 10.0


class BenchDevice:
    """Keeps the contract of `AcquisitionDevice`; called from a thread other than the executor's.

    In simulated time it lets time go on to the end of each block, where a conductor's `go` ends.
    """

    def __init__(self, node: ManagedNode, frame_id: str) -> None:
        self._node = node
        self._frame_id = frame_id
        self._play_client = node.create_client(Play, "bench/play")
        self._stop_client = node.create_client(Trigger, "bench/stop")
        self._blocks: queue.SimpleQueue[msg.Record | None] = queue.SimpleQueue()  # None: wake up
        self._interrupted = False
        self._armed: Excitation | None = None
        self._next_index = 0
        self._clock: SimulatedClock | None = None
        self._start_ns = 0
        self._answer_s = node.hung_after_s if node.time_server else ANSWER_TIMEOUT_S
        node.create_subscription(msg.Record, "bench/block", self._blocks.put, RESULTS)

    def plan(self, excitations: Sequence[Excitation]) -> list[Excitation]:
        """The bench plays what is asked."""
        return list(excitations)

    def configure(self, sample_rate_hz: float) -> DeviceInfo:
        """Wait for the bench."""
        if not self._play_client.wait_for_service(timeout_sec=self._answer_s):
            raise DeviceError(
                f"device: no bench answers on {self._play_client.srv_name}, start fake_hardware_node"
            )
        return DeviceInfo(
            name="simulated bench",
            simulated=True,
            input_kind=InputKind.MEASURED,
            between_samples=BetweenSamples.BAND_LIMITED,
            output_peak_v=float("inf"),
            latency_s=0.0,
            channel_delay_s=0.0,
            anti_alias_filter="ideal",
        )

    def arm(self, excitation: Excitation) -> None:
        """Remember what to play: the bench loads nothing beforehand."""
        self._armed = excitation
        self._next_index = 0
        self._interrupted = False
        if self._node.time_server and self._clock is None:
            try:
                self._clock = SimulatedClock(
                    self._node.time_server, self._node.get_name(), hands_over=True
                )
            except ClockLostError as error:
                raise DeviceError(f"device: {error}") from error

    def play(self) -> None:
        """Ask the bench to play."""
        if self._armed is None:
            raise DeviceError("device: nothing armed to play")
        request = Play.Request(
            excitation=excitation_to_message(self._armed, self._node.ros_now_ns(), self._frame_id)
        )
        answer = self._call(self._play_client, request)
        if not answer.accepted:
            raise DeviceError(f"device: the bench refuses: {answer.message}")
        self._start_ns = time_from_message(answer.start)

    def interrupt(self) -> None:
        """End the wait for a block."""
        self._interrupted = True
        self._blocks.put(None)
        if (clock := self._clock) is not None:
            clock.interrupt()

    def read_block(self, timeout_s: float) -> AcquiredBlock:
        """Next block of what is armed; blocks of what was stopped before are passed over."""
        if self._armed is not None and self._clock is not None:
            self._wait_for_time(self._clock, self._armed)
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
            if self._armed and message.excitation_id == self._armed.excitation_id:
                break
        if message.block_index != self._next_index:
            raise DeviceError(f"device: block {self._next_index} lost, got {message.block_index}")
        self._next_index += 1
        record = record_from_message(message)
        return AcquiredBlock(record.block_index, record.origin.time_ns, record.actuator, record.sensor)

    def stop(self) -> None:
        """Silence the bench, where there is one."""
        self._armed = None
        if self._clock is not None:
            self._clock.close()
            self._clock = None
        if self._stop_client.service_is_ready():
            self._call(self._stop_client, Trigger.Request())

    def close(self) -> None:
        """Nothing: services need an executor that spins, and a simulation may play to its end."""

    def _check(self) -> None:
        if self._interrupted:
            raise DeviceError("device: interrupted")

    def _wait_for_time(self, clock: SimulatedClock, armed: Excitation) -> None:
        """Let simulated time go on to the end of the next block; it stands there until the one after."""
        end_ns = self._start_ns + round((self._next_index + 1) * armed.period_s * 1e9)
        try:
            clock.wait_until(end_ns)
        except ClockLostError as error:
            self._check()
            raise DeviceError(f"device: {error}") from error

    def _call(self, client: Client, request: object) -> Any:
        """Answer of the bench, asked from a worker thread while the executor's thread spins."""
        answer = answer_of(client, request, self._answer_s)
        if answer is None:
            raise DeviceError(f"device: no answer on {client.srv_name}")
        return answer
