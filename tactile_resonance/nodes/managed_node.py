# SPDX-License-Identifier: Apache-2.0
"""The life that all nodes share: configure, activate, deactivate, clean up, and recover from errors."""

from __future__ import annotations

import contextlib
import os
import threading
import time
import traceback
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.client import Client
from rclpy.event_handler import PublisherEventCallbacks, QoSPublisherMatchedInfo
from rclpy.exceptions import InvalidHandle, ParameterException
from rclpy.executors import await_or_execute
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.lifecycle.publisher import LifecyclePublisher
from rclpy.qos import QoSProfile
from rclpy.task import Future
from rclpy.timer import Timer
from std_srvs.srv import Trigger

from tactile_resonance import msg
from tactile_resonance.contact.interfaces import ArmError, ForceError
from tactile_resonance.drivers.acquisition import DeviceError
from tactile_resonance.nodes.parameters import Fixed, Parameter, declare, values
from tactile_resonance.nodes.running import BEATS, STEADY, Health, RCLError, run_node

# What a configuration or a request may be refused with; anything else is a defect and keeps its traceback.
REFUSALS = (ValueError, OSError, DeviceError, ArmError, ForceError, ParameterException)

BEAT_S = 0.2
"""Between two signs of life, by this machine's clock."""

KEEP_RESULT_S = 900
"""The result of a goal that has ended can be asked for so long [s]."""

TIME_SERVER = Fixed(
    "time_server",
    "",
    "Address HOST:PORT of a simulated bench's time, in which the node then lives; empty: the machine's clock.",
)

HUNG_AFTER = Fixed(
    "hung_after_s",
    60.0,
    "In simulated time: a node without an answer for so long, by this machine's clock, hangs [s]; the "
    "scan ends, and can be resumed.",
    5.0,
    86400.0,
)


