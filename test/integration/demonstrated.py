# SPDX-License-Identifier: Apache-2.0
"""A demo of two dishes, which several files look at: one run costs as much as twenty other tests."""

from dataclasses import dataclass
from pathlib import Path

from robot_at_hand import own_host

from benchmarks.load_case import Demonstration, Load, demonstrate

HOST = own_host(18)
SCENE = """
name: two dishes
force_n: 0.01
regions:
  - {name: gelatine 10 %, gelatine_percent: 10.0, disc: {center_m: [0.0, 0.0], radius_m: 0.025}}
  - {name: gelatine 16 %, gelatine_percent: 16.0, disc: {center_m: [0.06, 0.0], radius_m: 0.025}}
positions:
  around: {centres_m: [[0.0, 0.0], [0.06, 0.0]], offsets_m: [[0.0, 0.0]]}
precision: {f0_std_hz: 0.02, damping_ratio_std: 1.0e-4}
blocks: {least: 2, most: 8}
notes: {temperature_c: 21.5, tip_wetness: dry}
tissue_classes:
  soft: {f0_hz: 253.84, damping_ratio: 0.0339, f0_std_hz: 0.5, damping_ratio_std: 0.0005, correlation: 0.9}
  stiff: {f0_hz: 262.2, damping_ratio: 0.0428, f0_std_hz: 0.5, damping_ratio_std: 0.0005, correlation: 0.9}
"""


@dataclass(frozen=True)
class Undisturbed:
    """Its scene, what it printed and wrote, and processes of its domain that it left behind."""

    scene: Path
    shown: Demonstration
    left: list[int]


def undisturbed(folder, domain):
    scene = folder / "scene.yaml"
    scene.write_text(SCENE)
    shown = demonstrate(folder, scene, HOST, Load("no load"))
    return Undisturbed(scene, shown, processes_of(domain))


def processes_of(domain):
    """Ids of the processes that were started in a domain."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            environment = (entry / "environ").read_bytes().split(b"\0")
        except OSError:
            continue
        if f"ROS_DOMAIN_ID={domain}".encode() in environment:
            found.append(int(entry.name))
    return found
