# SPDX-License-Identifier: Apache-2.0
"""Runs of earlier versions are read with the definitions in their files; what these lack is unknown."""

import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tactile_resonance.multisine import design_multisine
from tactile_resonance.record import ForceSpread
from tactile_resonance.scan.messages import make_message, message_types
from tactile_resonance.scan.point_result import TYPE as RESULT
from tactile_resonance.scan.point_result import serialised
from tactile_resonance.scan.recorded import EXCITATION, read_recorded, recorded_results
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.run_directory import RunDirectory

sys.path.insert(0, str(Path(__file__).resolve().parent))
from run_tables import RECORD, START_NS, plan, result

KEY, N = 7, 200
SPREAD = ("contact_force_rms_n", "contact_force_min_n", "contact_force_max_n")
LACKS_TODAY = ("contact_coverage", "contact_reason", *SPREAD)


def older(type_name, without=(), **kinds):
    """Definition of a version without some fields, or with some of another kind, and its types."""
    definition, _ = message_types().generate_msgdef(type_name, ros_version=2)
    own, *needed = definition.split("=" * 80 + "\n")
    lines = [line.split() for line in own.splitlines() if line.strip()]
    kept = [f"{kinds.get(name, kind)} {name}\n" for kind, name in lines if name not in without]
    assert len(kept) == len(lines) - len(without)
    text = ("=" * 80 + "\n").join(["".join(kept), *needed])
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, type_name))
    return text, store


def as_older(message, type_name, store):
    names = [name for name, _ in store.fielddefs[type_name][1]]
    return store.types[type_name](**{name: getattr(message, name) for name in names})


def excitation():
    made = design_multisine(
        sample_rate_hz=5000.0, samples_per_period=N, band_hz=(25.0, 1000.0), periods=2, seed=1
    )
    names = ("sample_rate_hz", "samples_per_period", "periods", "realisations", "seed")
    values = {name: getattr(made, name) for name in names}
    arrays = {name: getattr(made, name) for name in ("harmonics", "amplitude_v", "phase_rad")}
    arrays["harmonics"] = arrays["harmonics"].astype(np.uint32)
    return make_message(EXCITATION, measurement_id=KEY, grid=1, **values, **arrays)


def record(block):
    return make_message(
        RECORD,
        measurement_id=KEY,
        sample_rate_hz=5000.0,
        samples_per_period=N,
        block_index=block,
        final=block == 1,
        actuator_counts=np.arange(N, dtype=np.int32) + block,
        actuator_scale_v=1e-3,
        sensor_v=np.arange(N) * 1e-4,
        contact_force_n=0.01,
        contact_force_std_n=1e-4,
        contact_force_rms_n=2e-4,
        contact_force_min_n=0.009,
        contact_force_max_n=0.011,
        contact_coverage=1.0,
        contact_reason="not in older versions",
        label="hér",
    )


def write(path, messages, versions):
    """Write an MCAP file of (topic, type, message), with the definitions of `versions` by type."""
    with Writer(path.with_suffix(""), version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for k, (topic, name, message) in enumerate(messages):
            text, store = versions.get(name) or older(name)
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, name, msgdef=text, rihs01=store.hash_rihs01(name)
                )
            cdr = store.serialize_cdr(as_older(message, name, store), name)
            writer.write(connections[topic], START_NS + k, cdr)
    (path.with_suffix("") / path.name).rename(path)
    (path.with_suffix("") / "metadata.yaml").unlink()
    path.with_suffix("").rmdir()


def old_run(folder, **versions):
    """A run of two points, the first of them recorded by a version with other definitions."""
    versions = {{"Record": RECORD, "PointResult": RESULT}[k]: v for k, v in versions.items()}
    RunDirectory.create(folder, "name: x\n", plan(2), {"seed": 1}).close()
    cdr = serialised(result(0, measurement_id=KEY, repeats=2, notes="x"))
    messages = [
        ("/excitation", EXCITATION, excitation()),
        *(("/record", RECORD, record(block)) for block in range(2)),
        ("/point_result", RESULT, message_types().deserialize_cdr(cdr, RESULT)),
    ]
    write(folder / "recording" / "point-00000-00.mcap", messages, versions)
    return folder


