# SPDX-License-Identifier: Apache-2.0
"""Asks contact_node for contacts and hears its state; for benchmarks and tests."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from scipy.spatial.transform import Rotation
from std_srvs.srv import Trigger
from tactile_resonance.action import MakeContact

from tactile_resonance import msg
from tactile_resonance.nodes.client import HANGS_S, NodeClient
from tactile_resonance.nodes.running import SERIES
from tactile_resonance.recording.messages import time_from_message
from tactile_resonance.simulation.plant.defaults import TABLE_IN_BASE

TURN = Rotation.from_rotvec(TABLE_IN_BASE[3:]).as_quat().tolist()


class ContactClient(NodeClient):
    """One client; times are of the loop's clock.

    Attributes
    ----------
    state : ContactState or None
        The newest; None: none has come yet.
    states : list of (str, float)
        Each new state, and its time [s].
    """

    qos = SERIES

    def __init__(self, check: Callable[[], None]) -> None:
        super().__init__("contact_client", check)
        self.state: msg.ContactState | None = None
        self.states: list[tuple[str, float]] = []

    def join(self) -> None:
        """Action and state."""
        self._action = ActionClient(self._node, MakeContact, "make_contact")
        self._node.create_subscription(msg.ContactState, "contact_state", self._on_state, self.qos)

    def why(self) -> str:
        """State and its message."""
        return "" if self.state is None else f"{self.state.state}: {self.state.message}"

    @property
    def told_ns(self) -> int:
        """Time of the newest state [ns]."""
        return 0 if self.state is None else time_from_message(self.state.header.stamp)

    def start(
        self, x_m: float = 0.0, y_m: float = 0.0, force_n: float = 0.01, **fields: Any
    ) -> ClientGoalHandle:
        """Ask for a contact at a place of the table until the node takes it."""
        goal = goal_message(x_m, y_m, force_n, **fields)
        deadline_s = time.monotonic() + HANGS_S
        while True:
            if self._action.server_is_ready():
                handle = self.send(goal)
                if handle.accepted:
                    return handle
            assert time.monotonic() < deadline_s, f"no goal is taken ({self.why()})"
            self.spin(0.05)

    def send(self, goal: MakeContact.Goal) -> ClientGoalHandle:
        """Send a goal once."""
        future = self._action.send_goal_async(goal)
        self.wait(future.done, HANGS_S, "an answer to the goal")
        return future.result()

    def result(self, handle: ClientGoalHandle) -> MakeContact.Result:
        """Of a goal."""
        future = handle.get_result_async()
        self.wait(future.done, HANGS_S, "the result")
        return future.result().result

    def ask(self, name: str, timeout_s: float = HANGS_S) -> Trigger.Response:
        """Call a service without fields: `retract`, `manager_node/start` ..."""
        service = self._node.create_client(Trigger, name)
        try:
            return self.answer(service, Trigger.Request(), timeout_s)
        finally:
            self._node.destroy_client(service)

    def until(self, state: str) -> None:
        """Wait until the newest state is this one."""
        self.wait(lambda: self.state is not None and self.state.state == state, HANGS_S, state)

    def let_pass(self, seconds: float) -> None:
        """Wait until so much of the loop's time has passed."""
        end_ns = self.told_ns + round(1e9 * seconds)
        self.wait(lambda: self.told_ns >= end_ns, HANGS_S, "time to pass")

    def _on_state(self, message: msg.ContactState) -> None:
        self.state = message
        if not self.states or message.state != self.states[-1][0]:
            self.states.append((message.state, 1e-9 * self.told_ns))


def goal_message(
    x_m: float = 0.0, y_m: float = 0.0, force_n: float = 0.01, **fields: Any
) -> MakeContact.Goal:
    """Contact at a place of the table."""
    goal = MakeContact.Goal(force_n=force_n, pose=PoseStamped(), **fields)
    goal.pose.header.frame_id = "base"
    place, turn = goal.pose.pose.position, goal.pose.pose.orientation
    place.x, place.y = TABLE_IN_BASE[0] + x_m, TABLE_IN_BASE[1] + y_m
    place.z = TABLE_IN_BASE[2]
    turn.x, turn.y, turn.z, turn.w = TURN
    return goal
