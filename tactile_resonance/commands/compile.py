# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance compile`: what first fits would otherwise have to compile."""

from __future__ import annotations

import argparse


def add_parser(commands: argparse._SubParsersAction) -> None:
    """The command has no options."""
    parser = commands.add_parser(
        "compile",
        help="compile the fits of poles and mechanical tests ahead of their first use",
        description="Compile the fits of poles and mechanical tests into numba's cache, which takes about a "
        "minute and is done once per installation. 'make setup' does it; after 'pip install' or colcon the "
        "first fit does it otherwise.",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Compile what is not in the cache yet."""
    # only here: numba takes a second to load
    from tactile_resonance.mechanics import course
    from tactile_resonance.poles import tables

    missing = tables.compiled() + course.compiled()
    print(f"fits: {missing} kernels compiled" if missing else "fits: compiled already")
    return 0
