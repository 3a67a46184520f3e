# SPDX-License-Identifier: Apache-2.0
"""What docs/architecture.md and the list in README.md name is there."""

import re
from pathlib import Path

from tactile_resonance import cli

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = Path(cli.__file__).parent
PAGE = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")
PLACES = (ROOT, *(PACKAGE / name for name in ("", "poles", "simulation", "simulation/ur5e")))
"""From which a path on the page may start."""


def found(name):
    """File or folder of a path, with or without its ``.py``; None where there is none."""
    paths = (place / f"{name.rstrip('/')}{end}" for place in PLACES for end in ("", ".py"))
    return next(filter(Path.exists, paths), None)


def test_every_path_of_the_architecture_is_there():
    _, drawing, rest = PAGE.split("```")
    names = {*re.findall(r"`([\w./]+/[\w./]*)`", rest), *re.findall(r"[a-z_]+/[a-z_]+", drawing)}
    assert len(names) > 50
    missing = []
    for name in filter(lambda name: not found(name), names):
        module, _, inside = name.rpartition(".")  # as contact/interfaces.Cell
        path = found(module) if module else None
        if path is None or not re.search(rf"\b{inside}\b", path.read_text(encoding="utf-8")):
            missing.append(name)
    assert missing == []


def test_every_name_of_the_architecture_is_in_the_code():
    rest = PAGE.split("```")[2]
    names = set(re.findall(r"`([A-Za-z_]\w+)(?:\.\w+)?`", rest))
    code = "\n".join(path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py"))
    assert len(names) > 20
    assert [name for name in names if not (found(name) or re.search(rf"\b{name}\b", code))] == []


def test_every_part_of_the_package_is_in_the_list_of_the_readme():
    house = README.split("## The house")[1]
    parts = {
        path.name if path.is_file() else f"{path.name}/"
        for path in PACKAGE.iterdir()
        if (path.suffix == ".py" or (path / "__init__.py").is_file()) and path.stem != "__init__"
    }
    assert {part for part in parts if part not in house} == set()
