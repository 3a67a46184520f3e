# SPDX-License-Identifier: Apache-2.0
"""What stands between the nodes, or talks to them out of turn: relays, floods, a second clock.

``python -m benchmarks.faults_inject relay`` passes the topics of `HOPS` on, and does to them what its standard
input asks for; ``flood NODE`` sends to a node whatever it listens to, as fast as it can; ``clock``
publishes a time that jumps; ``node COMMAND...`` runs a node that hears the relay.
"""

from __future__ import annotations

import os
import re
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

RELAYED = "faults"
"""Before the name of a topic that has been relayed."""
HELD_S = 3.0
"""A late message is held for so long, and one whose successor does not come."""
LONGEST_S = 120.0


MODES = ("dropped", "duplicated", "reordered", "late", "NaN")


@dataclass(frozen=True)
class Hop:
    """A topic, who publishes it and who hears it relayed.

    Attributes
    ----------
    topic, speaker, listener : str
    modes : tuple of str
        What is done to it: what would make a difference.
    count : int
        So many messages are disturbed: one block of a measurement, or some seconds of a stream.
    """

    topic: str
    speaker: str
    listener: str
    modes: tuple[str, ...] = ("dropped", "duplicated", "late", "NaN")
    count: int = 1

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.topic} to {self.listener}"


HOPS = (
    Hop("bench/block", "fake_hardware_node", "excitation_node"),
    Hop("excitation", "excitation_node", "frf_node", ("dropped", "late")),
    Hop("record", "excitation_node", "frf_node"),
    Hop("frf", "frf_node", "poles_node"),
    Hop("record", "excitation_node", "scan_node", ("dropped", "duplicated")),
    Hop("frf", "frf_node", "scan_node", ("dropped", "duplicated", "NaN")),
    Hop("poles", "poles_node", "scan_node"),
    Hop("contact_state", "contact_node", "scan_node", MODES, 40),
    Hop("wrench", "contact_node", "scan_node", ("dropped", "NaN"), 40),
    Hop("point_result", "scan_node", "pole_map_node", ("dropped", "duplicated", "NaN")),
)


def relayed_topic(hop: Hop) -> str:
    """Where the listener of a hop hears its topic."""
    return f"{RELAYED}/{hop.listener}/{hop.topic}"


def _run_node(command: Sequence[str]) -> None:
    """Become the node of this command, with the topics of its hops from the relay."""
    (node,) = re.findall(r"tactile_resonance\.nodes\.(\w+)", " ".join(command))
    remapped = [f"{hop.topic}:={relayed_topic(hop)}" for hop in HOPS if hop.listener == node]
    more = [word for each in remapped for word in ("-r", each)]
    os.execv(command[0], [*command, *more])


class _Relay:
    """Passes one hop on; what it does to the next messages comes on its standard input."""

    def __init__(self, hop: Hop, node: Any, kind: type, qos: Any, out_qos: Any) -> None:
        self._hop, self._kind = hop, kind
        self._lock = threading.Lock()
        self._mode, self._left = "", 0
        self._held: bytes | None = None
        self._publisher = node.create_publisher(kind, relayed_topic(hop), out_qos)
        node.create_subscription(kind, hop.topic, self._take, qos, raw=True)

    def disturb(self, mode: str) -> None:
        with self._lock:
            self._mode, self._left = mode, self._hop.count if mode else 0

    def _take(self, cdr: bytes) -> None:
        with self._lock:
            mode, first = self._mode, self._left == self._hop.count
            if self._left:
                self._left -= 1
            elif self._held is None:
                mode = ""
        if mode and first:
            print(f"acted {time.monotonic()}", flush=True)
        if mode == "dropped":
            return
        if mode == "NaN":
            self._publisher.publish(not_finite(cdr, self._kind))
            return
        if mode == "late":
            threading.Timer(HELD_S, self._publisher.publish, (cdr,)).start()
            return
        if mode == "reordered":
            with self._lock:
                before, self._held = self._held, cdr if self._held is None else None
            if before is None:
                threading.Timer(HELD_S, self._release).start()
                return
            self._publisher.publish(cdr)
            cdr = before
        self._publisher.publish(cdr)
        if mode == "duplicated":
            self._publisher.publish(cdr)

    def _release(self) -> None:
        with self._lock:
            before, self._held = self._held, None
        if before is not None:
            self._publisher.publish(before)


def not_finite(cdr: bytes, kind: type) -> Any:
    """A message with NaN in place of each floating point number, samples included."""
    from rclpy.serialization import deserialize_message

    message = deserialize_message(cdr, kind)
    _spoil(message)
    return message


def _spoil(message: Any) -> None:
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if kind in ("double", "float"):
            setattr(message, name, float("nan"))
        elif kind in ("sequence<double>", "sequence<float>"):
            setattr(message, name, [float("nan")] * len(value))
        elif hasattr(value, "get_fields_and_field_types"):
            _spoil(value)
    for channel in ("actuator", "sensor"):  # integers cannot say it
        counts = getattr(message, f"{channel}_counts", ())
        if len(counts):
            setattr(message, f"{channel}_v", [float("nan")] * len(counts))
            setattr(message, f"{channel}_counts", [])


