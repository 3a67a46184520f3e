# SPDX-License-Identifier: Apache-2.0
"""Robot and sensor of a scan, through the actions of contact_node and excitation_node."""

from __future__ import annotations

import math
import queue
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration

from tactile_resonance import msg
from tactile_resonance.action import Measure
from tactile_resonance.contact.samples import Pose
from tactile_resonance.nodes.excitation_design import GRIDS
from tactile_resonance.nodes.goal_client import GoalClient
from tactile_resonance.nodes.goals import POLL_S, Goals, Poll
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import pose_to_message
from tactile_resonance.nodes.node_watch import Instances, NodeWatch
from tactile_resonance.nodes.running import PLACES
from tactile_resonance.nodes.scan_recorder import ScanRecorder
from tactile_resonance.nodes.scan_time import ScanTime
from tactile_resonance.nodes.tip_contact import STATE_TOPIC, TipContact
from tactile_resonance.record import Contact
from tactile_resonance.recording.messages import poles_from_message
from tactile_resonance.scan.hands import (
    Check,
    Measured,
    NodeAway,
    PointDisturbed,
    PointFailed,
    Recording,
    ScanEnded,
    Stopped,
    Touch,
)
from tactile_resonance.scan.measurement import MeasurementDesign
from tactile_resonance.scan.scan_point import ScanPoint
from tactile_resonance.scan.scene import Hold
from tactile_resonance.scan.surface_search import LEAST_TOUCH_STD_M

DEVICE_BACK_WITHIN_S = 60.0
RESULTS_WITHIN_S = 10.0
"""All results of a measurement come within this after its last block, on the machine's clock; in simulated time
a slow machine may take as long as a node may be silent."""
NOT_READY_POLL_S = 0.2
STREAM_TOPICS = ("record", "frf", "poles")
PLACED_WITHIN_S = 2.0
"""A place is received within this, on the machine's clock; in simulated time as `RESULTS_WITHIN_S`."""
DISCOVERED_WITHIN_S = 10.0
NOT_MOVED = "the tip is not moved (parameter contact is none)"
RECORDERS = 1  # of the subscribers of tcp_pose: the scan's own
MET_WITHIN_S, MET_SIMULATED_WITHIN_S = 1.0, 10.0
"""Nodes of this package give a sign of life much sooner, those of other packages never."""


