#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Renews requirements.lock: newest versions that requirements.in and requirements-ros.in allow, for every
# supported Python, with hashes. Uses uv in an environment that is thrown away.
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
UV_CUSTOM_COMPILE_COMMAND='make lock' "$scratch/venv/bin/uv" pip compile --quiet --no-config --upgrade \
    --universal --python-version 3.10 --generate-hashes --annotation-style line \
    requirements.in requirements-ros.in --output-file "$scratch/requirements.lock"
mv "$scratch/requirements.lock" requirements.lock
echo "requirements.lock: $(grep -c '^[a-z]' requirements.lock) entries"
