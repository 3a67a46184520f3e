# SPDX-License-Identifier: Apache-2.0
"""A calibration in a file, and the command that writes it."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_resonance.calibration.model import CalibratedSensor, read_calibration
from tactile_resonance.cantilever import tip_mass
from tactile_resonance.cli import main


@pytest.fixture
def written(fitted, bench, tmp_path):
    path = tmp_path / "sensor.yaml"
    nan, about = float("nan"), {"sensor": "a", "model": "b"}
    content = CalibratedSensor(fitted.calibration, bench.sensor.tip.radius_m, nan, nan, about)
    path.write_text(content.as_text())
    return path


def test_a_file_brings_back_what_was_written(written, fitted, bench):
    sensor, made = read_calibration(written), fitted.calibration
    np.testing.assert_array_equal(sensor.calibration.model.values, made.model.values)
    np.testing.assert_array_equal(sensor.calibration.covariance, made.covariance)
    np.testing.assert_array_equal(sensor.calibration.determined, made.determined)
    assert sensor.calibration.noise_v_per_root_hz == made.noise_v_per_root_hz
    assert sensor.tip_radius_m == bench.sensor.tip.radius_m
    assert np.isnan(sensor.tip_mass_kg)
    assert sensor.about == {"sensor": "a", "model": "b"}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("sensor calibration 1", "sensor calibration 9", "format: got"),
        ("tip_radius_m: 0.00", "tip_radius_m: -0.00", "tip_radius_m: got -0.00"),
        ("determined: [true, ", "determined: [", "determined: got 43; accepted is 44"),
        ("gain: ", "gian: ", "gain: got None"),
    ],
)
def test_a_damaged_file_is_refused_by_field(written, old, new, message):
    text = written.read_text()
    assert old in text
    written.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        read_calibration(written)


def test_a_covariance_is_symmetric_but_for_rounding(given, tmp_path):
    """An inverse leaves what is uncorrelated different by its rounding, however small both are."""
    path, size = tmp_path / "sensor.yaml", given.std.size
    for off, refused in ((1e-12, False), (1e-3, True)):
        covariance = np.eye(size)
        covariance[0, 1] = off
        sensor = CalibratedSensor(replace(given, covariance=covariance), 2.5e-3, np.nan, np.nan, {})
        path.write_text(sensor.as_text())
        if refused:
            with pytest.raises(ValueError, match="covariance: got .*; accepted is a symmetric one"):
                read_calibration(path)
        else:
            np.testing.assert_array_equal(read_calibration(path).calibration.covariance, covariance)


def test_the_tip_mass_is_that_of_the_ball(fitted, bench):
    mass_kg, std_kg, why = tip_mass(fitted.calibration)
    assert why == ""
    assert abs(mass_kg - bench.sensor.tip.mass_kg) < 4 * std_kg
    assert std_kg < 0.05 * mass_kg


def test_without_known_shapes_there_is_no_tip_mass(fitted):
    made = fitted.calibration
    determined = made.determined.copy()
    determined[3 * made.model.modes : 4 * made.model.modes] = False
    mass_kg, _, why = tip_mass(replace(made, determined=determined))
    assert np.isnan(mass_kg)
    assert "shape" in why


def test_modes_that_are_of_no_uniform_beam_give_no_tip_mass(fitted):
    made = fitted.calibration
    odd = made.model.natural_rad_s * np.where(np.arange(made.model.modes) % 2, 1.05, 1.0)
    mass_kg, _, why = tip_mass(replace(made, model=replace(made.model, natural_rad_s=odd)))
    assert np.isnan(mass_kg)
    assert "uniform" in why


def test_a_tip_that_goes_against_the_force_gives_no_tip_mass(fitted):
    made = fitted.calibration
    against = replace(made.model, tip_deflection=-made.model.tip_deflection)
    mass_kg, _, why = tip_mass(replace(made, model=against))
    assert np.isnan(mass_kg)
    assert why == "deflections at the tip are not all above 0"


def stored(path, u, y, harmonics, rate_hz):
    np.savez(
        path, u=u, y=y, sample_rate_hz=rate_hz, samples_per_period=u.shape[-1],
        excited_harmonics=harmonics,
    )  # fmt: skip
    return str(path)


@pytest.fixture(scope="module")
def files(bench, tmp_path_factory):
    from tactile_resonance.simulation.sensor.experiments import records_of_calibration

    folder = tmp_path_factory.mktemp("records")
    made, harmonics, rate_hz = records_of_calibration(bench, masses_kg=[5e-5], seed=9)
    return {
        kind: stored(folder / f"{kind}.npz", u, y, harmonics, rate_hz) for kind, _, u, y in made
    }


def test_the_command_calibrates_files_and_checks_a_sensor(files, tmp_path, capsys, bench):
    output, plot = tmp_path / "mine.yaml", tmp_path / "mine.png"
    arguments = ["calibrate", "--air", files["air"], "--mass", "5e-5", files["mass"]]
    arguments += ["--loopback", files["loopback"], "--output", str(output), "--plot", str(plot)]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert "natural_rad_s[10]" in text
    assert "tip mass: " in text
    assert plot.stat().st_size > 10_000
    sensor = read_calibration(output)
    assert sensor.calibration.knows_tip()
    assert sensor.tip_mass_kg == pytest.approx(bench.sensor.tip.mass_kg, rel=0.05)
    assert main(["calibrate", "--air", files["air"], "--check", str(output)]) == 0
    assert "as calibrated" in capsys.readouterr().out
    # with a mass at its tip a sensor is another one
    assert main(["calibrate", "--air", files["mass"], "--check", str(output)]) == 1
    assert "changed" in capsys.readouterr().out


def test_the_command_names_what_it_refuses(files, capsys):
    assert main(["calibrate", "--mass", "5e-5", files["mass"]]) == 1
    assert "in air" in capsys.readouterr().err
    assert main(["calibrate", "--air", files["air"], "--mass", "heavy", files["mass"]]) == 1
    assert "--mass: got 'heavy'" in capsys.readouterr().err
    assert main(["calibrate", "--air", files["air"], "--simulated", "1"]) == 1
    assert "--simulated" in capsys.readouterr().err
    swapped = ["calibrate", "--air", files["mass"], "--mass", "5e-5", files["air"]]
    assert main(swapped) == 1
    assert "air.npz: modes: got '+" in capsys.readouterr().err
    in_mg = ["calibrate", "--air", files["air"], "--mass", "50", files["mass"]]
    assert main(in_mg) == 1
    assert "--mass: got 50.0; accepted is kilograms, less than 0.001" in capsys.readouterr().err
    assert main(["calibrate", "--simulated", "-1"]) == 1
    assert "--simulated: got -1; accepted is 0 or above" in capsys.readouterr().err
    assert main(["calibrate", "--air", files["air"], "--check", "x.yaml", "--output", "y.yaml"]) == 1
    assert "--check: got 'x.yaml'; accepted is neither --output" in capsys.readouterr().err
