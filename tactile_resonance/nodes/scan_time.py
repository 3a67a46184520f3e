# SPDX-License-Identifier: Apache-2.0
"""The time of a scan: the machine's, or that of a simulated bench, which the scan conducts."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator

from tactile_resonance.clock import ClockLostError, SimulatedClock
from tactile_resonance.nodes.node_watch import SILENT_S

GO_AGAIN_S = 0.2


class ScanTime:
    """Conducts simulated time during a scan; on the machine's clock only `now_s` does something.

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

    @contextlib.contextmanager
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

    @contextlib.contextmanager
    def _while_there(self) -> Iterator[None]:
        """Conduct no more where the bench has ended."""
        try:
            yield
        except ClockLostError:
            self._end()
