# SPDX-License-Identifier: Apache-2.0
"""What a device read is on disk, whole and bit-exact, or named as missing."""

import errno
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.record import Channel, Contact, Origin, Record
from tactile_resonance.recording.store import (
    RecordStore,
    StoredMeasurement,
    read_measurement,
    read_stored,
    recording_of,
    write_stored,
)

sys.path.insert(0, str(Path(__file__).parent))
import stores
from stores import assert_same, read_store

STATED = (
    "simulated, not measured",
    "actuator saturated",
    "the sensor channel is 3.33333e-07 s behind the actuator channel, as the records state: it is taken out "
    "only where channel_delay_s (--channel-delay) gives it",
)
"""By the records of `stores` of themselves."""


def recording_in(folder, measurement_id=None, periods=None):
    return recording_of(read_measurement(folder, measurement_id), periods)


def test_everything_comes_back_to_the_bit(tmp_path):
    store = RecordStore(tmp_path / "not" / "yet" / "there")
    written = [stores.write(store, key) for key in (9, 7)]
    content = read_store(store.folder)
    assert content.problems == []
    # in the order they were measured, whatever their ids
    assert [m.measurement_id for m in content.measurements] == [9, 7]
    for measurement, (excitations, records) in zip(content.measurements, written, strict=True):
        assert measurement.gaps == ()
        assert len(measurement.excitations) == len(excitations)
        assert len(measurement.records) == len(records)
        for found, expected in zip(measurement.excitations, excitations, strict=True):
            assert_same(found, expected)
        for found, expected in zip(measurement.records, records, strict=True):
            assert_same(found, expected)


@pytest.mark.parametrize(
    "channel",
    [
        Channel(np.array([-128, 127], np.int32), 0.1),
        Channel(np.array([-129, 0], np.int32), 0.1),
        Channel(np.array([2**31 - 1, -(2**31)], np.int32), 0.1),
        Channel(np.array([-0.0, np.nan, np.inf, 5e-324])),
        Channel(np.array([0.1, -0.0], np.float32)),
    ],
)
def test_any_channel_comes_back_to_the_bit(tmp_path, channel):
    # nothing known but the samples: NaN, None and empty text stay what they are
    record = Record(channel, channel, 10.0, 2)
    write_stored(tmp_path / "r.npz", record)
    assert_same(read_stored(tmp_path / "r.npz", Record), record)


def test_large_ids_come_back(tmp_path):
    record = Record(Channel(np.zeros(2)), Channel(np.zeros(2)), 10.0, 2)
    record = replace(record, origin=Origin(measurement_id=2**64 - 1, contact=Contact(time_ns=-1)))
    write_stored(tmp_path / "r.npz", record)
    assert_same(read_stored(tmp_path / "r.npz", Record), record)


def test_an_origin_that_is_known_after_the_samples_is_that_of_the_file(tmp_path):
    record = stores.record(stores.excitations()[0], 0)
    contact = Contact(0.0101, 2e-5, (0.1, 0.0, 0.3), frame_id="base", coverage=0.9)
    whole = replace(record, origin=replace(record.origin, contact=contact))
    before = replace(record, origin=replace(record.origin, contact=Contact(reason="not asked yet")))
    write_stored(tmp_path / "r.npz", before, origin=lambda: whole.origin)
    assert_same(read_stored(tmp_path / "r.npz", Record), whole)


def test_counts_take_the_smallest_type(tmp_path):
    for top, dtype in ((127, np.int8), (128, np.int16), (2**15, np.int32)):
        counts = Channel(np.array([0, top], np.int32))
        write_stored(tmp_path / "r.npz", Record(counts, counts, 10.0, 2))
        with np.load(tmp_path / "r.npz") as archive:
            assert archive["sensor.samples"].dtype == dtype


def test_samples_of_another_type_are_refused(tmp_path):
    channel = Channel(np.zeros(2, np.uint16))
    with pytest.raises(ValueError, match="actuator.samples: values of type uint16"):
        write_stored(tmp_path / "r.npz", Record(channel, channel, 10.0, 2))
    assert list(tmp_path.iterdir()) == []


