# SPDX-License-Identifier: Apache-2.0
"""What clients of the nodes share: a context of their own, and waiting that notices when it is pointless."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import rclpy
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.client import Client
from rclpy.executors import SingleThreadedExecutor

from tactile_resonance.nodes.goals import Goals, answer_of
from tactile_resonance.scan.hands import NodeAway, ScanEnded

if TYPE_CHECKING:
    from typing_extensions import Self

HANGS_S = 120.0
"""Longest wait for what takes seconds [s]: it only ends what hangs, whatever else the machine does."""


class NoAnswer(RuntimeError):
    """Something that should have come from a node did not come in time."""


class NodeClient(ABC):
    """Context that joins the nodes' domain; not for use beside another executor.

    Parameters
    ----------
    name : str
        Of the client's node.
    check : callable
        Called while waiting; raises when waiting has become pointless.
    """

    def __init__(self, name: str, check: Callable[[], None]) -> None:
        self._name, self._check = name, check
        self._context = rclpy.Context()

    @abstractmethod
    def join(self) -> None:
        """Make publishers, subscriptions and clients on `_node`."""

    def why(self) -> str:
        """What is known of why something does not come; empty where nothing is."""
        return ""

    def __enter__(self) -> Self:
        rclpy.init(context=self._context)
        self._node = rclpy.create_node(self._name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.join()
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def spin(self, seconds: float) -> None:
        """Let messages in for at most so long."""
        self._executor.spin_once(timeout_sec=seconds)

    def wait(self, done: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Spin until something holds; `NoAnswer` where it does not in time."""
        deadline = time.monotonic() + timeout_s
        while not done():
            self._check()
            if time.monotonic() > deadline:
                raise self._no_answer(timeout_s, what)
            self.spin(0.05)

    def answer(self, service: Client, request: Any, timeout_s: float = HANGS_S) -> Any:
        """Answer of a service, which is waited for."""
        check, spin = self._check, self.spin
        answer = answer_of(service, request, timeout_s, check=check, pause=spin)
        if answer is None:
            raise self._no_answer(timeout_s, f"an answer of {service.srv_name}")
        return answer

    def _no_answer(self, timeout_s: float, what: str) -> NoAnswer:
        why = self.why()
        return NoAnswer(f"waited {timeout_s:g} s for {what}{f' ({why})' if why else ''}")

    def begin(
        self,
        client: ActionClient,
        goal: Any,
        timeout_s: float = HANGS_S,
        feedback: Callable[[Any], None] | None = None,
    ) -> ClientGoalHandle:
        """Send a goal until it is accepted; one whose answer may be lost is sent again under its id."""
        deadline = time.monotonic() + timeout_s

        def check() -> None:
            self._check()
            if time.monotonic() > deadline:
                raise NoAnswer(f"waited {timeout_s:g} s for the goal to be accepted")

        goals = Goals(client, type(goal).__qualname__, self.spin)
        try:
            return goals.send(goal, check, lambda: None, feedback)
        except (NodeAway, ScanEnded) as error:
            raise NoAnswer(str(error)) from error
