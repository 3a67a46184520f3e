# SPDX-License-Identifier: Apache-2.0
"""Topics heard in a thread of their own, also while the node that needs them is busy or goes down."""

from __future__ import annotations

import threading

from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from tactile_resonance.nodes.running import RCLError

CLOSE_WITHIN_S = 2.0


class Listener:
    """A second node beside one, spinning on its own; in its namespace.

    Parameters
    ----------
    beside : Node

    Attributes
    ----------
    node : Node
        On which subscriptions, publishers and timers are made, before or after `start`.
    """

    def __init__(self, beside: Node) -> None:
        self.node = Node(
            f"{beside.get_name()}_arm",
            context=beside.context,
            namespace=beside.get_namespace(),
            # a name that the command line gives is the other's
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._executor = SingleThreadedExecutor(context=beside.context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, name="listener", daemon=True)

    def start(self) -> None:
        """Spin from now on."""
        self._thread.start()

    def close(self) -> None:
        """Spin no more; all that was made on the node ends."""
        self._executor.shutdown()
        if self._thread.is_alive():
            # where the context is being shut down, that holds what the thread waits for
            self._thread.join(CLOSE_WITHIN_S)
        self.node.destroy_node()

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except (ExternalShutdownException, RCLError):
            return
