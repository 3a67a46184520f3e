# SPDX-License-Identifier: Apache-2.0
"""Every shipped file of configuration, damaged at random: it is read, or refused in one line that names it."""

import copy
import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.hostile_targets import CONFIGURATION
from tactile_resonance.configuration import dump_yaml, parse_yaml, share_path
from tactile_resonance.fields import LONGEST
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.simulation.tissue.scene import read_scene

LIBRARY = read_tissues()
READERS = {**CONFIGURATION, "./scenes/*.yaml": lambda path: read_scene(LIBRARY, path)}
CASES = [
    pytest.param(reader, path, id=f"{pattern.split('/')[0]}-{path.name}")
    for pattern, reader in READERS.items()
    for path in sorted(share_path("config").glob(pattern))
]
VALUES = st.sampled_from(
    [None, True, 0, -1, 3, 1e300, -1e-300, 10**400, math.nan, math.inf, "", "x", "a\nb", "é" * 999]
    + [[], {}, [1], [[]], [1] * 7, ["x"], {"a": 1}, {"a": {}}, [{}], [[1, 2], [3]]]
)
TEXTS = st.text(st.sampled_from("ab01: \n-[]{}&*!?'\"|>#%@,.~<\t\0é"), max_size=8)


def places(content, path=()):
    """Path of everything in a content."""
    yield path
    pairs = content.items() if isinstance(content, dict) else ()
    for key, value in enumerate(content) if isinstance(content, list) else pairs:
        yield from places(value, (*path, key))


def damaged(content, path, value, how):
    """Content with something else at a path, without it, or with one more entry."""
    content = copy.deepcopy(content)
    *outer, last = path
    inner = content
    for key in outer:
        inner = inner[key]
    if how == "leave out":
        del inner[last]
    elif how == "add" and isinstance(inner[last], dict):
        inner[last]["one_more"] = value
    elif how == "add" and isinstance(inner[last], list):
        inner[last].append(value)
    else:
        inner[last] = value
    return content


def refusal(reader, path, text):
    """What a reader says of a file that holds a text; empty where it reads it."""
    path.write_text(text, encoding="utf-8")
    try:
        reader(path)
    except ValueError as error:
        return str(error)
    return ""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tmp_path_factory.mktemp("damaged") / "mine.yaml"


@pytest.mark.parametrize(("reader", "shipped"), CASES)
def test_a_damaged_file_is_read_or_refused_in_one_line(reader, shipped, file):
    original = shipped.read_text(encoding="utf-8")
    content = parse_yaml(original)
    assert refusal(reader, file, dump_yaml(content)) == ""
    whole = [path for path in places(content) if path]

    @settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
    @given(st.sampled_from(whole), VALUES, st.sampled_from(["replace", "leave out", "add"]))
    def by_value(path, value, how):
        check(refusal(reader, file, dump_yaml(damaged(content, path, value, how))))

    @settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
    @given(st.integers(0, len(original)), st.integers(0, 12), TEXTS)
    def by_text(start, length, text):
        check(refusal(reader, file, original[:start] + text + original[start + length :]))

    def check(said):
        assert "\n" not in said
        assert len(said) < 5 * LONGEST
        assert said == "" or "mine.yaml" in said

    by_value()
    by_text()
