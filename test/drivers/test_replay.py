# SPDX-License-Identifier: Apache-2.0
"""What was recorded comes back as it was, in order, once, and with its gaps."""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.drivers.acquisition import DeviceError
from tactile_resonance.drivers.replay import ReplayDevice
from tactile_resonance.multisine import design_multisine
from tactile_resonance.poles.structure import PoleBand
from tactile_resonance.recording.store import RecordStore

sys.path.insert(0, str(Path(__file__).parent.parent / "recording"))
import stores
from stores import assert_same

ASKED = [design_multisine(label="asked for")]


def asked(measurement_id):
    return [design_multisine(measurement_id=measurement_id)]


def play(device, request=ASKED):
    """One measurement as a node would take it: plan, device, blocks per realisation."""
    planned = device.plan(request)
    info = device.configure(planned[0].sample_rate_hz)
    blocks = []
    for excitation in planned:
        device.play(excitation)
        blocks.append([device.read_block(1.0) for _ in range(excitation.periods)])
        device.stop()
    return planned, info, blocks


def test_a_store_comes_back_to_the_bit(tmp_path):
    excitations, records = stores.write(RecordStore(tmp_path), 7)
    planned, info, blocks = play(ReplayDevice(tmp_path, speed=0))
    for found, expected in zip(planned, excitations, strict=True):
        assert_same(found, expected)
    for block, record in zip([b for m in blocks for b in m], records, strict=True):
        assert_same(block, record)
    assert info.recorded


def test_poles_are_of_the_bands_recorded_or_else_of_those_asked_for(tmp_path):
    wanted, recorded = (PoleBand(300.0, 400.0),), (PoleBand(200.0, 300.0), PoleBand(400.0, 450.0))
    request = [design_multisine(bands=wanted)]
    for key, bands in ((1, ()), (2, recorded)):
        store = RecordStore(tmp_path / "store")
        (excitation,) = stores.excitations(key, realisations=1, periods=1)
        excitation = replace(excitation, bands=bands)
        store.begin([excitation])
        store.add_excitation(excitation)
        store.add_record(stores.record(excitation, 0))
    device = ReplayDevice(tmp_path / "store", speed=0)
    assert [play(device, request)[0][0].bands for _ in range(2)] == [wanted, recorded]
    multisine = design_multisine(sample_rate_hz=1000.0, samples_per_period=100, band_hz=(20.0, 200.0))
    u = np.tile(multisine.period(), (2, 1))
    np.savez(tmp_path / "m.npz", u=u, y=u, sample_rate_hz=1000.0)
    assert play(ReplayDevice(tmp_path / "m.npz", speed=0), request)[0][0].bands == wanted


def test_measurements_come_in_order_once_and_by_name(tmp_path):
    store = RecordStore(tmp_path)
    for key in (9, 7, 8):
        stores.write(store, key)
    device = ReplayDevice(tmp_path, speed=0)
    heard = [play(device)[0][0].measurement_id]
    # one out of turn changes nothing for the others
    assert play(device, asked(8))[0][0].measurement_id == 8
    # what was planned and not played is not used up
    device.plan(ASKED)
    heard += [play(device)[0][0].measurement_id for _ in range(2)]
    assert heard == [9, 7, 8]
    with pytest.raises(DeviceError, match="recording is over: all 3 measurements"):
        device.plan(ASKED)
    with pytest.raises(DeviceError, match="no measurement 3 in"):
        device.plan(asked(3))
    assert play(device, asked(7))[0][0].measurement_id == 7


def test_silent_and_driven_measurements_are_not_taken_for_each_other(tmp_path):
    store = RecordStore(tmp_path)
    silent = [
        replace(e, amplitude_v=np.zeros(e.harmonics.size)) for e in stores.excitations(6, 1, 2)
    ]
    store.begin(silent)
    store.add_excitation(silent[0])
    for block in range(2):
        store.add_record(stores.record(silent[0], block))
    stores.write(store, 7)
    driven = play(ReplayDevice(tmp_path, speed=0))[0][0]
    assert (driven.measurement_id, driven.level_v > 0) == (7, True)
    device = ReplayDevice(tmp_path, speed=0)
    nothing = [replace(ASKED[0], amplitude_v=np.zeros(ASKED[0].harmonics.size))]
    assert play(device, nothing)[0][0].measurement_id == 6
    assert play(device)[0][0].measurement_id == 7
    with pytest.raises(DeviceError, match="measurement 6 is silent, or the goal is"):
        device.plan(asked(6))


def test_an_early_end_is_played_to_its_end(tmp_path):
    store = RecordStore(tmp_path)
    planned = stores.excitations(7, realisations=3, periods=4)
    store.begin(stores.excitations(6))  # killed before its first record: passed over
    store.begin(planned)
    for excitation, periods in zip(planned[:2], (4, 2), strict=True):
        store.add_excitation(excitation)
        for block in range(periods):
            store.add_record(stores.record(excitation, block))
    found, _, blocks = play(ReplayDevice(tmp_path, speed=0))
    assert [(e.periods, e.realisation, e.realisations) for e in found] == [(4, 0, 2), (2, 1, 2)]
    assert [len(b) for b in blocks] == [4, 2]


def test_a_gap_is_an_error_where_it_comes(tmp_path):
    stores.write(RecordStore(tmp_path), 7, periods=4)
    (folder,) = tmp_path.iterdir()
    (folder / "record-00000-0000002.npz").unlink()
    device = ReplayDevice(tmp_path, speed=0)
    first, _ = device.plan(ASKED)
    device.play(first)
    assert [device.read_block(1.0).block_index for _ in range(2)] == [0, 1]
    with pytest.raises(DeviceError, match="block 3 of realisation 1 is missing"):
        device.read_block(1.0)
    (folder / "excitation-00000.npz").write_bytes(b"rubbish")
    with pytest.raises(DeviceError, match="excitation of realisation 1 is not readable"):
        ReplayDevice(tmp_path).plan(ASKED)


