# SPDX-License-Identifier: Apache-2.0
"""A run knows when one of its files is damaged, and its index never stands in the way."""

import base64
import json
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Reader, ReaderError

from tactile_resonance.scan import point_file
from tactile_resonance.scan.point_result import PointKind
from tactile_resonance.scan.recorded import recorded_results
from tactile_resonance.scan.run_content import INDEX, entry_of, read_run
from tactile_resonance.scan.run_directory import RunDirectory

sys.path.insert(0, str(Path(__file__).resolve().parent))
from run_tables import RECORD, START_NS, assert_same, plan, record_cdr, record_point, result

FLIPS = 300


def recorded(path, count=3):
    """A run of some points and a reference."""
    with RunDirectory.create(path, "name: test\nforce_n: 0.01\n", plan(count), {}) as run:
        with run.begin_reference("air-before") as reference:
            reference.write("/excitation", RECORD, START_NS - 10**9, record_cdr(9))
            reference.finish(result(count, kind=PointKind.AIR, time_ns=START_NS - 10**9))
        for index in range(count):
            record_point(run, index)
    return path


def assert_all_same(a, b):
    assert len(a) == len(b)
    for one, other in zip(a, b, strict=True):
        assert_same(one, other)


def flipped(path, random):
    """Content with one bit of it flipped."""
    content = bytearray(path.read_bytes())
    content[random.integers(len(content))] ^= 1 << int(random.integers(8))
    return bytes(content)


def test_no_flipped_bit_of_a_recording_is_silent(tmp_path):
    run, random = recorded(tmp_path / "run"), np.random.default_rng(21)
    whole = read_run(run)
    files = sorted((run / "recording").glob("*.mcap"))
    assert (len(files), whole.problems, whole.unchecked) == (4, (), 0)
    for path in [files[k] for k in random.integers(len(files), size=FLIPS)]:
        before = path.read_bytes()
        path.write_bytes(flipped(path, random))
        found = read_run(run)
        path.write_bytes(before)
        (problem,) = found.problems
        assert problem == f"{path.name}: differs from what was finished (checksum)"
        assert {file.name for file in found.files} == {p.name for p in files} - {path.name}
        left = [r for r in whole.results if f"point-{r.index:05d}" not in path.name]
        assert_all_same(found.results, left)


