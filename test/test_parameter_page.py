# SPDX-License-Identifier: Apache-2.0
"""docs/parameters.md says what config/ says, and every value has a source or a mark."""

from pathlib import Path

import pytest

from tactile_resonance.configuration import share_path
from tactile_resonance.report.parameter_page import FILES, Entry, parameter_page, read_entries

PAGE = Path(__file__).resolve().parent.parent / "docs" / "parameters.md"


def test_page_is_that_of_the_configuration():
    if not PAGE.exists():
        pytest.skip("the source tree's docs are not here")
    assert PAGE.read_text(encoding="utf-8") == parameter_page(), (
        "make it anew: tools/run.sh python -m tactile_resonance.report.parameter_page "
        "> docs/parameters.md"
    )


@pytest.mark.parametrize("file", FILES)
def test_every_value_has_its_mark(file):
    entries = [
        item
        for item in read_entries(share_path(file).read_text(encoding="utf-8"))
        if isinstance(item, Entry)
    ]
    assert len(entries) > 20
    assert [entry.name for entry in entries if entry.mark not in ("S", "K", "C", "D")] == []


def test_comments_are_read_with_their_values():
    text = "a:\n  # of all\n  b: [1, 2]   # S  a book\n" + " " * 25 + "#  page 3\n  label: x\n"
    note, value = read_entries(text)
    assert note == "of all"
    assert value == Entry("a.b", "[1, 2]", "S", "a book page 3")
