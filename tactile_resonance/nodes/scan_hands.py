# SPDX-License-Identifier: Apache-2.0
"""Robot and sensor of a scan, through the actions of contact_node and excitation_node."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.task import Future
from std_srvs.srv import Trigger

from tactile_resonance import msg
from tactile_resonance.action import MakeContact, Measure
from tactile_resonance.contact.result import Cause
from tactile_resonance.contact.samples import Pose
from tactile_resonance.identification.result import Poles
from tactile_resonance.nodes.conversions import poles_from_message, pose_to_message
from tactile_resonance.nodes.excitation_design import GRIDS
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.publisher_watch import PublisherWatch
from tactile_resonance.nodes.running import NEWEST, STREAM
from tactile_resonance.nodes.scan_recorder import ScanRecorder
from tactile_resonance.record import Contact
from tactile_resonance.scan.hands import (
    ATTEMPTS,
    Check,
    Interrupted,
    Measured,
    PointDisturbed,
    PointFailed,
    Recording,
    ScanEnded,
)
from tactile_resonance.scan.measurement import MeasurementDesign
from tactile_resonance.scan.scan_point import ScanPoint
from tactile_resonance.scan.scene import Hold
from tactile_resonance.scan.surface_search import Touch

POLL_S = 0.005
# A node that was started anew needs so long at most until it takes goals again.
NODE_BACK_WITHIN_S = 60.0
RESULTS_WITHIN_S = 10.0
# A measurement that is cancelled ends with its block.
GOAL_ENDS_WITHIN_S = 15.0
RETRACT_WITHIN_S = 60.0  # a contact_node that is brought back draws the tip back too
STATE_WITHIN_S = 1.0
STATE_STALE_S = 2.0
NOT_READY_POLL_S = 0.2
STREAM_TOPICS = ("record", "frf", "poles")
# What says nothing of the point: it comes again.
DEVICE_CAUSES = frozenset(
    cause.value
    for cause in (
        *(Cause.FORCE_SOURCE, Cause.FORCE_STALE),
        *(Cause.ARM_STALE, Cause.ARM_STOPPED, Cause.ARM_LINK),
    )
)
PLACE_FOR_S = 0.2
# Pose of the arm and time of the forces leave so much of a touch's height unknown, whatever its noise.
LEAST_TOUCH_STD_M = 2e-5


class NodeRenewed(PointDisturbed):
    """A node went away and was started anew: it knows nothing of what was asked of the one before."""


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
        self._measure = ActionClient(node, Measure, "measure")
        node.resources.callback(self._measure.destroy)
        self._contact: ActionClient | None = None
        # a scan that was killed may have left the tip on the tissue
        self._touching = with_robot
        self._state: msg.ContactState | None = None
        self._state_s = float("-inf")
        if with_robot:
            # the newest only: the recorder's may have to wait behind what else is recorded
            node.listen(msg.ContactState, "contact_state", self._on_state, NEWEST)
            self._contact = ActionClient(node, MakeContact, "make_contact")
            node.resources.callback(self._contact.destroy)
            self._retract = node.create_client(Trigger, "retract")
            node.resources.callback(node.destroy_client, self._retract)
        else:
            self._pose = node.publish_on(PoseStamped, "tcp_pose", STREAM)

    def touch(self, point: ScanPoint, force_n: float, hold: Hold, check: Check) -> None:
        """Bring the tip there and press until the force is held."""
        pose = self._pose_of(point)
        if self._contact is None:
            self._place(pose)
            return
        goal = MakeContact.Goal(pose=pose, force_n=force_n)
        goal.hold = goal.HOLD_FORCE if hold is Hold.FORCE else goal.HOLD_INDENTATION
        self._make_contact(goal, check)
        deadline = time.monotonic() + STATE_WITHIN_S
        while self._state is None or self._state.state != msg.ContactState.STATE_HOLD:
            if time.monotonic() > deadline:
                self._check_contact()
            check()
            time.sleep(POLL_S)

    def find(self, point: ScanPoint, force_n: float, ball_radius_m: float, check: Check) -> Touch:
        """Touch a point of the surface as it is expected and draw back; tell where the ball met it."""
        if self._contact is None:
            raise ScanEnded("surface.touch: nobody moves the tip (parameter contact is none)")
        for left in reversed(range(ATTEMPTS)):
            goal = MakeContact.Goal(pose=self._pose_of(point), force_n=force_n)
            try:
                result = self._make_contact(goal, check)
            except PointDisturbed:
                if not left:
                    raise
                continue
            finally:
                self.retract()
            break
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
        self._wait_for_stream(check)
        topics = (*STREAM_TOPICS, *(["contact_state"] if self._touching else []))
        watch = PublisherWatch(self._node, topics)
        self._recorder.record_into(recording, goal.measurement_id)
        try:
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
                self._check_contact()

            deadline = time.monotonic() + NODE_BACK_WITHIN_S
            while True:
                handle = self._send(self._measure, goal, "measure", check)
                result = self._follow(
                    self._measure, handle, "excitation_node", check, watch, each_poll
                )
                if result.outcome != Measure.Result.NOT_READY or time.monotonic() > deadline:
                    break
                time.sleep(NOT_READY_POLL_S)
            if result.outcome not in (Measure.Result.DONE, Measure.Result.CANCELLED):
                raise PointDisturbed(f"measurement: {result.message}", "measurement failed")
            self._wait_for_results(result, watch, check)
            take_poles()
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
        if self._contact is None or not self._touching:
            return
        deadline = time.monotonic() + RETRACT_WITHIN_S
        asked_s = float("-inf")
        while time.monotonic() < deadline:
            state = self._state
            since_s = time.monotonic() - asked_s
            if state is not None and state.state == state.STATE_IDLE and since_s < float("inf"):
                self._touching = False
                return
            if since_s > 1.0 and self._retract.service_is_ready():
                self._retract.call_async(Trigger.Request())
                asked_s = time.monotonic()
            time.sleep(POLL_S)
        raise ScanEnded(f"the tip was not drawn back within {RETRACT_WITHIN_S:g} s")

    # parts of these

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

    def _check_contact(self) -> None:
        state = self._state
        if not self._touching or state is None:
            return
        silent_s = time.monotonic() - self._state_s
        if silent_s > STATE_STALE_S:
            text = f"contact_node: nothing heard of it for {silent_s:.1f} s"
            raise PointDisturbed(text, "contact_node silent")
        if state.state != state.STATE_HOLD:
            raise _contact_failure(state)

    def _on_state(self, message: msg.ContactState) -> None:
        self._state, self._state_s = message, time.monotonic()

    def _new_poles(self) -> list[msg.Poles]:
        messages = []
        while True:
            try:
                messages.append(self._recorder.poles.get_nowait())
            except queue.Empty:
                return messages

    def _wait_for_stream(self, check: Check) -> None:
        """Until somebody publishes each topic: a node that is away would spoil point after point."""
        deadline = time.monotonic() + NODE_BACK_WITHIN_S
        for topic in STREAM_TOPICS:
            name = self._node.resolve_topic_name(topic)
            while not self._node.count_publishers(name):
                if time.monotonic() > deadline:
                    raise ScanEnded(f"{topic}: nobody publishes it for {NODE_BACK_WITHIN_S:g} s")
                check()
                time.sleep(POLL_S)

    def _wait_for_results(
        self, result: Measure.Result, watch: PublisherWatch, check: Check
    ) -> None:
        """Until every block's record, FRF and poles are in the recording."""
        deadline = time.monotonic() + RESULTS_WITHIN_S
        while True:
            counts = self._recorder.counts()
            if all(count >= result.blocks for count in counts):
                return
            if time.monotonic() > deadline or watch.renewed():
                raise PointDisturbed(
                    f"of {result.blocks} blocks {counts[0]} records, {counts[1]} FRFs and {counts[2]} poles "
                    "came",
                    "messages lost",
                )
            check()
            time.sleep(POLL_S)

    def _send(self, client: ActionClient, goal: Any, name: str, check: Check) -> ClientGoalHandle:
        """Goal that was accepted; waits for a node that is being brought back."""
        deadline = time.monotonic() + NODE_BACK_WITHIN_S
        while time.monotonic() < deadline:
            check()
            if client.server_is_ready():
                future = client.send_goal_async(goal)
                if self._done(future, 2.0) and future.result().accepted:
                    return future.result()
            time.sleep(0.05)
        raise ScanEnded(f"{name}: no node takes the goal for {NODE_BACK_WITHIN_S:g} s")

    def _follow(
        self,
        client: ActionClient,
        handle: ClientGoalHandle,
        node: str,
        check: Check,
        watch: PublisherWatch,
        each_poll: Callable[[], None] = lambda: None,
    ) -> Any:
        """Result of a goal; one that is left for whatever reason is cancelled and waited for."""
        future = handle.get_result_async()
        try:
            while not future.done():
                if not client.server_is_ready():
                    raise PointDisturbed(f"{node} went away", f"{node} went away")
                if topic := watch.renewed():
                    text = f"{topic}: who publishes it was started anew"
                    raise NodeRenewed(text, "node started anew")
                check()
                each_poll()
                time.sleep(POLL_S)
        except (PointFailed, Interrupted) as error:
            if client.server_is_ready() and not isinstance(error, NodeRenewed):
                handle.cancel_goal_async()
                self._done(future, GOAL_ENDS_WITHIN_S)
            raise
        return future.result().result

    def _make_contact(self, goal: MakeContact.Goal, check: Check) -> MakeContact.Result:
        """Contact that was reached; `PointFailed` or `PointDisturbed` where it was not."""
        assert self._contact is not None
        self._touching = True
        watch = PublisherWatch(self._node, ("contact_state",))
        handle = self._send(self._contact, goal, "make_contact", check)
        result = self._follow(self._contact, handle, "contact_node", check, watch)
        if not result.reached:
            raise _contact_failure(result)
        return result

    @staticmethod
    def _done(future: Future, timeout_s: float) -> bool:
        deadline = time.monotonic() + timeout_s
        while not future.done() and time.monotonic() < deadline:
            time.sleep(POLL_S)
        return future.done()


def _contact_failure(told: MakeContact.Result | msg.ContactState) -> PointFailed:
    """What a contact that was not reached, or that ended, means for the point."""
    text = f"contact: {told.cause}: {told.message}"
    if told.cause in DEVICE_CAUSES:
        return PointDisturbed(text, told.cause)
    return PointFailed(text)
