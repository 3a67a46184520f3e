# SPDX-License-Identifier: Apache-2.0
"""The colcon build of the messages and commands into build/ and install/."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
from contextlib import AbstractContextManager

from console import LOGS, ROOT, SetupError, run, running, step
from packages import BESIDE, NAMED, PYTHON

BUILD = ROOT / "build"
COLCON_BUILD = BUILD / NAMED / "tactile_resonance"
INSTALL = ROOT / f"install{BESIDE}"
INTERFACES = ("msg", "srv", "action")
INSTALLED = ("tactile_resonance", "config", "launch")

# What cmake looks for, in its order.
_COMPILERS = {
    "C": ("CC", ("cc", "gcc", "clang")),
    "C++": ("CXX", ("c++", "g++", "clang++")),
}
_PROBE = """
#include <Python.h>
#include <string>
int main() { return static_cast<int>(std::string().size()); }
"""


def check_tools() -> None:
    """Find out before anything is installed whether messages can be compiled here."""
    if not shutil.which("make"):
        raise SetupError("make is missing: apt install make")
    compiler = [find_compiler(language) for language in _COMPILERS][-1]
    probe = BUILD / "probe"
    probe.mkdir(parents=True, exist_ok=True)
    source = probe / "probe.cpp"
    source.write_text(_PROBE)
    run(
        [compiler, "-I", sysconfig.get_path("include"), source, "-o", probe / "probe"],
        "compiler.log",
        f"{compiler} cannot compile a program of one line: apt install g++ "
        f"python{sys.version_info.major}.{sys.version_info.minor}-dev",
    )


def find_compiler(language: str) -> str:
    """Path of the compiler that cmake will take."""
    variable, names = _COMPILERS[language]
    named = os.environ.get(variable)
    for name in [shlex.split(named)[0]] if named else names:
        if path := shutil.which(name):
            return path
    looked_for = f"${variable}={named}" if named else ", ".join(names)
    raise SetupError(f"no {language} compiler found ({looked_for}): apt install g++")


def build(anew: bool, python_only: bool) -> None:
    """Build and install with colcon, `anew` from nothing, else on top of the last build.

    `python_only`: messages for nodes in Python alone, as the ROS 2 from wheels has.
    """
    if anew:
        shutil.rmtree(COLCON_BUILD, ignore_errors=True)
        shutil.rmtree(INSTALL, ignore_errors=True)
    with step("building messages and commands" + (" (a minute or two)" if anew else "")):
        # By its module: of a sourced ROS 2 there may be a colcon that is not in .venv/bin.
        colcon = [PYTHON, "-c", "from colcon_core.command import main; raise SystemExit(main())"]
        colcon += ["--log-base", LOGS / "colcon", "build", "--base-paths", ROOT]
        colcon += ["--build-base", COLCON_BUILD.parent, "--install-base", INSTALL]
        # Python files are linked, so that what is edited in the source tree is what runs.
        layout = ["--merge-install", "--symlink-install"]
        cmake = ["--cmake-args", "-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={PYTHON}"]
        cmake.append(f"-DPYTHON_NODES_ONLY={'ON' if python_only else 'OFF'}")
        failure = "the messages could not be built"
        run([*colcon, *layout, *cmake], "build.log", failure, _environment())
        trial = ["python", "-c", "from tactile_resonance.msg import FRF; FRF()"]
        failure = "the messages were built but cannot be imported"
        run([ROOT / "tools" / "run.sh", *trial], "import.log", failure)


def compile_fits() -> None:
    """Compile the kernels of the fits into numba's cache, so that no first use has to."""
    with step("compiling the fits (about a minute)"), compiling():
        pass


def compiling() -> AbstractContextManager[None]:
    """Compile the fits beside the body: they take one core, and need nothing of ROS 2."""
    command = [PYTHON, "-m", "tactile_resonance.cli", "compile"]
    env = _environment()
    env["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), env.get("PYTHONPATH")]))
    env["PYTHONPYCACHEPREFIX"] = str(BUILD / "pycache")  # as tools/run.sh
    return running(command, "kernels.log", "the fits could not be compiled", env)


def _environment() -> dict[str, str]:
    """What tools/environment.sh makes of ours, less what would reach into the build."""
    script = f'root={shlex.quote(str(ROOT))}; . "$root/tools/environment.sh"; exec env -0'
    text = subprocess.run(["sh", "-c", script], capture_output=True, text=True, check=True).stdout
    env = dict(line.split("=", 1) for line in text.split("\0") if line)
    for name in ("MFLAGS", "MAKELEVEL", "CMAKE_GENERATOR", "DESTDIR"):
        env.pop(name, None)
    # The user's own colcon defaults (layout, build type, arguments) are for their workspaces. Jobs
    # are given because colcon's own choice waits for other processes: it limits the load as well.
    jobs = len(os.sched_getaffinity(0))
    return env | {"COLCON_HOME": str(BUILD / "colcon"), "MAKEFLAGS": f"-j{jobs}"}
