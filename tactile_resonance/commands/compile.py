# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance compile`: what first fits and contacts would otherwise have to compile."""

from __future__ import annotations

import argparse
from importlib import import_module

STEPPED = tuple(
    f"tactile_resonance.{name}"
    for name in (
        *("contact.contact_filter", "simulation.cell.transducer"),
        *("simulation.noise", "simulation.tissue.indenter"),
        *(f"simulation.ur5e.{name}" for name in ("forces", "kinematics", "poses")),
    )
)
"""Modules of what is stepped hundreds of times a second, compiled as they are imported."""


def add_parser(commands: argparse._SubParsersAction) -> None:
    """The command has no options."""
    parser = commands.add_parser(
        "compile",
        help="compile fits, contact control and the simulated robot ahead of their first use",
        description="Compile the fits of poles and mechanical tests, the filter of contacts and what a "
        "simulated robot steps into numba's cache, which takes about a minute and is done once per "
        "installation. 'make setup' does it; after 'pip install' or colcon the first use does it otherwise.",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Compile what is not in the cache yet."""
    # only here: numba takes a second to load
    from tactile_resonance.mechanics import course
    from tactile_resonance.poles import compiled

    missing = compiled.compiled() + course.compiled() + sum(map(_compiled, STEPPED))
    print(f"fits: {missing} kernels compiled" if missing else "fits: compiled already")
    return 0


def _compiled(name: str) -> int:
    """How many functions of a module were not in the cache and had to be compiled."""
    from numba.core.dispatcher import Dispatcher

    members = vars(import_module(name)).values()
    kernels = [each for each in members if isinstance(each, Dispatcher)]
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in kernels)
