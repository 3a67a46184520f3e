# SPDX-License-Identifier: Apache-2.0
"""The simulated robot knows nothing of the bench: it uses arithmetic, fields and kinds of arrays alone."""

import ast
from pathlib import Path

import tactile_resonance.simulation.ur5e

ALLOWED = {
    "tactile_resonance._typing",
    "tactile_resonance.contact.vectors",
    "tactile_resonance.fields",
    "tactile_resonance.simulation.noise",
}


def test_the_robot_imports_nothing_else_of_the_house():
    used = set()
    for file in Path(tactile_resonance.simulation.ur5e.__path__[0]).glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("tactile"):
                used.add(node.module)
    own = "tactile_resonance.simulation.ur5e"
    assert {name for name in used if not name.startswith(own)} == ALLOWED
