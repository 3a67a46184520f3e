# SPDX-License-Identifier: Apache-2.0
"""``results.csv`` as it grows is the table of all results, and holds no formula."""

import csv
import sys
from dataclasses import replace
from pathlib import Path

from tactile_resonance.frf.result import BandDistortion
from tactile_resonance.scan.point_result import BandResult, ResultsFile

sys.path.insert(0, str(Path(__file__).resolve().parent))
from run_tables import as_csv, result


def test_a_file_that_grows_is_the_table_of_the_latest_attempts(tmp_path):
    wider = replace(result(3), further=(BandResult(600.0, 800.0, f0_hz=703.0),))
    distorted = replace(result(4), distortion=(BandDistortion(200.0, 300.0, *range(1, 5)),))
    grown, latest = ResultsFile(tmp_path), {}
    for each in (result(0), result(2), result(1), wider, result(2, 1), distorted, result(5)):
        latest[each.index] = each
        in_order = [latest[index] for index in sorted(latest)]
        grown.add(each, lambda rows=in_order: rows)
        assert (tmp_path / "results.csv").read_text() == as_csv(in_order)


def test_a_file_that_is_taken_away_in_mid_scan_comes_back_whole(tmp_path):
    grown, both = ResultsFile(tmp_path), [result(0), result(1)]
    grown.add(both[0], lambda: both[:1])
    (tmp_path / "results.csv").unlink()
    grown.add(both[1], lambda: both)
    assert (tmp_path / "results.csv").read_text() == as_csv(both)


def test_a_text_is_no_formula_and_a_number_stays_one():
    given = replace(result(0), reason="=1+1", label="@x", notes="-1", f0_hz=-1.5)
    head, row = csv.reader(as_csv([given]).splitlines())
    cells = dict(zip(head, row, strict=True))
    assert [cells[name] for name in ("reason", "label", "notes")] == ["'=1+1", "'@x", "'-1"]
    assert float(cells["f0_hz"]) == -1.5
