# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance compile`: what the first fit of poles would otherwise have to compile."""

from __future__ import annotations

import argparse


def add_parser(commands: argparse._SubParsersAction) -> None:
    """The command has no options."""
    parser = commands.add_parser(
        "compile",
        help="compile the pole fits ahead of their first use",
        description="Compile the pole fits into numba's cache, which takes about a minute and is done once per "
        "installation. 'make setup' does it; after 'pip install' or colcon the first fit does it otherwise.",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Compile what is not in the cache yet."""
    # only here: numba takes a second to load
    from tactile_resonance.poles.tables import compiled

    missing = compiled()
    print(f"pole fits: {missing} kernels compiled" if missing else "pole fits: compiled already")
    return 0
