# SPDX-License-Identifier: Apache-2.0
"""What clients of the nodes share: a context of their own, and waiting that notices when it is pointless."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING

import rclpy
from rclpy.executors import SingleThreadedExecutor

if TYPE_CHECKING:
    from typing_extensions import Self


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
                why = self.why()
                raise NoAnswer(f"waited {timeout_s:g} s for {what}{f' ({why})' if why else ''}")
            self.spin(0.05)