class ManagedNode(LifecycleNode):
    """A lifecycle node whose subclasses define only what they set up and what they do.

    `configure` makes publishers, subscriptions, services, actions and devices through `publish_on`, `listen`,
    `serve`, `act` and `resources`; the way back undoes them in reverse order. What arrives while the node is
    not active is dropped, and nothing is published then. While `heartbeat` has
    subscribers, it publishes signs of life there.

    Parameters
    ----------
    name : str
    parameters : sequence of Parameter
    """

    def __init__(self, name: str, parameters: Sequence[Parameter]) -> None:
        # first, for an interrupt may have rclpy destroy a node that is not made yet
        self.resources = ExitStack()
        self.active = False
        self._failing = False
        super().__init__(name)
        for service in self.services:
            if service.srv_type is ChangeState:
                service.callback = partial(self._change_state, service.callback)
        declare(self, parameters)
        self.health = Health(self)
        self.instance = int.from_bytes(os.urandom(7), "big")
        # started by the first subscriber: each call wakes the executor: most of the cost of an idle node
        self._beat_timer = self.steady_timer(BEAT_S, self._beat)
        self._beat_timer.cancel()
        events = PublisherEventCallbacks(matched=self._on_listeners)
        self._beats = self.create_publisher(
            msg.Heartbeat, "heartbeat", BEATS, event_callbacks=events
        )

    @classmethod
    def run(cls) -> None:
        """Make and spin one, as the console script of its module does."""
        run_node(cls)

    # What a subclass defines

    def configure(self) -> None:
        """Set up; refuse with ValueError, OSError or DeviceError."""
        raise NotImplementedError

    def activate(self) -> None:
        """Begin to work."""

    def deactivate(self) -> None:
        """Stop working at once; may be called when it is not working."""

    def details(self) -> Mapping[str, str]:
        """Figures for the diagnostics beside rates and errors."""
        return {}

    def working(self) -> bool:
        """Whether threads of its own move on; the executor calls this, so that its own does."""
        return True

    def waiting_for(self) -> str:
        """What its work waits for, for people; empty: nothing."""
        return ""

    # What it sets up with

    def publish_on(
        self,
        kind: type,
        topic: str,
        qos: QoSProfile,
        matched: Callable[[QoSPublisherMatchedInfo], None] | None = None,
    ) -> LifecyclePublisher:
        """Publisher until the node is cleaned up; `matched` is called when a subscriber comes or goes."""
        events = PublisherEventCallbacks(matched=matched)
        publisher = self.create_lifecycle_publisher(kind, topic, qos, event_callbacks=events)
        self.resources.callback(self.destroy_lifecycle_publisher, publisher)
        return publisher

    def listen(
        self,
        kind: type,
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile,
        *,
        raw: bool = False,
        always: bool = False,
    ) -> None:
        """Subscription until the node is cleaned up, heard while active or `always`; serialised if `raw`.

        A message at which the callback raises ``ValueError`` is reported, and left out.
        """

        def heard(message: Any) -> None:
            if self.active or always:
                begun_s = time.perf_counter()
                try:
                    callback(message)
                except ValueError as error:
                    self.health.error(f"{topic}: {error}")
                self.health.saw(topic, time.perf_counter() - begun_s)

        subscription = self.create_subscription(kind, topic, heard, qos, raw=raw)
        self.resources.callback(self.destroy_subscription, subscription)

    def serve(self, kind: type, name: str, callback: Callable[[Any, Any], Any]) -> None:
        """Service until the node is cleaned up; the callback sees to `active` itself, and may wait.

        What it refuses with one of `REFUSALS` is answered by why, in the response's field ``message``.
        """

        async def serve(request: Any, response: Any) -> Any:
            try:
                return await await_or_execute(callback, request, response)
            except REFUSALS as error:
                response.message = str(error)
            return response

        # in the node's own group, whose callbacks exclude each other, one that waits would keep all waiting
        group = ReentrantCallbackGroup()
        service = self.create_service(kind, name, serve, callback_group=group)
        send = service.send_response

        def send_if_there(response: Any, header: Any) -> None:
            with contextlib.suppress(InvalidHandle):  # cleaned up while the callback waited
                send(response, header)

        service.send_response = send_if_there
        self.resources.callback(self.destroy_service, service)

    def serve_trigger(self, name: str, do: Callable[[], str | Awaitable[str]]) -> None:
        """Service without a request; `do` returns the answer, or raises one of `REFUSALS` with why."""

        async def serve(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            response.message = await await_or_execute(do)
            response.success = True
            return response

        self.serve(Trigger, name, serve)

    def client_of(self, kind: type, name: str) -> Client:
        """Client of a service until the node is cleaned up."""
        client = self.create_client(kind, name)
        self.resources.callback(self.destroy_client, client)
        return client

    def act(
        self,
        kind: type,
        name: str,
        callback: Callable[[ServerGoalHandle], Awaitable[Any]],
        on_cancel: Callable[[ServerGoalHandle], None] = lambda _: None,
        refuses: Callable[[Any], bool | Awaitable[bool]] = lambda _: False,
    ) -> None:
        """Action until the node is cleaned up.

        Goals are accepted while the node is active, unless `refuses`, which may wait, is true of them. A
        request to cancel is always accepted; the callback ends the goal.
        """

        async def on_request(goal: Any) -> GoalResponse:
            accepted = self.active and not await await_or_execute(refuses, goal) and self.active
            return GoalResponse.ACCEPT if accepted else GoalResponse.REJECT

        def on_cancel_request(goal: ServerGoalHandle) -> CancelResponse:
            on_cancel(goal)
            return CancelResponse.ACCEPT

        server = ActionServer(
            self,
            kind,
            name,
            callback,
            goal_callback=on_request,
            cancel_callback=on_cancel_request,
            callback_group=ReentrantCallbackGroup(),  # as for services
            result_timeout=KEEP_RESULT_S,
        )
        self.resources.callback(server.destroy)

    @contextlib.contextmanager
    def with_set_up(self, make: Callable[[], None]) -> Iterator[None]:
        """Run `make`; all that it set up is undone at the end of the context, or as the node is cleaned up."""
        rest, self.resources = self.resources, ExitStack()
        try:
            make()
        finally:
            made, self.resources = self.resources, rest
            self.resources.callback(made.close)
        with made:
            yield

    def every(self, period_s: float, callback: Callable[[], None]) -> Timer:
        """Timer until the node is cleaned up; called while it is active, by this machine's clock."""
        timer = self.steady_timer(period_s, lambda: callback() if self.active else None)
        self.resources.callback(self.destroy_timer, timer)
        return timer

    def steady_timer(self, period_s: float, callback: Callable[[], None]) -> Timer:
        """Timer by this machine's clock, whether time is simulated or not."""
        return self.create_timer(period_s, callback, clock=STEADY)

    def ros_now_ns(self) -> int:
        """ROS time now [ns], simulated where `use_sim_time` says so."""
        return int(self.get_clock().now().nanoseconds)

    @property
    def time_server(self) -> str:
        """Address of the simulated time in which the node lives; empty: it lives by the machine's clock."""
        return str(values(self, TIME_SERVER.name)[0])

    @property
    def hung_after_s(self) -> float:
        """In simulated time: how long an answer is waited for, by the machine's clock [s]."""
        return float(values(self, HUNG_AFTER.name)[0])

    def require_active(self) -> None:
        """Raise ``ValueError`` where the node is not active."""
        if not self.active:
            raise ValueError(f"{self.get_name()} is {self.state_name()}")

    def fail(self, reason: str) -> None:
        """Give up for a reason: back to unconfigured, from where the manager restarts it.

        Also from within `deactivate`, where the node cannot go on as it is.
        """
        self.health.error(reason)
        self._failing = True
        if self.active:
            self.trigger_deactivate()

    # Its life

    def _on_listeners(self, matched: QoSPublisherMatchedInfo) -> None:
        """Start the signs of life with the first subscriber, at once, and end them with the last."""
        if matched.current_count:
            self._beat_timer.reset()
            self._beat()
        else:
            self._beat_timer.cancel()

    def _beat(self) -> None:
        if self.working():
            self._beats.publish(
                msg.Heartbeat(
                    node=self.get_fully_qualified_name(),
                    state=self.state_name(),
                    instance=self.instance,
                    waiting_for=self.waiting_for(),
                )
            )

    def state_name(self) -> str:
        """Name of the present state."""
        return self._state_machine.current_state[1]

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Set up, or report why not and stay unconfigured."""
        try:
            self.configure()
        except REFUSALS as error:
            self._undo()
            self.health.error(" ".join(str(error).split()))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self.get_logger().error(traceback.format_exc())
            self.health.error(f"defect while configuring: {error!r}")
            raise
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to work."""
        result = super().on_activate(state)
        self._failing = False
        self.activate()
        self.active = True
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop working."""
        self.active = False
        self.deactivate()
        if self._failing:
            self._failing = False
            return TransitionCallbackReturn.ERROR
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop and let everything go that `configure` made; it can be configured again."""
        self._undo()
        return TransitionCallbackReturn.SUCCESS

    on_shutdown = on_error = on_cleanup

    def destroy_node(self) -> None:
        """Stop what is under way first, in whatever state."""
        self._undo()
        super().destroy_node()

    def _change_state(
        self,
        change: Callable[[ChangeState.Request, ChangeState.Response], ChangeState.Response],
        request: ChangeState.Request,
        response: ChangeState.Response,
    ) -> ChangeState.Response:
        """Refuse a transition that the present state does not have; in Jazzy it would end the node."""
        try:
            return change(request, response)
        except RCLError as error:
            self.get_logger().error(f"transition refused: {error}")
            response.success = False
            return response

    def _undo(self) -> None:
        if self.active:
            self.active = False
            self.deactivate()
        self.resources.close()


async def in_thread(node: ManagedNode, work: Callable[[], Any], name: str) -> Any:
    """Result of long `work`, done in a thread of that name while the executor goes on.

    A future that is set from another thread may never wake its coroutine: the executor sets it.
    """
    finished = Future()

    def run() -> None:
        try:
            set_it = partial(finished.set_result, work())
        except Exception as error:
            set_it = partial(finished.set_exception, error)
        executor = node.executor
        if executor is not None:  # else the node has gone, and nobody waits
            with contextlib.suppress(InvalidHandle):
                executor.create_task(set_it)

    threading.Thread(target=run, name=name, daemon=True).start()
    return await finished


def end_goal(goal: ServerGoalHandle, done: bool) -> None:
    """Tell the client of a goal how it ended."""
    if done:
        goal.succeed()
    elif goal.is_cancel_requested:
        goal.canceled()
    else:
        goal.abort()
