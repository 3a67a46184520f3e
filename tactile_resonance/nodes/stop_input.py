# SPDX-License-Identifier: Apache-2.0
"""The stop of a surgery stack: the tip leaves the tissue, and stays out until it is released."""

from __future__ import annotations

from std_msgs.msg import Bool
from std_srvs.srv import SetBool

from tactile_resonance.nodes.managed_node import ManagedNode

STOP = "stop"


class StopInput:
    """Service and topic `stop`, true: stop, false: release; served in every state of the node's life.

    What counts is the newest request, whoever it came from. A node that is reconfigured remembers it, one
    that is restarted does not.

    Parameters
    ----------
    node : ManagedNode

    Attributes
    ----------
    stopped : bool
    draw_back : callable
        Called with each request to stop.
    """

    def __init__(self, node: ManagedNode) -> None:
        self.stopped, self.draw_back = False, lambda: None
        self._node = node
        node.create_service(SetBool, STOP, self._on_request)
        node.create_subscription(Bool, STOP, lambda message: self._set(message.data), 10)

    def _on_request(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        self._set(request.data)
        response.success = True
        response.message = "stopped; contact_state reports when it is idle"
        if not request.data:
            response.message = "released; nothing moves until a goal asks for it"
        return response

    def _set(self, stopped: bool) -> None:
        if stopped != self.stopped:
            self._node.get_logger().warning("stopped" if stopped else "the stop is released")
        self.stopped = stopped
        if stopped:
            self.draw_back()
