#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Runs a command in the environment that `make setup` built: tools/run.sh COMMAND [ARGUMENT...]
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd -P)
if [ ! -f "$root/.venv/pyvenv.cfg" ] || [ ! -f "$root/install/setup.sh" ]; then
    echo "error: nothing is set up here yet: make setup" >&2
    exit 1
fi
. "$root/tools/environment.sh"
set +u # colcon's scripts read variables that may be unset
. "$root/install/setup.sh"
set -u

# Python modules come from the source tree, messages from the installed one (see tactile_resonance/__init__.py).
export PYTHONPATH="$root:${PYTHONPATH:-}"
# No traffic leaves this machine, no log or cache leaves this tree, and a process computes on one core.
export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"
export ROS_LOG_DIR="${ROS_LOG_DIR:-$root/log/ros}"
export MPLCONFIGDIR="${MPLCONFIGDIR:-$root/build/matplotlib}"
export OPENBLAS_NUM_THREADS="${OPENBLAS_NUM_THREADS:-1}"

exec "$@"
