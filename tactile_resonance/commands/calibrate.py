# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance calibrate`: a sensor's own parameters, from records in air and with known loads."""

from __future__ import annotations

import argparse
import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tactile_resonance.calibration.fit import Fitted, calibrate
from tactile_resonance.calibration.model import CalibratedSensor, Calibration, read_calibration
from tactile_resonance.calibration.records import CalibrationRecord, Load
from tactile_resonance.calibration.validity import check_in_air, poles_in_air
from tactile_resonance.cantilever import tip_mass
from tactile_resonance.commands.options import YAML, add_figure, add_option, add_output
from tactile_resonance.fields import number, require
from tactile_resonance.files import write_whole
from tactile_resonance.front import read_record
from tactile_resonance.sensor import sensor_named

SKEW_S = 3e-6
"""Of the channels of the simulated bench."""
MASS_KG = 5e-5
MOST_KG = 1e-3
"""A mass at the tip is less: tens of milligrams. What is more was given in other units."""


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of the command."""
    parser = commands.add_parser(
        "calibrate",
        help="a sensor's own parameters, from records in air and with known loads",
        description="Fit the parameters of a sensor to records in air, with known masses or springs at the "
        "tip, and of a loop-back (both channels on the generator). Prints them, says which the "
        "records do not determine, and writes them to a file that scenes and `analyze --calibration` take. "
        "With --check: whether a sensor is still as such a file says, from a record in air. "
        "(The table of the robot: calibrate-table.)",
    )
    each: dict[str, Any] = {"action": "append", "default": []}
    add_option(parser, "--air RECORD", Path, "tip free, in air", **each)
    text = "may be given several times"
    add_option(parser, "--mass KG RECORD", str, f"a known mass at the tip; {text}", **each)
    spring = f"a known spring between tip and ground; {text}"
    add_option(parser, "--spring N_PER_M RECORD", str, spring, **each)
    add_option(parser, "--mass-std KG", float, "default: 1e-7", default=1e-7)
    add_option(parser, "--spring-std N_PER_M", 0.1)
    text = "both channels on the generator: gain and delay between them"
    add_option(parser, "--loopback RECORD", Path, text, **each)
    add_option(parser, "--modes", int, "default: as many as show in air")
    add_option(parser, "--sensor", "bimorph", "of config/sensors: its ball's radius")
    add_output(parser, "--output FILE", "write the calibration here", *YAML)
    add_figure(parser, "--plot", "draw responses and residuals here")
    add_option(parser, "--check FILE", Path, "compare one record in air with this calibration")
    text = "records of a simulated sensor that is a few percent off; compares with its truth"
    add_option(parser, "--simulated SEED", int, text)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Calibrate and print, or check; status 1 where a checked sensor is not as calibrated."""
    radius_m = sensor_named(options.sensor).tip.radius_m
    about = {"sensor": options.sensor, "date": f"{datetime.date.today():%Y-%m-%d}"}
    truth = None
    if options.simulated is not None:
        require(options.simulated >= 0, "--simulated", options.simulated, "0 or above")
        given = [name for name in ("air", "mass", "spring", "loopback") if getattr(options, name)]
        require(not given, "--simulated", given, "no record beside it")
        records, truth, radius_m = _simulated(options.simulated)
        about["sensor"] = f"simulated {options.simulated}"
    else:
        records = _records(options)
    if options.check is not None:
        good = options.output is None and options.plot is None
        require(good, "--check", str(options.check), "neither --output nor --plot beside it")
        return _check(read_calibration(options.check).calibration, records)
    fitted = calibrate(records, options.modes)
    made = fitted.calibration
    mass_kg, mass_std_kg, why = tip_mass(made)
    print(as_text(fitted, truth))
    if why:
        print(f"tip mass: not determined: {why}")
    else:
        print(f"tip mass: {1e6 * mass_kg:.2f} +- {1e6 * mass_std_kg:.2g} mg, of a uniform beam")
    if options.plot is not None:
        # drawing libraries take half a second to load
        from tactile_resonance.report.drawing import SIMULATED, draw_calibration, save_figure

        title = f"calibration of {about['sensor']}" + (
            f" ({SIMULATED})" if truth is not None else ""
        )
        save_figure(draw_calibration(fitted, title), options.plot)
    if options.output is not None:
        content = CalibratedSensor(made, radius_m, mass_kg, mass_std_kg, about)
        write_whole(options.output, content.as_text().encode())
        print(f"written: {options.output}")
    return 0


