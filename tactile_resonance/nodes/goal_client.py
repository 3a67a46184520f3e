# SPDX-License-Identifier: Apache-2.0
"""Action client for goals that are asked for from a thread beside the executor's."""

from __future__ import annotations

import threading
from typing import Any

from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.task import Future


class GoalClient(ActionClient):
    """`ActionClient` whose executor takes no answer before its request is registered.

    rclpy of Jazzy sends a request before it registers it: an answer that the executor's thread takes in between
    is dropped, and its future is never done (rclpy #1123). Kilted has this lock itself.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._registering = threading.Lock()
        super().__init__(*args, **kwargs)

    def take_data(self) -> Any:
        """As the executor asks for it."""
        with self._registering:
            return super().take_data()

    def send_goal_async(self, *args: Any, **kwargs: Any) -> Future:
        """As every client."""
        with self._registering:
            return super().send_goal_async(*args, **kwargs)

    # What the methods of a goal handle call.

    def _get_result_async(self, goal_handle: ClientGoalHandle) -> Future:
        with self._registering:
            return super()._get_result_async(goal_handle)

    def _cancel_goal_async(self, goal_handle: ClientGoalHandle) -> Future:
        with self._registering:
            return super()._cancel_goal_async(goal_handle)
