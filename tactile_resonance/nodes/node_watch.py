# SPDX-License-Identifier: Apache-2.0
"""The time of a scan, and whether the nodes behind some topics are at work, from their signs of life."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from tactile_resonance import msg
from tactile_resonance.clock import ClockLostError, SimulatedClock
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.running import BEATS

SILENT_S = 1.5
"""A node without a sign of life for longer hangs, or has ended [s of this machine's clock]."""
GO_AGAIN_S = 0.2
SAID_AFTER_S = 5.0
"""A node that is waited for is named after this [s of this machine's clock]."""

DOUBTED = "doubted"


class ScanTime:
    """The time of a scan: the machine's, or that of a simulated bench, which the scan conducts.

    On the machine's clock only `now_s` does something.

    While a scan conducts, simulated time passes only where something needs it to: a contact on its way, a
    block that is measured. It stands while nodes compute and while the scan decides.

    Parameters
    ----------
    server : str
        Address of the simulated time; empty: the machine's clock.
    hung_after_s : float
        In simulated time a node is given up after so long without a sign of life [s of the machine's clock].

    Attributes
    ----------
    simulated : bool
    silent_s : float
        After so long without a sign of life a node is given up [s of the machine's clock].
    """

    def __init__(self, server: str, hung_after_s: float) -> None:
        self._server = server
        self.simulated = bool(server)
        self.silent_s = hung_after_s if server else SILENT_S
        self._clock: SimulatedClock | None = None
        self._gone_s = -math.inf
        self._offset_ns = self._last_ns = 0  # a bench that is restarted begins its time anew

    @contextmanager
    def conducted(self) -> Iterator[None]:
        """Conduct; a bench that cannot be reached now is tried again by `go`."""
        if self.simulated:
            with self._while_there():
                self._join()
        try:
            yield
        finally:
            self._end()

    def _end(self) -> None:
        """Conduct no more: time goes on at the pace of real time."""
        if self._clock is not None:
            self._clock.close()
            self._clock = None

    def patience_s(self, real_s: float) -> float:
        """Longest wait for nodes at work: in simulated time for as long as one may be silent [s]."""
        return self.silent_s if self.simulated else real_s

    def now_s(self) -> float:
        """Time for durations [s]; never goes back."""
        if not self.simulated:
            return time.monotonic()
        if self._clock is not None:
            with self._while_there():
                self._last_ns = self._clock.ask_ns() + self._offset_ns
        return self._last_ns * 1e-9

    def go(self) -> None:
        """Let time go on while something needs it, until a device hands a result over."""
        self._gone_s = time.monotonic()
        if not self.simulated:
            return
        with self._while_there():
            (self._clock or self._join()).go()

    def keep_going(self) -> None:
        """`go` again from time to time, where no result is awaited: somebody else's measurement ends a go."""
        if time.monotonic() - self._gone_s > GO_AGAIN_S:
            self.go()

    def seed(self, *integers: int) -> None:
        """Let the noise of the bench follow from integers, three at most, from now on."""
        if self._clock is not None:
            with self._while_there():
                self._clock.seed(*integers)

    def _join(self) -> SimulatedClock:
        clock = self._clock = SimulatedClock(self._server, "scan_node", conducts=True)
        self._offset_ns = max(self._offset_ns, self._last_ns - clock.now_ns())
        return clock

    @contextmanager
    def _while_there(self) -> Iterator[None]:
        """Conduct no more where the bench has ended."""
        try:
            yield
        except ClockLostError:
            self._end()


@dataclass(frozen=True)
class _Sign:
    """The newest sign of life of a node."""

    state: str
    instance: int
    heard_s: float
    waiting_for: str = ""
    waiting_since_s: float = 0.0


OF_OTHERS = _Sign("active", 0, math.inf)
"""In place of the sign of life of a node that gives none."""

Instances = dict[str, int]
"""Instance (one start of a node) at work, by the node's name."""


class NodeWatch:
    """Listens to the signs of life of the nodes that publish some topics.

    A publisher in the graph does not prove that its node is there: one that was killed stays in the graph for
    as long as its lease lasts, one that was restarted publishes nothing before it is active. A node of
    another package, which gives no signs of life, is taken to be at work while it publishes.

    Parameters
    ----------
    node : ManagedNode
    topics : sequence of str
    silent_s : float
        After so long without a sign of life a node is not at work.
    """

    def __init__(self, node: ManagedNode, topics: Sequence[str], silent_s: float) -> None:
        self._node, self._topics, self._silent_s = node, tuple(topics), silent_s
        self._signs: dict[str, _Sign] = {}  # replaced whole, by the executor's thread and the scan's
        self._behind: dict[str, set[str]] = {}  # newest publishers of a topic, which may have gone
        node.listen(msg.Heartbeat, "heartbeat", self._on_beat, BEATS)

    def met(self) -> bool:
        """Whether all nodes that publish now have given a sign of life.

        Subscriptions are discovered in the order in which they were made. So a node whose sign of life arrives
        has discovered those made before this watch: nothing that it publishes from then on is missed.
        """
        names = {name for topic in self._topics for name in self._publishers(topic)}
        return names <= self._signs.keys()

    def missing(self) -> str | None:
        """A topic that no node at work publishes, as a sentence; None: all topics are published."""
        for topic in self._topics:
            nodes = self._publishers(topic)
            if not nodes:
                return f"{topic}: no node publishes it"
            problems = [self._problem(node) for node in sorted(nodes)]
            if all(problems):
                return f"{topic}: {' and '.join(filter(None, problems))}"
        return None

    def held(self) -> bool:
        """Whether all that is missing was deactivated: nodes that come up are so only for a moment."""
        for topic in self._topics:
            nodes = self._publishers(topic)
            inactive = (node for node in nodes if self._sign(node).state == "inactive")
            if all(map(self._problem, nodes)) and all(map(self._silence, inactive)):
                return False
        return True

    def hung(self) -> str:
        """A node behind a topic that is silent for too long, as a sentence; empty: none is.

        Nodes whose lease in the graph has ended, because they were silent, count too.
        """
        for topic in self._topics:
            self._publishers(topic)
        for node in sorted(set().union(*self._behind.values())):
            if problem := self._silence(node):
                return problem
        return ""

    def instances(self, topics: Sequence[str]) -> Instances:
        """Instances of the nodes behind topics that are at work now."""
        names = {name for topic in topics for name in self._publishers(topic)}
        return {name: self._signs[name].instance for name in names if name in self._signs}

    def changed(self, instances: Instances) -> str | None:
        """Why one of these is not at work any more, as a sentence; None: all are."""
        for name, instance in instances.items():
            if self._signs[name].instance != instance:
                return f"{name} was restarted"
            if problem := self._problem(name):
                return problem
        return None

    def waited_for(self, instances: Instances) -> str:
        """One of these that is silent for a while, or waits for something itself, for people; empty: none."""
        now_s = time.monotonic()
        for name in instances:
            sign = self._signs[name]
            if now_s - sign.heard_s > SAID_AFTER_S:
                return f"{name}, silent for {now_s - sign.heard_s:.0f} s"
            if sign.waiting_for and now_s - sign.waiting_since_s > SAID_AFTER_S:
                return f"{name}, which waits for {sign.waiting_for}"
        return ""

    @contextmanager
    def doubted_after(self, error: type[Exception]) -> Iterator[None]:
        """After such an error doubt all nodes until their next sign of life: one may have been restarted."""
        try:
            yield
        except error:
            for name, sign in list(self._signs.items()):
                self._signs[name] = _Sign(DOUBTED, sign.instance, sign.heard_s)
            raise

    def _problem(self, node: str) -> str:
        """Why a node is not at work; empty where it is."""
        sign = self._sign(node)
        if sign.state == "active":
            return self._silence(node)
        if sign.state == DOUBTED:
            return f"{node} has given no sign of life again yet"
        return self._silence(node) or f"{node} is {sign.state}, not active"

    def _silence(self, node: str) -> str:
        """A node, or what it waits for, is silent for too long, as a sentence; empty where neither is."""
        sign, now_s = self._sign(node), time.monotonic()
        silent_s, waiting_s = now_s - sign.heard_s, now_s - sign.waiting_since_s
        if silent_s > self._silent_s:
            return f"{node} is silent for {silent_s:.1f} s"
        if sign.waiting_for and waiting_s > self._silent_s:
            return f"{node} waits for {sign.waiting_for}, which is silent for {waiting_s:.1f} s"
        return ""

    def _sign(self, node: str) -> _Sign:
        return self._signs.get(node, OF_OTHERS)

    def _publishers(self, topic: str) -> set[str]:
        """Names of the nodes that publish a topic."""
        name = self._node.resolve_topic_name(topic)
        infos = self._node.get_publishers_info_by_topic(name)
        found = {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos}
        if found:
            self._behind[topic] = found
        return found

    def _on_beat(self, message: msg.Heartbeat) -> None:
        before, now_s = self._sign(message.node), time.monotonic()
        same = before.waiting_for == message.waiting_for
        since_s = before.waiting_since_s if same else now_s
        self._signs[message.node] = _Sign(
            message.state, message.instance, now_s, message.waiting_for, since_s
        )
