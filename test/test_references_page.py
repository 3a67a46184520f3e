# SPDX-License-Identifier: Apache-2.0
"""The commands in docs/references.md are there, with the options that the page gives them."""

import re
from pathlib import Path

import pytest

from tactile_resonance import cli

PAGE = Path(__file__).resolve().parents[1] / "docs" / "references.md"
COMMANDS = re.findall(
    r"^    tools/run\.sh tactile_resonance (.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE
)


def test_the_page_has_commands():
    assert len(COMMANDS) == 5


@pytest.mark.parametrize("command", COMMANDS)
def test_options_of_the_page_are_those_of_the_command(command, capsys):
    words = command.split()
    name = words[:2] if words[0] == "references" else words[:1]
    with pytest.raises(SystemExit, match="0"):
        cli.main([*name, "--help"])
    told = capsys.readouterr().out
    for option in words:
        if option.startswith("--"):
            assert option in told
    for scene in re.findall(r"config/scenes/\S+", command):
        assert (PAGE.parents[1] / scene).is_file()