class NodeHands:
    """`scan.hands.Hands` for a scan's own thread; the executor's thread spins meanwhile.

    Parameters
    ----------
    node : ManagedNode
    base_frame : str
        Name of the robot's base.
    with_robot : bool
        False: the tip is not moved; it is taken to be where the plan states, and its pose is published.
    tell_waiting : callable
        Called in the scan's thread with the node that keeps the scan waiting, for people; empty: none any more.

    Attributes
    ----------
    free_air : bool
        Whether the tip can be lifted off the tissue: not without a robot.
    frame_in_base : Pose
        Frame of the scan's points in the robot's base, to be set before a scan.
    """

    def __init__(
        self,
        node: ManagedNode,
        base_frame: str,
        with_robot: bool,
        scan_time: ScanTime,
        tell_waiting: Callable[[str], None],
    ) -> None:
        self._node = node
        self.frame_in_base = Pose.at_origin()
        self._base_frame = base_frame
        self._time = scan_time
        self.free_air = with_robot
        self._tell_waiting = tell_waiting
        client = GoalClient(node, Measure, "measure")
        node.resources.callback(client.destroy)
        self._measure = Goals(client, "measure")
        self._tip: TipContact | None = None
        if with_robot:
            self._tip = TipContact(node, scan_time, self._end_if_hung)
        else:
            self._pose = node.publish_on(PoseStamped, "tcp_pose", PLACES)

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Subscribe to what a scan needs while there is one: idle, each message would cost as much.

        To be entered and left in the executor's thread.
        """
        stop = self._node.set_up(self._listen)
        try:
            yield
        finally:
            stop()

    def _listen(self) -> None:
        self._waited_for = ""
        self._recorder = ScanRecorder(self._node)
        topics = STREAM_TOPICS
        if self._tip is not None:
            self._tip.listen()
            topics = (*topics, STATE_TOPIC)
        # last: a node whose sign of life arrives has discovered all subscriptions made before
        self._nodes = NodeWatch(self._node, topics, self._time.silent_s)

    def meet(self) -> None:
        """Wait until the nodes have discovered the subscriptions of this scan."""
        simulated = self._time.simulated
        deadline = time.monotonic() + (MET_SIMULATED_WITHIN_S if simulated else MET_WITHIN_S)
        while not self._nodes.met() and time.monotonic() < deadline:
            time.sleep(POLL_S)

    def now_s(self) -> float:
        """Time by which durations count [s]."""
        return self._time.now_s()

    def begin(self, *integers: int) -> None:
        """Let simulated noise follow from these integers from now on."""
        self._time.seed(*integers)

    def missing(self) -> str | None:
        """A node that points need and that is not at work, as a sentence; None: all are at work."""
        self._end_if_hung()
        if self._is_stopped():
            return str(Stopped())
        return self._nodes.missing()

    def held(self) -> bool:
        """Whether somebody has stopped the tip, or deactivated what is missing, as a supervisor does."""
        return self._is_stopped() or self._nodes.held()

    def touch(self, point: ScanPoint, force_n: float, hold: Hold, check: Check) -> None:
        """Bring the tip there and press until the force is held."""
        pose = self._pose_of(point)
        if self._tip is None:
            self._place(pose, check)
            return
        with self._nodes.doubted_after(NodeAway):
            self._tip.hold(pose, force_n, hold, check, self._poll_of([STATE_TOPIC]))

    def find(self, point: ScanPoint, force_n: float, ball_radius_m: float, check: Check) -> Touch:
        """Touch a point of the surface as it is expected and draw back; return where the ball met it."""
        if self._tip is None:
            raise ScanEnded(NOT_MOVED)
        poll = self._poll_of([STATE_TOPIC])
        result = self._tip.touch(self._pose_of(point), force_n, check, poll)
        way = np.array(point.normal) * (ball_radius_m + result.surface_m)
        x, y, z = (point.position_m + way).tolist()
        return Touch((x, y, z), max(result.surface_std_m, LEAST_TOUCH_STD_M), result.force_n)

    def measure(
        self,
        design: MeasurementDesign,
        label: str,
        seed: int,
        enough: Callable[[Measured, int], bool],
        recording: Recording,
        check: Check,
    ) -> Measured:
        """Measure until it is enough or the design's end; all messages go into the recording."""
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
            with self._nodes.doubted_after(NodeAway):
                seen = self._record(goal, enough, check)
        finally:
            self._recorder.stop()
        if not seen:
            raise PointFailed("measurement: it ended before its first block")
        measured = self._measured(seen[-1])
        origin = measured.origin
        touching = self._tip is not None and self._tip.touching
        if touching and np.isnan(origin.contact.force_n):
            reason = self._recorder.force_reason or "no record states why"
            raise PointDisturbed(f"force unknown: {reason}", "force unknown")
        if origin.contact.position_m is None:
            # a node that has just come up may not have discovered the one that knows it
            reason = self._recorder.force_reason or "no record states why"
            text = f"measurement: the place of the tip is unknown: {reason}"
            raise PointDisturbed(text, "place unknown")
        return measured

    def retract(self) -> float:
        """Draw the tip back and wait until it is free; return by how much the zero of the force moved [N]."""
        return 0.0 if self._tip is None else self._tip.retract()

    # helpers

    def _is_stopped(self) -> bool:
        return self._tip is not None and self._tip.stopped

    def _measured(self, message: msg.Poles) -> Measured:
        poles, origin = poles_from_message(message)
        touched_ns = None if self._tip is None else self._tip.touched_ns
        age_s = math.nan if touched_ns is None else (origin.time_ns - touched_ns) * 1e-9
        return Measured(poles, origin, age_s)

    def _record(
        self, goal: Measure.Goal, enough: Callable[[Measured, int], bool], check: Check
    ) -> list[msg.Poles]:
        """The poles of a measurement, all of whose messages have come."""
        if self._is_stopped():
            raise Stopped
        if missing := self.missing():
            raise NodeAway(missing, "node away")
        touching = self._tip is not None and self._tip.touching
        poll = self._poll_of([*STREAM_TOPICS, *([STATE_TOPIC] if touching else [])])
        seen: list[msg.Poles] = []
        stopping = [False]
        news_s = [time.monotonic()]

        def take_poles() -> None:
            for message in self._new_poles():
                seen.append(message)
                news_s[0] = time.monotonic()
                if stopping[0]:
                    continue
                if enough(self._measured(message), len(seen)):
                    stopping[0] = True
                    handle.cancel_goal_async()
                else:
                    self._time.go()

        def each_poll() -> None:
            take_poles()
            poll()
            if self._tip is not None:
                self._tip.check()
            if self._time.simulated and time.monotonic() - news_s[0] > self._time.silent_s:
                raise PointDisturbed("no poles of a block came", "messages lost")

        deadline = time.monotonic() + DEVICE_BACK_WITHIN_S
        while True:
            # once before the measurement and once after each block: every block that is handed over ends it
            self._time.go()
            handle = self._measure.send(goal, check, poll)
            result = self._measure.follow(handle, check, each_poll)
            if result.outcome != Measure.Result.NOT_READY or time.monotonic() > deadline:
                break
            time.sleep(NOT_READY_POLL_S)
        if result.outcome not in (Measure.Result.DONE, Measure.Result.CANCELLED):
            raise PointDisturbed(f"measurement: {result.message}", "measurement failed")
        self._wait_for_results(result, check, poll)
        take_poles()
        return seen

    def _wait_for_results(self, result: Measure.Result, check: Check, poll: Poll) -> None:
        """Until every block's record, FRF and poles are in the recording, and all excitations."""
        deadline = time.monotonic() + self._patience_s(RESULTS_WITHIN_S)
        while missing := self._recorder.missing(result.blocks):
            if time.monotonic() > deadline:
                raise PointDisturbed(missing, "messages lost")
            try:
                poll()
            except NodeAway as error:
                raise NodeAway(f"{error}; {missing}", error.kind) from error
            check()
            time.sleep(POLL_S)

    def _poll_of(self, topics: list[str]) -> Poll:
        """Raises `NodeAway` where a node behind these topics is not at work any more."""
        instances: Instances = self._nodes.instances(topics)

        def poll() -> None:
            waited_for = self._nodes.waited_for(instances)
            who = waited_for.partition(",")[0]
            if who != self._waited_for:
                self._waited_for = who
                self._tell_waiting(waited_for)
            self._end_if_hung()
            if self._is_stopped():
                raise Stopped
            problem = self._nodes.changed(instances)
            if problem is not None:
                raise NodeAway(problem, "node away")

        return poll

    def _end_if_hung(self) -> None:
        """In simulated time a node that hangs holds time up; the scan ends where that lasts too long."""
        if self._time.simulated and (problem := self._nodes.hung()):
            raise ScanEnded(f"{problem}; the run can be resumed")

    def _new_poles(self) -> list[msg.Poles]:
        messages = []
        while True:
            try:
                messages.append(self._recorder.poles.get_nowait())
            except queue.Empty:
                return messages

    def _pose_of(self, point: ScanPoint) -> PoseStamped:
        """The point on the surface, in the robot's base."""
        turn = self.frame_in_base.rotation
        place = self.frame_in_base.position_m + turn.apply(point.position_m)
        x, y, z, w = (turn * turn.from_quat(point.orientation_xyzw)).as_quat().tolist()
        return pose_to_message(
            Contact(
                position_m=tuple(place.tolist()),
                orientation_xyzw=(x, y, z, w),
                frame_id=self._base_frame,
                time_ns=self._node.ros_now_ns(),
            )
        )

    def _place(self, pose: PoseStamped, check: Check) -> None:
        """Publish where the tip is, once another node listens, and wait until it is received there."""
        deadline = time.monotonic() + DISCOVERED_WITHIN_S
        while self._pose.get_subscription_count() <= RECORDERS and time.monotonic() < deadline:
            check()
            time.sleep(POLL_S)
        self._pose.publish(pose)
        self._pose.wait_for_all_acked(Duration(seconds=self._patience_s(PLACED_WITHIN_S)))

    def _patience_s(self, real_s: float) -> float:
        """Longest wait for nodes at work: in simulated time for as long as one may be silent."""
        return self._time.silent_s if self._time.simulated else real_s
