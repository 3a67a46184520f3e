# SPDX-License-Identifier: Apache-2.0
"""The control loop in a thread of its own, beside the executor's."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable

from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.goal import ContactGoal, State
from tactile_resonance.contact.interfaces import Arm, ForceSource
from tactile_resonance.contact.loop import ContactLoop, Cycle, WallClock
from tactile_resonance.contact.machine import ContactController
from tactile_resonance.contact.parameters import ContactParameters, Limits

# A tip that cannot be drawn back in this time is left where the envelope stopped it.
RETRACT_WITHIN_S = 12.0
POLL_S = 0.01


class ContactThread:
    """Runs a `ContactLoop` until it is closed; requests may come from any thread.

    Parameters
    ----------
    arm, force : Arm, ForceSource
        Connected and started.
    parameters, limits : ContactParameters, Limits
    tip : TipGeometry
    listener : callable
        Called with each cycle in the loop's thread; must return at once.
    """

    def __init__(
        self,
        arm: Arm,
        force: ForceSource,
        parameters: ContactParameters,
        limits: Limits,
        tip: TipGeometry,
        listener: Callable[[Cycle], None],
    ) -> None:
        self.controller = ContactController(parameters, limits, tip)
        self.loop = ContactLoop(arm, force, WallClock(), self.controller, listener)
        self.error: Exception | None = None
        self._arm = arm
        self._lock = threading.Lock()
        self._running = True
        self._thread = threading.Thread(target=self._run, name="contact", daemon=True)
        self._thread.start()

    def configure(self, parameters: ContactParameters, limits: Limits) -> None:
        """Exchange parameters; ``ValueError`` unless idle."""
        with self._lock:
            self.controller.configure(parameters, limits)

    def start(self, goal: ContactGoal, parameters: ContactParameters, limits: Limits) -> None:
        """Begin a contact within these limits; ``ValueError`` where it is refused."""
        with self._lock:
            self.controller.configure(parameters, limits)
            self.loop.start(goal)

    def retract(self) -> None:
        """Draw the tip back, beginning with the next cycle."""
        with self._lock:
            self.controller.retract()

    def tell_touch(self) -> bool:
        """Pass on that another sensor tells the first contact; whether that is new in an approach."""
        with self._lock:
            return self.controller.tell_touch()

    def make_ready(self) -> None:
        """Start the program of an arm again that was stopped; ``ArmError`` where it is not released."""
        with self._lock:
            if self.controller.state is State.FAULT:
                self._arm.connect()

    def close(self) -> None:
        """Draw the tip back where the link allows it, and end the loop."""
        self.retract()
        deadline = time.monotonic() + RETRACT_WITHIN_S
        while self._thread.is_alive() and time.monotonic() < deadline:
            if self.controller.settled:
                break
            time.sleep(POLL_S)
        self._running = False
        self._thread.join()

    def _run(self) -> None:
        try:
            while self._running:
                self.loop.wait()
                with self._lock:
                    self.loop.run_period()
        except Exception as error:
            # nobody judges any more: first of all the arm stops
            with contextlib.suppress(Exception):
                self._arm.stop(self.controller.limits.stop_deceleration_m_s2)
            self.error = error
