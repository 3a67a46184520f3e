# SPDX-License-Identifier: Apache-2.0
"""Designs the excitation, drives the device, hands out records block by block."""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import replace
from functools import partial

from rclpy.action.server import ServerGoalHandle

from tactile_resonance import msg
from tactile_resonance.action import Measure
from tactile_resonance.drivers.acquisition import AcquiredBlock, DeviceError, DeviceInfo
from tactile_resonance.fields import counted
from tactile_resonance.multisine import Excitation
from tactile_resonance.nodes import contact_source, devices, excitation_design
from tactile_resonance.nodes.managed_node import HUNG_AFTER, TIME_SERVER, ManagedNode, in_thread
from tactile_resonance.nodes.messages import excitation_to_message, record_to_message
from tactile_resonance.nodes.parameters import Fixed, Parameter, values
from tactile_resonance.nodes.running import EXCITATIONS, POINT_RESULTS, RESULTS
from tactile_resonance.record import Origin, Record
from tactile_resonance.recording.store import RecordStore

PARAMETERS = (
    *excitation_design.PARAMETERS,
    *devices.PARAMETERS,
    contact_source.PARAMETER,
    TIME_SERVER,
    HUNG_AFTER,
    Fixed(
        "keep_all_records",
        False,
        "Keep in record_folder what the run of a scan holds, too. Else the records of a point that is done are "
        "removed there as soon as point_result tells that all of them are in its run, on the disk.",
    ),
    Parameter("block_timeout_s", 10.0, "Longest wait for a block [s].", 0.1, 3600.0),
)


# A device that is read shows life within this beyond the length of a block.
HUNG_S = 2.0


class NotReady(DeviceError):
    """The device does not answer; it may do so later."""


class Cancelled(Exception):
    """The goal was cancelled."""


