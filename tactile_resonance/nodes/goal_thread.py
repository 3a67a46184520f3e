# SPDX-License-Identifier: Apache-2.0
"""Long work of an action goal in a thread of its own, while the executor goes on."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.task import Future


async def in_thread(node: Node, work: Callable[[], Any], name: str) -> Any:
    """Result of `work`, done in a thread; what it raises is raised here, in the executor's thread.

    A future that is set from another thread may never wake its coroutine; a guard condition wakes the
    executor, which sets it.
    """
    outcome: list[Any] = []
    raised: list[Exception] = []
    finished: Future = Future()

    def wake() -> None:
        if (outcome or raised) and not finished.done():
            finished.set_result(None)

    guard = node.create_guard_condition(wake)

    def run() -> None:
        try:
            outcome.append(work())
        except Exception as error:
            raised.append(error)
        with contextlib.suppress(InvalidHandle):  # the node has gone, and nobody waits
            guard.trigger()

    threading.Thread(target=run, name=name, daemon=True).start()
    await finished
    node.destroy_guard_condition(guard)
    if raised:
        raise raised[0]
    return outcome[0]
