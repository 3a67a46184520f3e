# SPDX-License-Identifier: Apache-2.0
"""What ROS serialises and a run keeps comes back bit by bit, without ROS."""

import dataclasses
import json
import os

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

import rclpy
from rclpy.serialization import serialize_message
from tactile_resonance.action import Measure

from tactile_resonance import msg
from tactile_resonance.cli import main
from tactile_resonance.drivers.acquisition import DeviceError
from tactile_resonance.multisine import Grid, design_multisine
from tactile_resonance.nodes.devices import PARAMETERS, make_device
from tactile_resonance.nodes.messages import excitation_to_message, record_to_message
from tactile_resonance.nodes.parameters import declare
from tactile_resonance.nodes.running import initialised
from tactile_resonance.processes import free_domain_id
from tactile_resonance.record import BetweenSamples, Channel, Contact, InputKind, Origin, Record
from tactile_resonance.recording import messages
from tactile_resonance.recording.store import recording_of
from tactile_resonance.scan.point_result import PointKind, PointResult
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.recorded import EXCITATION, RECORD, read_recorded
from tactile_resonance.scan.run_directory import RunDirectory

START_NS = 1_700_000_000_000_000_000
N, RATE_HZ = 2000, 5000.0


def same(a, b):
    if dataclasses.is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.tobytes() == b.tobytes()
    return a == b or (a != a and b != b)


def measurement(key):
    """Three blocks of one realisation, counts on one channel and volts on the other."""
    rng = np.random.default_rng(key)
    excitation = design_multisine(
        sample_rate_hz=RATE_HZ,
        samples_per_period=N,
        band_hz=(20.0, 1000.0),
        grid=Grid.ODD_RANDOM,
        seed=key,
        periods=3,
        measurement_id=key,
        excitation_id=key + 1,
        label="hér",
    )
    s, w0 = 1j * 2 * np.pi * excitation.frequency_hz, 2 * np.pi * 250
    g = 0.02 + 100 * s / (s**2 + 0.06 * w0 * s + w0**2)
    spectrum = excitation.spectrum()
    spectrum[excitation.harmonics] *= g
    y = np.fft.irfft(spectrum * N, N)
    contact = Contact(0.01, 1e-4, (0.1, 0.2, 0.3), (0.0, 0.0, 0.6, 0.8), "table", START_NS)
    records = [
        Record(
            actuator=Channel(np.round(excitation.period() / 3e-4).astype(np.int32), 3e-4, 1e-3),
            sensor=Channel(y + 1e-4 * rng.standard_normal(N), saturated=block == 1),
            sample_rate_hz=RATE_HZ,
            samples_per_period=N,
            block_index=block,
            input_kind=InputKind.MEASURED,
            between_samples=BetweenSamples.BAND_LIMITED,
            channel_delay_s=1e-6,
            anti_alias_filter="none",
            origin=Origin(key, key + 1, START_NS + block, block == 2, "tip", "hér", True, contact),
        )
        for block in range(3)
    ]
    return excitation, records


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded") / "run"
    plan = [ScanPoint(i, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)) for i in range(2)]
    with RunDirectory.create(folder, "name: x\n", plan, {}) as run:
        # free air, taken before the points
        excitation, records = measurement(13)
        with run.begin_reference("air-before") as recording:
            times_ns = START_NS - 10**9 + np.arange(4)
            cdr = serialize_message(excitation_to_message(excitation, START_NS, "tip"))
            recording.write("/left/excitation", EXCITATION, int(times_ns[3]), cdr)
            for time_ns, record in zip(times_ns.tolist(), records, strict=False):
                recording.write(
                    "/left/record", RECORD, time_ns, serialize_message(record_to_message(record))
                )
            recording.finish(PointResult(2, kind=PointKind.AIR, measurement_id=13))
        for index, key in enumerate((11, 12)):
            excitation, records = measurement(key)
            with run.begin_point(index) as recording:
                cdr = serialize_message(excitation_to_message(excitation, START_NS, "tip"))
                recording.write("/left/excitation", EXCITATION, START_NS, cdr)
                for k, record in enumerate(records):
                    cdr = serialize_message(record_to_message(record))
                    recording.write("/left/record", RECORD, START_NS + k, cdr)
                result = PointResult(index, measurement_id=key, time_ns=START_NS + 10 * (index + 1))
                recording.finish(result)
    return folder


