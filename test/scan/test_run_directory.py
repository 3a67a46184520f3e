# SPDX-License-Identifier: Apache-2.0
"""A run's folder keeps every finished point, whatever happens, and any reader of bags can open it."""

import gc
import json
import os
import re
import signal
import struct
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from tactile_resonance.configuration import share_path
from tactile_resonance.scan.measurement import design_measurement
from tactile_resonance.scan.messages import make_message, message_types, to_cdr
from tactile_resonance.scan.point_file import offered_qos, read_content
from tactile_resonance.scan.point_result import COLUMNS, PointKind, PointOutcome
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.run_directory import RunDirectory, expected_bytes
from tactile_resonance.scan.scene import Output

sys.path.insert(0, str(Path(__file__).resolve().parent))
from bench_hands import scene
from run_tables import (
    POLES,
    RECORD,
    START_NS,
    as_csv,
    assert_same,
    plan,
    record_cdr,
    record_point,
    result,
    table_of,
)

SCENE = "name: test\nforce_n: 0.01\n"
KILLS = 20


def create(path, count=4, **values):
    return RunDirectory.create(path, SCENE, plan(count), {"seed": 1, **values})


def test_a_run_is_read_back_by_an_independent_reader(tmp_path):
    with create(tmp_path / "run") as run:
        for index in range(3):
            record_point(run, index, messages=2 + index)
        with run.begin_reference("air-before") as reference:
            reference.write("/excitation", RECORD, START_NS - 10**9, record_cdr(9))
            reference.finish(result(3, kind=PointKind.AIR, time_ns=START_NS - 10**9))
    with AnyReader([tmp_path / "run" / "recording"]) as reader:
        counts = {topic: info.msgcount for topic, info in reader.topics.items()}
        assert counts == {"/record": 2 + 3 + 4, "/point_result": 4, "/excitation": 1}
        heard = [
            (c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()
        ]
    # the reader made its types from the definitions in the files alone
    assert len(heard) == sum(counts.values())
    for topic, time_ns, message in heard:
        if topic == "/record":
            index = (time_ns - START_NS) // 10**9
            np.testing.assert_array_equal(
                message.actuator_counts, np.arange(200, dtype=np.int32) * 7 + index
            )
        elif topic == "/point_result":
            assert message.f0_hz == 250.0 + message.index


def test_definitions_in_the_files_are_those_of_the_package(tmp_path):
    with create(tmp_path / "run") as run:
        record_point(run, 0)
    with Reader(tmp_path / "run" / "recording" / "point-00000-00.mcap") as reader:
        text = {c.msgtype: c.msgdef.data for c in reader.connections}
    own = share_path("msg/Record.msg").read_text()
    fields = [line.split("#")[0].split() for line in own.splitlines() if line.split("#")[0].strip()]
    written = [
        line.split() for line in text[RECORD].split("=" * 80)[0].splitlines() if line.strip()
    ]
    assert [f[:2] for f in written if "=" not in "".join(f)] == [
        f[:2] for f in fields if "=" not in "".join(f)
    ]


def test_type_hashes_are_those_of_the_ros_build():
    msg = pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")
    from ament_index_python.packages import get_package_share_directory

    share = get_package_share_directory("tactile_resonance")
    for name in ("PointResult", "Poles", "Record", "FRF", "Excitation"):
        assert hasattr(msg, name)
        with open(f"{share}/msg/{name}.json") as file:
            hashes = json.load(file)["type_hashes"]
        by_name = {entry["type_name"]: entry["hash_string"] for entry in hashes}
        full = f"tactile_resonance/msg/{name}"
        assert message_types().hash_rihs01(full) == by_name[full]


def test_a_row_a_message_and_a_file_say_the_same(tmp_path):
    given = [
        result(0, reason='a "quoted", text', f0_hz=1 / 3),
        result(1, outcome=PointOutcome.FAILED, f0_hz=float("nan"), notes="tip wet", simulated=True),
    ]
    with create(tmp_path / "run") as run:
        for r in given:
            with run.begin_point(r.index) as recording:
                recording.finish(r)
    rows = table_of(tmp_path / "run")
    read = read_run(tmp_path / "run").latest
    for a, b, c in zip(given, rows, read, strict=True):
        assert_same(a, b)
        assert_same(a, c)
    # every field of the message but its poles is a column
    fields = [name for name, _ in message_types().fielddefs["tactile_resonance/msg/PointResult"][1]]
    columns = [c for c in COLUMNS if c not in ("time_ns", "frame_id")]
    assert ["header", *columns, "distortion", "poles"] == fields


def offers_of(path):
    """Texts in the metadata of the channels of an MCAP file: key and value, each after its length."""
    content = path.read_bytes()
    summary = content[
        int.from_bytes(content[-28:-20], "little") :
    ]  # not compressed; see the footer
    for found in re.finditer(b"offered_qos_profiles", summary):
        size = int.from_bytes(summary[found.end() : found.end() + 4], "little")
        yield summary[found.end() + 4 : found.end() + 4 + size].decode()


def test_replays_offer_what_the_nodes_offered(tmp_path):
    """As rosbag2 writes it, both where it reads: else a replayed topic is offered as volatile."""
    with create(tmp_path / "run") as run:
        with run.begin_reference("air-before") as reference:
            poles = to_cdr(make_message(POLES))
            reference.write("/poles", POLES, START_NS, poles, offered_qos(1024, latched=True))
            wrench = offered_qos(5, reliable=False)
            reference.write("/wrench", RECORD, START_NS, record_cdr(0), wrench)
            reference.finish(result(4, kind=PointKind.AIR))
        record_point(run, 0)
    path = tmp_path / "run" / "recording"
    content = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    in_yaml = {
        topic["topic_metadata"]["name"]: topic["topic_metadata"]["offered_qos_profiles"]
        for topic in content["topics_with_message_count"]
    }
    assert in_yaml["/record"] == []  # nobody said
    in_mcap = [yaml.safe_load(text) for text in offers_of(path / "reference-00-air-before.mcap")]
    forever = {"sec": 9223372036, "nsec": 854775807}
    for topic, reliability, durability, depth in (
        ("/poles", "reliable", "transient_local", 1024),
        ("/point_result", "reliable", "transient_local", 4096),
        ("/wrench", "best_effort", "volatile", 5),
    ):
        (profile,) = in_yaml[topic]
        assert [profile] in in_mcap
        assert profile == {
            "history": "keep_last",
            "depth": depth,
            "reliability": reliability,
            "durability": durability,
            "deadline": forever,
            "lifespan": forever,
            "liveliness": "automatic",
            "liveliness_lease_duration": forever,
            "avoid_ros_namespace_conventions": False,
        }


def test_an_attempt_more_replaces_the_row_and_keeps_the_file(tmp_path):
    with create(tmp_path / "run") as run:
        record_point(run, 0, outcome=PointOutcome.FAILED, reason="contact lost")
        record_point(run, 1)
        record_point(run, 0)
        assert [(r.index, r.attempt, r.outcome) for r in run.content.latest] == [
            (0, 1, PointOutcome.DONE),
            (1, 0, PointOutcome.DONE),
        ]
        assert run.content.next_point.index == 2
    names = sorted(path.name for path in (tmp_path / "run" / "recording").glob("*.mcap"))
    assert names == ["point-00000-00.mcap", "point-00000-01.mcap", "point-00001-00.mcap"]
    assert table_of(tmp_path / "run")[0].attempt == 1


def test_what_is_not_finished_leaves_nothing(tmp_path):
    with create(tmp_path / "run") as run:
        with run.begin_point(0) as recording:
            recording.write("/record", RECORD, START_NS, record_cdr(0))
        assert run.content.next_point.index == 0
        assert not list((tmp_path / "run" / "recording").glob("*.mcap"))


def test_refusals_leave_all_as_it_was(tmp_path):
    with create(tmp_path / "run") as run:
        record_point(run, 0)
        before = {p: p.read_bytes() for p in (tmp_path / "run").rglob("*") if p.is_file()}
        with pytest.raises(ValueError, match="holds something; accepted is a new or empty folder"):
            create(tmp_path / "run")
        with pytest.raises(ValueError, match="being recorded by another process"):
            RunDirectory.open(tmp_path / "run")
        assert before == {p: p.read_bytes() for p in (tmp_path / "run").rglob("*") if p.is_file()}
        with run.begin_point(1) as recording:
            with pytest.raises(ValueError, match="type_name: got 'a/msg/B'"):
                recording.write("/x", "a/msg/B", START_NS, b"")
            recording.write("/poles", RECORD, START_NS, record_cdr(1))
            with pytest.raises(ValueError, match="/poles has tactile_resonance/msg/Record"):
                recording.write("/poles", POLES, START_NS, record_cdr(1))
    with pytest.raises(ValueError, match="MB free, the run may take"):
        RunDirectory.create(tmp_path / "big", SCENE, plan(1), {}, needed_bytes=10**18)
    assert not (tmp_path / "big").exists()
    with pytest.raises(ValueError, match="cannot be read as a run"):
        RunDirectory.open(tmp_path)


def test_a_damaged_file_is_named_and_its_point_measured_again(tmp_path):
    with create(tmp_path / "run") as run:
        for index in range(3):
            record_point(run, index)
    path = tmp_path / "run" / "recording" / "point-00001-00.mcap"
    whole = path.read_bytes()
    for broken in (whole[: len(whole) // 2], b"", b"\0" * 100, whole[:-1]):
        path.write_bytes(broken)
        with RunDirectory.open(tmp_path / "run") as run:
            assert [problem.split(":")[0] for problem in run.content.problems] == [path.name]
            assert run.content.next_point.index == 1
    assert path.read_bytes() == whole[:-1]
    with RunDirectory.open(tmp_path / "run") as run:
        record_point(run, 1)
        assert run.content.next_point.index == 3
    with AnyReader([tmp_path / "run" / "recording"]) as reader:
        assert reader.message_count == 3 * 4


@pytest.mark.parametrize("gone", [False, True])
def test_where_the_newest_attempt_is_damaged_none_before_it_counts(tmp_path, gone):
    """It was made for the one before did not count: as of a contact that was lost, or repeated on request."""
    with create(tmp_path / "run") as run:
        for index in (0, 1, 1, 2):
            record_point(run, index)
    path = tmp_path / "run" / "recording" / "point-00001-01.mcap"
    if gone:
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:-1])
    with RunDirectory.open(tmp_path / "run") as run:
        assert [result.index for result in run.content.latest] == [0, 2]
        assert run.content.next_point.index == 1
        record_point(run, 1)
        assert run.content.next_point.index == 3
        assert [result.index for result in run.content.latest] == [0, 1, 2]
    assert [row.index for row in table_of(tmp_path / "run")] == [0, 1, 2]


def test_a_summary_with_a_record_of_no_length_is_refused_in_one_line(tmp_path):
    with create(tmp_path / "run") as run:
        record_point(run, 0)
    path = tmp_path / "run" / "recording" / "point-00000-00.mcap"
    content = bytearray(path.read_bytes())
    # the footer, before the magic: begin of the summary, begin of its offsets, checksum
    (summary,) = struct.unpack_from("<Q", content, len(content) - 8 - 20)
    assert content[summary] == 0x03  # a schema
    content[summary + 1 : summary + 9] = bytes(8)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"{path.name}: damaged or foreign file") as error:
        read_content(path)
    assert "\n" not in str(error.value)