def test_no_flipped_bit_of_the_index_changes_a_result(tmp_path):
    """Its line is named and left out, and the file read in its place, compared with its own checksums."""
    run, random = recorded(tmp_path / "run"), np.random.default_rng(22)
    whole, index = read_run(run), run / INDEX
    before = index.read_bytes()
    for _ in range(FLIPS // 10):
        index.write_bytes(flipped(index, random))
        found = read_run(run)
        assert_all_same(found.results, whole.results)
        assert found.files == whole.files
        torn = not index.read_bytes().endswith(b"\n")  # as an interruption leaves it
        assert torn or all(text.startswith("index.jsonl: line ") for text in found.problems)
        assert len(found.problems) == (not torn)  # a flipped end of line takes the next one with it
        assert found.unchecked == 0
        index.write_bytes(before)


def test_no_flipped_bit_of_a_file_without_its_index_is_silent(tmp_path):
    """Of a file that was copied out of its run, or whose index is lost: it holds checksums itself."""
    run, random = recorded(tmp_path / "run"), np.random.default_rng(23)
    (run / INDEX).unlink()
    files = sorted((run / "recording").glob("*.mcap"))
    assert (read_run(run).problems, read_run(run).unchecked) == ((), 0)
    for path in [files[k] for k in random.integers(len(files), size=FLIPS)]:
        before = path.read_bytes()
        path.write_bytes(flipped(path, random))
        (problem,) = read_run(run).problems
        path.write_bytes(before)
        assert problem.startswith(f"{path.name}: damaged or foreign file (")
    for size in (0, 1, 8, 20, len(before) // 2, len(before) - 1):
        path.write_bytes(before[:size])
        (problem,) = read_run(run).problems
        assert problem.startswith(f"{path.name}: damaged or foreign file (")


def test_rosbags_reads_no_sample_that_does_not_agree_with_its_chunk(tmp_path):
    """Its reader compares what is there; it writes no checksums itself."""
    run = recorded(tmp_path / "run", 1)
    path = run / "recording" / "point-00000-00.mcap"
    samples = record_cdr(0)[-400:]
    whole = path.read_bytes()
    at = whole.index(samples) + 200
    path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    with pytest.raises(ReaderError, match="Chunk checksum mismatch"), Reader(path) as reader:
        list(reader.messages())


def test_files_of_earlier_versions_are_read_and_said_not_to_be_checked(tmp_path, monkeypatch):
    monkeypatch.setattr(point_file, "write_checksums", lambda path: None)
    run = recorded(tmp_path / "run")
    assert read_run(run).unchecked == 0  # the index has theirs
    (run / INDEX).unlink()
    assert (read_run(run).problems, read_run(run).unchecked) == ((), 4)


def test_a_changed_scene_and_a_missing_file_are_named(tmp_path):
    run = recorded(tmp_path / "run")
    (run / "scene.yaml").write_text("name: tist\nforce_n: 0.01\n")
    (run / "recording" / "point-00001-00.mcap").unlink()
    found = read_run(run)
    assert found.problems == (
        "point-00001-00.mcap: finished, but no longer there",
        "scene.yaml: differs from what was finished (checksum)",
    )
    assert found.next_point.index == 1


@pytest.mark.parametrize("text", ["name: test\nforce_n: 0.02\n", "name: test\nforce_n: 0.015\n"])
def test_no_scan_goes_on_with_another_scene(tmp_path, text):
    """Points of two forces would be those of one scene."""
    run = recorded(tmp_path / "run")
    scene, whole = run / "scene.yaml", (run / "scene.yaml").read_text()
    scene.write_text(text)
    with pytest.raises(ValueError, match=r"scene.yaml: .*; accepted is the scene with which the run began"):
        RunDirectory.open(run)
    assert len(read_run(run).latest) == 3  # it is read all the same
    scene.write_text(whole)
    RunDirectory.open(run).close()


def test_results_and_messages_from_the_index_are_those_of_the_files(tmp_path):
    run = recorded(tmp_path / "run")
    with_index = read_run(run)
    messages = list(recorded_results(with_index))
    (run / INDEX).unlink()  # as of an earlier version
    without = read_run(run)
    assert (with_index.unchecked, without.unchecked) == (0, 0)
    assert_all_same(with_index.results, without.results)
    assert with_index.files == without.files
    assert list(recorded_results(without)) == messages


def test_what_an_interruption_left_in_the_index_is_mended(tmp_path):
    run = recorded(tmp_path / "run", 2)
    index, last = run / INDEX, run / "recording" / "point-00001-00.mcap"
    whole = index.read_bytes()
    last.rename(tmp_path / "never had its name")
    assert read_run(run).problems == ()
    with RunDirectory.open(run) as again:
        assert again.content.next_point.index == 1
        record_point(again, 1)
    assert len(index.read_bytes().splitlines()) == len(whole.splitlines())
    index.write_bytes(index.read_bytes() + b"12345678 {half a l")
    with RunDirectory.open(run) as again:
        record_point(again, 0)  # a second attempt, whose line begins where the torn one stood
    found = read_run(run)
    assert (found.problems, found.unchecked) == ((), 0)
    assert [(r.index, r.attempt) for r in found.results] == [(0, 0), (0, 1), (1, 0)]


def test_half_a_first_line_does_not_swallow_the_next(tmp_path):
    """A run of an earlier version, whose first point since was interrupted."""
    run = recorded(tmp_path / "run", 2)
    (run / INDEX).write_bytes(b"12345678 {half a l")
    with RunDirectory.open(run) as again:
        record_point(again, 0)
    found = read_run(run)
    assert (len(found.files), found.problems) == (4, ())


JUNK = (None, -1, 2**70, 0.5, True, "x", "a" * 5000, "../../x.mcap", [], [1], {}, {"name": 1})


def lines_of(run):
    """JSON of an index."""
    return [json.loads(line.partition(b" ")[2]) for line in (run / INDEX).read_bytes().splitlines()]


def places(value, way=()):
    """Ways to all that JSON holds."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, each in items:
        yield (*way, key)
        if isinstance(each, (dict, list)):
            yield from places(each, (*way, key))


def write_lines(run, lines):
    texts = [json.dumps(line).encode() for line in lines]
    (run / INDEX).write_bytes(b"".join(b"%08x %s\n" % (zlib.crc32(t), t) for t in texts))


def test_an_index_that_anyone_wrote_with_good_checksums_stops_nobody(tmp_path):
    """What a line says wrongly is a problem by name, or its file is read in its place."""
    run = recorded(tmp_path / "run", 1)
    lines, whole = lines_of(run), read_run(run)
    for way in places(lines):
        for junk in JUNK:
            changed = json.loads(json.dumps(lines))
            at = changed
            for key in way[:-1]:
                at = at[key]
            at[way[-1]] = junk
            write_lines(run, changed)
            found = read_run(run)
            assert len(found.results) == 1 or found.problems
            assert len(list(recorded_results(found))) == len(found.files)
    cdr = base64.b64decode(lines[-1]["point_result"])
    for cut in (0, 1, len(cdr) // 2, len(cdr) - 1):
        lines[-1]["point_result"] = base64.b64encode(cdr[:cut]).decode()
        write_lines(run, lines)
        assert_all_same(read_run(run).results, whole.results)


def test_a_result_of_another_point_in_the_index_is_named(tmp_path):
    run = recorded(tmp_path / "run", 2)
    lines = lines_of(run)
    lines[-1]["point_result"] = lines[-2]["point_result"]
    write_lines(run, lines)
    (problem,) = read_run(run).problems
    assert problem == "point-00001-00.mcap: holds point and attempt (0, 0)"


def test_checksum_is_that_of_other_tools(tmp_path):
    """The check value of CRC-32/ISO-HDLC (Williams, A painless guide to CRC error detection, 1993)."""
    (tmp_path / "file").write_bytes(b"123456789")
    assert entry_of(tmp_path / "file", "file").crc32 == 0xCBF43926