def test_excitation_and_records_come_back_bit_by_bit(run):
    for key in (11, 12):
        excitation, records = measurement(key)
        back = read_recorded(run, key)
        assert same(
            back.excitations[0],
            dataclasses.replace(excitation, harmonics=back.excitations[0].harmonics),
        )
        np.testing.assert_array_equal(back.excitations[0].harmonics, excitation.harmonics)
        assert len(back.records) == 3
        assert all(same(a, b) for a, b in zip(back.records, records, strict=True))
        assert back.gaps == back.problems == ()


def test_a_replay_plays_the_run_again_bit_by_bit(run):
    given = {"device": "replay", "device_config": run, "replay_speed": 0.0}
    arguments = [part for name, value in given.items() for part in ("-p", f"{name}:={value}")]
    with initialised(args=["--ros-args", *arguments], domain_id=free_domain_id(os.environ)):
        node = rclpy.create_node("replay_test")
        declare(node, PARAMETERS)
        device, _ = make_device(node)
        node.destroy_node()
    for key in (13, 11, 12):  # in the order in which they were taken
        excitation, records = measurement(key)
        (planned,) = device.plan([design_multisine(label="asked for")])
        assert planned.measurement_id == key
        device.configure(planned.sample_rate_hz)
        device.play(planned)
        blocks = [device.read_block(1.0) for _ in range(planned.periods)]
        device.stop()
        assert same(planned.phase_rad, excitation.phase_rad)
        for block, record in zip(blocks, records, strict=True):
            assert same(block.actuator, record.actuator)
            assert same(block.sensor, record.sensor)
            assert same(block.origin.contact, record.origin.contact)
    with pytest.raises(DeviceError, match="recording is over: all 3 measurements"):
        device.plan([design_multisine()])


def test_analyze_reads_a_run(run, tmp_path, capsys):
    output = tmp_path / "out.json"
    arguments = ["analyze", str(run), "--measurement", "11", "--band", "200", "300"]
    assert main([*arguments, "--json", str(output)]) == 0
    (pole,) = json.loads(output.read_text())["poles"]
    assert pole["f0_hz"] == pytest.approx(250, abs=5 * np.sqrt(pole["covariance"][0][0]))
    assert recording_of(read_recorded(run, 11)).u.shape == (1, 3, N)
    assert main(["analyze", str(run)]) == 1
    assert "not given" in capsys.readouterr().err
    assert main(["analyze", str(run), "--measurement", "5"]) == 1
    known = "holds 13 (reference-00-air-before), 11 (point 1), 12 (point 2)"
    assert known in capsys.readouterr().err


def test_analyze_takes_a_point_of_a_run(run, tmp_path, capsys):
    output = tmp_path / "out.json"
    arguments = ["analyze", str(run), "--band", "200", "300", "--json", str(output)]
    found = []
    for which in (["--measurement", "12"], ["--point", "2"]):
        assert main([*arguments, *which]) == 0
        assert "\nstatus: ok\n" in capsys.readouterr().out
        found.append(json.loads(output.read_text())["poles"])
    assert found[0] == found[1]
    assert main([*arguments, "--point", "3"]) == 1
    assert f"point (--point): 3, measured points of {run} are 1, 2" in capsys.readouterr().err
    assert main([*arguments, "--point", "2", "--measurement", "12"]) == 1
    assert "beside --measurement" in capsys.readouterr().err


def test_numbers_of_the_core_are_the_constants_of_the_messages():
    for grid, number in messages.GRIDS.items():
        assert number == getattr(msg.Excitation, f"GRID_{grid.name}")
        asked = getattr(Measure.Goal, f"GRID_{grid.name}", 0)  # 0: the node's parameter
        assert asked == number
    for kind, number in messages.INPUT_KINDS.items():
        assert number == getattr(msg.Record, f"INPUT_{kind.name}")
    for between, number in messages.BETWEEN_SAMPLES.items():
        assert number == getattr(msg.Record, between.name)
