#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Runs a command in the environment that `make setup` built: tools/run.sh COMMAND [ARGUMENT...]
# TACTILE_ROS=jazzy takes the one that `make jazzy` built beside it, on ROS 2 Jazzy.
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd -P)
beside=${TACTILE_ROS:+-$TACTILE_ROS}
if [ ! -f "$root/.venv$beside/pyvenv.cfg" ] || [ ! -f "$root/install$beside/setup.sh" ]; then
    echo "error: nothing is set up here yet: make setup${TACTILE_ROS:+ TACTILE_ROS=$TACTILE_ROS}" >&2
    exit 1
fi
. "$root/tools/environment.sh"
set +u # colcon's scripts read variables that may be unset
. "$root/install$beside/setup.sh"
set -u

# Python modules come from the source tree, messages from the installed one (see tactile_resonance/__init__.py).
export PYTHONPATH="$root:${PYTHONPATH:-}"
# No traffic leaves this machine, no log or cache leaves this tree, and a process computes on one core.
export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"
export ROS_LOG_DIR="${ROS_LOG_DIR:-$root/log/ros}"
export MPLCONFIGDIR="${MPLCONFIGDIR:-$root/build/matplotlib}"
export OPENBLAS_NUM_THREADS="${OPENBLAS_NUM_THREADS:-1}"
# Compiled modules are kept, also where this is switched off for all of the machine: without them every process
# of a run takes more than twice as long to start.
export PYTHONPYCACHEPREFIX="${PYTHONPYCACHEPREFIX:-$root/build/pycache}"
unset PYTHONDONTWRITEBYTECODE
export TACTILE_RESONANCE_COMMAND="$0 tactile_resonance" # for messages that name a command

exec "$@"
