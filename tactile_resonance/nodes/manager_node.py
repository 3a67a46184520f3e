# SPDX-License-Identifier: Apache-2.0
"""Brings the nodes up in order, and those back that failed or were restarted."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from typing import Any

from lifecycle_msgs.msg import State, Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from tactile_resonance.nodes.parameters import Fixed, Parameter, declare, values
from tactile_resonance.nodes.running import STEADY, Health, run_node

STREAM_NODES = ["excitation_node", "frf_node", "poles_node"]

PARAMETERS = (
    Fixed("nodes", STREAM_NODES, "Names of the managed nodes, in the order in which they come up."),
    Parameter("answer_timeout_s", 15.0, "Longest wait for a node to change [s].", 0.1, 3600.0),
    Parameter("retry_s", 1.0, "First wait after a refusal [s]; doubled each time.", 0.05, 60.0),
)

TICK_S = 0.1
# While all are up: nodes report changes by themselves, only one that was killed has to be found.
QUIET_S = 1.0
# A node that was killed stays in the graph and never answers; the one started in its place waits meanwhile.
STATE_WITHIN_S = 3.0
# An answer may overtake the event that states why a node is not active any more.
EVENT_WITHIN_S = 0.2
LONGEST_RETRY_S = 16.0

_UP = {
    State.PRIMARY_STATE_UNCONFIGURED: Transition.TRANSITION_CONFIGURE,
    State.PRIMARY_STATE_INACTIVE: Transition.TRANSITION_ACTIVATE,
}
_DOWN = {
    State.PRIMARY_STATE_ACTIVE: Transition.TRANSITION_DEACTIVATE,
    State.PRIMARY_STATE_INACTIVE: Transition.TRANSITION_CLEANUP,
}
_NAMES = {
    State.PRIMARY_STATE_UNKNOWN: "unreachable",
    State.PRIMARY_STATE_UNCONFIGURED: "unconfigured",
    State.PRIMARY_STATE_INACTIVE: "inactive",
    State.PRIMARY_STATE_ACTIVE: "active",
    State.PRIMARY_STATE_FINALIZED: "finalised",
}


@dataclass
class _Managed:
    """One node as the manager sees it."""

    name: str
    get: Client
    change: Client
    state: int = State.PRIMARY_STATE_UNKNOWN
    pending: Future | None = None
    client: Client | None = None
    deadline_s: float = 0.0
    refusals: int = 0
    worked: bool = False  # it has been active since it was last brought up
    held: bool = False  # somebody else has deactivated it
    sure_s: float | None = None  # from when on an answer counts that it is not active any more
    due: bool = False  # its turn came while a question was under way
    next_try_s: float = 0.0


class ManagerNode(Node):
    """Asks each node for its state and moves it on; a node waits for those before it.

    A node that fails goes back to unconfigured, one that is restarted is unconfigured: both are
    brought up again. A node that somebody else deactivates is held: it stays down, also where it is cleaned up
    or restarted, until a client activates it or calls `~/start`. Services `~/shut_down` (all nodes
    unconfigured, in reverse order) and `~/start`.
    """

    def __init__(self) -> None:
        super().__init__("manager_node")
        declare(self, PARAMETERS)
        (names,) = values(self, "nodes")
        self._nodes = [self._managed(name) for name in names]
        if not self._nodes:
            raise ValueError("nodes: empty, expected names of nodes")
        self._wanted_up = True
        self._was_up = False
        self.health = Health(self)
        self.create_service(Trigger, "~/start", partial(self._want, True))
        self.create_service(Trigger, "~/shut_down", partial(self._want, False))
        self._timer = self.create_timer(TICK_S, self._tick, clock=STEADY)

    def _managed(self, name: str) -> _Managed:
        node = _Managed(
            name,
            self.create_client(GetState, f"{name}/get_state"),
            self.create_client(ChangeState, f"{name}/change_state"),
        )
        on_event = partial(self._on_event, node)
        self.create_subscription(TransitionEvent, f"{name}/transition_event", on_event, 10)
        return node

    def _want(self, up: bool, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._wanted_up = up
        for node in self._nodes:
            node.refusals, node.next_try_s = 0, 0.0
            node.worked = node.held = False
        response.success = True
        response.message = f"asked; see /diagnostics of {self.get_fully_qualified_name()}"
        return response

    def _on_event(self, node: _Managed, event: TransitionEvent) -> None:
        """A node has changed, asked by this one or by somebody else."""
        state = event.goal_state.id
        if state not in _NAMES:  # it is on its way
            return
        if node.client is node.get and node.pending is not None:
            self._forget_question(node)  # its answer may be older
        self._see(node, state)
        self._tick()

    def _tick(self) -> None:
        ready = State.PRIMARY_STATE_ACTIVE if self._wanted_up else State.PRIMARY_STATE_UNCONFIGURED
        moves = _UP if self._wanted_up else _DOWN
        clear = True  # whether all nodes before have come as far as they should
        for node in self._nodes if self._wanted_up else reversed(self._nodes):
            self._advance(node, moves if clear and not node.held else {})
            clear = clear and node.state == ready
        if clear and self._wanted_up and not self._was_up:
            self.get_logger().info(f"all active: {', '.join(node.name for node in self._nodes)}")
        self._was_up = clear and self._wanted_up
        period_ns = round(1e9 * (QUIET_S if self._was_up else TICK_S))
        if self._timer.timer_period_ns != period_ns:
            self._timer.timer_period_ns = period_ns
            self._timer.reset()

    def _advance(self, node: _Managed, moves: dict[int, int]) -> None:
        """One step of one node: a question asked, unless one is under way."""
        now_s = time.monotonic()
        if node.pending is not None:
            node.due = node.state in moves
            if now_s > node.deadline_s:
                self._drop(node)
            return
        if not (node.get.service_is_ready() and node.change.service_is_ready()):
            node.state = State.PRIMARY_STATE_UNKNOWN
            return
        transition = moves.get(node.state)
        if transition is not None and now_s >= node.next_try_s:
            request = ChangeState.Request(transition=Transition(id=transition))
            self._ask(node, node.change, request, now_s)
        else:
            self._ask(node, node.get, GetState.Request(), now_s)

    def _ask(self, node: _Managed, client: Client, request: object, now_s: float) -> None:
        (timeout_s,) = values(self, "answer_timeout_s")
        if client is node.get:
            timeout_s = min(timeout_s, STATE_WITHIN_S)
        else:  # its event may state where it came to before the answer does
            node.state = State.PRIMARY_STATE_UNKNOWN
        node.client, node.pending = client, client.call_async(request)
        node.deadline_s = now_s + timeout_s
        node.pending.add_done_callback(lambda future: self._hear(node, future))

    def _hear(self, node: _Managed, answer: Future) -> None:
        """An answer by which a node has moved, or may now, leads to a tick at once."""
        if node.pending is answer and not answer.cancelled():
            before, due, node.due = node.state, node.due, False
            node.pending = None
            self._take(node, answer.result(), time.monotonic())
            if due or node.client is node.change or node.state != before:
                self._tick()

    def _take(self, node: _Managed, answer: Any, now_s: float) -> None:
        if isinstance(answer, GetState.Response):
            state = answer.current_state.id
            if node.worked and self._wanted_up and state != State.PRIMARY_STATE_ACTIVE:
                node.sure_s = now_s + EVENT_WITHIN_S if node.sure_s is None else node.sure_s
                state = State.PRIMARY_STATE_UNKNOWN if now_s < node.sure_s else state
            if state in _NAMES and state != State.PRIMARY_STATE_UNKNOWN:
                self._see(node, state)
            else:  # asked again, also one that is on its way
                node.state = state
            return
        if answer.success:
            node.refusals = 0
            return
        (retry_s,) = values(self, "retry_s")
        wait_s = min(retry_s * 2**node.refusals, LONGEST_RETRY_S)
        node.refusals += 1
        node.next_try_s = now_s + wait_s
        self.health.error(
            f"{node.name} refuses to {'come up' if self._wanted_up else 'go down'} "
            f"(its log and /diagnostics say why), asked again in {wait_s:g} s"
        )

    def _see(self, node: _Managed, state: int) -> None:
        node.state, node.sure_s = state, None
        if state == State.PRIMARY_STATE_ACTIVE:
            node.worked, node.held = True, False
        elif node.worked and self._wanted_up:
            # a node that fails does not stay inactive
            node.worked = False
            node.held = state == State.PRIMARY_STATE_INACTIVE
            said = "was deactivated, and is held" if node.held else "is not active any more"
            self.health.error(f"{node.name} {said}")

    def _forget_question(self, node: _Managed) -> None:
        node.client.remove_pending_request(node.pending)
        node.pending = None

    def _drop(self, node: _Managed) -> None:
        """A node that was killed never answers."""
        self._forget_question(node)
        node.state = State.PRIMARY_STATE_UNKNOWN
        self.health.error(f"{node.name} does not answer")

    def state_name(self) -> str:
        """Name of the state of all, for the diagnostics."""
        if held := [node.name for node in self._nodes if node.held]:
            return f"held: {', '.join(held)}"
        return "active" if self._was_up else ("starting" if self._wanted_up else "shut down")

    def details(self) -> dict[str, str]:
        """State of each node."""
        return {node.name: _NAMES.get(node.state, "in transition") for node in self._nodes}


def main() -> None:
    """Console script."""
    run_node(ManagerNode)
