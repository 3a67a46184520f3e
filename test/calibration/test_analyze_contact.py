# SPDX-License-Identifier: Apache-2.0
"""Records to contacts through the front door and the command."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from calibration.played import contact_of, run_on

import tactile_resonance as tr
from benchmarks.calibrate_benches import BAND_HZ, excitation
from tactile_resonance.calibration.contact import ContactStatus, Law
from tactile_resonance.calibration.model import CalibratedSensor
from tactile_resonance.cli import main
from tactile_resonance.commands.analyze import _pressed
from tactile_resonance.scan.point_result import PointResult
from tactile_resonance.scan.run_content import RunContent
from tactile_resonance.simulation.sensor.bimorph import CoupledBimorph, sensor_model

FORCE_N = 0.01


@pytest.fixture(scope="module")
def sensor_file(fitted, bench, tmp_path_factory):
    path = tmp_path_factory.mktemp("sensor") / "mine.yaml"
    nan = float("nan")
    content = CalibratedSensor(fitted.calibration, bench.sensor.tip.radius_m, nan, nan, {})
    path.write_text(content.as_text())
    return path


def recording_on(bench, contact, duration_s, periods, seed=1) -> tr.Recording:
    signal = excitation(duration_s)
    block = run_on(bench, contact, seed).block(signal, periods)
    return tr.make_recording(
        block.actuator.volts(),
        block.sensor.volts(),
        sample_rate_hz=signal.sample_rate_hz,
        samples_per_period=signal.samples_per_period,
        excited_harmonics=signal.harmonics,
    )


@pytest.mark.parametrize(("duration_s", "periods", "rest"), [(0.02, 1, True), (0.1, 6, False)])
def test_the_front_door_gives_the_contact(bench, library, sensor_file, duration_s, periods, rest):
    contact = contact_of(bench, library["gel16"])
    recording = recording_on(bench, contact, duration_s, periods)
    found = tr.estimate_contact(
        recording, sensor_file, band_hz=BAND_HZ, force_n=FORCE_N, from_rest=rest
    )
    k = complex(contact.dynamic_stiffness(2j * np.pi * found.poles.f0_hz[0]))
    off = found.contact.stiffness_n_per_m - k
    assert abs(off) < 4 * np.sqrt(np.trace(found.contact.stiffness_total))
    assert found.black_box is None
    assert found.moduli.status.value == "ok"
    assert found.warnings == ()


def test_one_period_needs_a_known_start(bench, library, sensor_file):
    recording = recording_on(bench, contact_of(bench, library["gel16"]), 0.02, 1)
    with pytest.raises(ValueError, match="periods: got 1; accepted is two periods or more, or from"):
        tr.estimate_contact(recording, sensor_file, band_hz=BAND_HZ)
    known = {"band_hz": BAND_HZ, "from_rest": True}
    with pytest.raises(ValueError, match="law: got 'Hooke'; accepted is one of .*power law"):
        tr.estimate_contact(recording, sensor_file, **known, law="Hooke")
    for std, accepted in ((np.nan, "a finite number"), (-1e-4, "0 or above")):
        with pytest.raises(ValueError, match=f"force_std_n: got {std}; accepted is {accepted}"):
            tr.estimate_contact(recording, sensor_file, **known, force_n=FORCE_N, force_std_n=std)
    by_name = tr.estimate_contact(recording, sensor_file, **known, law="power law")
    assert by_name.contact.prior.law is Law.POWER_LAW


def test_a_record_in_air_is_no_contact_and_contradicts_nothing(bench, sensor_file):
    recording = recording_on(bench, None, 0.1, 6)
    found = tr.estimate_contact(recording, sensor_file, band_hz=BAND_HZ, force_n=FORCE_N)
    assert found.contact.status is found.moduli.status is ContactStatus.NO_CONTACT
    assert np.isnan(found.moduli.storage_pa)
    assert any("nothing is touched" in text for text in found.warnings)
    assert not any("contradict" in text for text in found.warnings)
    assert found.poles is found.black_box.poles


@pytest.mark.parametrize("force_std_n", [np.nan, -1e-3, np.inf])
def test_the_deviation_of_a_force_is_a_number(bench, library, sensor_file, force_std_n):
    recording = recording_on(bench, contact_of(bench, library["gel16"]), 0.1, 6)
    with pytest.raises(ValueError, match="force_std_n: got .*; accepted is"):
        tr.estimate_contact(recording, sensor_file, force_n=FORCE_N, force_std_n=force_std_n)


def test_a_contradicted_calibration_falls_back_and_says_so(bench, library, sensor_file):
    contact = contact_of(bench, library["gel16"])
    wet = replace(contact, radiation_mass_kg=contact.radiation_mass_kg + 2e-5)
    recording = recording_on(bench, wet, 0.1, 6)
    found = tr.estimate_contact(recording, sensor_file, band_hz=BAND_HZ, force_n=FORCE_N)
    assert found.black_box is not None
    assert found.poles is found.black_box.poles
    assert any("contradict the calibration" in text for text in found.warnings)
    assert any("without the calibration" in text for text in found.warnings)
    true = CoupledBimorph(sensor_model(bench.sensor), wet).mode_near(250.0)
    assert abs(found.poles.main.f0_hz - true.f0_hz) < 0.2


def test_of_a_run_each_point_is_analysed_once_and_an_earlier_attempt_where_it_is_asked_for():
    attempts = (PointResult(0, 0, blocks=3, measurement_id=7), PointResult(0, 1, blocks=3, measurement_id=8))
    run = RunContent(Path("run"), "", {}, (), results=(*attempts, PointResult(1, blocks=3, measurement_id=9)))
    for asked, found in ((None, [8, 9]), (7, [7]), (8, [8])):
        options = SimpleNamespace(measurement_id=asked, force_n=None, record="run")
        assert [key for key, *_ in _pressed(options, run)] == found


def test_the_command_prints_and_writes_the_contact(bench, library, sensor_file, tmp_path, capsys):
    recording = recording_on(bench, contact_of(bench, library["gel16"]), 0.1, 4)
    record, output = tmp_path / "record.npz", tmp_path / "contact.json"
    np.savez(
        record,
        u=recording.u[0],
        y=recording.y[0],
        sample_rate_hz=recording.sample_rate_hz,
        samples_per_period=recording.u.shape[-1],
        excited_harmonics=recording.excited_harmonics,
    )
    arguments = ["analyze", str(record), "--calibration", str(sensor_file), "--force", "0.01"]
    arguments += ["--band", "200", "620", "--json", str(output)]
    assert main([*arguments, "--from-rest"]) == 0
    text = capsys.readouterr().out
    assert "contact: k'" in text
    assert "moduli: storage" in text
    content = json.loads(output.read_text())
    k = complex(*content["stiffness_n_per_m"])
    true = complex(contact_of(bench, library["gel16"]).dynamic_stiffness(2j * np.pi * content["at_hz"]))
    assert abs(k - true) < 4 * np.sqrt(np.trace(content["stiffness_total_covariance"]))
    assert content["status"] == "ok"
    assert content["moduli"]["storage_pa"] > 1e4
    assert main([*arguments, "--plot", str(tmp_path / "a.png")]) == 1
    assert "--plot" in capsys.readouterr().err
    for options in (["--order", "4"], ["--method", "frf"], ["--channel-delay", "1e-6"], ["--silent"]):
        assert main([*arguments, *options]) == 1
        error = capsys.readouterr().err
        assert f"{options[0]}: got" in error
        assert "accepted is one without --calibration" in error
    assert main(["analyze", str(record), "--calibration", str(record)]) == 1
    assert "record.npz" in capsys.readouterr().err
