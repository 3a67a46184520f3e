# SPDX-License-Identifier: Apache-2.0
"""Opening buses of python-can, and whether they are quick enough."""

from __future__ import annotations

import logging
import socket
import threading
from typing import Any

import can

from tactile_resonance.contact.interfaces import ForceError, ForceFault

OPEN_WITHIN_S = 3.5  # serial adapters are given two seconds to wake up
RATE_WINDOW_S = 0.5
LEAST_SHARE = 0.9
"""Of the wrenches of a window that must arrive; fewer in two on end, and they pile up on the way."""


def open_bus(settings: dict[str, Any], where: str) -> can.BusABC:
    """Open a bus within a time: some interfaces try for long, or wait for ever.

    Parameters
    ----------
    settings : dict
        Arguments of ``can.Bus``.
    where : str
        Name for messages.

    Raises
    ------
    ForceError
        `LINK_LOST`.
    """
    if settings["interface"] == "socketcand":
        # a message in two pieces is no fault, but python-can warns of each
        logging.getLogger("can.interfaces.socketcand").setLevel(logging.ERROR)
        # python-can would try for ten seconds, without a pause
        address = (settings.get("host"), settings.get("port"))
        try:
            socket.create_connection(address, OPEN_WITHIN_S).close()
        except (OSError, ValueError) as error:  # ValueError: what no name or address can be
            text = f"{where}: {one_line(error)}"
            raise ForceError(ForceFault.LINK_LOST, text) from error
    opened: list[can.BusABC] = []
    failed: list[Exception] = []
    given_up = threading.Event()

    def open_bus() -> None:
        try:
            bus = can.Bus(**settings)
        except Exception as error:  # each interface has errors of its own
            failed.append(error)
            return
        opened.append(bus)
        if given_up.is_set():
            bus.shutdown()

    opener = threading.Thread(target=open_bus, name="can_open", daemon=True)
    opener.start()
    opener.join(OPEN_WITHIN_S)
    if failed:
        text = f"{where}: {one_line(failed[0])}"
        raise ForceError(ForceFault.LINK_LOST, text) from failed[0]
    if not opened:
        given_up.set()
        text = f"{where}: not open after {OPEN_WITHIN_S:g} s"
        raise ForceError(ForceFault.LINK_LOST, text)
    return opened[0]


class Flow:
    """Whether as many wrenches arrive as the cell sends.

    Attributes
    ----------
    rate_hz : float
        Of the last window.
    """

    def __init__(self, nominal_hz: float, now_s: float) -> None:
        self._nominal_hz = nominal_hz
        self._begin_s, self._count, self._short = now_s, 0, 0
        self.rate_hz = nominal_hz

    def short(self, now_s: float, count: int) -> bool:
        """Whether two windows on end were short; a reader held up in one catches up in the next."""
        span_s = now_s - self._begin_s
        if span_s < RATE_WINDOW_S:
            return False
        self.rate_hz = (count - self._count) / span_s
        self._begin_s, self._count = now_s, count
        self._short = self._short + 1 if self.rate_hz < LEAST_SHARE * self._nominal_hz else 0
        return self._short > 1


def one_line(error: BaseException) -> str:
    """Message of an error, or its kind where it has none."""
    return " ".join(str(error).split()) or type(error).__name__
