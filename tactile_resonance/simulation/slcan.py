# SPDX-License-Identifier: Apache-2.0
"""A CAN bus as serial adapters serve it (slcan), over TCP: ``socket://host:port`` for pyserial.

Commands of Lawicel's CAN232 (manual, version 3): ``Sn``, ``O``, ``L``, ``C``, ``tiiildd..``, ``V``, ``N``; each
ends with CR and is answered with CR, or BELL where it fails.
"""

from __future__ import annotations

import re
import time

from tactile_resonance.simulation.load_cell import CanFrame
from tactile_resonance.simulation.tcp_bus import Client, TcpBus

OK, FAILED = b"\r", b"\a"
_FRAME = re.compile(r"t([0-7][0-9A-Fa-f]{2})([0-8])((?:[0-9A-Fa-f]{2})*)")


class SlcanServer(TcpBus):
    """See `TcpBus`. Frames carry no time stamps."""

    def __init__(self, host: str = "127.0.0.1", port: int = 29537) -> None:
        super().__init__(host, port)

    def greeting(self) -> bytes:
        """What a new client is sent: nothing."""
        return b""

    def understand(self, client: Client) -> list[tuple[int, bytes]]:
        """Frames in what a client has sent; answers to the rest."""
        frames = []
        while (end := client.received.find(b"\r")) >= 0:
            line = client.received[:end].decode("ascii", "replace")
            client.received = client.received[end + 1 :]
            command = line[:1]
            if command in ("S", "s"):  # while it listens the speed stays as it is
                client.queue += OK if client.listens_from_s is None else FAILED
            elif command in ("O", "L"):
                client.listens_from_s = time.monotonic()
                client.queue += OK
            elif command == "C":
                client.listens_from_s = None
                client.queue += OK
            elif command == "t":
                frame = _frame(line)
                if frame is None or client.listens_from_s is None:
                    client.queue += FAILED
                else:
                    frames.append(frame)
                    client.queue += b"z" + OK
            elif command in ("V", "N"):
                client.queue += command.encode() + b"0000" + OK
            else:
                client.queue += FAILED
        return frames

    def text_of(self, frame: CanFrame) -> bytes:
        """A frame of the bus as clients read it."""
        return b"t%03X%d%s\r" % (frame.can_id, len(frame.data), frame.data.hex().upper().encode())


def _frame(line: str) -> tuple[int, bytes] | None:
    """Identifier and data of a line ``tiiildd..``; None where it is none."""
    found = _FRAME.fullmatch(line)
    if found is None:
        return None
    data = bytes.fromhex(found[3])
    return (int(found[1], 16), data) if len(data) == int(found[2]) else None
