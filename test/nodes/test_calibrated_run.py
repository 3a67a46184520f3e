# SPDX-License-Identifier: Apache-2.0
"""`analyze RUN --calibration`: contacts of all points, after a check of the reference in air."""

import array
import json

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from dataclasses import replace

from rclpy.serialization import serialize_message

from tactile_resonance.calibration.model import CalibratedSensor, Calibration
from tactile_resonance.cli import main
from tactile_resonance.multisine import design_multisine
from tactile_resonance.nodes.messages import (
    excitation_to_message,
    poles_to_message,
    record_to_message,
)
from tactile_resonance.poles.estimator import identify_poles_from_records
from tactile_resonance.record import Origin
from tactile_resonance.scan.messages import make_message, to_cdr
from tactile_resonance.scan.point_result import POLES_TYPE, PointKind, PointResult
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.recorded import EXCITATION, RECORD
from tactile_resonance.scan.run_directory import RunDirectory
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.sensor.experiments import true_sensor
from tactile_resonance.simulation.tissue.library import read_tissues

START_NS = 1_700_000_000_000_000_000
TISSUES = ("gel10", "gel16")


def played(bench, tissue, key, periods=3):
    """Excitation of a measurement, and its records from rest."""
    excitation = design_multisine(
        samples_per_period=5000,
        band_hz=(200.0, 400.0),
        level_v=0.2,
        seed=key,
        periods=periods,
        measurement_id=key,
        excitation_id=key,
    )
    run = bench.start(tissue, seed=key)
    origin = Origin(key, key, START_NS, simulated=True)
    blocks = run.play(excitation, periods)
    return excitation, [replace(block, origin=origin) for block in blocks]


def write(recording, excitation, records):
    cdr = serialize_message(excitation_to_message(excitation, START_NS, "tip"))
    recording.write("/excitation", EXCITATION, START_NS, cdr)
    for k, record in enumerate(records):
        recording.write(
            "/record", RECORD, START_NS + k, serialize_message(record_to_message(record))
        )


def cdr_of(poles, origin):
    """Poles as they travel, their numbers and texts."""
    message = poles_to_message(poles, origin)
    content = {name: getattr(message, name) for name in message.get_fields_and_field_types()}
    kept = {
        name: np.array(value) if isinstance(value, array.array) else value
        for name, value in content.items()
        if isinstance(value, (array.array, str, int, float, bool))
    }
    return to_cdr(make_message(POLES_TYPE, **kept))


@pytest.fixture(scope="module")
def bench():
    return SimulatedBench.from_configuration()


@pytest.fixture(scope="module")
def run(bench, tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrated") / "run"
    plan = [ScanPoint(i, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)) for i in range(2)]
    library = read_tissues()
    with RunDirectory.create(folder, "name: x\n", plan, {}) as run:
        excitation, records = played(bench, None, 13, 4)
        u, y = (np.array([getattr(r, n).volts() for r in records]) for n in ("actuator", "sensor"))
        poles = identify_poles_from_records(
            u,
            y,
            sample_rate_hz=excitation.sample_rate_hz,
            harmonics=excitation.harmonics,
            band_hz=(200.0, 300.0),
        )
        with run.begin_reference("air-before") as recording:
            write(recording, excitation, records)
            recording.write("/poles", POLES_TYPE, START_NS + 9, cdr_of(poles, records[0].origin))
            recording.finish(PointResult(2, kind=PointKind.AIR, measurement_id=13))
        for index, name in enumerate(TISSUES):
            with run.begin_point(index) as recording:
                write(recording, *played(bench, library[name], 20 + index))
                recording.finish(
                    PointResult(
                        index, measurement_id=20 + index, force_n=0.01, force_std_n=1e-5, blocks=3
                    )
                )
    return folder


def sensor_file(bench, path, factor=1.0):
    """A calibration that is the truth, but for the frequencies."""
    model = true_sensor(bench)
    model = replace(model, natural_rad_s=factor * model.natural_rad_s)
    size = model.values.size
    known = Calibration(
        model, np.diag((1e-5 * model.values) ** 2), np.ones(size, bool), (10.0, 12e3), 3.2e-6, 1.0
    )
    path.write_text(CalibratedSensor(known, 0.0025, 7.7e-5, 1e-7, {}).as_text())
    return str(path)


def test_all_points_of_a_run(bench, run, tmp_path, capsys):
    sensor, output = sensor_file(bench, tmp_path / "sensor.yaml"), tmp_path / "contacts.json"
    assert main(["analyze", str(run), "--calibration", sensor, "--json", str(output)]) == 0
    text = capsys.readouterr().out
    assert "sensor in air: as calibrated" in text
    named = [line.split()[1].rstrip(":") for line in text.splitlines() if line.startswith("point ")]
    assert named == ["1", "2"]
    found = json.loads(output.read_text())
    assert list(found) == ["20", "21"]
    for content, name in zip(found.values(), TISSUES, strict=True):
        contact = bench.coupled(read_tissues()[name]).contact
        true = complex(contact.dynamic_stiffness(2j * np.pi * content["at_hz"]))
        off = complex(*content["stiffness_n_per_m"]) - true
        assert abs(off) < 4 * np.sqrt(np.trace(content["stiffness_total_covariance"]))
        assert content["status"] == "ok"
        assert content["moduli"]["storage_pa"] > 1e4  # the force is that of the run


def test_a_shifted_sensor_is_taken_along_and_a_changed_one_refused(bench, run, tmp_path, capsys):
    sensor = sensor_file(bench, tmp_path / "warm.yaml", 1.002)
    assert main(["analyze", str(run), "--calibration", sensor, "--measurement", "20"]) == 0
    text = capsys.readouterr().out
    assert "one mode shifted" in text
    assert "contradicts" not in text
    sensor = sensor_file(bench, tmp_path / "other.yaml", 1.05)
    assert main(["analyze", str(run), "--calibration", sensor]) == 1
    assert "calibrate it again" in capsys.readouterr().err