def test_damage_is_named_and_never_read_as_data(tmp_path):
    """A flipped bit or a cut leaves either the very same record or a refusal with the name."""
    path = tmp_path / "record-00000-0000000.npz"
    expected = stores.record(stores.excitations()[0], 0)
    write_stored(path, expected)
    whole = path.read_bytes()
    rng = np.random.default_rng(1)
    spoilt = [whole[:length] for length in rng.integers(0, len(whole), 40)]
    for bit in rng.integers(0, 8 * len(whole), 500):
        content = bytearray(whole)
        content[bit // 8] ^= 1 << (bit % 8)
        spoilt.append(bytes(content))
    refusals = []
    for content in spoilt:
        path.write_bytes(content)
        try:
            assert_same(read_stored(path, Record), expected)
        except ValueError as error:
            refusals.append(str(error))
    assert len(refusals) > len(spoilt) / 2
    for refusal in refusals:
        assert refusal.startswith("record-00000-0000000.npz: damaged or foreign file")
        assert "\n" not in refusal


def test_rest_is_read_beside_damaged_and_foreign_files(tmp_path):
    store = RecordStore(tmp_path)
    stores.write(store, 7)
    stores.write(store, 8)
    first, second = sorted(tmp_path.iterdir())
    (first / "record-00000-0000001.npz").write_bytes(b"PK\x03\x04 rubbish")
    (first / "excitation-00001.npz").write_bytes(b"")
    shutil.copy(first / "record-00000-0000000.npz", second / "record-00000-0000002.npz")
    np.savez(second / "holiday.npz", u=np.zeros(3))
    (second / "record-00001-0000003.npz.part").write_bytes(b"begun")  # what kill -9 may leave
    (tmp_path / "README").write_text("notes")
    content = read_store(tmp_path)
    assert [len(m.records) for m in content.measurements] == [5, 5]
    assert [len(m.excitations) for m in content.measurements] == [1, 2]
    assert [m.gaps for m in content.measurements] == [((0, 1),), ((0, 2),)]
    named = "\n".join(content.problems)
    assert len(content.problems) == 5
    for name in (
        "README",
        "000001-7/record-00000-0000001.npz",
        "000001-7/excitation-00001.npz",
        "000002-8/record-00000-0000002.npz: holds what belongs to (7, 0, 0)",
        "000002-8/holiday.npz",
    ):
        assert name in named


def test_gaps_are_found_and_an_early_end_is_none(tmp_path):
    store = RecordStore(tmp_path)
    stores.write(store, 7, realisations=3, periods=4)
    (folder,) = tmp_path.iterdir()

    def lose(*places):
        for realisation, block in places:
            (folder / f"record-{realisation:05d}-{block:07d}.npz").unlink()

    lose((2, 3), (2, 2))
    assert read_store(tmp_path).measurements[0].gaps == ()
    lose((0, 1), (1, 3))
    assert read_store(tmp_path).measurements[0].gaps == ((0, 1), (1, 3))
    lose((1, 0), (1, 1), (1, 2))
    expected = ((0, 1), *((1, block) for block in range(4)))
    assert read_store(tmp_path).measurements[0].gaps == expected


def test_recording_holds_the_complete_realisations(tmp_path):
    store = RecordStore(tmp_path)
    _, records = stores.write(store, 7, realisations=3, periods=4)
    (folder,) = tmp_path.iterdir()
    whole = recording_in(tmp_path)
    assert whole.u.shape == whole.y.shape == (3, 4, stores.SAMPLES)
    assert whole.notes == STATED
    for found, record in zip(whole.u.reshape(12, -1), records, strict=True):
        np.testing.assert_array_equal(found, record.actuator.volts())
    np.testing.assert_array_equal(whole.excited_harmonics, stores.excitations()[0].harmonics)

    (folder / "record-00001-0000002.npz").unlink()
    part = recording_in(tmp_path)
    np.testing.assert_array_equal(part.y, whole.y[[0, 2]])
    assert part.notes == ("realisation 2 left out: 2 of 4 consecutive periods are there", *STATED)
    # the periods before the gap serve where so many are enough
    short = recording_in(tmp_path, periods=2)
    np.testing.assert_array_equal(short.y, whole.y[:, :2])
    assert short.notes == STATED


def test_recording_of_an_early_end(tmp_path):
    store = RecordStore(tmp_path)
    planned = stores.excitations(7, realisations=3, periods=4)
    store.begin(planned)
    store.add_excitation(planned[0])
    for block in range(3):
        store.add_record(stores.record(planned[0], block))
    with pytest.raises(ValueError, match="no complete realisation .*3 of 4 consecutive periods"):
        recording_in(tmp_path, periods=4)
    recording = recording_in(tmp_path, periods=3)
    assert recording.u.shape == (1, 3, stores.SAMPLES)
    assert recording.notes == ("1 of 3 realisations were played", *STATED)
    whole = recording_in(tmp_path)
    np.testing.assert_array_equal(whole.y, recording.y)
    ended = "the measurement ended after 3 of 4 periods"
    assert whole.notes == (ended, "1 of 3 realisations were played", *STATED)


def test_a_block_that_was_lost_is_no_early_end(tmp_path):
    stores.write(RecordStore(tmp_path), 7, realisations=1, periods=4)
    (folder,) = tmp_path.iterdir()
    (folder / "record-00000-0000002.npz").unlink()
    found = recording_in(tmp_path)
    assert found.u.shape == (1, 2, stores.SAMPLES)
    lost = "2 of 4 consecutive periods are used: block 3 of realisation 1 is missing"
    assert found.notes == (lost, *STATED)


def test_a_block_whose_channels_differ_in_length_is_lost_and_shifts_nothing(tmp_path):
    _, records = stores.write(RecordStore(tmp_path), 7, realisations=1, periods=4)
    excitation = stores.excitations(realisations=1, periods=4)[0]
    short = replace(records[2].sensor, samples=records[2].sensor.samples[:-1])
    cut = [*records[:2], replace(records[2], sensor=short), records[3]]
    found = recording_of(StoredMeasurement.of(7, [excitation], cut, []))
    np.testing.assert_array_equal(found.y[0], [record.sensor.volts() for record in records[:2]])
    n = stores.SAMPLES
    differ = f"block 3 of realisation 1: {n} samples of the actuator, {n - 1} of the sensor, expected as many"
    assert found.notes[:2] == (
        differ,
        "2 of 4 consecutive periods are used: block 3 of realisation 1 is missing",
    )


def test_what_records_say_of_themselves_is_noted_and_nothing_else():
    excitation = stores.excitations(realisations=1, periods=1)[0]
    record = stores.record(excitation, 0)
    measured = replace(record.origin, simulated=False)
    actuator = replace(record.actuator, saturated=False)
    plain = replace(record, actuator=actuator, channel_delay_s=0.0, origin=measured)
    for channel_delay_s in (0.0, np.nan):
        of = StoredMeasurement.of(7, [excitation], [replace(plain, channel_delay_s=channel_delay_s)], [])
        assert recording_of(of).notes == ()
    sensed = replace(plain, sensor=replace(plain.sensor, saturated=True))
    assert recording_of(StoredMeasurement.of(7, [excitation], [sensed], [])).notes == ("sensor saturated",)


def test_one_of_several_measurements_must_be_chosen(tmp_path):
    with pytest.raises(ValueError, match="no measurement in it"):
        recording_in(tmp_path)
    store = RecordStore(tmp_path)
    stores.write(store, 12)
    _, records = stores.write(store, 11)
    with pytest.raises(ValueError, match="not given, .* holds 12, 11"):
        recording_in(tmp_path)
    with pytest.raises(ValueError, match="measurement_id: 13, .* holds 12, 11"):
        recording_in(tmp_path, 13)
    found = recording_in(tmp_path, 11)
    np.testing.assert_array_equal(found.y[0, 0], records[0].sensor.volts())


def test_what_does_not_fit_is_refused_with_figures(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)._replace(free=2_000_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    store = RecordStore(tmp_path)
    with pytest.raises(ValueError, match="has 2 MB free, the measurement may take 3[0-9] MB"):
        store.begin(stores.excitations(periods=1000))
    assert list(tmp_path.iterdir()) == []
    store.begin(stores.excitations(periods=10))


def test_a_measurement_is_never_overwritten(tmp_path):
    stores.write(RecordStore(tmp_path), 7)
    with pytest.raises(ValueError, match="measurement_id: 7 is in .* already"):
        RecordStore(tmp_path).begin(stores.excitations(7))
    with pytest.raises(ValueError, match="measurement_id: 8, expected one that was begun"):
        RecordStore(tmp_path).add_record(stores.record(stores.excitations(8)[0], 0))


def test_what_is_safe_elsewhere_is_removed_and_nothing_else(tmp_path):
    stores.write(RecordStore(tmp_path), 6)
    store = RecordStore(tmp_path)
    for key in (7, 8, 9):
        stores.write(store, key)
    for key in (6, 8, 9, 9, 1234):  # 6 is from an earlier session, 1234 nobody's
        store.remove(key)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000001-6", "000002-7"]
    with pytest.raises(ValueError, match="measurement_id: 9 is in .* already"):
        store.begin(stores.excitations(9))
    stores.write(store, 10)
    assert [m.measurement_id for m in read_store(tmp_path).measurements] == [6, 7, 10]
    assert sorted(path.name for path in tmp_path.iterdir())[-1] == "000005-10"


def test_a_measurement_costs_the_same_however_many_a_store_has_had(tmp_path, monkeypatch):
    looked = []
    listed = Path.iterdir
    monkeypatch.setattr(Path, "iterdir", lambda path: looked.append(path) or listed(path))
    store = RecordStore(tmp_path / "store")
    for key in range(1, 30):
        store.begin(stores.excitations(key))
    assert len(looked) == 1


def test_a_failed_write_leaves_nothing_that_looks_whole(tmp_path, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    store = RecordStore(tmp_path)
    planned = stores.excitations()
    store.begin(planned)
    store.add_excitation(planned[0])
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space left"):
            store.add_record(stores.record(planned[0], 0))
    (measurement,) = read_store(tmp_path).measurements
    assert measurement.records == ()
    assert [p.name for p in next(tmp_path.iterdir()).iterdir()] == ["excitation-00000.npz"]


def test_what_was_handed_out_stays_where_the_disk_fails_then(tmp_path, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    def gone():
        raise RuntimeError("the publisher is gone")

    store, told = RecordStore(tmp_path), []
    planned = stores.excitations()
    store.begin(planned)
    store.add_excitation(planned[0])
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space left"):
            store.add_record(stores.record(planned[0], 0), lambda: told.append(0))
    with pytest.raises(RuntimeError, match="publisher"):
        store.add_record(stores.record(planned[0], 1), gone)
    (measurement,) = read_store(tmp_path).measurements
    assert told == [0]
    for block, record in enumerate(measurement.records):
        assert_same(record, stores.record(planned[0], block))
    assert len(measurement.records) == 2


WRITER = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import stores
from tactile_resonance.recording.store import RecordStore
store = RecordStore(Path(sys.argv[2]))
(excitation,) = stores.excitations(7, realisations=1, periods=100000)
store.begin([excitation])
store.add_excitation(excitation)
for block in range(excitation.periods):
    store.add_record(stores.record(excitation, block), lambda: print(block, flush=True))
"""


@pytest.mark.parametrize("said", [1, 3, 10, 37])
def test_kill_leaves_every_block_that_was_told(tmp_path, said):
    folder = Path(__file__).resolve().parent
    environment = os.environ | {"PYTHONPATH": str(folder.parent.parent)}
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, folder, tmp_path],
        stdout=subprocess.PIPE,
        env=environment,
        text=True,
    )
    for line in writer.stdout:
        if int(line) >= said:
            break
    writer.send_signal(signal.SIGKILL)
    told = [int(line), *(int(rest) for rest in writer.stdout.read().split())]
    writer.wait()
    content = read_store(tmp_path)
    assert content.problems == []
    (measurement,) = content.measurements
    assert measurement.gaps == ()
    # the last one may be whole on disk without having been told
    assert len(measurement.records) in (told[-1] + 1, told[-1] + 2)
    for block, record in enumerate(measurement.records):
        assert_same(record, stores.record(measurement.excitations[0], block))
