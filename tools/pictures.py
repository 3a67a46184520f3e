# SPDX-License-Identifier: Apache-2.0
"""Renews docs/demo/report.png and docs/demo/live.png, by ``tools/run.sh python -m tools.pictures``.

Runs a demo with the live page beside it, and looks at both pages in a headless browser (see browser.py).
"""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from tactile_resonance.processes import free_domain_id
from tools.browser import Browser

COMMAND = (sys.executable, "-m", "tactile_resonance.cli")
TARGET = Path(__file__).resolve().parent.parent / "docs" / "demo"
WITHIN_S = 600.0
POINTS = 11  # of the demo's sixteen, when the live page is looked at
COLOURS = 200
WIDTH, HEIGHT = 1300, 1080


def main() -> None:
    """Run, look, write."""
    os.environ["ROS_DOMAIN_ID"] = str(free_domain_id())
    live = subprocess.Popen([*COMMAND, "live", "--port", "0"], stdout=subprocess.PIPE, text=True)
    try:
        assert live.stdout is not None
        url = live.stdout.readline().split()[0]
        with tempfile.TemporaryDirectory() as folder, Browser(WIDTH, HEIGHT) as browser:
            run = Path(folder) / "run"
            demo = subprocess.Popen([*COMMAND, "demo", "--output", str(run)])
            try:
                told = f"parseInt(document.querySelectorAll('.note')[1]?.textContent) >= {POINTS}"
                browser.show(url, told, WITHIN_S)
                browser.wait("document.querySelector('h2').textContent.startsWith('under way')")
                keep(browser, "live.png")
                demo.wait(WITHIN_S)
            finally:
                if demo.poll() is None:
                    demo.send_signal(signal.SIGINT)
                    demo.wait(WITHIN_S)
            page = (run / "report.html").as_uri()
            browser.show(f"{page}#point=4", "document.querySelector('h2')?.textContent === 'point 4'")
            keep(browser, "report.png")
            if browser.console:
                sys.exit(f"the pages wrote to the console: {browser.console}")
    finally:
        live.send_signal(signal.SIGINT)
        live.wait(WITHIN_S)


def keep(browser: Browser, name: str) -> None:
    """Write what the browser shows, with few colours: a third of the size."""
    picture = Image.open(io.BytesIO(browser.picture())).convert("RGB")
    picture.quantize(COLOURS).save(TARGET / name, optimize=True)
    print(f"{TARGET / name}: {(TARGET / name).stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
