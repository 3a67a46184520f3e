# SPDX-License-Identifier: Apache-2.0
"""The control loop in a thread of its own, beside the executor's."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable

from tactile_resonance.clock import Clock
from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.goal import ContactGoal, State
from tactile_resonance.contact.interfaces import Cell, ForceError, NodeArm
from tactile_resonance.contact.loop import ContactLoop, Cycle
from tactile_resonance.contact.machine import IDLE_PERIODS, ContactController
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.payload import Mount

# A tip that cannot be drawn back in this time is left where the envelope stopped it.
RETRACT_WITHIN_S = 12.0
POLL_S = 0.01
# A loop without a cycle for so long hangs.
HUNG_S = 1.0
# A loop that has not ended so long after it should is given up.
END_WITHIN_S = 3.0
# Between two attempts to start a force source that has failed, by the loop's clock.
SOURCE_AGAIN_NS = 250_000_000
# A contact that is held and calm is looked at in one of so many periods: 8 ms, less than forces may be old.
CALM_PERIODS = 4
# While nothing is under way the loop runs as often as is published, at least once in so many periods: 40 ms.
MOST_IDLE_PERIODS = 20


class _EndedError(Exception):
    """The loop is to end."""


class ContactThread:
    """Runs a `ContactLoop` until it is closed; requests may come from any thread.

    Parameters
    ----------
    arm, force : NodeArm, Cell
        Connected and started.
    parameters, limits : ContactParameters, Limits
    tip : TipGeometry
    listener : callable
        Called with each cycle in the loop's thread; must return at once.
    failed : callable
        Called in that thread where the loop has ended with an error.
    told_s : float
        Time between two cycles that the listener needs while nothing is under way [s].

    Attributes
    ----------
    clock : Clock
        On which it dates what it sees.
    error : Exception or None
        With which the loop has ended.
    moves : str
        Why the arm was not seen to stand after that, and its link was closed; empty: it stands.
    """

    def __init__(
        self,
        arm: NodeArm,
        force: Cell,
        parameters: ContactParameters,
        limits: Limits,
        tip: TipGeometry,
        listener: Callable[[Cycle], None],
        failed: Callable[[], None],
        told_s: float = 0.0,
    ) -> None:
        self.error: Exception | None = None
        self.moves = ""
        self._arm, self._force, self._failed = arm, force, failed
        self._lock = threading.Condition()
        self._running = True
        self._connecting = False  # meanwhile the arm is another thread's, and the loop stands
        self._asked = threading.Event()  # something was, which an idle loop is to hear at once
        self._time_passed = False  # simulated time has gone on while the loop waited for the lock
        self._source_tried_ns: int | None = None
        self._alive_s = time.monotonic()
        self._led = arm.led_clock(force, self._stay)
        self.clock: Clock = self._led or arm.clock
        idle_periods = min(MOST_IDLE_PERIODS, int(told_s / parameters.period_s))
        self.controller = ContactController(
            *(parameters, limits, tip),
            under_sample=force.mounting.mount is Mount.TABLE,
            # simulated time ends where a block does, and a block waits for the force at its end
            calm_periods=1 if self.clock.simulated else CALM_PERIODS,
            # simulated time needs no haste, and there the arm's watchdog is fed once a period
            idle_periods=IDLE_PERIODS if self.clock.simulated else max(IDLE_PERIODS, idle_periods),
        )
        self.loop = ContactLoop(arm, force, self.clock, self.controller, listener)
        self._thread = threading.Thread(target=self._run, name="contact", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the loop moves on, or waits for simulated time that stands."""
        return self._connecting or time.monotonic() - self._alive_s < HUNG_S

    def configure(self, parameters: ContactParameters, limits: Limits) -> None:
        """Exchange parameters; ``ValueError`` unless idle."""
        with self._lock:
            self.controller.configure(parameters, limits)

    def start(self, goal: ContactGoal, parameters: ContactParameters, limits: Limits) -> None:
        """Begin a contact within these limits; ``ValueError`` where it is refused."""
        with self._lock:
            self.controller.configure(parameters, limits)
            self.loop.start(goal)
            self._hurry()

    def retract(self) -> None:
        """Draw the tip back, beginning with the next cycle."""
        with self._lock:
            self.controller.retract()
            self._hurry()

    def tell_touch(self) -> bool:
        """Pass on that another sensor has detected the first contact; whether that is new in an approach."""
        with self._lock:
            return self.controller.tell_touch()

    def make_ready(self) -> None:
        """Start the program of an arm again that was stopped; ``ArmError`` where it is not released.

        That takes seconds. Meanwhile the loop leaves the arm alone, and requests are taken.
        """
        with self._lock:
            self._lock.wait_for(lambda: not self._connecting)
            if self.controller.state is not State.FAULT:
                return
            self._connecting = True
        try:
            self._arm.connect()
        finally:
            with self._lock:
                self._connecting, self._time_passed = False, True
                self._alive_s = time.monotonic()
                self._lock.notify_all()

    def close(self) -> bool:
        """Draw the tip back where the link allows it, and end the loop; whether it has ended.

        The arm of a loop that hangs is closed: nobody moves it any more, and its own watchdog stops it.
        """
        deadline = time.monotonic() + RETRACT_WITHIN_S
        if self._lock.acquire(timeout=RETRACT_WITHIN_S):  # a loop that hangs may hold it
            self._lock.wait_for(lambda: not self._connecting, RETRACT_WITHIN_S)
            self.controller.retract()
            self._hurry()
            self._lock.release()
        while self._thread.is_alive() and time.monotonic() < deadline:
            if self.controller.settled:
                break
            time.sleep(POLL_S)
        self._running = False
        self._thread.join(END_WITHIN_S)
        if self._thread.is_alive():
            self._arm.close()
        return not self._thread.is_alive()

    def _hurry(self) -> None:
        """Let the loop's next period begin now; with the lock."""
        if self._led is not None:
            self._led.hurry()
        elif not self.clock.simulated:
            self.loop.hurry()
            self._asked.set()

    def _wait(self) -> None:
        """Wait for the loop's next period; a loop that is idle hears at once what is asked of it."""
        if self.clock.simulated or self.controller.state is not State.IDLE:
            self.loop.wait()
        else:
            self._asked.wait(self.loop.left_s)
            self._asked.clear()

    def _stay(self) -> None:
        """Called while simulated time stands."""
        self._alive_s = time.monotonic()
        if not self._running:
            raise _EndedError

    def _start_source_again(self) -> None:
        """Start a force source that has failed; only while no contact is under way, since it takes a while."""
        now_ns, tried_ns = self.clock.now_ns(), self._source_tried_ns
        waited = tried_ns is None or now_ns - tried_ns > SOURCE_AGAIN_NS
        if self.controller.state is State.IDLE and waited:
            self._source_tried_ns = now_ns
            with contextlib.suppress(ForceError):  # its next `read` reports it
                self._force.start()

    def _run(self) -> None:
        try:
            while self._running:
                self._wait()
                with self._lock:
                    while self._connecting:
                        self._lock.wait()
                    if not self._running:
                        break
                    if self._led is not None and self._time_passed:
                        # the data of that time were not waited for, and would seem old
                        self._time_passed = False
                        self._led.ask_ns()
                        self.loop.skip()
                        continue
                    self.loop.run_period()
                self._alive_s = time.monotonic()
                if isinstance(self.loop.fault, ForceError):
                    self._start_source_again()
            if not self.controller.settled:
                self.loop.bring_to_rest()
        except _EndedError:
            pass
        except Exception as error:
            # nothing supervises the arm any more: first of all it stops
            self.moves = self.loop.bring_to_rest()
            if self.moves:
                self._arm.close()
            self.error = error
            self._failed()
        finally:
            if self._led is not None:
                with contextlib.suppress(Exception):
                    self._led.close()
