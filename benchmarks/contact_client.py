# SPDX-License-Identifier: Apache-2.0
"""Asks contact_node for contacts and hears its state; for benchmarks and tests."""

from __future__ import annotations

import time
from collections.abc import Callable

from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.task import Future
from scipy.spatial.transform import Rotation
from std_srvs.srv import Trigger
from tactile_resonance.action import MakeContact

from tactile_resonance import msg
from tactile_resonance.nodes.client import NodeClient
from tactile_resonance.nodes.conversions import time_from_message
from tactile_resonance.nodes.running import SERIES
from tactile_resonance.simulation.plant_defaults import TABLE_IN_BASE

HANGS_S = 120.0
TURN = Rotation.from_rotvec(TABLE_IN_BASE[3:]).as_quat().tolist()


class ContactClient(NodeClient):
    """One client; times are of the loop's clock."""

    def __init__(self, check: Callable[[], None]) -> None:
        super().__init__("contact_client", check)
        self.states: list[tuple[str, float]] = []  # each new state and its time [s]
        self.state = ""
        self.now_s = 0.0
        self.message = ""

    def join(self) -> None:
        """Action and state."""
        self._action = ActionClient(self._node, MakeContact, "make_contact")
        self._node.create_subscription(msg.ContactState, "contact_state", self._on_state, SERIES)

    def why(self) -> str:
        """State and its message."""
        return f"{self.state}: {self.message}"

    def start(self, x_m: float, y_m: float, force_n: float = 0.01) -> ClientGoalHandle:
        """Ask for a contact at a place of the table until the node takes it."""
        goal = MakeContact.Goal(force_n=force_n, pose=PoseStamped())
        goal.pose.header.frame_id = "base"
        place, turn = goal.pose.pose.position, goal.pose.pose.orientation
        place.x, place.y = TABLE_IN_BASE[0] + x_m, TABLE_IN_BASE[1] + y_m
        place.z = TABLE_IN_BASE[2]
        turn.x, turn.y, turn.z, turn.w = TURN
        deadline_s = time.monotonic() + HANGS_S
        while True:
            if self._action.server_is_ready():
                handle = self._done(self._action.send_goal_async(goal), "an answer to the goal")
                if handle.accepted:
                    return handle
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"no goal is taken ({self.why()})")
            self.spin(0.1)

    def result(self, handle: ClientGoalHandle) -> MakeContact.Result:
        """Of a goal."""
        return self._done(handle.get_result_async(), "the result").result

    def ask(self, name: str) -> Trigger.Response:
        """Call a service without fields: `retract`, `manager_node/start` ..."""
        service = self._node.create_client(Trigger, name)
        self.wait(service.service_is_ready, HANGS_S, name)
        return self._done(service.call_async(Trigger.Request()), f"an answer to {name}")

    def until(self, state: str) -> None:
        """Wait for a state."""
        self.wait(lambda: self.state == state, HANGS_S, state)

    def let_pass(self, seconds: float) -> None:
        """Wait until so much of the loop's time has passed."""
        end_s = self.now_s + seconds
        self.wait(lambda: self.now_s >= end_s, HANGS_S, "time to pass")

    def _done(self, future: Future, what: str) -> object:
        self.wait(future.done, HANGS_S, what)
        return future.result()

    def _on_state(self, message: msg.ContactState) -> None:
        self.now_s = 1e-9 * time_from_message(message.header.stamp)
        self.message = message.message
        if message.state != self.state:
            self.state = message.state
            self.states.append((message.state, self.now_s))
