# SPDX-License-Identifier: Apache-2.0
"""What a point of a long run costs does not depend on how many are finished: counted, not timed."""

import os
import pathlib
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.scan import run_directory
from tactile_resonance.scan.hands import Controls
from tactile_resonance.scan.messages import message_types
from tactile_resonance.scan.point_result import TYPE, from_message
from tactile_resonance.scan.pole_map import GrowingMap
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.run_directory import RunDirectory
from tactile_resonance.scan.runner import ScanRunner

sys.path.insert(0, str(Path(__file__).resolve().parent))
from bench_hands import Bench, begin, scene
from run_tables import assert_same, plan, result

SHORT, LONG, COUNTED = 24, 150, 8
"""Points of a short and of a long run; the last so many are counted."""
MORE = LONG - SHORT
COUNTED_IN = (str(Path(run_directory.__file__).parents[1]), pathlib.__file__)
"""The package, and what looks through folders."""


class Instructions:
    """Counts those of Python in `COUNTED_IN` while it is on, of functions that are called from then on."""

    def __init__(self):
        self.count, self._before = 0, sys.gettrace()

    def on(self):
        sys.settrace(self._each)

    def off(self):
        sys.settrace(self._before)

    def _each(self, frame, event, _):
        if not frame.f_code.co_filename.startswith(COUNTED_IN):
            return None
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        self.count += event == "opcode"
        return self._each


@pytest.fixture
def no_disk(monkeypatch):
    """Nothing waits for the disk."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


def cost_of_last(points, path):
    """Instructions and bytes of each of the last points of a scan, bag metadata left out."""
    scan_plan, run = begin(path, scene(points))
    counted, heard, counts, sizes = Instructions(), GrowingMap(), [], []

    def publish(cdr):
        counted.off()
        heard.take(from_message(message_types().deserialize_cdr(cdr, TYPE)))
        counts.append(counted.count)
        sizes.append([(path / name).stat().st_size for name in ("index.jsonl", "results.csv")])
        if points - COUNTED <= len(heard) < points:
            counted.on()

    with run:
        # metadata are written again after each twentieth of the points: what that costs is told apart
        run._listed = 10 * points
        ScanRunner(scan_plan, run, Bench(), Controls(), lambda progress: None, 1, publish).run()
    shown = [point.result for point in heard.map.points]
    for one, other in zip(shown, read_run(path).latest, strict=True):
        assert_same(one, other)
    last = slice(points - COUNTED + 1, points + 1)  # the first is of the reference before
    return np.diff(counts)[last], np.diff(sizes, axis=0)[last]


def test_a_point_of_a_long_scan_costs_what_one_of_a_short_one_does(tmp_path, no_disk):
    early, few = cost_of_last(SHORT, tmp_path / "short")
    late, many = cost_of_last(LONG, tmp_path / "long")
    assert np.median(early) > 1000
    assert np.median(late) - np.median(early) < MORE  # less than an instruction per finished point
    assert np.all(
        np.median(many, axis=0) <= 1.02 * np.median(few, axis=0)
    )  # numbers have more digits


def test_a_point_of_a_resumed_run_costs_the_same_again(tmp_path, no_disk):
    costs = []
    for points in (SHORT, LONG):
        path, counted, counts = tmp_path / str(points), Instructions(), [0]
        with RunDirectory.create(path, "name: x\n", plan(points), {}) as run:
            for index in range(points - COUNTED):
                with run.begin_point(index) as recording:
                    recording.finish(result(index))
        with RunDirectory.open(path) as run:
            for _ in range(COUNTED):
                run._listed = 10 * points
                counted.on()
                index = run.next_point.index
                with run.begin_point(index) as recording:
                    recording.finish(result(index, recording.attempt))
                counted.off()
                counts.append(counted.count)
            assert run.finished == len(run.content.latest) == points
        costs.append(np.median(np.diff(counts)))  # the first looks for where it goes on
    assert costs[0] > 1000
    assert costs[1] - costs[0] < MORE


def test_what_a_run_directory_counts_is_what_is_read_from_its_files(tmp_path, no_disk):
    random = np.random.default_rng(3)
    with RunDirectory.create(tmp_path / "run", "name: x\n", plan(12), {}) as run:
        for _ in range(30):
            index = int(random.integers(12))
            with run.begin_point(index) as recording:
                repeats = int(random.integers(3))
                recording.finish(replace(result(index, recording.attempt), repeats=repeats))
            read = read_run(tmp_path / "run")
            for one, other in zip(run.content.results, read.results, strict=True):
                assert_same(one, other)
            assert run.finished == len(read.latest)
            assert run.next_point == read.next_point
            assert run.repeats == sum(each.repeats for each in read.results)


def test_a_map_takes_a_point_at_the_same_cost_however_many_it_has():
    grown, costs = GrowingMap(), []
    for index in range(3000):
        counted = Instructions()
        if index % 500 > 480:
            counted.on()
        grown.take(result(index, measurement_id=1 + index))
        counted.off()
        costs.append(counted.count)
    counts = np.array(costs).reshape(-1, 500)[:, 481:]
    assert 100 < np.max(counts) <= 1.02 * np.min(counts)
