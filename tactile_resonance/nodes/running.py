# SPDX-License-Identifier: Apache-2.0
"""What all nodes share: qualities of service, a report on their health, and spinning until asked to stop."""

from __future__ import annotations

import faulthandler
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import uninstall_signal_handlers

from tactile_resonance.drivers.acquisition import DeviceError
from tactile_resonance.processes import END_WITHIN_S, ENDING, keep_memory

RCLError = rclpy_implementation.RCLError

UNUSABLE = (ValueError, OSError, DeviceError, ParameterException, NameValidationException, RCLError)
"""What a start may be refused with, in one line; anything else is a defect and keeps its traceback."""

STEADY = Clock(clock_type=ClockType.STEADY_TIME)
"""This machine's clock, for timers that must go on while simulated time stands."""


# Of rclpy's own profile: the last `depth` messages, reliable, and nothing for late readers.
_latched = partial(QoSProfile, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_unreliable = partial(QoSProfile, reliability=ReliabilityPolicy.BEST_EFFORT)
# Records and results: every one counts. A depth of 256 is a hundred seconds of periods of 0.4 s.
RESULTS = QoSProfile(depth=256)
# Static metadata and maps: late readers get the last one.
LATCHED = _latched(depth=1)
# Excitations: late readers get those of the measurement under way, however many realisations it has.
EXCITATIONS = _latched(depth=64)
# Truths: one with each block, and those of two blocks may leave the bench together.
TRUTHS = _latched(depth=64)
# Poles: small, and a map that is started or restarted in mid-scan gets those it missed.
POLES = _latched(depth=1024)
# What became of the points: late readers get all of a scan.
POINT_RESULTS = _latched(depth=4096)
# The same from now on: of a run that is resumed all come at once.
NEW_POINT_RESULTS = QoSProfile(depth=POINT_RESULTS.depth)
# Poses and wrenches: the newest counts.
STREAM = _unreliable(depth=5)
NEWEST = _unreliable(depth=1)
# Where the tip is put, by those who put it there: the bench must hear it before it plays.
PLACES = QoSProfile(depth=5)
# To a controller: only the newest counts, and it must arrive.
COMMANDS = QoSProfile(depth=1)
# Of a recording, and from a sensor of another driver: what is published at 50 Hz may wait two seconds.
SERIES = _unreliable(depth=100)
# Signs of life.
BEATS = _unreliable(depth=10)


STDERR = 2  # its descriptor
# Between two reports of a node on `/diagnostics`.
PERIOD_S = 1.0
# How long after an error a node still warns of it.
ERROR_REMEMBERED_S = 10.0
MEAN, LONGEST = ": mean time [ms]", ": longest time [ms]"
"""After a topic's name: how long a message of it kept the node, since the last report."""


@dataclass
class _Flow:
    """Messages of one topic, in or out."""

    total: int = 0
    last_s: float = float("nan")
    took_s: list[float] = field(default_factory=list)  # of each since the last report


class Health:
    """Counts what goes in and out, remembers the last error, and publishes both.

    Parameters
    ----------
    node : Node
        With methods ``state_name``, and ``details`` for further figures by name.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._flows: dict[str, _Flow] = {}
        self._error = ""
        self._error_s = float("-inf")
        self._reported_s = time.monotonic()
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        node.create_timer(PERIOD_S, self._publish, clock=STEADY)

    def saw(self, topic: str, seconds: float) -> None:
        """Count one message of a topic, which kept the node busy for so long [s]."""
        flow = self._flows.setdefault(topic, _Flow())
        flow.total += 1
        flow.last_s = time.monotonic()
        flow.took_s.append(seconds)

    def error(self, text: str) -> None:
        """Log an error and remember it."""
        self._node.get_logger().error(text)
        self._error = text
        self._error_s = time.monotonic()

    def failed(self, what: str, error: Exception) -> str:
        """Report what `what` ended with; the reason, for whoever waits for an answer.

        Of a `ValueError` its message; of any other exception, a defect, also the type, and the
        traceback goes to the log.
        """
        reason = str(error)
        if not isinstance(error, ValueError):
            reason = f"{type(error).__name__}: {error}"
            self._node.get_logger().error("".join(traceback.format_exception(error)))
        self.error(f"{what}: {reason}")
        return reason

    def _publish(self) -> None:
        now_s, state = time.monotonic(), self._node.state_name()
        recent = now_s - self._error_s < ERROR_REMEMBERED_S
        message = f"{state}: {self._error}" if recent else state
        levels = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
        level = levels[recent + (state != "active")]
        values = {"state": state}
        for topic, flow in self._flows.items():
            rate_hz = len(flow.took_s) / (now_s - self._reported_s)
            if flow.took_s:
                mean_s = sum(flow.took_s) / len(flow.took_s)
                values[f"{topic}{MEAN}"] = f"{1e3 * mean_s:.3g}"
                values[f"{topic}{LONGEST}"] = f"{1e3 * max(flow.took_s):.3g}"
                flow.took_s.clear()
            values[f"{topic}: messages"] = str(flow.total)
            values[f"{topic}: rate [Hz]"] = f"{rate_hz:.3g}"
            values[f"{topic}: age [s]"] = f"{now_s - flow.last_s:.3g}"
        if self._error:
            values["last error"] = self._error
            values["last error: age [s]"] = f"{now_s - self._error_s:.3g}"
        values.update(self._node.details())
        self._reported_s = now_s
        name = self._node.get_fully_qualified_name()
        status = DiagnosticStatus(
            level=level,
            name=name,
            message=message,
            hardware_id=self._node.get_namespace(),
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)



@contextmanager
def initialised(**options: Any) -> Iterator[None]:
    """`with rclpy.init(**options)` of Kilted; in Jazzy `rclpy.init` returns nothing to enter."""
    try:
        rclpy.init(**options)
        yield
    finally:
        rclpy.try_shutdown()  # also where only the log cannot be written, and the context is open
        uninstall_signal_handlers()  # try_shutdown of Jazzy leaves them


def run_node(make: Callable[[], Node]) -> None:
    """Spin one node until it is interrupted or ROS shuts down.

    An interrupt ends it even where a shell started it in the background, interrupts ignored; further ones are
    ignored, so that the node ends in order. A node that does not end in time, because something in it hangs, is
    ended all the same.
    """
    keep_memory()
    ending = False

    def end_in_time(*_: object) -> None:
        nonlocal ending
        ending = True
        # by a thread that needs no interpreter: the middleware hangs with the interpreter's lock where another
        # process was killed while it held a port of the shared memory
        faulthandler.dump_traceback_later(END_WITHIN_S, exit=True, file=STDERR)

    def interrupt(*_: object) -> None:
        if ending:
            return
        end_in_time()
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupt)
    signal.signal(signal.SIGTERM, end_in_time)
    for hangup in ENDING[2:]:  # the terminal was closed
        signal.signal(hangup, interrupt)
    try:
        with initialised():
            node = make()
            try:
                rclpy.spin(node)
            except (RuntimeError, RCLError):
                # what rclpy makes of an interrupt that meets it while it takes a message, or of SIGTERM, on
                # which it shuts down in a thread of its own, while it waits for one
                if not ending:
                    raise
            finally:
                node.destroy_node()
    except (KeyboardInterrupt, ExternalShutdownException):
        # the interpreter, as it ends, takes handlers away
        for further in ENDING:
            signal.signal(further, signal.SIG_IGN)
    except UNUSABLE as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        sys.exit(1)
