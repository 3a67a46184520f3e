# SPDX-License-Identifier: Apache-2.0
"""Imports point one way, as the table in docs/architecture.md states: what each module loads with itself."""

import ast
from collections import defaultdict
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

from tactile_resonance import cli

PACKAGE = Path(cli.__file__).parent
TOOLS = {
    *("_typing", "clock", "configuration", "fields", "files", "processes"),
    "array_files",
}
CORE = {
    *("calibration", "contact", "frf", "mechanics", "poles", "tissue"),
    *("cantilever", "multisine", "record", "sensor", "tones"),
}
MAY_IMPORT = {
    **dict.fromkeys(TOOLS, TOOLS),
    **dict.fromkeys(CORE, CORE | TOOLS),
    "recording": CORE | TOOLS,
    "analysis": CORE | TOOLS | {"recording"},
    "contact_analysis": CORE | TOOLS | {"recording", "analysis"},
    "front": CORE | TOOLS | {"recording", "analysis"},
    "scan": CORE | TOOLS | {"recording"},
    "drivers": CORE | TOOLS | {"recording"},
    "simulation": CORE | TOOLS,
}
"""By part of the package; parts that are not here may import all others."""
OF_THE_ROBOT = ("_typing", "contact.vectors", "fields", "simulation.noise", "simulation.ur5e")
LIBRARIES = {
    "numba": {"poles", "mechanics", "contact", "simulation"},
    "rosbags": {"scan"},
    **dict.fromkeys(("rtde_control", "rtde_receive", "can", "nidaqmx"), {"drivers"}),
    "rclpy": {"nodes", "client"},
}


BACK = {
    ("drivers.force_config", "drivers.can_wrench"),  # which needs python-can: made where a cell is on a bus
    ("drivers.ur_time", "drivers.ur_arm"),  # the arm that a clock leads, and the clock that leads it
    ("simulation.ur5e.variables", "simulation.ur5e.controller"),  # what each output reads
}
"""Imports for types, or in a function, that run against all others."""


def imports(everywhere: bool = False) -> Iterator[tuple[str, str]]:
    """Each module's name, without the package's, and what it imports at its top, or anywhere."""
    for path in PACKAGE.rglob("*.py"):
        module = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree) if everywhere else tree.body:
            names = []
            if isinstance(node, ast.ImportFrom):
                assert node.level == 0, module
                # a whole module may be what is imported
                below = [f"{node.module}.{alias.name}" for alias in node.names]
                names = below if node.module.startswith(PACKAGE.name) else [node.module]
            elif isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            yield from ((module, name) for name in names)


IMPORTS = sorted(imports())
OWN = [
    (module, name.removeprefix(f"{PACKAGE.name}."))
    for module, name in IMPORTS
    if name.startswith(f"{PACKAGE.name}.")
]


def part(name: str) -> str:
    return name.split(".")[0]


def test_each_part_imports_only_what_it_may():
    assert len(OWN) > 1000
    there = {path.stem for path in PACKAGE.iterdir()}
    assert set(MAY_IMPORT) <= there
    wrong = [
        (module, name)
        for module, name in OWN
        if part(module) in MAY_IMPORT
        and part(name) not in MAY_IMPORT[part(module)] | {part(module)}
    ]
    assert wrong == []


def test_no_modules_import_each_other_in_a_circle():
    """Not for types or in a function either; within `poles`, where numba fixes where classes are, they may."""
    modules = {module for module, _ in IMPORTS}
    below = defaultdict(set)
    for module, name in imports(everywhere=True):
        name = name.removeprefix(f"{PACKAGE.name}.")
        name = name if name in modules else name.rpartition(".")[0]
        if name in modules and (module, name) not in BACK and {part(module), part(name)} != {"poles"}:
            below[module].add(name)
    assert sum(map(len, below.values())) > 1000
    TopologicalSorter(below).prepare()  # CycleError names the modules of a circle


def test_the_simulated_robot_stands_by_itself():
    robot = [(module, name) for module, name in OWN if module.startswith("simulation.ur5e")]
    assert robot
    assert [pair for pair in robot if not pair[1].startswith(OF_THE_ROBOT)] == []


def test_libraries_stay_where_they_belong():
    found = {(part(module), part(name)) for module, name in IMPORTS if part(name) in LIBRARIES}
    assert {"numba", "rosbags", "can", "rclpy"} <= {library for _, library in found}
    assert [pair for pair in found if pair[0] not in LIBRARIES[pair[1]]] == []
