# SPDX-License-Identifier: Apache-2.0
"""For commands and tests: clients with a context of their own, whose waits end when they are pointless."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.client import Client
from rclpy.executors import SingleThreadedExecutor

from tactile_resonance import msg
from tactile_resonance.client import CalibrationOutcome, ScanOutcome, TactileClient
from tactile_resonance.nodes.goals import Goals, answer_of, wait_for
from tactile_resonance.nodes.running import NEWEST, POINT_RESULTS, RESULTS, SERIES
from tactile_resonance.recording.messages import poles_from_message, time_from_message
from tactile_resonance.scan.failures import NodeAway, ScanEnded
from tactile_resonance.scan.point_result import from_message

if TYPE_CHECKING:
    from typing_extensions import Self

    from tactile_resonance.report.live import LiveRun

HANGS_S = 120.0
"""Longest wait for what takes seconds [s]: it only ends what hangs, whatever else the machine does."""
NOBODY_S = 15.0
"""Where no node is found within this, the domain has none [s]."""
SCAN_WITHIN_S = 24 * 3600.0
CANCELLED_WITHIN_S = 130.0  # as long as a tip may take to be drawn back


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
        # an initialised context that is dropped stays known to rclpy's handler of signals, which then crashes
        with ExitStack() as opened:
            opened.callback(rclpy.try_shutdown, context=self._context)
            rclpy.init(context=self._context)  # it is open also where its log fails
            self._node = rclpy.create_node(self._name, context=self._context)
            opened.callback(self._node.destroy_node)
            self._executor = SingleThreadedExecutor(context=self._context)
            opened.callback(self._executor.shutdown)
            self._executor.add_node(self._node)
            self.join()
            self._opened = opened.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def spin(self, seconds: float) -> None:
        """Let messages in for at most so long."""
        self._executor.spin_once(timeout_sec=seconds)

    def wait(self, done: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Spin until something holds; `NoAnswer` where it does not in time."""
        if not wait_for(done, timeout_s, self._check, lambda _: self.spin(0.05)):
            raise self._no_answer(timeout_s, what)

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
        self, client: ActionClient, goal: Any, feedback: Callable[[Any], None] | None = None
    ) -> ClientGoalHandle:
        """Send a goal until it is accepted; one whose answer may be lost is sent again under its id."""
        goals = Goals(client, type(goal).__qualname__, self.spin)
        try:
            return goals.send(goal, self._check, feedback)
        except (NodeAway, ScanEnded) as error:
            raise NoAnswer(str(error)) from error


class ScanClient(NodeClient):
    """Spins around a `TactileClient`, and knows when all nodes are up.

    Parameters
    ----------
    check, name
        As `NodeClient`.
    namespace : str
        Of scan_node.

    Attributes
    ----------
    tactile : TactileClient
    states : dict
        The latest diagnostics of each node, by its name.
    reports : Counter
        How often each node has sent diagnostics.
    """

    def __init__(
        self, check: Callable[[], None], name: str = "scan_client", namespace: str = ""
    ) -> None:
        super().__init__(name, check)
        self._namespace = namespace
        self.states: dict[str, str] = {}
        self.reports: Counter[str] = Counter()
        self._details: dict[str, dict[str, str]] = {}

    def join(self) -> None:
        """The client, and a reader of the diagnostics."""
        self.tactile = TactileClient(self._node, self._namespace)
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)

    def why(self) -> str:
        """State of each node from the diagnostics."""
        told = "; ".join(f"{name}: {state}" for name, state in sorted(self.states.items()))
        return told or "no diagnostics"

    def nodes_there(self, wanted: Collection[str], within_s: float) -> list[str]:
        """Nodes of these names in this namespace, of whomever.

        They are looked for until one is found, or for so long after a node of any name was; a machine with much
        else to do takes its time.
        """
        own, begun_s = (self._node.get_name(), self._node.get_namespace()), time.monotonic()
        seen_s: float | None = None
        while True:
            self.spin(0.05)
            there = set(self._node.get_node_names_and_namespaces()) - {own}
            found = sorted({name for name, where in there if where == own[1] and name in wanted})
            now_s = time.monotonic()
            seen_s = now_s if there and seen_s is None else seen_s
            nobody = now_s - begun_s > NOBODY_S if seen_s is None else now_s - seen_s > within_s
            if found or nobody:
                return found

    def details(self, node: str) -> dict[str, str]:
        """Figures of a node's diagnostics, as heard last."""
        return self._details.get(node, {})

    def wait_until_up(self, timeout_s: float) -> None:
        """Wait until the manager reports that all nodes are active.

        Raises
        ------
        NoAnswer
            If they are not in time, with what the diagnostics say.
        """

        def up() -> bool:
            return self.states.get("manager_node", "").startswith("active")

        self.wait(up, timeout_s, "the nodes to come up")

    def scan(self, timeout_s: float = SCAN_WITHIN_S, **wanted: Any) -> ScanOutcome:
        """Ask for a scan as `TactileClient.scan` does, and wait for its outcome."""
        future = self.tactile.scan(**wanted)
        self.wait(future.done, timeout_s, "the scan")
        return future.result()

    def calibrate_table(self, timeout_s: float, **wanted: Any) -> CalibrationOutcome:
        """As `TactileClient.calibrate_table`, waiting for its outcome; an interrupt has the tip drawn back."""
        future = self.tactile.calibrate_table(**wanted)
        try:
            self.wait(future.done, timeout_s, "the calibration")
        except KeyboardInterrupt:
            self.tactile.cancel()
            self.wait(future.done, CANCELLED_WITHIN_S, "the calibration to end")
            raise
        return future.result()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if str(Path(status.name).parent) != self._node.get_namespace():
                continue  # of another sensor
            name = Path(status.name).name
            self.reports[name] += 1
            self._details[name] = {value.key: value.value for value in status.values}
            # a node reports for seconds why it does not come up, then only that it has not
            refused = self.states.get(name, "").startswith(f"{status.message}: ")
            if status.level == DiagnosticStatus.ERROR or not refused:
                self.states[name] = status.message


class LiveListener(NodeClient):
    """Passes on what it hears of a scan under way while it spins; publishes and asks for nothing.

    Parameters
    ----------
    live : LiveRun
    namespace : str
        Of the nodes.
    """

    def __init__(self, live: LiveRun, namespace: str = "") -> None:
        super().__init__("live_page", lambda: None)
        self._live = live
        self._prefix = f"{namespace.rstrip('/')}/" if namespace else ""

    def join(self) -> None:
        """Topics: what scan_node, frf_node, poles_node and contact_node publish anyway."""
        for kind, topic, take, qos in (
            (msg.PointResult, "point_result", self._on_result, POINT_RESULTS),
            (msg.FRF, "frf", self._live.take_frf, NEWEST),
            (msg.Poles, "poles", self._on_poles, RESULTS),
            (msg.ContactState, "contact_state", self._on_state, SERIES),
        ):
            self._node.create_subscription(kind, f"{self._prefix}{topic}", take, qos)

    def _on_result(self, message: msg.PointResult) -> None:
        poles = poles_from_message(message.poles[0])[0] if message.poles else None
        self._live.take_result(from_message(message), poles)

    def _on_poles(self, message: msg.Poles) -> None:
        poles, origin = poles_from_message(message)
        self._live.take_poles(poles, origin.measurement_id, origin.label)

    def _on_state(self, message: msg.ContactState) -> None:
        time_s = 1e-9 * time_from_message(message.header.stamp)
        self._live.take_state(time_s, message.state, message.force_n, message.message)
