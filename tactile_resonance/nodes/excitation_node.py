# SPDX-License-Identifier: Apache-2.0
"""Designs the excitation, drives the device, hands out records block by block."""

from __future__ import annotations

import threading
import time

from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from rclpy.task import Future

from tactile_resonance import msg
from tactile_resonance.action import Measure
from tactile_resonance.drivers.acquisition import AcquisitionDevice, Block, DeviceError, DeviceInfo
from tactile_resonance.multisine import Excitation, Grid, design_multisine
from tactile_resonance.nodes.bench_device import BenchDevice
from tactile_resonance.nodes.conversions import (
    contact_from_message,
    excitation_to_message,
    record_to_message,
)
from tactile_resonance.nodes.parameters import Parameter, declare, values
from tactile_resonance.nodes.running import EXCITATIONS, RESULTS, STREAM, run_node
from tactile_resonance.record import Contact, Origin, Record

GRIDS = {
    Measure.Goal.GRID_FULL: Grid.FULL,
    Measure.Goal.GRID_ODD: Grid.ODD,
    Measure.Goal.GRID_ODD_RANDOM: Grid.ODD_RANDOM,
}

PARAMETERS = (
    Parameter("sample_rate_hz", 50e3, "Sample rate of both channels [Hz].", 1.0, 1e7),
    Parameter("samples_per_period", 20000, "Samples of one period.", 4, 10**8),
    Parameter("f_min_hz", 10.0, "Lowest excited line [Hz].", 1e-3, 1e7),
    Parameter("f_max_hz", 10e3, "Highest excited line [Hz].", 1e-3, 1e7),
    Parameter("level_v", 1.0, "Root mean square of the drive [V].", 1e-6, 1e3),
    Parameter(
        "max_level_v",
        4.0,
        "The sensor's limit: a level above is refused [V rms].",
        1e-6,
        1e3,
        read_only=True,
    ),
    Parameter(
        "grid",
        "full",
        "Which harmonics are excited.",
        choices=tuple(grid.value for grid in GRIDS.values()),
    ),
    Parameter("periods", 8, "Periods of each realisation.", 1, 10**6),
    Parameter("realisations", 1, "Realisations of the phases in each measurement.", 1, 10**6),
    Parameter(
        "seed",
        1,
        "Seed of the phases of the first measurement; each further one takes the next.",
        1,
        2**62,
    ),
    Parameter("frame_id", "tip", "Frame of the sensor's tip.", read_only=True),
    Parameter("block_timeout_s", 10.0, "Longest wait for a block [s].", 0.1, 3600.0),
)


# How long a client may take to fetch a result.
RESULT_TIMEOUT_S = 900


class Cancelled(Exception):
    """The goal was cancelled."""


