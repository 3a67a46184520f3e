# SPDX-License-Identifier: Apache-2.0
"""The process in which ur_rtde runs, as its owner sees it: requests, commands, and why it is gone."""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from importlib.util import find_spec

from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.drivers.ur_config import UrArmConfig
from tactile_resonance.drivers.ur_exchange import EXIT_LINK_LOST, SIZE, Exchange, UrCommand

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

    def ask(self, request: dict, meanwhile: Callable[[], None]) -> None:
        """Send a request and wait for its answer; `meanwhile` is called again and again.

        Raises ArmError where it fails: the client is ended then.
        """
        deadline = time.monotonic() + self._connect_timeout_s
        try:
            self._commands.send(json.dumps(request).encode())
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
        answer = json.loads(data)
        if not answer["ok"]:
            self.end()
            raise ArmError(ArmFault(answer["fault"]), answer["message"])

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
        if status == EXIT_LINK_LOST or (status < 0 and LIBRARY_LOST in said):
            return ArmError(ArmFault.LINK_LOST, f"the connection to {self._host} is lost")
        return ArmError(
            ArmFault.CLIENT_DIED, f"the client process ended with status {status}: {said}"
        )
