# SPDX-License-Identifier: Apache-2.0
"""What CI compares with the figures kept: worse errors and counts fail, times never do."""

import json

import pytest

from benchmarks import overview
from benchmarks.overview import Value, compared

KEPT = {"error": 1.0, "silent": 0, "time": 2.0}


@pytest.fixture(autouse=True)
def kept(tmp_path, monkeypatch):
    path = tmp_path / "kept.json"
    path.write_text(json.dumps(KEPT))
    monkeypatch.setattr(overview, "KEPT", path)
    return path


def values(error=1.0, silent=0.0, time=2.0):
    return [
        Value("error", error, f"{error:g}", "error", "poles"),
        Value("silent", silent, f"{silent:g}", "count", "stability"),
        Value("time", time, f"{time:g}", "time", "frf"),
    ]


def test_figures_as_good_as_those_kept_pass():
    assert compared(values(error=1.1)) == ("error: 1.1\nsilent: 0\ntime: 2", True)


@pytest.mark.parametrize("changed", [{"error": 1.2}, {"silent": 1.0}])
def test_a_worse_error_or_one_more_silent_cell_fails(changed):
    text, good = compared(values(**changed))
    (name,) = changed
    assert not good
    assert [line for line in text.splitlines() if line.startswith("worse: ")] == [
        f"worse: {name}: {changed[name]:g}"
    ]


def test_a_slow_machine_is_stated_and_does_not_fail():
    assert compared(values(time=5.0))[1]
    assert "slower" not in compared(values(time=5.0))[0]
    text, good = compared(values(time=7.0))
    assert good
    assert text.endswith("slower: time: 7, 2 before")


def test_kept_figures_that_cannot_be_read_are_refused(kept):
    kept.write_text("{")
    with pytest.raises(ValueError, match="delete it to begin anew"):
        compared(values())