class ExcitationNode(Node):
    """Action `measure`; publishes `excitation` (latched) and `record`.

    Records carry the tip pose and the force heard last on `tcp_pose` and `wrench`. The device is read in a
    thread of its own, so that its blocking calls never hold up the executor.
    """

    def __init__(self) -> None:
        super().__init__("excitation_node")
        declare(self, PARAMETERS)
        (self._frame_id,) = values(self, "frame_id")
        self._excitations = self.create_publisher(msg.Excitation, "excitation", EXCITATIONS)
        self._records = self.create_publisher(msg.Record, "record", RESULTS)
        self._device: AcquisitionDevice = BenchDevice(self, self._frame_id)
        self._pose = PoseStamped()
        self._force_n = float("nan")
        self._busy = threading.Lock()
        self._measurements = 0
        self._last_id = 0
        self.create_subscription(PoseStamped, "tcp_pose", self._on_pose, STREAM)
        self.create_subscription(WrenchStamped, "wrench", self._on_wrench, STREAM)
        self._server = ActionServer(
            self,
            Measure,
            "measure",
            self._on_goal,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            result_timeout=RESULT_TIMEOUT_S,
        )

    def _on_pose(self, message: PoseStamped) -> None:
        self._pose = message

    def _on_wrench(self, message: WrenchStamped) -> None:
        # +z is the outward surface normal: what the tissue does to the tip points along it
        self._force_n = message.wrench.force.z

    async def _on_goal(self, goal: ServerGoalHandle) -> Measure.Result:
        """Measure in a thread; the executor goes on meanwhile."""
        outcome: list[Measure.Result | Exception] = []
        finished: Future = Future()

        # A future set from another thread may never wake its coroutine; a guard condition wakes the
        # executor, which sets it here.
        def wake() -> None:
            if outcome and not finished.done():
                finished.set_result(outcome[0])

        guard = self.create_guard_condition(wake)

        def work() -> None:
            try:
                outcome.append(self._measure(goal))
            except Exception as error:
                outcome.append(error)
            guard.trigger()

        threading.Thread(target=work, name="measure", daemon=True).start()
        result = await finished
        self.destroy_guard_condition(guard)
        if isinstance(result, Exception):
            raise result
        # in this thread and at once: a goal that is over may expire before its result is taken
        end = {Measure.Result.DONE: goal.succeed, Measure.Result.CANCELLED: goal.canceled}
        end.get(result.outcome, goal.abort)()
        return result

    def _measure(self, goal: ServerGoalHandle) -> Measure.Result:
        result = Measure.Result()
        if not self._busy.acquire(blocking=False):
            result.outcome = Measure.Result.REFUSED
            result.message = "a measurement is running, cancel it or wait for its result"
            return result
        try:
            excitations = self._design(goal.request)
            result.measurement_id = excitations[0].measurement_id
            info = self._device.configure(excitations[0].sample_rate_hz)
            self._check_output(excitations, info)
        except (ValueError, DeviceError) as error:
            self._busy.release()
            result.outcome = Measure.Result.REFUSED
            result.message = str(error)
            self.get_logger().error(f"refused: {error}")
            return result
        try:
            for excitation in excitations:
                self._play(goal, excitation, info, result)
            result.outcome = Measure.Result.DONE
        except Cancelled:
            result.outcome = Measure.Result.CANCELLED
            result.message = f"cancelled after {result.blocks} blocks"
        except DeviceError as error:
            result.outcome = Measure.Result.FAILED
            result.message = str(error)
            self.get_logger().error(f"failed: {error}")
        finally:
            self._busy.release()
        return result

    def _design(self, goal: Measure.Goal) -> list[Excitation]:
        """All realisations of a goal; zero in the goal means the node's parameter."""
        rate, samples, low, high, level, max_level, grid, periods, realisations, seed = values(
            self,
            *("sample_rate_hz", "samples_per_period", "f_min_hz", "f_max_hz", "level_v"),
            *("max_level_v", "grid", "periods", "realisations", "seed"),
        )
        level = goal.level_v or level
        if not level <= max_level:
            raise ValueError(f"level_v: {level:g}, the sensor bears at most {max_level:g} V rms")
        if goal.grid and goal.grid not in GRIDS:
            raise ValueError(
                f"grid: {goal.grid}, accepted are {sorted(GRIDS)}, 0 for the parameter"
            )
        seed = goal.seed or seed + self._measurements
        measurement_id = goal.measurement_id or self._new_id()
        self._measurements += 1
        realisations = goal.realisations or realisations
        return [
            design_multisine(
                sample_rate_hz=rate,
                samples_per_period=samples,
                band_hz=(goal.f_min_hz or low, goal.f_max_hz or high),
                level_v=level,
                grid=GRIDS[goal.grid] if goal.grid else Grid(grid),
                seed=seed,
                realisation=realisation,
                realisations=realisations,
                periods=goal.periods or periods,
                measurement_id=measurement_id,
                excitation_id=self._new_id(),
                label=goal.label,
            )
            for realisation in range(realisations)
        ]

    def _new_id(self) -> int:
        """Microseconds of the clock, so that ids of a restarted node do not repeat."""
        self._last_id = max(self._last_id + 1, time.time_ns() // 1000)
        return self._last_id

    @staticmethod
    def _check_output(excitations: list[Excitation], info: DeviceInfo) -> None:
        for excitation in excitations:
            peak_v = excitation.level_v * excitation.crest_factor()
            if peak_v > info.output_peak_v:
                raise ValueError(
                    f"level_v: peak {peak_v:.3g} V, {info.name} puts out at most "
                    f"{info.output_peak_v:.3g} V"
                )

    def _play(
        self,
        goal: ServerGoalHandle,
        excitation: Excitation,
        info: DeviceInfo,
        result: Measure.Result,
    ) -> None:
        (timeout_s,) = values(self, "block_timeout_s")
        self._excitations.publish(excitation_to_message(excitation, time.time_ns(), self._frame_id))
        self._device.arm(excitation)
        try:
            self._device.play()
            for _ in range(excitation.periods):
                block = self._device.read_block(timeout_s)
                self._records.publish(record_to_message(self._record(block, excitation, info)))
                result.blocks += 1
                goal.publish_feedback(
                    Measure.Feedback(
                        blocks=result.blocks,
                        blocks_planned=excitation.periods * excitation.realisations,
                    )
                )
                if goal.is_cancel_requested:
                    raise Cancelled
        finally:
            self._device.stop()

    def _record(self, block: Block, excitation: Excitation, info: DeviceInfo) -> Record:
        last_period = block.index == excitation.periods - 1
        last_realisation = excitation.realisation == excitation.realisations - 1
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
                frame_id=self._frame_id,
                label=excitation.label,
                simulated=info.simulated,
                contact=block.contact or self._contact(),
            ),
        )

    def _contact(self) -> Contact:
        return contact_from_message(self._pose, self._force_n, float("nan"))


def main() -> None:
    """Console script."""
    run_node(ExcitationNode)


if __name__ == "__main__":
    main()
