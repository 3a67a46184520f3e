# SPDX-License-Identifier: Apache-2.0
# Sourced with $root set: the virtual environment and ROS 2 as the set-up and its commands see them.
# With ROS 2 from wheels nothing of another ROS may be left; with a sourced distribution (which the
# virtual environment sees: include-system-site-packages) everything of it stays.

venv="$root/.venv${TACTILE_ROS:+-$TACTILE_ROS}"
if ! grep -q '^include-system-site-packages = true' "$venv/pyvenv.cfg"; then
    if [ -n "${AMENT_PREFIX_PATH:-}" ]; then unset LD_LIBRARY_PATH; fi
    unset PYTHONPATH COLCON_PREFIX_PATH ROS_DISTRO ROS_VERSION ROS_PYTHON_VERSION
    export AMENT_PREFIX_PATH="$venv" CMAKE_PREFIX_PATH="$venv"
fi
unset PYTHONHOME _ROS_WHEELS_BOOTSTRAP_COMPLETE
export VIRTUAL_ENV="$venv" PATH="$venv/bin:$PATH"