def test_summaries_are_made_anew_from_the_files(tmp_path):
    with create(tmp_path / "run") as run:
        for index in range(3):
            record_point(run, index)
    recording = tmp_path / "run" / "recording"
    metadata, rows = (recording / "metadata.yaml"), tmp_path / "run" / "results.csv"
    before = metadata.read_bytes(), rows.read_bytes()
    metadata.unlink()
    rows.write_text("half a l")
    (recording / "metadata.yaml.part").write_text("rosbag2")
    with RunDirectory.open(tmp_path / "run"):
        pass
    assert (metadata.read_bytes(), rows.read_bytes()) == before
    assert not (recording / "metadata.yaml.part").exists()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_killed_at_any_moment_no_finished_point_is_lost_or_repeated(tmp_path):
    """`KILLS` kills with SIGKILL at random moments of recording, each followed by a resume."""
    random = np.random.default_rng(8)
    killed, in_the_midst, number = 0, 0, 0
    path = tmp_path / "run-0"
    create(path, 60).close()
    announced: set[int] = set()
    while killed < KILLS:
        told, ended = record_until_killed(path, float(random.uniform(0.0, 0.08)))
        assert not announced & told, "a finished point was recorded again"
        announced |= told
        killed += ended
        in_the_midst += any((path / ".unfinished").glob("*"))
        # whoever looks before the run goes on sees whole files only
        run = read_run(path)
        finished = {r.index for r in run.results}
        assert run.problems == ()
        assert announced <= finished
        assert len(finished - announced) <= 1  # finished, and killed before it could say so
        assert finished == set(range(len(finished)))
        with RunDirectory.open(path) as resumed:
            following = resumed.content.next_point
        assert (following.index if following else 60) == len(finished)
        announced = finished
        assert len(table_of(path)) == len(finished)
        assert (path / "results.csv").read_text() == as_csv(run.latest)
        with Reader(path / "recording") as reader:
            assert reader.message_count == 4 * len(finished)
            assert sum(1 for _ in reader.messages()) == 4 * len(finished)
        if following is None:
            number, announced = number + 1, set()
            path = tmp_path / f"run-{number}"
            create(path, 60).close()
    assert in_the_midst > KILLS / 3, "the kills did not meet a point being recorded"


