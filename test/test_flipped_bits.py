# SPDX-License-Identifier: Apache-2.0
"""No flipped bit of a run's file, or of a record beside it, changes in silence what is read."""

from collections import Counter

import pytest

from benchmarks.hostile_flips import flips_of, places_in
from tactile_resonance.scan.run_content import PLAN_DAMAGED, read_run
from tactile_resonance.scan.run_directory import RunDirectory

FLIPS = 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("flips")


@pytest.fixture(scope="module")
def places(folder):
    return places_in(folder)


@pytest.mark.parametrize("number", range(8))
def test_no_flipped_bit_is_silent(places, number):
    found = flips_of(places[number], FLIPS, 100 + number)
    assert found.total() == FLIPS
    assert found["silent"] == 0
    assert found != Counter({"without effect": FLIPS})


def test_no_scan_goes_on_with_a_plan_that_was_changed(places, folder):
    run = folder / "run"
    plan = run / "run.json"
    whole = plan.read_text()
    plan.write_text(whole.replace("0.002", "0.003"))
    found = read_run(run)
    assert found.problems == (PLAN_DAMAGED,)
    assert len(found.results) == 3
    with pytest.raises(ValueError, match="run.json: differs from what was written"):
        RunDirectory.open(run)
    plan.write_text(whole)
    assert read_run(run).problems == ()
    RunDirectory.open(run).close()
