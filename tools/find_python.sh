#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Prints the path of a Python interpreter that the set-up can use, or says in one line what to install.
# PYTHON, if set, is the only candidate. Candidates are run, not just looked up: a name on PATH may be
# a shim of a version manager with nothing behind it.
# Where a ROS 2 distribution is sourced, an interpreter that imports its rclpy comes first. Python 3.13 comes last
# otherwise: there is no ur-rtde for it, so no demo.
set -u

# One line about the interpreter that runs it, and of a virtual environment the one behind it; old Pythons
# must be able to read this.
question='
import sys
version = "%d.%d" % sys.version_info[:2]
if sys.version_info[:2] < (3, 10) or sys.version_info[:2] > (3, 13):
    answer = "version " + version
else:
    import os, sysconfig
    answer = ("fit " if sys.version_info[:2] < (3, 13) else "spare ") + getattr(sys, "_base_executable", sys.executable)
    if not os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")):
        answer = "headers " + version
    try:
        import ensurepip, venv
    except ImportError:
        answer = "venv " + version
print(answer)
'

say() {
    echo "error: $*" >&2
    exit 1
}

# -E -s -S: what a virtual environment or a sourced ROS adds to the interpreter is of no interest here.
ask() {
    "$1" -E -s -S -c "$question" 2>/dev/null
}

candidates=${PYTHON:-python3 python3.12 python3.11 python3.13 python3.10}

with_ros=
if [ -n "${ROS_DISTRO:-}" ] && [ -n "${AMENT_PREFIX_PATH:-}" ]; then
    for name in $candidates; do
        if "$name" -c 'import rclpy' >/dev/null 2>&1; then with_ros="$with_ros $name"; fi
    done
    candidates="$with_ros $candidates"
fi

flaw= spare=
for name in $candidates; do
    answer=$(ask "$name") || continue
    case $answer in
        "fit "*)
            echo "${answer#fit }"
            exit 0
            ;;
        "spare "*)
            spare=${spare:-${answer#spare }}
            if [ -n "$with_ros" ]; then break; fi
            ;;
        version*) flaw=${flaw:-$answer} ;;
        *) case ${flaw:-version} in version*) flaw=$answer ;; esac ;;
    esac
done
if [ -n "$spare" ]; then
    echo "$spare"
    exit 0
fi

version=${flaw#* }
case $flaw in
    venv*) say "Python $version cannot make virtual environments: apt install python$version-venv" ;;
    headers*) say "Python $version has no headers (Python.h): apt install python$version-dev" ;;
    version*) say "Python $version found, 3.10 to 3.13 needed: apt install python3 python3-venv python3-dev, or set PYTHON" ;;
esac
say "no working Python 3.10 to 3.13 found as ${PYTHON:-python3 or python3.10 to python3.13}: apt install python3 python3-venv python3-dev"