def _qualities() -> dict[str, tuple[type, Any]]:
    """Type and quality of service of each topic."""
    from geometry_msgs.msg import PoseStamped, WrenchStamped
    from lifecycle_msgs.msg import TransitionEvent

    from tactile_resonance import msg
    from tactile_resonance.nodes import running

    return {
        "bench/block": (msg.Record, running.RESULTS),
        "excitation": (msg.Excitation, running.EXCITATIONS),
        "record": (msg.Record, running.RESULTS),
        "frf": (msg.FRF, running.RESULTS),
        "poles": (msg.Poles, running.POLES),
        "contact_state": (msg.ContactState, running.SERIES),
        "wrench": (WrenchStamped, running.SERIES),
        "tcp_pose": (PoseStamped, running.STREAM),
        "point_result": (msg.PointResult, running.POINT_RESULTS),
        "poles_node/transition_event": (TransitionEvent, 10),
    }


def _relay() -> None:
    """All hops, each under the name of the node that it speaks for: the watch over them goes by names."""
    import rclpy
    from rclpy.executors import MultiThreadedExecutor

    rclpy.init()
    executor = MultiThreadedExecutor(2)
    kinds = _qualities()
    nodes, relays = {}, {}
    for hop in HOPS:
        if hop.speaker not in nodes:
            nodes[hop.speaker] = rclpy.create_node(hop.speaker, start_parameter_services=False)
            executor.add_node(nodes[hop.speaker])
        kind, qos = kinds[hop.topic]
        relays[hop.name] = _Relay(hop, nodes[hop.speaker], kind, qos, qos)
    threading.Thread(target=executor.spin, daemon=True).start()
    print("ready", flush=True)
    for line in sys.stdin:
        name, _, mode = line.rstrip("\n").partition(": ")
        relays[name].disturb(mode)
    os._exit(0)


FLOODED = {
    "fake_hardware_node": ("tcp_pose",),
    "excitation_node": ("bench/block", "tcp_pose"),
    "frf_node": ("record", "excitation"),
    "poles_node": ("frf",),
    "contact_node": ("poles",),
    "pole_map_node": ("point_result", "poles"),
    "scan_node": ("record", "frf", "poles", "excitation"),
    "manager_node": ("poles_node/transition_event",),
}
"""What each node listens to. Messages are empty ones: of no measurement, point or block of this scan."""


def _flood(victim: str) -> None:
    """Messages, goals and service calls as fast as this process can, until it is ended."""
    import rclpy
    from rcl_interfaces.srv import ListParameters
    from rclpy.action import ActionClient
    from rclpy.executors import SingleThreadedExecutor
    from std_srvs.srv import Trigger
    from tactile_resonance.action import MakeContact, Measure, Scan
    from tactile_resonance.srv import Truth

    actions = {
        "excitation_node": (Measure, "measure"),
        "contact_node": (MakeContact, "make_contact"),
        "scan_node": (Scan, "scan"),
    }
    services = {
        "fake_hardware_node": (Truth, "bench/get_truth"),
        "manager_node": (Trigger, "manager_node/start"),
    }
    rclpy.init()
    node = rclpy.create_node("flood")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    kinds = _qualities()
    publishers = []
    for topic in FLOODED[victim]:
        kind, qos = kinds[topic]
        # both the node and its relay hear it: as the node is remapped, the relay is what it hears
        heard = next(
            (relayed_topic(h) for h in HOPS if (h.topic, h.listener) == (topic, victim)), topic
        )
        publishers.append((node.create_publisher(kind, heard, qos), kind()))
    kind, name = services.get(victim, (ListParameters, f"{victim}/list_parameters"))
    service = node.create_client(kind, name)
    asked: list[Any] = []
    goals = []
    if victim in actions:
        of, called = actions[victim]
        goals = [(ActionClient(node, of, called), of.Goal())]
    found_s = time.monotonic() + 2.0
    while time.monotonic() < found_s:
        executor.spin_once(timeout_sec=0.05)
    print(f"acted {time.monotonic()}", flush=True)
    over_s = time.monotonic() + LONGEST_S
    while time.monotonic() < over_s:
        for publisher, message in publishers:
            publisher.publish(message)
        if service.service_is_ready():
            asked.append(service.call_async(kind.Request()))
        for client, goal in goals:
            if client.server_is_ready():
                client.send_goal_async(goal)
        executor.spin_once(timeout_sec=0.0)
        while len(asked) > 100:
            service.remove_pending_request(asked.pop(0))
    os._exit(0)


def _clock() -> None:
    """A second publisher of ``/clock``: an hour ahead and at zero in turn, until it is ended."""
    import rclpy
    from builtin_interfaces.msg import Time
    from rosgraph_msgs.msg import Clock

    rclpy.init()
    node = rclpy.create_node("second_clock")
    publisher = node.create_publisher(Clock, "/clock", 1)
    time.sleep(2.0)
    print(f"acted {time.monotonic()}", flush=True)
    for k in range(int(LONGEST_S / 0.02)):
        publisher.publish(Clock(clock=Time(sec=int(time.time()) + 3600 if k % 2 else 0)))
        time.sleep(0.02)
    os._exit(0)


def main() -> None:
    """Command line."""
    what, *rest = sys.argv[1:]
    if what == "node":
        _run_node(rest)
    {"relay": _relay, "flood": lambda: _flood(rest[0]), "clock": _clock}[what]()


if __name__ == "__main__":
    main()
