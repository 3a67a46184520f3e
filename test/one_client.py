# SPDX-License-Identifier: Apache-2.0
"""A TCP server of one client: it answers an expected dialogue, then the test reads and writes the channel."""

import contextlib
import fcntl
import socket
import termios
import threading
import time
from array import array

PATIENCE_S = 30.0


class OneClient:
    """Answers a dialogue in a thread of its own.

    Parameters
    ----------
    address : (str, int)
    dialogue : sequence of (bytes, bytes)
        Requests, of which only the length is checked, and their answers.
    probes : int
        Connections that are closed at once, before the one that is served.
    piece : int
        Bytes that are sent at once.

    Attributes
    ----------
    heard : list of bytes
        Requests as they came.
    channel : socket
        The connection, after `join`.
    """

    def __init__(self, address, dialogue, probes=0, piece=1 << 16):
        self.heard = []
        self.channel = None
        self._listener = socket.create_server(address)
        self.port = self._listener.getsockname()[1]
        self._dialogue, self._probes, self._piece = dialogue, probes, piece
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self):
        for _ in range(self._probes):
            self._listener.accept()[0].close()
        self.channel, _ = self._listener.accept()
        self.channel.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with contextlib.suppress(OSError):
            for request, answer in self._dialogue:
                got = b""
                while len(got) < len(request):
                    part = self.channel.recv(len(request) - len(got))
                    if not part:
                        return
                    got += part
                self.heard.append(got)
                for at in range(0, len(answer), self._piece):
                    self.channel.sendall(answer[at : at + self._piece])

    def join(self):
        """Wait until the dialogue is over."""
        self._thread.join(PATIENCE_S)

    def close(self):
        """End the server and its connection."""
        self.join()
        self._listener.close()
        if self.channel is not None:
            self.channel.close()


@contextlib.contextmanager
def one_client(*arguments, **options):
    """A `OneClient` that is closed afterwards."""
    with contextlib.closing(OneClient(*arguments, **options)) as server:
        yield server


def wait_until_arrived(descriptor, size):
    """Wait until so many bytes can be read from a socket."""
    there, end_s = array("i", [0]), time.monotonic() + PATIENCE_S
    while there[0] < size:
        assert time.monotonic() < end_s, f"{there[0]} bytes of {size}"
        fcntl.ioctl(descriptor, termios.FIONREAD, there)
