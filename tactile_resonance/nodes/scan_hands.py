# SPDX-License-Identifier: Apache-2.0
"""Robot and sensor of a scan, through the actions of contact_node and excitation_node."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import PoseStamped

from tactile_resonance import msg
from tactile_resonance.action import Measure
from tactile_resonance.contact.samples import Pose
from tactile_resonance.identification.result import Poles
from tactile_resonance.nodes.conversions import poles_from_message, pose_to_message
from tactile_resonance.nodes.excitation_design import GRIDS
from tactile_resonance.nodes.goal_client import GoalClient
from tactile_resonance.nodes.goals import POLL_S, follow_goal, send_goal
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.publisher_watch import PublisherWatch
from tactile_resonance.nodes.running import STREAM
from tactile_resonance.nodes.scan_recorder import ScanRecorder
from tactile_resonance.nodes.stream_nodes import StreamNodes
from tactile_resonance.nodes.tip_contact import STATE_TOPIC, TipContact
from tactile_resonance.record import Contact
from tactile_resonance.scan.hands import (
    Check,
    Measured,
    NodeAway,
    PointDisturbed,
    PointFailed,
    Recording,
    ScanEnded,
)
from tactile_resonance.scan.measurement import MeasurementDesign
from tactile_resonance.scan.scan_point import ScanPoint
from tactile_resonance.scan.scene import Hold
from tactile_resonance.scan.surface_search import Touch

DEVICE_BACK_WITHIN_S = 60.0
RESULTS_WITHIN_S = 10.0
NOT_READY_POLL_S = 0.2
STREAM_TOPICS = ("record", "frf", "poles")
PLACE_FOR_S = 0.2
# Pose of the arm and time of the forces leave so much of a touch's height unknown, whatever its noise.
LEAST_TOUCH_STD_M = 2e-5


class NodeHands:
    """`scan.hands.Hands` for a scan's own thread; the executor's thread spins meanwhile.

    Parameters
    ----------
    node : ManagedNode
    recorder : ScanRecorder
    table_in_base : Pose
        Frame of the scan's points in the robot's base.
    base_frame : str
        Name of that base.
    with_robot : bool
        False: nobody moves the tip; it is taken to be where the plan says, and its pose is published.

    Attributes
    ----------
    free_air : bool
        Without a robot nobody lifts the tip off the tissue.
    """

    def __init__(
        self,
        node: ManagedNode,
        recorder: ScanRecorder,
        table_in_base: Pose,
        base_frame: str,
        with_robot: bool,
    ) -> None:
        self._node = node
        self._recorder = recorder
        self._table = table_in_base
        self._base_frame = base_frame
        self.free_air = with_robot
        self._nodes = StreamNodes(node, (*STREAM_TOPICS, *([STATE_TOPIC] if with_robot else [])))
        self._measure = GoalClient(node, Measure, "measure")
        node.resources.callback(self._measure.destroy)
        self._tip: TipContact | None = None
        if with_robot:
            self._tip = TipContact(node)
        else:
            self._pose = node.publish_on(PoseStamped, "tcp_pose", STREAM)

    def missing(self) -> str | None:
        """A node that points need and that is not at work."""
        return self._nodes.missing()

    def touch(self, point: ScanPoint, force_n: float, hold: Hold, check: Check) -> None:
        """Bring the tip there and press until the force is held."""
        pose = self._pose_of(point)
        if self._tip is None:
            self._place(pose)
            return
        with self._nodes.doubted_after(NodeAway):
            self._tip.hold(pose, force_n, hold, check)

    def find(self, point: ScanPoint, force_n: float, ball_radius_m: float, check: Check) -> Touch:
        """Touch a point of the surface as it is expected and draw back; tell where the ball met it."""
        if self._tip is None:
            raise ScanEnded("surface.touch: nobody moves the tip (parameter contact is none)")
        result = self._tip.touch(self._pose_of(point), force_n, check)
        way = np.array(point.normal) * (ball_radius_m + result.surface_m)
        x, y, z = (point.position_m + way).tolist()
        return Touch((x, y, z), max(result.surface_std_m, LEAST_TOUCH_STD_M), result.force_n)

    def measure(
        self,
        design: MeasurementDesign,
        label: str,
        seed: int,
        enough: Callable[[Poles, int], bool],
        recording: Recording,
        check: Check,
    ) -> Measured:
        """Measure until it is enough or the design's end; all messages go into the recording."""
        # its own id: another measurement may be under way, begun by a scan that was killed
        goal = Measure.Goal(
            measurement_id=time.time_ns() // 1000,
            label=label,
            grid=next(number for number, grid in GRIDS.items() if grid is design.grid),
            level_v=design.level_v,
            f_min_hz=design.f_min_hz,
            f_max_hz=design.f_max_hz,
            periods=design.periods,
            realisations=design.realisations,
            seed=seed,
        )
        self._recorder.record_into(recording, goal.measurement_id)
        try:
            with self._nodes.doubted_after(NodeAway):
                seen = self._record(goal, enough, check)
        finally:
            self._recorder.stop()
        if not seen:
            raise PointFailed("measurement: it ended before its first block")
        poles, origin = poles_from_message(seen[-1])
        if origin.contact.position_m is None:
            raise PointFailed("measurement: nobody told where the tip is (tcp_pose)")
        return Measured(poles, origin)

    def retract(self) -> None:
        """Draw the tip back and wait until it is free."""
        if self._tip is not None:
            self._tip.retract()

    # parts of these

    def _record(
        self, goal: Measure.Goal, enough: Callable[[Poles, int], bool], check: Check
    ) -> list[msg.Poles]:
        """The poles of a measurement, all of whose messages have come."""
        if missing := self.missing():
            raise NodeAway(missing, "node away")
        touching = self._tip is not None and self._tip.touching
        watch = PublisherWatch(self._node, (*STREAM_TOPICS, *([STATE_TOPIC] if touching else [])))
        seen: list[msg.Poles] = []
        stopping = [False]

        def take_poles() -> None:
            for message in self._new_poles():
                seen.append(message)
                if enough(poles_from_message(message)[0], len(seen)) and not stopping[0]:
                    stopping[0] = True
                    handle.cancel_goal_async()

        def each_poll() -> None:
            take_poles()
            if self._tip is not None:
                self._tip.check()

        deadline = time.monotonic() + DEVICE_BACK_WITHIN_S
        while True:
            handle = send_goal(self._measure, goal, "measure", check)
            result = follow_goal(self._measure, handle, "excitation_node", check, watch, each_poll)
            if result.outcome != Measure.Result.NOT_READY or time.monotonic() > deadline:
                break
            time.sleep(NOT_READY_POLL_S)
        if result.outcome not in (Measure.Result.DONE, Measure.Result.CANCELLED):
            raise PointDisturbed(f"measurement: {result.message}", "measurement failed")
        self._wait_for_results(result, watch, check)
        take_poles()
        return seen

    def _wait_for_results(
        self, result: Measure.Result, watch: PublisherWatch, check: Check
    ) -> None:
        """Until every block's record, FRF and poles are in the recording."""
        deadline = time.monotonic() + RESULTS_WITHIN_S
        while True:
            counts = self._recorder.counts()
            if all(count >= result.blocks for count in counts):
                return
            came = (
                f"of {result.blocks} blocks {counts[0]} records, {counts[1]} FRFs and {counts[2]} poles "
                "came"
            )
            if topic := watch.renewed():
                raise NodeAway(f"{topic}: who publishes it was started anew; {came}", "node away")
            if missing := self.missing():
                raise NodeAway(f"{missing}; {came}", "node away")
            if time.monotonic() > deadline:
                raise PointDisturbed(came, "messages lost")
            check()
            time.sleep(POLL_S)

    def _new_poles(self) -> list[msg.Poles]:
        messages = []
        while True:
            try:
                messages.append(self._recorder.poles.get_nowait())
            except queue.Empty:
                return messages

    def _pose_of(self, point: ScanPoint) -> PoseStamped:
        """The point on the surface, in the robot's base."""
        turn = self._table.rotation
        place = self._table.position_m + turn.apply(point.position_m)
        x, y, z, w = (turn * turn.from_quat(point.orientation_xyzw)).as_quat().tolist()
        return pose_to_message(
            Contact(
                position_m=tuple(place.tolist()),
                orientation_xyzw=(x, y, z, w),
                frame_id=self._base_frame,
                time_ns=time.time_ns(),
            )
        )

    def _place(self, pose: PoseStamped) -> None:
        """Say where the tip is, often enough for best effort to reach everybody."""
        end_s = time.monotonic() + PLACE_FOR_S
        while time.monotonic() < end_s:
            self._pose.publish(pose)
            time.sleep(PLACE_FOR_S / 10)
