# SPDX-License-Identifier: Apache-2.0
"""The process in which ur_rtde runs, as `UrArm` sees it, and what both exchange.

Commands go over a socket, signs of life are on a page: each value there has one writer and eight bytes of its
own; neither side waits for the other.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import pickle
import select
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import NamedTuple

from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.drivers.ur_config import UrArmConfig

SIZE = mmap.PAGESIZE
_BEAT, _SEEN, _DONE, _REFUSED, _HEARD = range(5)

SPEED, STOP, NOTHING = b"s", b"t", b"-"
_COMMAND = struct.Struct("<cxxxxxxxqqq7d")
REST = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

# Exit statuses of the client process; any other is a death.
EXIT_ORDERLY, EXIT_BROKEN = 0, 1


class UrCommand(NamedTuple):
    """One message of the owner.

    Attributes
    ----------
    kind : bytes
        `SPEED`, `STOP` or `NOTHING`.
    number : int
    until_ns : int
        In simulated time: up to when it may go on after the command; 0: not stated.
    demand : int
        A `tactile_resonance.clock.Demand`.
    twist : tuple of 6 floats
    acceleration : float
    """

    kind: bytes
    number: int = 0
    until_ns: int = 0
    demand: int = 0
    twist: tuple[float, ...] = REST
    acceleration: float = 0.0

    def pack(self) -> bytes:
        """As it is sent."""
        return _COMMAND.pack(*self[:4], *self.twist, self.acceleration)

    @classmethod
    def unpack(cls, data: bytes) -> UrCommand:
        """From what was sent."""
        values = _COMMAND.unpack(data)
        return cls(*values[:4], values[4:10], values[10])


# What the owner sees of the robot: its newest state is fresh enough to command on; that state forbids motion; a
# program runs that is not ours. Plain integers: the operators of an enum cost a period tens of times as much.
FRESH, FAULTY, REVIVED = 1, 2, 4


class Exchange:
    """The shared page.

    Parameters
    ----------
    descriptor : int
        Of a file of `SIZE` bytes that both processes hold open.
    """

    def __init__(self, descriptor: int) -> None:
        self._page = mmap.mmap(descriptor, SIZE)
        self._values = memoryview(self._page).cast("q")
        self._reported = 0

    def beat(self, seen: int | None = None) -> int:
        """Owner: give a sign of life, and state what is seen of the robot: `FRESH`, `FAULTY`, `REVIVED`.

        Returns when, by this machine's monotonic clock [ns].
        """
        self._values[_BEAT] = now_ns = time.monotonic_ns()
        if seen is not None:
            self._values[_SEEN] = seen
        return now_ns

    def silence_s(self) -> float:
        """Client: time since the owner's last sign of life [s]."""
        return (time.monotonic_ns() - self._values[_BEAT]) * 1e-9

    @property
    def seen(self) -> int:
        """Client: what the owner sees of the robot."""
        return self._values[_SEEN]

    def report(self, number: int, done: bool) -> None:
        """Client: report that a command was done, or refused."""
        if not done:
            self._values[_REFUSED] = number
        self._reported = max(number, self._reported)
        self._values[_DONE] = self._reported

    @property
    def answered(self) -> tuple[int, int]:
        """Owner: numbers of the last command that was done or refused, and of the last refused; 0: none."""
        return self._values[_DONE], self._values[_REFUSED]

    def hear(self, until_ns: int) -> None:
        """Client: state the time up to which it has let simulated time go on for the owner."""
        self._values[_HEARD] = until_ns

    @property
    def heard_ns(self) -> int:
        """Owner: the time that the client has let go on to last."""
        return self._values[_HEARD]

    def close(self) -> None:
        """Unmap."""
        self._values.release()
        self._page.close()


GRACE_S = 1.5
PROBES_NS = 10_000_000
"""So often it is asked whether the process runs [ns]; a command that is sent to a dead one finds it at once."""
# Of what ur_rtde 1.6.5 writes when it finds its connection lost.
LIBRARY_LOST = "Robot is disconnected"