def test_calls_out_of_order_are_refused(tmp_path):
    stores.write(RecordStore(tmp_path), 7)
    device = ReplayDevice(tmp_path)
    for call in (
        lambda: device.configure(1.0),
        lambda: device.play(ASKED[0]),
        lambda: device.read_block(1.0),
    ):
        with pytest.raises(DeviceError, match="nothing"):
            call()
    device.stop()  # harmless
    (first, *_) = device.plan(ASKED)
    device.close()
    with pytest.raises(DeviceError, match="nothing planned"):
        device.play(first)


def test_speed_paces_the_blocks(tmp_path):
    stores.write(RecordStore(tmp_path), 7)  # periods of 40 ms
    fast = ReplayDevice(tmp_path, speed=0)
    fast.play(fast.plan(ASKED)[0])
    assert [fast.read_block(0.0).block_index for _ in range(3)] == [0, 1, 2]
    slow = ReplayDevice(tmp_path, speed=1e-3)  # the first block is due after 40 s
    slow.play(slow.plan(ASKED)[0])
    with pytest.raises(DeviceError, match="no block within 0.01 s"):
        slow.read_block(0.01)
    with pytest.raises(ValueError, match="speed: -1"):
        ReplayDevice(tmp_path, speed=-1)


@pytest.mark.parametrize("lines", [True, False])
def test_a_plain_file_is_one_measurement(tmp_path, lines):
    wanted = [
        design_multisine(
            sample_rate_hz=1000.0,
            samples_per_period=100,
            band_hz=(20.0, 200.0),
            realisation=realisation,
            seed=4,
        )
        for realisation in range(2)
    ]
    u = np.stack([np.tile(e.period(), (3, 1)) for e in wanted])  # (2, 3, 100)
    y = 0.1 * np.roll(u, 1, axis=-1)
    fields = {"excited_harmonics": wanted[0].harmonics} if lines else {}
    noise = 0 if lines else 1e-9 * np.random.default_rng(0).standard_normal(u.shape)
    u = u + noise
    np.savez(tmp_path / "m.npz", u=u, y=y, sample_rate_hz=1000.0, samples_per_period=100, **fields)
    before_ns = time.time_ns()
    device = ReplayDevice(tmp_path / "m.npz", speed=0)
    assert device.plan(asked(5))[0].measurement_id == 5
    with pytest.raises(DeviceError, match="or are driven"):
        device.plan([replace(ASKED[0], amplitude_v=0 * ASKED[0].amplitude_v)])
    planned, info, blocks = play(device)
    for found, expected in zip(planned, wanted, strict=True):
        np.testing.assert_array_equal(found.harmonics, expected.harmonics)
        np.testing.assert_allclose(found.period(), expected.period(), atol=1e-8)
        assert (found.periods, found.realisations, found.label) == (3, 2, "asked for")
        assert not found.random_phases  # the file does not say
        assert (found.measurement_id, found.excitation_id) == (0, 0)  # for the caller to give
    for realisation in range(2):
        for period, block in enumerate(blocks[realisation]):
            np.testing.assert_array_equal(block.actuator.volts(), u[realisation, period])
            np.testing.assert_array_equal(block.sensor.volts(), y[realisation, period])
            # nothing is known of where it was taken, and the tip of today is not it
            assert block.origin.contact.position_m is None
            assert np.isnan(block.origin.contact.force_n)
            assert block.origin.time_ns >= before_ns
            assert np.isnan(block.channel_delay_s)
            assert block.origin.frame_id == ""
    assert info.recorded
    with pytest.raises(DeviceError, match="recording is over"):
        device.plan(ASKED)


def test_where_the_machines_time_is_set_blocks_of_a_file_keep_to_the_monotonic_clock(
    tmp_path, monkeypatch
):
    excitation = design_multisine(sample_rate_hz=1000.0, samples_per_period=100, band_hz=(20.0, 200.0))
    u = np.tile(excitation.period(), (3, 1))
    np.savez(tmp_path / "m.npz", u=u, y=u, sample_rate_hz=1000.0)
    device = ReplayDevice(tmp_path / "m.npz", speed=0)
    (planned,) = device.plan(ASKED)
    device.play(planned)
    ahead_ns = time.time_ns() - time.monotonic_ns() + 3600 * 10**9
    monkeypatch.setattr(time, "time_ns", lambda: time.monotonic_ns() + ahead_ns)
    for n in range(3):
        begun_s = 1e-9 * (device.read_block(1.0).origin.time_ns - time.time_ns())
        assert begun_s == pytest.approx(n * excitation.period_s, abs=10.0)
    device.stop()


def test_a_file_that_names_no_period_is_refused(tmp_path):
    """As one period it would tell no noise."""
    excitation = design_multisine(sample_rate_hz=1000.0, samples_per_period=100, band_hz=(20.0, 200.0))
    u = np.tile(excitation.period(), 4)
    np.savez(tmp_path / "m.npz", u=u, y=0.1 * u, sample_rate_hz=1000.0)
    with pytest.raises(ValueError, match="samples_per_period"):
        ReplayDevice(tmp_path / "m.npz")


def test_what_is_no_recording_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no measurement in it"):
        ReplayDevice(tmp_path)
    with pytest.raises(OSError, match="nowhere"):
        ReplayDevice(tmp_path / "nowhere.npz")
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(ValueError, match="notes.txt: no record"):
        ReplayDevice(tmp_path / "notes.txt")
