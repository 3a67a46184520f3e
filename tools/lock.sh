#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Renews the locks: newest versions that requirements.in and requirements-ros.in allow, for every supported
# Python, with hashes. requirements-DISTRO.lock adds to requirements.lock the wheels of one distribution of ROS 2.
# Uses uv in an environment that is thrown away.
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd -P)
cd "$root"
python=$(tools/find_python.sh)
mkdir -p build
scratch=$(mktemp -d "$root/build/lock.XXXXXX")
trap 'rm -rf "$scratch"' EXIT
trap 'exit 130' INT TERM

"$python" -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check uv

compile() {
    UV_CUSTOM_COMPILE_COMMAND='make lock' "$scratch/venv/bin/uv" pip compile --quiet --no-config --upgrade \
        --universal --python-version 3.10 --generate-hashes --annotation-style line "$@"
}

shared="$scratch/requirements.lock"
compile requirements.in --output-file "$shared"
in_shared=$(sed -n 's/^\([a-z][^=]*\)==.*/--no-emit-package \1/p' "$shared")
for distro in kilted jazzy; do
    # shellcheck disable=SC2086 # one argument per word
    sed "s/DISTRO/$distro/" requirements-ros.in |
        compile - --constraint "$shared" $in_shared --output-file "$scratch/requirements-$distro.lock"
done
# which folder this is, is nobody's business
sed -i "s|-r $root/|-r |" "$scratch"/requirements*.lock
mv "$scratch"/requirements*.lock .
grep -c '^[a-z]' requirements*.lock
