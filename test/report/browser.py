# SPDX-License-Identifier: Apache-2.0
"""A page as a headless Chromium shows it, where there is one."""

import re
import shutil
import subprocess

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
WITHIN_S = 120


def chromium():
    """Its path; a test without one is skipped."""
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip(f"no browser is here: none of {', '.join(NAMES)} is installed")
    return found


def shown(url, folder, *options):
    """The page after its scripts have run, as HTML, and what they wrote to the console."""
    command = [chromium(), "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"]
    command += [f"--user-data-dir={folder}", "--window-size=1400,1400", "--virtual-time-budget=20000"]
    command += ["--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"]
    done = subprocess.run(
        [*command, *options, "--dump-dom", url], capture_output=True, text=True, timeout=WITHIN_S, check=True
    )
    return done.stdout, re.findall(r"CONSOLE.*", done.stderr)
