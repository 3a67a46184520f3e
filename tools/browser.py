# SPDX-License-Identifier: Apache-2.0
"""A headless Chromium over the pipe of its DevTools protocol, for tests and pictures of the pages.

Needs nothing but the browser. https://chromedevtools.github.io/devtools-protocol has the names.
"""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
WITHIN_S = 180.0
# the browser reads from descriptor 3 and writes to 4
_LAUNCH = """
import fcntl, os, sys
ends = [fcntl.fcntl(int(end), fcntl.F_DUPFD, 10) for end in sys.argv[1:3]]
os.dup2(ends[0], 3)
os.dup2(ends[1], 4)
os.execv(sys.argv[3], sys.argv[3:])
"""


def find() -> str | None:
    """Path of a browser; None where there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """One page in a browser of its own, which finds no host but 127.0.0.1; a context that ends it.

    Attributes
    ----------
    console : list of str
        What the page wrote to the console, and errors of its scripts.
    requests : list of str
        Addresses it asked for, those of data and blobs left out.
    """

    def __init__(self, width: int = 1400, height: int = 1000) -> None:
        path = find()
        if path is None:
            raise ValueError(f"no browser is here: none of {', '.join(NAMES)} is installed")
        self._path, self._size = path, (width, height)
        self.console: list[str] = []
        self.requests: list[str] = []

    def __enter__(self) -> Browser:
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        options = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe", "--no-first-run"]
        options += [f"--user-data-dir={self._folder.name}", "--hide-scrollbars"]
        options += ["--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1", "about:blank"]
        ours, theirs = os.pipe(), os.pipe()  # (read, write) of what we get, and of what we send
        self._process = subprocess.Popen(
            [sys.executable, "-c", _LAUNCH, str(theirs[0]), str(ours[1]), self._path, *options],
            pass_fds=(theirs[0], ours[1]),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        os.close(theirs[0])
        os.close(ours[1])
        self._read, self._write = ours[0], theirs[1]
        self._buffer, self._number, self._session = b"", 0, ""
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for name in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{name}.enable")
        width, height = self._size
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.send("Emulation.setDeviceMetricsOverride", **size)
        return self

    def __exit__(self, *_: object) -> None:
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        os.close(self._read)
        os.close(self._write)
        self._folder.cleanup()

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Result of a method of the protocol."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + WITHIN_S
        while True:
            answer = self._next(deadline)
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return dict(answer["result"])

    def _next(self, deadline: float) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._read], [], [], max(0.0, deadline - time.monotonic()))
            part = os.read(self._read, 1 << 20) if ready else b""
            if not part:
                raise RuntimeError("the browser ended, or does not answer")
            self._buffer += part
        line, _, self._buffer = self._buffer.partition(b"\0")
        message: dict[str, Any] = json.loads(line)
        self._note(message.get("method", ""), message.get("params", {}))
        return message

    def _note(self, event: str, told: dict[str, Any]) -> None:
        if event == "Runtime.consoleAPICalled":
            self.console.append(" ".join(str(each.get("value", "")) for each in told["args"]))
        elif event == "Runtime.exceptionThrown":
            details = told["exceptionDetails"]
            self.console.append(details.get("exception", {}).get("description", details["text"]))
        elif event == "Log.entryAdded":
            self.console.append(told["entry"]["text"])
        elif event == "Network.requestWillBeSent":
            address = told["request"]["url"]
            if not address.startswith(("data:", "blob:")):
                self.requests.append(address)

    def show(self, url: str, until: str, within_s: float = WITHIN_S) -> None:
        """Go to a page, until an expression of JavaScript is true there."""
        self.send("Page.navigate", url=url)
        self.wait(until, within_s)

    def wait(self, until: str, within_s: float = WITHIN_S) -> None:
        """Wait until an expression of JavaScript is true."""
        deadline = time.monotonic() + within_s
        while not self.value(f"Boolean({until})"):
            if time.monotonic() > deadline:
                raise RuntimeError(f"not within {within_s:g} s: {until}; console: {self.console[:5]}")
            time.sleep(0.1)

    def value(self, expression: str) -> Any:
        """What an expression of JavaScript gives; None where it raises."""
        answer = self.send("Runtime.evaluate", expression=expression, returnByValue=True)
        return answer["result"].get("value")

    def move(self, x: float, y: float, click: bool = False) -> None:
        """Move the mouse to a place of the window, and click there."""
        for kind in ("mouseMoved", "mouseMoved", *(("mousePressed", "mouseReleased") if click else ())):
            button = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
            self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **button)
            time.sleep(0.2)

    def picture(self, height: int = 0) -> bytes:
        """PNG of the window; of the page down to a height, where one is given."""
        options: dict[str, Any] = {}
        if height:
            clip = {"x": 0, "y": 0, "width": self._size[0], "height": height, "scale": 1}
            options = {"clip": clip, "captureBeyondViewport": True}
        answer = self.send("Page.captureScreenshot", format="png", **options)
        return base64.b64decode(answer["data"])

    def paper(self) -> bytes:
        """PDF of the page as it prints."""
        answer = self.send("Page.printToPDF", preferCSSPageSize=True)
        return base64.b64decode(answer["data"])
