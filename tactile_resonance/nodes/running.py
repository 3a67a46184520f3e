# SPDX-License-Identifier: Apache-2.0
"""What all nodes share: qualities of service, and spinning until asked to stop."""

from __future__ import annotations

import faulthandler
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import rclpy
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
