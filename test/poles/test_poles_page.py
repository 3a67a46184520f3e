# SPDX-License-Identifier: Apache-2.0
"""One table of the page on poles renewed, the others as they were."""

import argparse
from pathlib import Path

import pytest

from benchmarks import poles
from tactile_resonance.commands import benchmark

PAGE = Path(poles.__file__).parents[1] / "docs" / "benchmarks" / "poles.md"


@pytest.mark.parametrize("part", poles.PARTS)
def test_other_tables_stay(part, tmp_path, monkeypatch):
    before = PAGE.read_text(encoding="utf-8")
    (tmp_path / "poles.md").write_text(before, encoding="utf-8")
    monkeypatch.setattr(poles, "_measured", lambda name, *_: [f"## New {name}", ""])
    new = poles.run(tmp_path, quick=False, part=part).split("\n## ")
    old = before.split("\n## ")
    assert len(new) == len(old) == 1 + len(poles.PARTS)
    changed = [k for k in range(1, len(old)) if old[k].strip() != new[k].strip()]
    assert changed == [1 + poles.PARTS.index(part)]
    assert new[changed[0]].startswith(f"New {part}")


def test_only_poles_has_parts():
    parser = argparse.ArgumentParser()
    benchmark.add_parser(parser.add_subparsers())
    options = parser.parse_args(["benchmark", "frf", "--part", "grid"])
    with pytest.raises(ValueError, match="--part: got 'grid'; accepted is with poles only"):
        options.run(options)