class ClientProcess:
    """Runs `ur_client` until it is ended, or this process ends.

    Parameters
    ----------
    config : UrArmConfig
    simulated_time : bool
        Which may go on far between two looks.

    Attributes
    ----------
    exchange : Exchange
        The page that it shares with this process.

    Raises
    ------
    ArmError
        CLIENT_DIED where ur_rtde is not installed.
    """

    def __init__(self, config: UrArmConfig, *, simulated_time: bool = False) -> None:
        if find_spec("rtde_control") is None:
            raise ArmError(
                ArmFault.CLIENT_DIED, "ur_rtde is not installed: pip install 'ur-rtde>=1.6.5,<1.7'"
            )
        self._host, self._connect_timeout_s = config.host, config.connect_timeout_s
        self._using = threading.Lock()  # one thread may end it while another waits for it
        self._ended = False
        self._probed_ns, self._probes_ns = 0, 0 if simulated_time else PROBES_NS
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with tempfile.TemporaryFile() as page, theirs:
            page.truncate(SIZE)
            self.exchange = Exchange(page.fileno())
            self.exchange.beat()
            self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the client
            self._commands = ours
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "tactile_resonance.drivers.ur_client",
                    str(theirs.fileno()),
                    str(page.fileno()),
                ],
                pass_fds=(theirs.fileno(), page.fileno()),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._errors,
                start_new_session=True,
            )

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def look(self, seen: int | None = None) -> None:
        """Give the client a sign of life and what is seen of the robot; `ArmError` where the client is gone."""
        with self._using:
            if not self._ended:
                now_ns = self.exchange.beat(seen)
                if now_ns - self._probed_ns < self._probes_ns or self._runs():
                    return
        raise self._death()

    def _runs(self) -> bool:
        """Whether the process has not ended; one call of the system, and it stays to be waited for."""
        self._probed_ns = time.monotonic_ns()
        how = os.WEXITED | os.WNOHANG | os.WNOWAIT
        try:
            return self._process.returncode is None and os.waitid(os.P_PID, self.pid, how) is None
        except ChildProcessError:  # another thread has waited for it just now
            return False

    def send(self, command: UrCommand) -> None:
        """Send a command and do not wait. Raises ArmError where the client is gone."""
        try:
            self._commands.send(command.pack(), socket.MSG_DONTWAIT)
        except OSError as error:
            raise self._death() from error

    def ask(self, request: tuple, meanwhile: Callable[[], None]) -> None:
        """Send a request, its name first, and wait for its answer; `meanwhile` is called again and again.

        Raises ArmError where it fails: the client is ended then.
        """
        deadline = time.monotonic() + self._connect_timeout_s
        try:
            self._commands.send(pickle.dumps(request))
            while not select.select([self._commands], [], [], 0.02)[0]:
                meanwhile()
                if time.monotonic() > deadline:
                    self._kill()
                    text = f"{self._host} is not ready after {self._connect_timeout_s:g} s"
                    raise ArmError(ArmFault.LINK_LOST, text)
            data = self._commands.recv(8192)
        except OSError:
            data = b""
        if not data:
            death = self._death()
            self._kill()
            raise death
        fault = pickle.loads(data)
        if fault is not None:
            self.end()
            raise ArmError(*fault)

    def last_error(self) -> str:
        """The last line that the client wrote."""
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").split("\n")
        return next((line.strip() for line in reversed(lines) if line.strip()), "no output")

    def end(self) -> None:
        """Let the client stop the arm and end; kill it where it does not."""
        self._commands.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(GRACE_S)
        self._kill()

    def _kill(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        with self._using:
            self._ended = True
            for resource in (self._commands, self.exchange, self._errors):
                resource.close()

    def _death(self) -> ArmError:
        """Why the client process is gone."""
        try:
            status = self._process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            return ArmError(ArmFault.CLIENT_DIED, "the client process does not answer")
        with self._using:
            if self._ended:
                return ArmError(ArmFault.CLIENT_DIED, "the client process was ended")
            said = self.last_error()
        # on a lost connection the library reconnects without being asked, prints it, and now and then crashes
        # where a command is under way: the link is why
        if status < 0 and LIBRARY_LOST in said:
            return ArmError(ArmFault.LINK_LOST, f"the connection to {self._host} is lost")
        return ArmError(
            ArmFault.CLIENT_DIED, f"the client process ended with status {status}: {said}"
        )
