# SPDX-License-Identifier: Apache-2.0
"""The process in which ur_rtde runs, as its owner sees it: requests, commands, states, and why it is gone."""

from __future__ import annotations

import contextlib
import json
import select
import socket
import subprocess
import sys
import tempfile
from importlib.util import find_spec

from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.drivers.ur_config import UrArmConfig
from tactile_resonance.drivers.ur_exchange import EXIT_LINK_LOST, SIZE, ClientState, Exchange
from tactile_resonance.drivers.ur_safety import PROGRAM_PLAYING

GRACE_S = 1.5
# Of what ur_rtde 1.6.5 writes when it finds its connection lost.
LIBRARY_LOST = "Robot is disconnected"


class ClientProcess:
    """Runs `ur_client` until it is ended, or this process ends.

    Parameters
    ----------
    config : UrArmConfig

    Raises
    ------
    ArmError
        CLIENT_DIED where ur_rtde is not installed.
    """

    def __init__(self, config: UrArmConfig) -> None:
        if find_spec("rtde_control") is None:
            raise ArmError(
                ArmFault.CLIENT_DIED, "ur_rtde is not installed: pip install 'ur-rtde>=1.6.5,<1.7'"
            )
        self._host, self._connect_timeout_s = config.host, config.connect_timeout_s
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with tempfile.TemporaryFile() as page, theirs:
            page.truncate(SIZE)
            self._exchange = Exchange(page.fileno())
            self._exchange.beat()
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

    def beat(self) -> None:
        """Show the client that its owner lives."""
        self._exchange.beat()

    def state(self) -> ClientState | None:
        """Newest state, None before the first; a sign of life too. Raises ArmError where the client is gone."""
        self._exchange.beat()
        if self._process.poll() is not None:
            raise self._death()
        return self._exchange.read()

    def send(self, command: dict) -> None:
        """Send a command and do not wait. Raises ArmError where the client is gone."""
        try:
            self._commands.send(json.dumps(command).encode(), socket.MSG_DONTWAIT)
        except OSError as error:
            raise self._death() from error

    def ask(self, request: dict) -> None:
        """Send a request and wait for its answer. Raises ArmError where it fails: the client is ended then."""
        try:
            self._commands.send(json.dumps(request).encode())
            ready, _, _ = select.select([self._commands], [], [], self._connect_timeout_s)
            data = self._commands.recv(8192) if ready else None
        except OSError:
            data = b""
        if data is None:
            late = self._late(request["name"])
            self._kill()
            raise late
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
        for resource in (self._commands, self._exchange, self._errors):
            resource.close()

    def _late(self, request: str) -> ArmError:
        """Why a request has no answer in time."""
        text = f"{self._host} is not ready after {self._connect_timeout_s:g} s"
        client = self._exchange.read()  # while it connects: the state that it found
        running = client is not None and client.runtime_state == PROGRAM_PLAYING
        if request == "connect" and running:
            # the library asks it to end in a register that the program may not read, and waits for ever
            return ArmError(
                ArmFault.PROGRAM_NOT_STARTED,
                f"{text}: another program runs there and does not end; stop it at the robot",
            )
        return ArmError(ArmFault.LINK_LOST, text)

    def _death(self) -> ArmError:
        """Why the client process is gone."""
        try:
            status = self._process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            return ArmError(ArmFault.CLIENT_DIED, "the client process does not answer")
        said = self.last_error()
        # on a lost connection the library connects anew by itself, says so, and now and then crashes
        # where a command is under way: the link is why
        if status == EXIT_LINK_LOST or (status < 0 and LIBRARY_LOST in said):
            return ArmError(ArmFault.LINK_LOST, f"the connection to {self._host} is lost")
        return ArmError(
            ArmFault.CLIENT_DIED, f"the client process ended with status {status}: {said}"
        )
