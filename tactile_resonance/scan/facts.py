# SPDX-License-Identifier: Apache-2.0
"""What a run notes about itself: versions, seeds, plan and what it leaves out."""

from __future__ import annotations

import platform
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from tactile_resonance.configuration import PACKAGE_NAME, share_path
from tactile_resonance.scan.plan import Plan

_LIBRARIES = ("numpy", "scipy", "rosbags", "ur-rtde", "python-can")


def run_facts(plan: Plan, seed: int, more: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Facts of a run that begins now, as JSON holds them.

    Parameters
    ----------
    plan : Plan
    seed : int
        Of the excitations.
    more : mapping, optional
        What else belongs to the run: parameters of the nodes, the robot's serial number.
    """
    design = plan.measurement
    return {
        "begun": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "seed": seed,
        "versions": versions(),
        "shortest_s": plan.shortest_s,
        "longest_s": plan.longest_s,
        "measurement": {
            "grid": design.grid.value,
            "f_min_hz": design.f_min_hz,
            "f_max_hz": design.f_max_hz,
            "level_v": design.level_v,
            "most_periods": design.periods,
            "realisations": design.realisations,
        },
        "skipped": [asdict(skipped) for skipped in plan.skipped],
        **(more or {}),
    }


def versions() -> dict[str, str]:
    """Of this package, Python and the libraries that results depend on; those absent are left out."""
    found = {PACKAGE_NAME: _own_version(), "python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _own_version() -> str:
    """From package.xml, in the source tree and installed; from the metadata where there is none."""
    try:
        text = ElementTree.parse(share_path("package.xml")).getroot().findtext("version")
    except FileNotFoundError:
        text = version(PACKAGE_NAME)
    return str(text)