def record_until_killed(path, after_s):
    """Indices that the recording process has told to be finished, and whether it was killed."""
    read_end, write_end = os.pipe()
    child = os.fork()
    if child == 0:  # the recorder: nothing of the test's own may run in it
        gc.disable()
        try:
            os.close(read_end)
            with RunDirectory.open(path) as run:
                os.write(write_end, b"\xff")
                while (point := run.content.next_point) is not None:
                    record_point(run, point.index)
                    os.write(write_end, bytes([point.index]))
        finally:
            os._exit(0)
    os.close(write_end)
    os.read(read_end, 1)  # it has opened the run
    time.sleep(after_s)
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    told = b""
    while chunk := os.read(read_end, 4096):
        told += chunk
    os.close(read_end)
    return set(told), os.WIFSIGNALED(status)


def test_expected_bytes_bounds_what_a_run_takes(tmp_path):
    samples, blocks = 20_000, 3
    design = design_measurement(scene(outputs=(Output.POLES, Output.FRF)))
    design = replace(design, periods=blocks)
    assert (design.samples, design.lines) == (samples, 3997)
    with create(tmp_path / "run", 2) as run:
        for index in range(2):
            with run.begin_point(index) as recording:
                for _ in range(blocks):
                    recording.write("/record", RECORD, START_NS, record_cdr(index, samples))
                recording.finish(result(index))
    taken = sum(path.stat().st_size for path in (tmp_path / "run").rglob("*") if path.is_file())
    assert 2 * blocks * 4 * samples < taken < expected_bytes(2, design)
