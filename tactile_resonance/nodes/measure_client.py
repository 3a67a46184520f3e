# SPDX-License-Identifier: Apache-2.0
"""Measurements of a scan, asked of excitation_node and recorded with all that comes of them."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable

from tactile_resonance import msg
from tactile_resonance.action import Measure
from tactile_resonance.nodes.excitation_design import GRIDS
from tactile_resonance.nodes.goals import POLL_S, GoalClient, Goals, Poll
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.scan_recorder import ScanRecorder
from tactile_resonance.nodes.scan_time import ScanTime
from tactile_resonance.scan.hands import Check, NodeAway, PointDisturbed
from tactile_resonance.scan.measurement import MeasurementDesign
from tactile_resonance.scan.run_directory import PointRecording

DEVICE_BACK_WITHIN_S = 60.0
RESULTS_WITHIN_S = 10.0
"""All results of a measurement come within this after its last block, on the machine's clock; in simulated time
a slow machine may take as long as a node may be silent."""
NOT_READY_POLL_S = 0.2


class MeasureClient:
    """Client of excitation_node, for a thread of its own.

    Parameters
    ----------
    node : ManagedNode
    scan_time : ScanTime
    """

    def __init__(self, node: ManagedNode, scan_time: ScanTime) -> None:
        self._node, self._time = node, scan_time
        client = GoalClient(node, Measure, "measure")
        node.resources.callback(client.destroy)
        self._goals = Goals(client, "measure")

    def listen(self) -> None:
        """Hear all topics that are recorded, for one scan."""
        self._recorder = ScanRecorder(self._node)

    @property
    def force_reason(self) -> str:
        """Why the force of a block of the newest measurement is unknown."""
        return self._recorder.force_reason or "no record states why"

    def measure(
        self,
        design: MeasurementDesign,
        label: str,
        seed: int,
        enough: Callable[[msg.Poles, int], bool],
        recording: PointRecording,
        check: Check,
        poll: Poll,
        held: Callable[[], None],
    ) -> msg.Poles | None:
        """The last poles of a measurement all of whose messages are in the recording; None where none came.

        `poll` is called while waiting, and raises where what is waited for cannot come; `held` while it is
        measured, and raises where the contact was lost.
        """
        # its own id: another measurement may be under way, begun by a scan that was killed
        recording.measurement_id = time.time_ns() // 1000
        goal = Measure.Goal(
            measurement_id=recording.measurement_id,
            label=label,
            grid=next(number for number, grid in GRIDS.items() if grid is design.grid),
            level_v=0.0 if design.silent else design.level_v,
            silent=design.silent,
            f_min_hz=design.f_min_hz,
            f_max_hz=design.f_max_hz,
            periods=design.periods,
            realisations=design.realisations,
            seed=seed,
        )
        self._recorder.record_into(recording, goal.measurement_id)
        try:
            return self._follow(goal, enough, check, poll, held)
        finally:
            self._recorder.stop()

    def _follow(
        self,
        goal: Measure.Goal,
        enough: Callable[[msg.Poles, int], bool],
        check: Check,
        poll: Poll,
        held: Callable[[], None],
    ) -> msg.Poles | None:
        seen: list[msg.Poles] = []
        stopping = False
        news_s = time.monotonic()

        def take_poles() -> None:
            nonlocal stopping, news_s
            while (message := self._new_poles()) is not None:
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
            poll()
            held()
            if self._time.simulated and time.monotonic() - news_s > self._time.silent_s:
                raise PointDisturbed("no poles of a block came", "messages lost")

        deadline = time.monotonic() + DEVICE_BACK_WITHIN_S
        while True:
            # once before the measurement and once after each block: every block that is handed over ends it
            self._time.go()
            handle = self._goals.send(goal, check, poll)
            result = self._goals.follow(handle, check, each_poll)
            if result.outcome != Measure.Result.NOT_READY or time.monotonic() > deadline:
                break
            time.sleep(NOT_READY_POLL_S)
        if result.outcome not in (Measure.Result.DONE, Measure.Result.CANCELLED):
            raise PointDisturbed(f"measurement: {result.message}", "measurement failed")
        self._wait_for_results(result, check, poll)
        take_poles()
        return seen[-1] if seen else None

    def _wait_for_results(self, result: Measure.Result, check: Check, poll: Poll) -> None:
        """Until every block's record, FRF and poles are in the recording, and all excitations."""
        deadline = time.monotonic() + self._time.patience_s(RESULTS_WITHIN_S)
        while missing := self._recorder.missing(result.blocks):
            if time.monotonic() > deadline:
                raise PointDisturbed(missing, "messages lost")
            try:
                poll()
            except NodeAway as error:
                raise NodeAway(f"{error}; {missing}", error.kind) from error
            check()
            time.sleep(POLL_S)

    def _new_poles(self) -> msg.Poles | None:
        try:
            return self._recorder.poles.get_nowait()
        except queue.Empty:
            return None