def test_a_record_without_todays_fields_is_read_whole_and_they_are_unknown(tmp_path):
    run = old_run(tmp_path / "run", Record=older(RECORD, LACKS_TODAY))
    stored = read_recorded(run)
    assert (stored.problems, stored.measurement_id, len(stored.records)) == ((), KEY, 2)
    for block, read in enumerate(stored.records):
        np.testing.assert_array_equal(read.actuator.samples, np.arange(N) + block)
        np.testing.assert_array_equal(read.sensor.samples, np.arange(N) * 1e-4)
        contact = read.origin.contact
        # the label follows the fields that are lacking
        assert (contact.force_n, contact.force_std_n, read.origin.label) == (0.01, 1e-4, "hér")
        assert math.isnan(contact.coverage)
        assert contact.reason == ""
        assert np.isnan([contact.spread.rms_n, contact.spread.min_n, contact.spread.max_n]).all()


def test_what_todays_version_records_is_known(tmp_path):
    (first, _) = read_recorded(old_run(tmp_path / "run")).records
    assert first.origin.contact.coverage == 1.0
    assert first.origin.contact.reason == "not in older versions"
    assert first.origin.contact.spread == ForceSpread(2e-4, 0.009, 0.011)


def test_numbers_and_texts_of_a_result_that_were_not_recorded_are_unknown(tmp_path):
    version = older(RESULT, ("f0_shift_hz", "disturbances", "force_rms_n"))
    content = read_run(old_run(tmp_path / "run", PointResult=version))
    (read,) = content.results
    assert content.problems == ()
    assert math.isnan(read.f0_shift_hz)
    assert math.isnan(read.force_rms_n)
    assert (read.disturbances, read.repeats, read.notes) == ("", 2, "x")
    assert (read.index, read.f0_hz, read.damping_ratio) == (0, 250.0, 0.03)


def test_results_of_runs_without_kinds_and_poles_can_be_told(tmp_path):
    version = older(RESULT, ("kind", "poles"))
    (cdr,) = recorded_results(read_run(old_run(tmp_path / "run", PointResult=version)))
    told = message_types().deserialize_cdr(cdr, RESULT)
    assert (told.kind, told.poles, told.f0_hz, told.notes) == ("tissue", [], 250.0, "x")


@pytest.mark.parametrize(
    ("version", "message"),
    [
        (older(RESULT, ("repeats",)), r"PointResult: recorded by a version without .* repeats"),
        (older(RESULT, f0_hz="float32"), r"PointResult: .* whose field f0_hz has another type"),
    ],
)
def test_counts_are_not_made_up_and_other_kinds_not_read(tmp_path, version, message):
    content = read_run(old_run(tmp_path / "run", PointResult=version))
    assert content.results == ()
    (problem,) = content.problems
    assert problem.startswith("point-00000-00.mcap: tactile_resonance/msg/")
    assert re.search(message, problem)


def test_a_run_of_another_version_is_not_gone_on_with_and_stays_as_it_is(tmp_path):
    run = old_run(tmp_path / "run", Record=older(RECORD, LACKS_TODAY))
    (run / "point.part").touch()
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match=r"other definitions of tactile_resonance/msg/Record; acc"):
        RunDirectory.open(run)
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


def test_a_run_of_the_same_definitions_goes_on_as_one_bag(tmp_path):
    run = old_run(tmp_path / "run")
    with RunDirectory.open(run) as opened, opened.begin_point(1) as recording:
        recording.finish(result(1))
    with AnyReader([run / "recording"]) as reader:
        counts = {topic: info.msgcount for topic, info in reader.topics.items()}
        for connection, _, cdr in reader.messages():
            reader.deserialize(cdr, connection.msgtype)
    assert counts == {"/excitation": 1, "/record": 2, "/point_result": 2}
