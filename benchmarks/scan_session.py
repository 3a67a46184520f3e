# SPDX-License-Identifier: Apache-2.0
"""A client of the nodes: puts the tip on a point, measures, waits for the poles."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionClient
from tactile_resonance.action import Measure
from tactile_resonance.srv import Truth

from tactile_resonance import msg
from tactile_resonance.frf.result import FRF
from tactile_resonance.nodes.client import HANGS_S, NoAnswer, NodeClient
from tactile_resonance.nodes.messages import frf_from_message, pose_to_message
from tactile_resonance.nodes.running import RESULTS, STREAM, TRUTHS
from tactile_resonance.poles.result import Poles
from tactile_resonance.record import Contact, Origin
from tactile_resonance.recording.messages import poles_from_message

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class PointResult:
    """What came back for one point.

    Attributes
    ----------
    origin : Origin
    frf : FRF
    poles : Poles
    truth : Poles
        All modes of the simulated sensor at that point.
    contact : Truth.Response
        What the simulation knows of the contact there.
    """

    origin: Origin
    frf: FRF
    poles: Poles
    truth: Poles
    contact: Truth.Response


class ScanSession(NodeClient):
    """Context that joins the nodes' domain; not for use beside another executor.

    Parameters
    ----------
    check : callable
        Called while waiting; raises when waiting has become pointless.
    """

    def __init__(self, check: Callable[[], None]) -> None:
        super().__init__("scan_session", check)
        self._frfs: dict[int, msg.FRF] = {}
        self._poles: dict[int, msg.Poles] = {}
        self._truth: msg.Poles | None = None
        self._progress: Progress = lambda done, planned: None
        self._refusal = ""

    def join(self) -> None:
        """Publisher of the tip's pose, readers of the results."""
        self._pose = self._node.create_publisher(PoseStamped, "tcp_pose", STREAM)
        self._measure = ActionClient(self._node, Measure, "measure")
        self._ask_truth = self._node.create_client(Truth, "bench/get_truth")
        subscribe = self._node.create_subscription
        subscribe(msg.FRF, "frf", lambda m: self._keep_final(self._frfs, m), RESULTS)
        subscribe(msg.Poles, "poles", lambda m: self._keep_final(self._poles, m), RESULTS)
        subscribe(msg.Poles, "bench/truth", self._on_truth, TRUTHS)
        subscribe(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def wait_for_nodes(self, timeout_s: float) -> None:
        """Until the action and all topics of the stream have somebody at both ends.

        Raises
        ------
        NoAnswer
            If a node refuses to come up, or not all are there in time.
        """
        count = self._node.count_publishers, self._node.count_subscribers

        def complete() -> bool:
            if self._refusal:
                raise NoAnswer(self._refusal)
            ends = {"excitation": 1, "record": 1, "frf": 2, "poles": 1, "bench/block": 1}
            ready = self._measure.server_is_ready() and self._ask_truth.service_is_ready()
            return ready and all(
                count[0](topic) >= 1 and count[1](topic) >= readers
                for topic, readers in ends.items()
            )

        self.wait(complete, timeout_s, "the nodes to find each other")

    def warm_up(self, position_m: tuple[float, float, float], timeout_s: float) -> PointResult:
        """Measure briefly until poles come back: only then has every node heard every other.

        The graph tells that publishers and subscribers exist, not that each pair has matched or that
        its node is active; records published before that reach nobody.
        """
        goal = Measure.Goal(label="warm-up", periods=3)
        deadline, patience_s = time.monotonic() + timeout_s, 2.0
        while True:
            try:
                return self.measure(
                    position_m, goal, lambda done, planned: None, answer_timeout_s=patience_s
                )
            except NoAnswer:
                if time.monotonic() > deadline:
                    raise
                patience_s *= 2.0  # lost, or late on a machine with much else to do

    def measure(
        self,
        position_m: tuple[float, float, float],
        goal: Measure.Goal,
        progress: Progress,
        timeout_s: float = HANGS_S,
        answer_timeout_s: float = HANGS_S,
    ) -> PointResult:
        """Put the tip there, measure, wait for the final poles.

        Raises
        ------
        NoAnswer
            If the measurement fails or takes longer than `timeout_s`, or its poles do not follow within
            `answer_timeout_s`.
        """
        self._progress = progress
        self._place(position_m)
        truth = self._truth
        contact = self.truth(here=True)
        future = self.begin(self._measure, goal, self._on_feedback).get_result_async()
        self.wait(future.done, timeout_s, "the measurement")
        answer = future.result()
        if answer.result.outcome != Measure.Result.DONE:
            raise NoAnswer(f"measurement of {goal.label}: {answer.result.message}")
        key = answer.result.measurement_id
        self.wait(lambda: key in self._poles and key in self._frfs, answer_timeout_s, "poles")
        poles, origin = poles_from_message(self._poles.pop(key))
        frf, _ = frf_from_message(self._frfs.pop(key))
        return PointResult(origin, frf, poles, poles_from_message(truth)[0], contact)

    def truth(self, timeout_s: float = HANGS_S, **request: object) -> Truth.Response:
        """What the simulated bench knows; fields of the request by name.

        Raises
        ------
        NoAnswer
            If the bench refuses, or does not answer in time.
        """
        answer = self.answer(self._ask_truth, Truth.Request(**request), timeout_s)
        if not answer.success:
            raise NoAnswer(f"truth: {answer.message}")
        return answer

    def _place(self, position_m: tuple[float, float, float]) -> None:
        """Say where the tip is until the bench's truth carries that very pose."""
        now_ns = time.time_ns()
        pose = pose_to_message(Contact(position_m=position_m, frame_id="table", time_ns=now_ns))

        def there() -> bool:
            self._pose.publish(pose)
            return self._truth is not None and self._truth.tip_pose == pose

        self.wait(there, HANGS_S, "the bench to take up the pose")

    def _on_truth(self, message: msg.Poles) -> None:
        self._truth = message

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            # the manager only repeats what the node itself says better
            if status.level == DiagnosticStatus.ERROR and not status.name.endswith("manager_node"):
                self._refusal = f"{status.name.lstrip('/')} is {status.message}"

    def _on_feedback(self, message: object) -> None:
        self._progress(message.feedback.blocks, message.feedback.blocks_planned)

    @staticmethod
    def _keep_final(kept: dict, message: msg.FRF | msg.Poles) -> None:
        if message.final:
            kept[message.measurement_id] = message