def _records(options: argparse.Namespace) -> list[CalibrationRecord]:
    loads = [
        *((Load.AIR, 0.0, 0.0, path) for path in options.air),
        *((Load.MASS, v, options.mass_std, path) for v, path in options.mass),
        *((Load.SPRING, v, options.spring_std, path) for v, path in options.spring),
        *((Load.LOOPBACK, 0.0, 0.0, path) for path in options.loopback),
    ]
    records = []
    for load, value, std, path in loads:
        recording = read_record(Path(path))
        try:
            known = number(float(value), f"--{load.value}")
        except ValueError as error:
            raise ValueError(f"--{load.value}: got {value!r}; accepted is a number") from error
        light = load is not Load.MASS or known < MOST_KG
        require(light, "--mass", known, f"kilograms, less than {MOST_KG:g}: 50 mg are 5e-5")
        records.append(
            CalibrationRecord.of_samples(
                recording.u,
                recording.y,
                sample_rate_hz=recording.sample_rate_hz,
                harmonics=recording.excited_harmonics,
                load=load,
                value=known,
                value_std=std if known else 0.0,
                name=Path(path).name,
            )
        )
    return records


def _simulated(seed: int) -> tuple[list[CalibrationRecord], np.ndarray, float]:
    """Records of a sensor that is a few percent off, its true parameters, its ball's radius [m]."""
    from tactile_resonance.sensor import read_sensor
    from tactile_resonance.simulation.sensor.bench import BenchEffects, SimulatedBench
    from tactile_resonance.simulation.sensor.experiments import (
        another_sensor,
        calibration_records,
        true_sensor,
    )
    from tactile_resonance.simulation.tissue.library import read_tissues

    bench = SimulatedBench(another_sensor(read_sensor(), seed), read_tissues().contact)
    effects = BenchEffects(channel_skew_s=SKEW_S)
    records = calibration_records(bench, masses_kg=[MASS_KG], effects=effects, seed=seed)
    return records, true_sensor(bench, SKEW_S).values, bench.sensor.tip.radius_m


def _check(calibration: Calibration, records: Sequence[CalibrationRecord]) -> int:
    """Compare a record in air with a calibration; all its modes."""
    air = [record for record in records if record.load is Load.AIR]
    require(bool(air), "--air", [], "a record in air")
    now = calibrate(air, None).calibration
    poles, covariances = poles_in_air(now)
    top = poles[:, 0] <= now.band_hz[1]
    found = check_in_air(calibration, list(poles[top]), list(covariances[top]))
    print(found.message)
    print(
        f"common shift of the frequencies: {1e2 * found.shift:+.4f} +- {1e2 * found.shift_std:.2g} %"
    )
    return 0 if found.usable else 1


def as_text(fitted: Fitted, truth: np.ndarray | None = None) -> str:
    """Table of the parameters; with the truth, errors over deviations, where it has as many modes."""
    made = fitted.calibration
    if truth is not None and truth.size != made.model.values.size:
        truth = None
    lines = [f"{'parameter':22s}{'value':>14s}{'std':>11s}"]
    lines[0] += "" if truth is None else f"{'truth':>14s}{'error / std':>13s}"
    for k, (name, value, std) in enumerate(
        zip(made.model.names, made.model.values, made.std, strict=True)
    ):
        line = f"{name:22s}{value:14.8g}{std:11.2g}"
        if not made.determined[k]:
            line = f"{name:22s}{'not determined':>14s}"
        elif truth is not None:
            line += f"{truth[k]:14.8g}{(value - truth[k]) / std:+13.1f}"
        lines.append(line)
    lines.append("capacitance, moduli: not determined; voltages show couplings over the root of Ct")
    lines += [
        f"residuals of {record.name}: mean square {np.mean(np.abs(residual) ** 2):.2f} of noise"
        for record, residual in zip(fitted.records, fitted.residuals, strict=True)
    ]
    if made.message:
        lines.append(f"note: {made.message}")
    return "\n".join(lines)
