# SPDX-License-Identifier: Apache-2.0
"""The one reader: of any file the object that was asked for, or one line that tells what is wrong."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated, Any, Literal

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from tactile_resonance._typing import FloatArray
from tactile_resonance.configuration import MOST_ALIASES, MOST_DEPTH, dump_yaml, parse_yaml
from tactile_resonance.fields import (
    LONGEST,
    MOST_BYTES,
    number,
    one_of,
    read,
    read_dataclass,
    read_file,
    read_yaml,
    require,
)


class Colour(Enum):
    RED = "red"
    BLUE = "blue"


@dataclass(frozen=True)
class Inner:
    low: float
    high: float = 1.0

    def __post_init__(self):
        require(self.low < self.high, "low", self.low, f"below high = {self.high:g}")


def read_doubled(value, name):
    return 2 * number(value, name)


@dataclass(frozen=True)
class Outer:
    name: str
    inner: Inner
    count: int = 3
    flag: bool = False
    colour: Colour = Colour.RED
    form: Literal["plane", "quadric"] = "plane"
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    several: tuple[Inner, ...] = ()
    named: Mapping[str, float] = field(default_factory=dict)
    perhaps: float | None = None
    table: FloatArray | None = None
    doubled: Annotated[float, read_doubled] = 0.0
    anything: Any = None
    from_: str = ""


LEAST = {"name": "a", "inner": {"low": 0}}


def test_every_kind_is_read():
    got = read_dataclass(
        Outer,
        LEAST
        | {"count": 4, "flag": True, "colour": "blue", "form": "quadric", "place": [1, 2, 3.5]}
        | {"several": [{"low": -1}, {"low": 1, "high": 2}], "named": {"x": 1}, "perhaps": 5}
        | {"table": [[1, 2], [3, 4], [5, 6]], "doubled": 2, "anything": [{}], "from": "x"},
        "",
    )
    assert got.inner == Inner(0.0)
    assert (got.count, got.flag, got.colour, got.form) == (4, True, Colour.BLUE, "quadric")
    assert got.place == (1.0, 2.0, 3.5)
    assert got.several == (Inner(-1.0), Inner(1.0, 2.0))
    assert got.from_ == "x"
    assert (got.named, got.perhaps, got.doubled, got.anything) == ({"x": 1.0}, 5.0, 4.0, [{}])
    np.testing.assert_array_equal(got.table, [[1, 2], [3, 4], [5, 6]])
    assert all(type(value) is float for value in (*got.place, got.inner.low, got.perhaps))
    assert read_dataclass(Outer, LEAST | {"perhaps": None}, "").perhaps is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"nam": 1}, "f.yaml: nam: got 1; accepted is one of anything, colour, "),
        ({"name": 3}, "f.yaml: name: got 3; accepted is text"),
        ({"inner": {}}, "f.yaml: inner.low: got None; accepted is a number (it is missing)"),
        ({"inner": [1]}, "f.yaml: inner: got [1]; accepted is a mapping"),
        ({"inner": {"low": 2}}, "f.yaml: inner.low: got 2.0; accepted is below high = 1"),
        ({"several": [LEAST["inner"], {"low": 2}]}, "several[1].low: got 2.0; accepted is below"),
        ({"several": [{"low": 0, "lo": 1}]}, "several[0].lo: got 1; accepted is one of high, low"),
        ({"count": 3.0}, "count: got 3.0; accepted is an integer"),
        ({"count": True}, "count: got True; accepted is an integer"),
        ({"flag": 1}, "flag: got 1; accepted is true or false"),
        ({"colour": "green"}, "colour: got 'green'; accepted is one of red, blue"),
        ({"colour": ["red"]}, "colour: got ['red']; accepted is one of red, blue"),
        ({"form": None}, "form: got None; accepted is one of plane, quadric"),
        ({"place": [1, 2]}, "place: got [1, 2]; accepted is a list of 3 numbers"),
        ({"place": [1, 2, "3"]}, "place[2]: got '3'; accepted is a finite number"),
        ({"place": "123"}, "place: got '123'; accepted is a list of 3 numbers"),
        ({"named": {"x": "y"}}, "named.x: got 'y'; accepted is a finite number"),
        ({"named": {1: 2}}, "named.1: got 1; accepted is text"),
        ({"perhaps": math.nan}, "perhaps: got nan; accepted is a finite number"),
        ({"perhaps": 10**400}, "perhaps: got 1000"),
        ({"table": [[1], [1, 2]]}, "table[1]: got (2,); accepted is shape (1,)"),
        ({"table": [[1], 2]}, "table[1]: got 2; accepted is a list of numbers"),
        ({"doubled": "x"}, "doubled: got 'x'; accepted is a finite number"),
        ({"a\nb": 1}, r"f.yaml: 'a\nb': got 1; accepted is one of"),
    ],
)
def test_what_is_wrong_is_named(change, message):
    with pytest.raises(ValueError, match=".") as caught:
        read_dataclass(Outer, LEAST | change, "f.yaml:")
    assert message in str(caught.value)


def test_what_a_field_that_is_missing_consists_of_is_told():
    told = "inner: got None; accepted is a mapping with low, high (it is missing)"
    with pytest.raises(ValueError, match=re.escape(told)):
        read_dataclass(Outer, {"name": "x"}, "")


def test_one_of_several_keys_names_the_kind():
    kinds = {"inner": Inner, "place": tuple[float, float]}
    assert one_of(kinds, {"inner": {"low": 0}}, "x") == ("inner", Inner(0.0))
    assert one_of(kinds, {"place": [1, 2], "n": 1}, "x", frozenset("n"))[1] == (1.0, 2.0)
    for wrong, message in (
        ({}, r"x: got \[\]; accepted is exactly one of inner, place"),
        ({"inner": {}, "place": []}, "x: got .*; accepted is exactly one of"),
        ({"plaice": 1}, "x.plaice: got 1; accepted is one of inner, place"),
        ({"inner": {"low": 2}}, "x.inner.low: got 2.0"),
    ):
        with pytest.raises(ValueError, match=message):
            one_of(kinds, wrong, "x")


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text("ab1.\n", max_size=9)
PLAIN = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(SCALARS, inner, max_size=3),
    max_leaves=6,
)
NAMES = st.sampled_from([*Outer.__dataclass_fields__, "from", "low", "high"])


@given(st.dictionaries(NAMES, PLAIN | st.dictionaries(NAMES, PLAIN, max_size=3), max_size=5))
def test_any_content_is_read_or_refused_in_one_line(content):
    got, refused = None, "f.yaml: accepted is"
    try:
        got = read_dataclass(Outer, LEAST | content, "f.yaml:")
    except ValueError as error:
        refused = str(error)
    assert refused.startswith("f.yaml: ")
    assert "\n" not in refused
    assert len(refused) < 5 * LONGEST
    assert "accepted is" in refused
    if got is not None:
        assert all(math.isfinite(value) for value in (got.inner.low, got.doubled, *got.place))


def same(a, b):
    """Equal in value and type, NaN included."""
    if type(a) is not type(b):
        return False
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(same, a, b))
    return a == b or a != a and b != b


# PyYAML does not write line breaks of Unicode so that it reads them again
TEXTS = st.text(st.characters(categories=["L", "N", "P", "S"]) | st.sampled_from(" \n"), max_size=9)
LIKE_NUMBERS = st.from_regex(r"[-+.0-9:eExo_]{1,6}", fullmatch=True)
WRITTEN = st.recursive(
    SCALARS | TEXTS | LIKE_NUMBERS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXTS, inner, max_size=4),
    max_leaves=6,
)


@given(WRITTEN)
def test_what_is_written_is_read_back_by_this_and_by_yaml_1_1(content):
    text = dump_yaml(content)
    assert same(parse_yaml(text), content)
    assert same(yaml.safe_load(text), content)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *[("10", 10), ("-3", -3), ("0", 0), ("0x1F", 31), ("0o17", 15), ("1e-3", 1e-3)],
        *[("1.", 1.0), (".5", 0.5), ("-1.5E+3", -1500.0), ("-.inf", -math.inf)],
        *[("1:30", "1:30"), ("1_000", "1_000"), ("no", "no"), ("2024-05-01", "2024-05-01")],
        *[("true", True), ("False", False), ("~", None), ("", None), ("'010'", "010")],
        *[("- &a [1]\n- *a", [[1], [1]]), ("<<: 1", {"<<": 1}), ("\ufeffa: 1", {"a": 1})],
    ],
)
def test_yaml_means_what_version_1_2_says(text, value):
    assert same(parse_yaml(text), value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("force_n: 1\nx: 2\nforce_n: 3", "line 3: got 'force_n' again; accepted is each key once"),
        ("1: a\n0x1: b", "line 2: got 1 again"),
        ("a: 010", "line 1: got 010; accepted is a number without zeros before it"),
        ("a: -007", "got -007"),
        (f"a: {'9' * 5000}", "got 5000 digits; accepted is at most 1000"),
        ("a: !!int 1", "got the tag tag:yaml.org,2002:int; accepted is no tag"),
        ("!!python/object:os.system {}", "the tag"),
        ("&a [*a]", "line 1: got .a; accepted is an anchor that stands before"),
        ("a: *b", "got .b; accepted is an anchor"),
        ("a: &a 1\nb: [" + "*a, " * (MOST_ALIASES + 1) + "]", "got one more alias"),
        ("? [1]\n: 2", "got a key of several parts; accepted is a name"),
        ("a\n---\nb", "line 2: got a second document; accepted is one"),
        ("[" * (MOST_DEPTH + 1), f"a deeper level; accepted is {MOST_DEPTH} levels"),
        ("- " * 200_000, "a deeper level"),
        ("{a: " * 200_000, "a deeper level"),
        ("a: [", "did not find|expected"),
        ("a: \0", "."),
        ("a:\n\t- b", "."),
    ],
)
def test_ambiguous_or_hostile_yaml_is_refused(text, message):
    with pytest.raises(ValueError, match=message) as caught:
        parse_yaml(text)
    assert "\n" not in str(caught.value)


@given(st.text(st.sampled_from("ab: \n-[]{}&*!?'\"|>#%@,0123.e~<"), max_size=60))
def test_any_text_is_parsed_or_refused_in_one_line(text):
    refused = ""
    try:
        parse_yaml(text)
    except ValueError as error:
        refused = str(error)
    assert "\n" not in refused


@pytest.mark.parametrize("depth", [5, MOST_ALIASES])
def test_lists_that_repeat_each_other_cost_nothing(depth):
    levels = [f"&a{i} [*a{i - 1}]" if i else "&a0 [1]" for i in range(depth + 1)]
    content = parse_yaml("\n".join(f"- {level}" for level in levels))
    with pytest.raises(ValueError, match=r"x: got \[\[1\]") as caught:
        read(float, content, "x")
    assert len(str(caught.value)) < 2 * LONGEST


def test_messages_are_short(tmp_path):
    path = tmp_path / "long.yaml"
    path.write_text(dump_yaml({"name": "n" * 10_000, "inner": {"low": "x" * 10_000}}))
    with pytest.raises(ValueError, match="inner.low: got 'xxx") as caught:
        read_file(Outer, path)
    assert len(str(caught.value)) < LONGEST + 100
    path.write_text(dump_yaml({"k" * 10_000: 1}))
    with pytest.raises(ValueError, match="kkk") as caught:
        read_file(Inner, path)
    assert len(str(caught.value)) < LONGEST + 100


def test_only_regular_files_of_sane_size_are_read(tmp_path):
    pipe, large = tmp_path / "pipe", tmp_path / "large.yaml"
    os.mkfifo(pipe)
    with open(large, "wb") as file:
        file.truncate(MOST_BYTES + 1)
    for path in ("/dev/zero", pipe, tmp_path):
        with pytest.raises(ValueError, match="accepted is a regular file"):
            read_yaml(path)
    with pytest.raises(ValueError, match="accepted is a file of at most 16 MiB"):
        read_yaml(large)
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"a: \xff\xfe")
    for path in (tmp_path / "absent.yaml", binary):
        with pytest.raises(ValueError, match=f"{path.name}: cannot be read"):
            read_yaml(path)
