# SPDX-License-Identifier: Apache-2.0
"""One name, one thing: who reads a name of a class need not ask which of two is meant."""

import ast
from collections import Counter
from pathlib import Path

from tactile_resonance import cli


def test_no_two_classes_have_one_name():
    names = Counter(
        node.name
        for path in Path(cli.__file__).parent.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef)
    )
    assert len(names) > 200
    assert [name for name, count in names.items() if count > 1] == []
