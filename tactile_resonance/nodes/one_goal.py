# SPDX-License-Identifier: Apache-2.0
"""Several actions of one node, of which one goal at a time is worked at, in a thread of its own."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import AbstractContextManager
from typing import Any

from rclpy.action.server import ServerGoalHandle
from std_srvs.srv import Trigger

from tactile_resonance.nodes.managed_node import ManagedNode, end_goal, in_thread
from tactile_resonance.scan.progress import Controls, Request

RUNNING = "a scan or a calibration is running, cancel it or wait for its result"


class OneGoal:
    """Accepts, works at and ends goals; reports why the newest one was rejected.

    Parameters
    ----------
    node : ManagedNode
        Whose actions and service they are, until it is cleaned up.
    rejection : str
        Name of the service that has the reason: rclpy has no place for it in its answer to a goal.
    around : callable
        Context of the work, entered and left in the executor's thread.

    Attributes
    ----------
    handle : ServerGoalHandle or None
        The goal that is worked at.
    controls : Controls or None
        What is asked of it; None where none is worked at.
    """

    def __init__(
        self, node: ManagedNode, rejection: str, around: Callable[[], AbstractContextManager[None]]
    ) -> None:
        self._node, self._around = node, around
        self.handle: ServerGoalHandle | None = None
        self.controls: Controls | None = None
        self._asked = self._rejection = ""
        node.serve(Trigger, rejection, self._on_rejection)

    def act(
        self,
        kind: type,
        name: str,
        check: Callable[[Any], Awaitable[Any]],
        work: Callable[[ServerGoalHandle, Any], Any],
        done: int,
        busy: Any,
    ) -> None:
        """Offer an action.

        Parameters
        ----------
        kind : type
        name : str
        check : callable
            Awaited with the goal; raises ``ValueError`` or ``OSError`` where it is wrong.
        work : callable
            Called in a thread with the handle of the goal and what its check has returned; returns the result.
        done : int
            The result's field ``outcome`` of a goal that has succeeded.
        busy : message
            Result of a goal that was accepted beside another one.
        """
        found: dict[int, Any] = {}  # by the check of a goal, by its message

        async def refusal(message: Any) -> str:
            self._asked = asked = str(message)
            reason = ""
            try:
                self._require_free()
                checked = await check(message)
                self._require_free()
                found[id(message)] = checked
            except (ValueError, OSError) as error:
                reason = " ".join(str(error).split())
                self._node.get_logger().warning(f"goal rejected: {reason}")
            if self._asked == asked:  # no other came while this one was checked
                self._rejection = reason
            return reason

        async def serve(goal: ServerGoalHandle) -> Any:
            checked = found.pop(id(goal.request))
            if self.handle is not None:
                goal.abort()
                return busy
            self.handle, self.controls = goal, Controls()
            if goal.is_cancel_requested:  # before there were controls
                self.cancel()
            try:
                with self._around():
                    result = await in_thread(self._node, lambda: work(goal, checked), "goal")
            finally:
                self.handle = self.controls = None
            end_goal(goal, result.outcome == done)
            return result

        self._node.act(kind, name, serve, lambda _: self.cancel(), refusal)

    def serve_control(self, name: str, ask: Callable[[Controls], None]) -> None:
        """Service that asks something of the goal that is worked at."""

        def do() -> str:
            if self.controls is None:
                raise ValueError("no scan is running")
            ask(self.controls)
            return ""

        self._node.serve_trigger(name, do)

    def cancel(self) -> None:
        """Cancel the goal that is worked at."""
        if self.controls is not None:
            self.controls.ask(Request.CANCEL)

    def forget_rejection(self) -> None:
        """From now on nothing was rejected."""
        self._rejection = ""

    def _require_free(self) -> None:
        if self.handle is not None:
            raise ValueError(RUNNING)

    def _on_rejection(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = bool(self._rejection), self._rejection
        return response