class ExcitationNode(ManagedNode):
    """Action `measure`; publishes `excitation` (latched), `record`; of a run it replays `point_result`.

    Every record is in its file before it is published, and on the disk before the next is read; the files go
    once the run of a scan has all of them. Records carry
    the place of the tip and the mean force over the block, where the device is no replay; they never wait
    long for it. The device is read in a thread of its own, so that its blocking calls never hold up the
    executor.
    """

    def __init__(self) -> None:
        super().__init__("excitation_node", PARAMETERS)
        self._last_id = 0

    def configure(self) -> None:
        """Open the device; the store follows with the first measurement."""
        (self._frame_id,) = values(self, "frame_id")
        self._excitations = self.publish_on(msg.Excitation, "excitation", EXCITATIONS)
        self._records = self.publish_on(msg.Record, "record", RESULTS)
        self._device, self._replayed = devices.make_device(self)
        self.resources.callback(self._device.close)
        if self._replayed:
            self._results = self.publish_on(msg.PointResult, "point_result", POINT_RESULTS)
        elif not values(self, "keep_all_records")[0]:
            self.listen(msg.PointResult, "point_result", self._on_result, POINT_RESULTS)
        self._store: RecordStore | None = None
        self._has_store = False
        self._contact = contact_source.make_contact_source(self)
        self._cancelled = threading.Event()
        self._measured: ServerGoalHandle | None = None
        self._measurements = 0
        self._read_by_s = float("inf")  # when a device that is read must have shown life
        self.act(Measure, "measure", self._on_goal, self._on_cancel)

    def activate(self) -> None:
        """Tell what became of the points of a run that is played again."""
        for result in self._replayed:
            self._results.publish(result)

    def _on_result(self, message: msg.PointResult) -> None:
        """Records are kept once: a scan waits for all of a point before it is done, and writes them first."""
        if self._store is not None and message.outcome == message.OUTCOME_DONE:
            self._store.remove(message.measurement_id)

    def _on_cancel(self, goal: ServerGoalHandle) -> None:
        """At once where the device can, for a block under way is of no use to anybody."""
        if goal is self._measured:
            self._cancelled.set()
            self._device.interrupt()

    def working(self) -> bool:
        """A device that does not come back from a block hangs."""
        return time.monotonic() < getattr(self, "_read_by_s", float("inf"))

    async def _on_goal(self, goal: ServerGoalHandle) -> Measure.Result:
        """Measure in a thread; the executor goes on meanwhile."""
        if self._measured is not None:
            goal.abort()
            busy = "a measurement is running, cancel it or wait for its result"
            return Measure.Result(outcome=Measure.Result.NOT_READY, message=busy)
        self._cancelled.clear()
        self._measured = goal
        try:
            result = await in_thread(self, lambda: self._measure(goal), "measure")
        finally:
            self._measured = None
        # in this thread and at once: a goal that is over may expire before its result is taken
        end = {Measure.Result.DONE: goal.succeed, Measure.Result.CANCELLED: goal.canceled}
        end.get(result.outcome, goal.abort)()
        return result

    def _measure(self, goal: ServerGoalHandle) -> Measure.Result:
        result = Measure.Result(outcome=Measure.Result.REFUSED)
        try:
            excitations = self._plan(goal.request)
            result.measurement_id = excitations[0].measurement_id
            info = self._ready_device(excitations[0].sample_rate_hz)
            excitation_design.check_output(excitations, info)
            store = self._open_store()
            if store is not None:
                store.begin(excitations)
            planned = sum(excitation.periods for excitation in excitations)
            result.outcome = Measure.Result.FAILED  # what an error means from now on
            for excitation in excitations:
                self._play(goal, excitation, info, store, result, planned)
            result.outcome = Measure.Result.DONE
        except Cancelled:
            result.outcome = Measure.Result.CANCELLED
            result.message = f"cancelled after {counted(result.blocks, 'block')}"
        except (ValueError, OSError, DeviceError) as error:
            if isinstance(error, NotReady):
                result.outcome = Measure.Result.NOT_READY
            result.message = _reason(error)
            failed = result.outcome == Measure.Result.FAILED
            self.health.error(f"{'failed' if failed else 'refused'}: {result.message}")
        return result

    def _ready_device(self, sample_rate_hz: float) -> DeviceInfo:
        try:
            return self._device.configure(sample_rate_hz)
        except DeviceError as error:
            raise NotReady(str(error)) from error

    def _plan(self, goal: Measure.Goal) -> list[Excitation]:
        """What the device will play, with ids where neither goal nor device gives any."""
        asked = excitation_design.design(self, goal, self._measurements)
        self._measurements += 1
        planned = self._device.plan(asked)
        measurement_id = planned[0].measurement_id or self._new_id()
        return [
            replace(
                excitation,
                measurement_id=measurement_id,
                excitation_id=excitation.excitation_id or self._new_id(),
            )
            for excitation in planned
        ]

    def _open_store(self) -> RecordStore | None:
        """The store of this run; its folder is made when the first measurement needs it."""
        if not self._has_store:
            self._store = devices.open_store(*values(self, "record_folder", "device"))
            self._has_store = True
            where = self._store.folder if self._store else "no file: the replay is on disk already"
            self.get_logger().info(f"records go to {where}")
        return self._store

    def _new_id(self) -> int:
        """Microseconds of the clock, so that ids of a restarted node do not repeat."""
        self._last_id = max(self._last_id + 1, time.time_ns() // 1000)
        return self._last_id

    def _play(
        self,
        goal: ServerGoalHandle,
        excitation: Excitation,
        info: DeviceInfo,
        store: RecordStore | None,
        result: Measure.Result,
        planned: int,
    ) -> None:
        (timeout_s,) = values(self, "block_timeout_s")

        def hand_out(record: Record) -> None:
            self._records.publish(record_to_message(record))
            result.blocks += 1

        if store is not None:
            store.add_excitation(excitation)
        self._excitations.publish(
            excitation_to_message(excitation, self.ros_now_ns(), self._frame_id)
        )
        try:
            self._device.arm(excitation)
            self._device.play()
            for _ in range(excitation.periods):
                try:
                    block = self._read_block(timeout_s)
                except DeviceError as error:
                    if self._cancelled.is_set():
                        raise Cancelled from error
                    raise
                record = self._record(block, excitation, info)
                if store is None:
                    hand_out(record)
                else:  # what is written no kill of this node can lose; the disk takes its time
                    store.add_record(record, partial(hand_out, record))
                goal.publish_feedback(
                    Measure.Feedback(blocks=result.blocks, blocks_planned=planned)
                )
                if self._cancelled.is_set() or goal.is_cancel_requested:
                    raise Cancelled
                if not self.active:
                    raise DeviceError("device: stopped, the node was deactivated")
        finally:
            self._device.stop()

    def _read_block(self, timeout_s: float) -> AcquiredBlock:
        # in simulated time a block takes as long as it takes
        if not self.time_server:
            self._read_by_s = time.monotonic() + timeout_s + HUNG_S
        try:
            return self._device.read_block(timeout_s)
        finally:
            self._read_by_s = float("inf")

    def _record(self, block: AcquiredBlock, excitation: Excitation, info: DeviceInfo) -> Record:
        last_period = block.index == excitation.periods - 1
        last_realisation = excitation.realisation == excitation.realisations - 1
        end_ns = block.time_ns + round(excitation.period_s * 1e9)
        return Record(
            actuator=block.actuator,
            sensor=block.sensor,
            sample_rate_hz=excitation.sample_rate_hz,
            samples_per_period=excitation.samples_per_period,
            realisation=excitation.realisation,
            block_index=block.index,
            input_kind=info.input_kind,
            between_samples=info.between_samples,
            channel_delay_s=info.channel_delay_s,
            anti_alias_filter=info.anti_alias_filter,
            origin=Origin(
                measurement_id=excitation.measurement_id,
                excitation_id=excitation.excitation_id,
                time_ns=block.time_ns,
                final=last_period and last_realisation,
                frame_id=info.frame_id or self._frame_id,
                label=excitation.label,
                simulated=info.simulated,
                contact=block.contact or self._contact.over(block.time_ns, end_ns),
            ),
        )


def _reason(error: Exception) -> str:
    # devices raise DeviceError: what the operating system refused has to do with the records
    return f"{excitation_design.NO_RECORDS}{error}" if isinstance(error, OSError) else str(error)


def main() -> None:
    """Console script."""
    # the thread that reads the device takes over from that of the executor within this, and not 5 ms
    sys.setswitchinterval(1e-4)
    ExcitationNode.run()


if __name__ == "__main__":
    main()
