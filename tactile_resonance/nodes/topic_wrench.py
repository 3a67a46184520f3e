# SPDX-License-Identifier: Apache-2.0
"""A force sensor of any ROS 2 driver: its geometry_msgs/WrenchStamped; how far messages have arrived."""

from __future__ import annotations

import threading
from collections import deque

from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node

from tactile_resonance.clock import Clock, WallClock
from tactile_resonance.contact.cell_checks import CellChecks
from tactile_resonance.contact.interfaces import ForceError, ForceFault
from tactile_resonance.contact.payload import Mounting
from tactile_resonance.contact.samples import CellSample
from tactile_resonance.drivers.force_config import TopicForce
from tactile_resonance.nodes.running import SERIES
from tactile_resonance.recording.messages import time_from_message

EARLIEST_S = 0.005
LATEST_S = 0.5
FIRST_WITHIN_S = 2.0


class Arrivals:
    """The newest stamp of a topic, for a thread that waits for it while another spins."""

    def __init__(self) -> None:
        self.newest_ns = 0
        self.lost = False
        self._changed = threading.Condition()

    def add(self, stamp_ns: int) -> None:
        """Take the stamp of a message [ns]."""
        with self._changed:
            self.newest_ns, self.lost = stamp_ns, False
            self._changed.notify_all()

    def wait(self, stamp_ns: int, seconds: float) -> bool:
        """Wait for a stamp or a later one; whether it has come within so many seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: self.newest_ns >= stamp_ns, seconds)


class TopicWrench:
    """Wrenches from a topic, in the sensor's frame (a `contact.interfaces.Cell`).

    Takes reliable and best-effort publishers; read by another thread than the one in which the node spins.

    Parameters
    ----------
    node : Node
    config : TopicForce
    clock : Clock
        On which wrenches are dated and silence is judged; stamps of messages are ROS time. Stamps of simulated
        time are those of its bench, and not judged.
    """

    def __init__(self, node: Node, config: TopicForce, clock: Clock | None = None) -> None:
        self.mounting: Mounting = config
        self._node, self._config, self.info = node, config, config
        self._clock: Clock = WallClock() if clock is None else clock
        self.arrivals = Arrivals()
        self._checks = CellChecks(config, config.range_nm, config.limits)
        self._samples: deque[CellSample] = deque(maxlen=10000)
        self._fault: ForceError | None = None
        self._silent_from_s = 0.0
        self._last_stamp_ns = 0
        self._frame_id: str | None = None  # of the first wrench
        self._listening = False
        self._subscription = None

    def start(self) -> None:
        """Subscribe again; without a wrench in the next two seconds it counts as silent."""
        self._listening = False
        self._samples.clear()
        self._checks.restart()
        self._fault, self._last_stamp_ns, self._frame_id = None, 0, None
        self._silent_from_s = self._now_s + FIRST_WITHIN_S
        self._listening = True
        if self._subscription is None:
            self._subscription = self._node.create_subscription(
                WrenchStamped, self._config.topic, self._on_wrench, SERIES
            )

    def read(self) -> list[CellSample]:
        """Wrenches since the last call, oldest first, without waiting. Raises `ForceError`."""
        if not self._listening:
            raise ForceError(ForceFault.LINK_LOST, f"topic {self._config.topic}: not started")
        if self._fault is not None:
            raise self._fault
        samples = []
        while self._samples:
            samples.append(self._samples.popleft())
        late_s = self._now_s - self._silent_from_s
        if not samples and late_s > 0:
            known = self._last_stamp_ns > 0
            since_s = late_s + (self._config.limits.silent_s if known else FIRST_WITHIN_S)
            text = f"topic {self._config.topic}: silent for {since_s * 1e3:.0f} ms"
            self._fault = ForceError(ForceFault.SILENT, text)
            raise self._fault
        return samples

    def close(self) -> None:
        """Listen no longer; the subscription ends with its node.

        An executor that spins in another thread may hold it at this moment.
        """
        self._listening = False

    def _on_wrench(self, message: WrenchStamped) -> None:
        if not self._listening or self._fault is not None:
            return
        force, torque = message.wrench.force, message.wrench.torque
        wrench = (force.x, force.y, force.z, torque.x, torque.y, torque.z)
        stamp_ns = time_from_message(message.header.stamp)
        try:
            self._check_stamp(stamp_ns)
            self._check_frame(message.header.frame_id)
            overload = self._checks.check(wrench)
        except ForceError as error:
            self._fault = error
            return
        self._last_stamp_ns = stamp_ns
        self._silent_from_s = self._now_s + self._config.limits.silent_s
        taken_ns = self._clock.own_ns(stamp_ns) - round(self._config.latency_s * 1e9)
        self._samples.append(CellSample(taken_ns, wrench, overload))
        self.arrivals.add(stamp_ns)

    @property
    def _now_s(self) -> float:
        return self._clock.now_ns() * 1e-9

    def _check_stamp(self, stamp_ns: int) -> None:
        topic = self._config.topic
        age_s = (self._clock.now_ns() - self._clock.own_ns(stamp_ns)) * 1e-9
        if stamp_ns == 0:
            raise ForceError(ForceFault.INVALID, f"topic {topic}: its messages have no time stamp")
        if not (self._clock.simulated or -EARLIEST_S <= age_s <= LATEST_S):
            text = (
                f"topic {topic}: its time stamp is {age_s:.3g} s old, accepted are {-EARLIEST_S:g} to "
                f"{LATEST_S:g} s: are the clocks of both machines synchronised?"
            )
            raise ForceError(ForceFault.INVALID, text)
        if stamp_ns <= self._last_stamp_ns:
            raise ForceError(ForceFault.INVALID, f"topic {topic}: time stamps do not increase")

    def _check_frame(self, frame_id: str) -> None:
        """Two sensors that publish on one topic would count as one."""
        if self._frame_id is None:
            self._frame_id = frame_id
        if frame_id != self._frame_id:
            text = f"wrenches in {self._frame_id!r} and in {frame_id!r}: do two sensors publish it?"
            raise ForceError(ForceFault.INVALID, f"topic {self._config.topic}: {text}")
