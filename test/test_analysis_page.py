# SPDX-License-Identifier: Apache-2.0
"""The Python in docs/analysis.md does what the page says."""

import re
from pathlib import Path

PAGE = Path(__file__).resolve().parents[1] / "docs" / "analysis.md"


def test_the_example_prints_what_the_page_states(capsys):
    text = PAGE.read_text(encoding="utf-8")
    (block,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    exec(compile(block, str(PAGE), "exec"), {})
    assert f"prints `{capsys.readouterr().out.strip()}`" in text
