# SPDX-License-Identifier: Apache-2.0
"""Robot, sensor and time of a scan, through the nodes that have them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager

import numpy as np
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import GetParameters
from rclpy.duration import Duration
from rclpy.parameter import parameter_value_to_python
from rclpy.serialization import serialize_message

from tactile_resonance import msg
from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.goal import HoldMode
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.samples import Pose
from tactile_resonance.nodes.goals import answer_of, wait_for
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.measure_client import MeasureClient
from tactile_resonance.nodes.messages import pose_to_message
from tactile_resonance.nodes.node_watch import NodeWatch, ScanTime
from tactile_resonance.nodes.parameters import values
from tactile_resonance.nodes.running import PLACES
from tactile_resonance.nodes.tip_contact import STATE_TOPIC, TipContact
from tactile_resonance.record import Contact
from tactile_resonance.recording.messages import poles_from_message
from tactile_resonance.scan.clearance import STILL_M, Standoffs, TipUse
from tactile_resonance.scan.failures import (
    Disturbances,
    NodeAway,
    PointDisturbed,
    PointFailed,
    ScanEnded,
    Stopped,
    SurfaceEarly,
)
from tactile_resonance.scan.hands import Check, Measured, Touch
from tactile_resonance.scan.measurement import MeasurementDesign
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.run_directory import PointRecording
from tactile_resonance.scan.surface import Plane
from tactile_resonance.scan.surface_search import LEAST_TOUCH_STD_M
from tactile_resonance.scan.tissue_tests import TOPIC, TYPE, ProtocolRequest
from tactile_resonance.sensor import sensor_named

STREAM_TOPICS = ("record", "frf", "poles")
PLACED_WITHIN_S = 2.0
"""A place is received within this, on the machine's clock; in simulated time for as long as a node may
be silent."""
DISCOVERED_WITHIN_S = 10.0
NOT_MOVED = "the tip is not moved (parameter contact is none)"
RECORDERS = 1  # of the subscribers of tcp_pose: the scan's own
MET_WITHIN_S, MET_SIMULATED_WITHIN_S = 1.0, 10.0
"""Nodes of this package give a sign of life much sooner, those of other packages never."""

# Parameters of contact_node that say how it uses the sensor: a scan checks the way with the same figures.
TIP_GEOMETRY = ("beam_tilt_rad", "housing_below_m")
TIP_PARAMETERS = ("standoff_m", "early_m")
TIP_LIMITS = ("depth_m", "near_m", "misalignment_rad", "clearance_m")
TIP_NAMES = (*TIP_GEOMETRY, *(f"contact.{n}" for n in TIP_PARAMETERS), *(f"limits.{n}" for n in TIP_LIMITS))
ANSWERED_WITHIN_S = 5.0


class NodeHands:
    """`scan.hands.Hands` for a scan's own thread; the executor's thread spins meanwhile.

    Parameters
    ----------
    node : ManagedNode
        Where its parameter ``contact`` is none the tip is not moved; it is taken to be where the plan states,
        and its pose is published.
    tell_waiting : callable
        Called in the scan's thread with the node that keeps the scan waiting, for people; empty: none any more.

    Attributes
    ----------
    free_air : bool
        Whether the tip can be lifted off the tissue: not without a robot.
    frame_in_base : Pose
        Frame of the scan's points in the robot's base, to be set before a scan.
    standoffs : Standoffs
        Of the scan's surface, to be set before a scan.
    """

    def __init__(self, node: ManagedNode, tell_waiting: Callable[[str], None]) -> None:
        self._node, self._tell_waiting = node, tell_waiting
        self._time = ScanTime(node.time_server, node.hung_after_s)
        self.frame_in_base = Pose.at_origin()
        self.standoffs = Standoffs(Plane())
        contact, self._base_frame = values(node, "contact", "base_frame")
        self.free_air = contact == "robot"
        self._measure = MeasureClient(node, self._time)
        self._tip: TipContact | None = None
        if self.free_air:
            self._tip = TipContact(node, self._time, self._end_if_hung)
            self._parameters = node.client_of(GetParameters, "contact_node/get_parameters")
        else:
            self._pose = node.publish_on(PoseStamped, "tcp_pose", PLACES)

    def listening(self) -> AbstractContextManager[None]:
        """Subscribe to what a scan needs while there is one: idle, each message would cost as much.

        To be entered and left in the executor's thread.
        """
        return self._node.with_set_up(self._listen)

    def _listen(self) -> None:
        self._waited_for = ""
        self._measure.listen()
        topics = STREAM_TOPICS
        if self._tip is not None:
            self._tip.listen()
            topics = (*topics, STATE_TOPIC)
        # last: a node whose sign of life arrives has discovered all subscriptions made before
        self._nodes = NodeWatch(self._node, topics, self._time.silent_s)

    @contextmanager
    def at_work(self) -> Iterator[None]:
        """Conduct the time; begins once the nodes have discovered the subscriptions of this scan."""
        within_s = MET_SIMULATED_WITHIN_S if self._time.simulated else MET_WITHIN_S
        with self._time.conducted():
            wait_for(self._nodes.met, within_s)
            yield

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

    def touch(self, point: ScanPoint, force_n: float, hold: HoldMode, check: Check) -> None:
        """Bring the tip there and press until the force is held."""
        pose = self._pose_of(point)
        if self._tip is None:
            self._place(pose, check)
            return
        lowest_m = self.standoffs.lowest_m(point)
        check = self._check_of([STATE_TOPIC], check)
        with self._nodes.doubted_after(NodeAway):
            try:
                made = self._tip.hold(pose, force_n, hold, check, lowest_m)
            except SurfaceEarly:
                if math.isinf(lowest_m):
                    raise
                self.standoffs.forget()
                made = self._tip.hold(pose, force_n, hold, check)
        self.standoffs.add(point, made.surface_m, made.surface_std_m)

    def find(self, point: ScanPoint, force_n: float, ball_radius_m: float, check: Check) -> Touch:
        """Touch a point of the surface as it is expected and draw back; return where the ball met it.

        A touch that is disturbed is repeated, once the tip is not stopped.
        """
        tip = self._tip
        if tip is None:
            raise ScanEnded(NOT_MOVED)
        pose, disturbed, result = self._pose_of(point), Disturbances(), None
        while result is None:
            wait_for(lambda: not tip.stopped, math.inf, check)
            try:
                # anew each time: a node that was restarted is another one
                result = tip.touch(pose, force_n, self._check_of([STATE_TOPIC], check))
            except PointDisturbed as error:
                if not disturbed.again(error):
                    raise
        way = np.array(point.normal) * (ball_radius_m + result.surface_m)
        x, y, z = (point.position_m + way).tolist()
        return Touch((x, y, z), max(result.surface_std_m, LEAST_TOUCH_STD_M), result.force_n)

    def measure(
        self,
        design: MeasurementDesign,
        label: str,
        seed: int,
        enough: Callable[[Measured, int], bool],
        recording: PointRecording,
        check: Check,
    ) -> Measured:
        """Measure until it is enough or the design's end; all messages go into the recording."""
        touching = self._tip is not None and self._tip.touching
        if self._tip is not None and not touching:
            self._tip.rise()  # a reference is taken at rest

        def enough_of(message: msg.Poles, blocks: int) -> bool:
            return enough(self._measured(message), blocks)

        held = (lambda: None) if self._tip is None else self._tip.check
        topics = (*STREAM_TOPICS, *([STATE_TOPIC] if touching else []))
        with self._nodes.doubted_after(NodeAway):
            if self._is_stopped():
                raise Stopped
            if missing := self.missing():
                raise NodeAway(missing, "node away")
            check = self._check_of(topics, check)
            last = self._measure.measure(design, label, seed, enough_of, recording, check, held)
        if last is None:
            raise PointFailed("measurement: it ended before its first block")
        measured = self._measured(last)
        contact = measured.origin.contact
        reason = self._measure.recorder.force_reason or "no record states why"
        if touching and math.isnan(contact.force_n):
            raise PointDisturbed(f"force unknown: {reason}", "force unknown")
        if contact.position_m is None:
            # a node that has just come up may not have discovered the one that knows it
            text = f"measurement: the place of the tip is unknown: {reason}"
            raise PointDisturbed(text, "place unknown")
        return measured

    def tip_use(self, sensor: str) -> TipUse | None:
        """Use of a sensor of ``config/sensors``; None where no contact_node of ours answers in time."""
        answer = answer_of(self._parameters, GetParameters.Request(names=TIP_NAMES), ANSWERED_WITHIN_S)
        if answer is None:
            return None
        told = [parameter_value_to_python(value) for value in answer.values]
        if len(told) != len(TIP_NAMES) or None in told:
            return None
        given = dict(zip((name.rpartition(".")[2] for name in TIP_NAMES), told, strict=True))
        described = sensor_named(sensor)
        ball, beam = described.tip.radius_m, described.beam.free_length_m
        return TipUse(
            TipGeometry(ball, beam, **{name: given[name] for name in TIP_GEOMETRY}),
            ContactParameters(**{name: given[name] for name in TIP_PARAMETERS}),
            Limits(**{name: given[name] for name in TIP_LIMITS}),
        )

    def offers_tests(self) -> bool:
        """Whether a node offers the action `indent`."""
        return self._tip is not None and self._tip.offers_tests()

    def test(
        self,
        point: ScanPoint,
        asked: ProtocolRequest,
        force_n: float,
        recording: PointRecording,
        check: Check,
    ) -> None:
        """Carry a mechanical test out by contact_node; what it recorded is kept, whatever becomes of it."""
        if self._tip is None:
            raise ScanEnded(NOT_MOVED)
        check = self._check_of([STATE_TOPIC], check)
        with self._nodes.doubted_after(NodeAway):
            result = self._tip.test(self._pose_of(point), asked, force_n, check)
        record = result.record
        if record.time_s:
            topic = self._node.resolve_topic_name(TOPIC)
            recording.write(topic, TYPE, time.time_ns(), serialize_message(record))
        if not result.done:
            raise self._tip.failure(result)

    def retract(self) -> float:
        """Draw the tip back and wait until it is free; return by how much the zero of the force moved [N]."""
        if self._tip is None:
            return 0.0
        if self._tip.tissue_moves_m > STILL_M:
            self.standoffs.forget()
        return self._tip.retract()

    def spent_s(self) -> dict[str, float]:
        """Where the time of the newest contact went, as fields of `PointResult`; empty: unknown."""
        return {} if self._tip is None else self._tip.spent_s

    # helpers

    def _is_stopped(self) -> bool:
        return self._tip is not None and self._tip.stopped

    def _measured(self, message: msg.Poles) -> Measured:
        poles, origin = poles_from_message(message)
        touched_ns = None if self._tip is None else self._tip.touched_ns
        age_s = math.nan if touched_ns is None else (origin.time_ns - touched_ns) * 1e-9
        return Measured(poles, origin, age_s, self._measure.recorder.distortion)

    def _check_of(self, topics: Sequence[str], check: Check) -> Check:
        """The same, which also raises `NodeAway` where a node behind these topics is not at work any more."""
        instances = self._nodes.instances(topics)

        def both() -> None:
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
            check()

        return both

    def _end_if_hung(self) -> None:
        """In simulated time a node that hangs holds time up; the scan ends where that lasts too long."""
        if self._time.simulated and (problem := self._nodes.hung()):
            raise ScanEnded(f"{problem}; the run can be resumed")

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
        heard = self._pose.get_subscription_count
        wait_for(lambda: heard() > RECORDERS, DISCOVERED_WITHIN_S, check)
        self._pose.publish(pose)
        self._pose.wait_for_all_acked(Duration(seconds=self._time.patience_s(PLACED_WITHIN_S)))
