# SPDX-License-Identifier: Apache-2.0
"""Every value of the simulation's configuration has a mark that says where it is from."""

import re

import pytest
import yaml

from tactile_resonance.configuration import share_path

NAMES = ("label", "gelatine_percent")  # they say which, not how much


def leaves(content):
    """Names of the values below a mapping."""
    for key, value in content.items():
        if isinstance(value, dict):
            yield from leaves(value)
        elif key not in NAMES:
            yield key


@pytest.mark.parametrize("file", ["config/sensors/bimorph.yaml", "config/tissues.yaml"])
def test_every_value_has_its_mark(file):
    text = share_path(file).read_text(encoding="utf-8")
    values = re.findall(r"^ *(\w+): +([^#\n]*[^# \n])(?: *#(.*))?$", text, re.MULTILINE)
    notes = [(name, note) for name, _, note in values if name not in NAMES]
    assert [name for name, _ in notes] == list(leaves(yaml.safe_load(text)))
    assert len(notes) > 20
    unmarked = [name for name, note in notes if not re.match(r" *[SKCD](  |$)", note)]
    assert unmarked == []
