# SPDX-License-Identifier: Apache-2.0
"""The page of parameters, made of the configuration itself: values, marks and sources in one place.

``tools/run.sh python -m tactile_resonance.report.parameter_page > docs/parameters.md``
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from tactile_resonance.configuration import share_path

FILES = ("config/sensors/bimorph.yaml", "config/tissues.yaml")
NAMES = ("label", "gelatine_percent")  # they say which, not how much
HEAD = """# Parameters of the simulation

Made of `config/` by `tools/run.sh python -m tactile_resonance.report.parameter_page > docs/parameters.md`; a
test compares the two. To simulate the sensor you own, put its values into `config/sensors/bimorph.yaml`.

Marks: **S** read in the source named; **K** common knowledge, not re-checked; **C** chosen so that the
simulation shows what the paper shows (Oliva Uribe, Schoukens, Stroop, arXiv 1805.00682); **D** derived. Nothing
here was measured on a sensor or tissue by this project.
"""
_ENTRY = re.compile(
    r"^(?P<indent> *)(?P<key>\w+):(?: +(?P<value>[^#]*[^# ]))?(?: *# *(?P<note>.*))?$"
)
_MARK = re.compile(r"^(?P<mark>[SKCD]) {2,}(?P<text>.*)$")


@dataclass
class Entry:
    """One value of a configuration file.

    Attributes
    ----------
    name : str
        Its path in the file, with dots.
    value : str
        As it is written there.
    mark : str
        S, K, C, D; empty where the note before the entry states it.
    note : str
        The rest of its comment.
    """

    name: str
    value: str
    mark: str
    note: str


def read_entries(text: str) -> list[Entry | str]:
    """Return the values of a configuration file with their comments, and notes between them."""
    path: list[tuple[int, str]] = []
    found: list[Entry | str] = []
    for line in text.splitlines():
        stripped = line.strip()
        indent = len(line) - len(line.lstrip())
        if stripped.startswith("#"):
            comment = stripped.lstrip("# ")
            if indent == 0 and not path:
                continue  # head of the file: it says what HEAD says
            last = found[-1] if found else None
            if indent > 20 and isinstance(last, Entry):
                last.note = f"{last.note} {comment}"
            elif isinstance(last, str):
                found[-1] = f"{last} {comment}"
            else:
                found.append(comment)
            continue
        match = _ENTRY.match(line)
        if match is None:
            continue
        path = [step for step in path if step[0] < indent] + [(indent, match["key"])]
        if match["value"] is None or match["key"] in NAMES:
            continue
        note = match["note"] or ""
        marked = _MARK.match(note)
        mark, rest = (marked["mark"], marked["text"]) if marked else ("", note)
        if note in ("S", "K", "C", "D"):
            mark, rest = note, ""
        found.append(Entry(".".join(key for _, key in path), match["value"].strip(), mark, rest))
    return found


def parameter_page() -> str:
    """Return the page."""
    parts = [HEAD]
    for file in FILES:
        parts.append(f"## {file}\n")
        table = False
        for item in read_entries(share_path(file).read_text(encoding="utf-8")):
            if isinstance(item, str):
                parts.append(f"\n{item}\n")
                table = False
                continue
            if not table:
                parts.append("| Name | Value | Mark | Source, remark |\n|---|---|---|---|")
                table = True
            cells = (item.name, item.value, item.mark, item.note)
            parts.append(f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |")
        parts.append("")
    return "\n".join(parts)


if __name__ == "__main__":
    print(parameter_page(), end="")
