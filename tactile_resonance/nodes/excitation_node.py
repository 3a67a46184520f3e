# SPDX-License-Identifier: Apache-2.0
"""Designs the excitation, drives the device, hands out records block by block."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from tactile_resonance import msg
from tactile_resonance.action import Measure
from tactile_resonance.drivers.acquisition import AcquisitionDevice, DeviceError, DeviceInfo
from tactile_resonance.fields import counted
from tactile_resonance.multisine import Excitation, Grid, compress_crest_factor, design_multisine
from tactile_resonance.nodes import devices
from tactile_resonance.nodes.managed_node import HUNG_AFTER, TIME_SERVER, ManagedNode, in_thread
from tactile_resonance.nodes.messages import (
    NO_RECORDS,
    excitation_to_message,
    record_to_message,
    write_record_contact,
)
from tactile_resonance.nodes.parameters import Fixed, Parameter, values
from tactile_resonance.nodes.running import EXCITATIONS, POINT_RESULTS, RESULTS
from tactile_resonance.poles.structure import PoleBand
from tactile_resonance.record import Contact, Origin, Record
from tactile_resonance.recording.messages import GRIDS, each_from_message, key_of
from tactile_resonance.recording.store import RecordStore
from tactile_resonance.sensor import MAX_LEVEL_V

ASKED = ("sample_rate_hz", "samples_per_period", "level_v", "periods", "realisations")
"""Parameters that a goal may state too, by the names that `design_multisine` has for them."""
MOST_REALISATIONS = 1000  # each is designed, with all its lines, before the first is played

PARAMETERS = (
    Parameter("sample_rate_hz", 50e3, "Sample rate of both channels [Hz].", 1.0, 1e7),
    Parameter("samples_per_period", 20000, "Samples of one period.", 4, 10**8),
    Parameter("f_min_hz", 10.0, "Lowest excited line [Hz].", 1e-3, 1e7),
    Parameter("f_max_hz", 10e3, "Highest excited line [Hz].", 1e-3, 1e7),
    Parameter("level_v", 1.0, "Root mean square of the drive [V].", 1e-6, 1e3),
    Fixed(
        "max_level_v",
        MAX_LEVEL_V,
        "The sensor's limit: a level above is refused [V rms].",
        1e-6,
        1e3,
    ),
    Parameter(
        "grid",
        "full",
        "Which harmonics are excited.",
        choices=tuple(grid.value for grid in GRIDS if grid is not Grid.CUSTOM),
    ),
    Parameter(
        "mains_hz",
        0.0,
        "Lines at the harmonics of this mains frequency are not excited; 0 excites all [Hz].",
        0.0,
        1e3,
    ),
    Parameter(
        "mains_lines_beside", 1, "So many lines on either side of them are not excited too.", 0, 100
    ),
    Parameter("periods", 8, "Periods of each realisation.", 1, 10**6),
    Parameter(
        "realisations", 1, "Realisations of the phases in each measurement.", 1, MOST_REALISATIONS
    ),
    Parameter(
        "seed",
        1,
        "Seed of the phases of the first measurement; each further one takes the next.",
        1,
        2**62,
    ),
    Parameter(
        "compression_passes",
        0,
        "Passes that make the peaks small; 0 leaves the phases random. For linear work only.",
        0,
        10**5,
    ),
    *devices.PARAMETERS,
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
        self._contact = devices.make_contact_source(self)
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
        device = self._device  # of this configuration: the node may have another one before this ends
        try:
            result = await in_thread(self, lambda: self._measure(goal, device), "measure")
        finally:
            if self._measured is goal:
                self._measured = None
        # in this thread and at once: a goal that is over may expire before its result is taken
        end = {Measure.Result.DONE: goal.succeed, Measure.Result.CANCELLED: goal.canceled}
        end.get(result.outcome, goal.abort)()
        return result

    def _measure(self, goal: ServerGoalHandle, device: AcquisitionDevice) -> Measure.Result:
        result = Measure.Result(outcome=Measure.Result.REFUSED)
        try:
            excitations = self._plan(goal.request, device)
            result.measurement_id = excitations[0].measurement_id
            result.outcome = Measure.Result.NOT_READY  # a device that does not answer may do so later
            info = device.configure(excitations[0].sample_rate_hz)
            result.outcome = Measure.Result.REFUSED
            check_output(excitations, info)
            store = self._open_store()
            if store is not None:
                store.begin(excitations)
            planned = sum(excitation.periods for excitation in excitations)
            result.outcome = Measure.Result.FAILED  # what an error means from now on
            for excitation in excitations:
                self._play(goal, device, excitation, info, store, result, planned)
            result.outcome = Measure.Result.DONE
        except Cancelled:
            result.outcome = Measure.Result.CANCELLED
            result.message = f"cancelled after {counted(result.blocks, 'block')}"
        except (ValueError, OSError, DeviceError) as error:
            if result.outcome == Measure.Result.NOT_READY and not isinstance(error, DeviceError):
                result.outcome = Measure.Result.REFUSED
            # devices raise DeviceError: what the operating system refused has to do with the records
            result.message = f"{NO_RECORDS if isinstance(error, OSError) else ''}{error}"
            failed = result.outcome == Measure.Result.FAILED
            self.health.error(f"{'failed' if failed else 'refused'}: {result.message}")
        except Exception as error:  # an answer without this would tell of a measurement that is done
            result.outcome = Measure.Result.FAILED
            result.message = self.health.failed("measurement", error)
        return result

    def _plan(self, goal: Measure.Goal, device: AcquisitionDevice) -> list[Excitation]:
        """What the device will play, with ids where neither goal nor device gives any."""
        asked = design(self, goal, self._measurements)
        self._measurements += 1
        planned = device.plan(asked)
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
        device: AcquisitionDevice,
        excitation: Excitation,
        info: DeviceInfo,
        store: RecordStore | None,
        result: Measure.Result,
        planned: int,
    ) -> None:
        (timeout_s,) = values(self, "block_timeout_s")

        def hand_out(message: msg.Record) -> None:
            self._records.publish(message)
            result.blocks += 1

        if store is not None:
            store.add_excitation(excitation)
        self._excitations.publish(
            excitation_to_message(excitation, self.ros_now_ns(), self._frame_id)
        )
        try:
            device.play(excitation)
            for _ in range(excitation.periods):
                try:
                    block = self._read_block(device, timeout_s)
                except DeviceError as error:
                    if self._cancelled.is_set():
                        raise Cancelled from error
                    raise
                contact = self._contact_over(block, excitation, info)
                # what is known is made ready while the contact is asked for
                record = self._record(block, excitation, info)
                message = record_to_message(record)
                origin = partial(self._origin, record, contact, message)
                if store is None:
                    origin()
                    hand_out(message)
                else:  # what is written no kill of this node can lose; the disk takes its time
                    store.add_record(record, partial(hand_out, message), origin)
                goal.publish_feedback(
                    Measure.Feedback(blocks=result.blocks, blocks_planned=planned)
                )
                if self._cancelled.is_set() or goal.is_cancel_requested:
                    raise Cancelled
                if not self.active:
                    raise DeviceError("device: stopped, the node was deactivated")
        finally:
            device.stop()

    def _read_block(self, device: AcquisitionDevice, timeout_s: float) -> Record:
        # in simulated time a block takes as long as it takes
        if not self.time_server:
            self._read_by_s = time.monotonic() + timeout_s + HUNG_S
        try:
            return device.read_block(timeout_s)
        finally:
            if device is self._device:
                self._read_by_s = float("inf")

    def _contact_over(
        self, block: Record, excitation: Excitation, info: DeviceInfo
    ) -> Callable[[], Contact]:
        """What waits for the contact over a block, which is asked for now."""
        if info.recorded:
            return lambda: block.origin.contact
        begin_ns = block.origin.time_ns
        return self._contact.ask(begin_ns, begin_ns + round(excitation.period_s * 1e9))

    @staticmethod
    def _origin(record: Record, contact: Callable[[], Contact], message: msg.Record) -> Origin:
        """The origin of a record with its contact, also in its message."""
        origin = replace(record.origin, contact=contact())
        write_record_contact(message, origin.contact)
        return origin

    def _record(self, block: Record, excitation: Excitation, info: DeviceInfo) -> Record:
        """A block of the device as one of the measurement, its contact apart."""
        last_period = block.block_index == excitation.periods - 1
        last_realisation = excitation.realisation == excitation.realisations - 1
        frame_id = block.origin.frame_id if info.recorded else ""
        origin = Origin(
            measurement_id=excitation.measurement_id,
            excitation_id=excitation.excitation_id,
            time_ns=block.origin.time_ns,
            final=last_period and last_realisation,
            frame_id=frame_id or self._frame_id,
            label=excitation.label,
            simulated=block.origin.simulated,
        )
        return replace(block, realisation=excitation.realisation, origin=origin)


def design(node: Node, goal: Measure.Goal, measurements: int) -> list[Excitation]:
    """All realisations of a goal; zero in the goal means the node's parameter.

    The measurement id is the goal's, so 0 where it names none; excitation ids are 0.

    Parameters
    ----------
    node : Node
        Has declared `PARAMETERS`.
    goal : Measure.Goal
    measurements : int
        How many came before: the seed moves on.

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted.
    """
    given = {each.name: node.get_parameter(each.name).value for each in PARAMETERS}
    asked = {name: getattr(goal, name) or given[name] for name in ASKED}
    if goal.silent and goal.level_v:
        raise ValueError(f"level_v: {goal.level_v:g}, a silent measurement plays nothing: 0")
    counts = len(goal.excited_low_hz), len(goal.excited_high_hz)
    if counts[0] != counts[1]:
        raise ValueError(
            f"excited_low_hz, excited_high_hz: {counts} values, as many of each are accepted"
        )
    stretches_hz = list(zip(goal.excited_low_hz, goal.excited_high_hz, strict=True))
    if stretches_hz and (goal.f_min_hz or goal.f_max_hz):
        raise ValueError(
            f"f_min_hz, f_max_hz: {goal.f_min_hz:g}, {goal.f_max_hz:g}, 0 are accepted beside excited_low_hz"
        )
    level, max_level = asked["level_v"], given["max_level_v"]
    if not level <= max_level:
        raise ValueError(f"level_v: {level:g}, the sensor bears at most {max_level:g} V rms")
    grid = key_of(GRIDS, goal.grid, "grid") if goal.grid else Grid(given["grid"])
    realisations = asked["realisations"]
    if realisations > MOST_REALISATIONS:
        raise ValueError(f"realisations: {realisations}, accepted is up to {MOST_REALISATIONS}")
    ends_hz = goal.f_min_hz or given["f_min_hz"], goal.f_max_hz or given["f_max_hz"]
    excitations = [
        design_multisine(
            **asked,
            band_hz=stretches_hz or ends_hz,
            grid=grid,
            mains_hz=(given["mains_hz"],) if given["mains_hz"] else (),
            lines_beside=given["mains_lines_beside"],
            sweep=goal.sweep,
            seed=goal.seed or given["seed"] + measurements,
            realisation=realisation,
            measurement_id=goal.measurement_id,
            label=goal.label,
            bands=each_from_message(PoleBand, goal.bands),
        )
        for realisation in range(realisations)
    ]
    if goal.silent:
        return [replace(each, amplitude_v=np.zeros(each.harmonics.size)) for each in excitations]
    if (passes := given["compression_passes"]) and not goal.sweep:
        return [compress_crest_factor(each, passes=passes) for each in excitations]
    return excitations


def check_output(excitations: Sequence[Excitation], info: DeviceInfo) -> None:
    """ValueError if a peak is more than the device can put out."""
    for excitation in excitations:
        peak_v = float(np.max(np.abs(excitation.period())))
        if peak_v > info.output_peak_v:
            raise ValueError(
                f"level_v: peak {peak_v:.3g} V, {info.name} puts out at most "
                f"{info.output_peak_v:.3g} V"
            )


def main() -> None:
    """Console script."""
    # the thread that reads the device takes over from that of the executor within this, and not 5 ms
    sys.setswitchinterval(1e-5)
    ExcitationNode.run()
