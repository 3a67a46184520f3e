# SPDX-License-Identifier: Apache-2.0
"""Small runs for the tests, and the table of a run read back."""

import csv
from dataclasses import asdict, fields
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tactile_resonance.multisine import design_multisine
from tactile_resonance.scan.messages import make_message, to_cdr
from tactile_resonance.scan.point_result import (
    COLUMNS,
    PointKind,
    PointOutcome,
    PointResult,
    ResultsFile,
)
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.recorded import EXCITATION, RECORD

POLES = "tactile_resonance/msg/Poles"
START_NS = 1_700_000_000_000_000_000
N, RATE_HZ, PERIODS = 2000, 5000.0, 4


# how a value of each type stands in results.csv
VALUES = {
    "int": int,
    "float": float,
    "str": str,
    "bool": {"True": True, "False": False}.__getitem__,
    "PointKind": PointKind,
    "PointOutcome": lambda text: PointOutcome[text.upper()],
}


def as_csv(results):
    """Text of results.csv, written at once."""
    with TemporaryDirectory() as folder:
        ResultsFile(Path(folder), results)
        return (Path(folder) / "results.csv").read_text()


def table_of(run_folder):
    """Results as they stand in results.csv."""
    rows = csv.DictReader((run_folder / "results.csv").read_text().splitlines())
    return [
        PointResult(
            **{
                f.name: VALUES[str(f.type)](row[f.name])
                for f in fields(PointResult)
                if f.name in COLUMNS
            }
        )
        for row in rows
    ]


def assert_same(a, b):
    """Equal in every field, NaN being equal to NaN."""
    np.testing.assert_equal(asdict(a), asdict(b))


def plan(count):
    return [
        ScanPoint(i, (0.002 * i, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0), f"point {i}")
        for i in range(count)
    ]


def record_cdr(index, samples=200):
    """A record whose content tells which point it is of."""
    counts = (np.arange(samples, dtype=np.int32) * 7 + index).astype(np.int32)
    return to_cdr(make_message(RECORD, actuator_counts=counts))


def result(index, attempt=0, **values):
    given = {
        "label": f"point {index}",
        "x_m": 0.002 * index,
        "y_m": 0.0,
        "z_m": 0.0,
        "f0_hz": 250.0 + index,
        "f0_std_hz": 0.01,
        "damping_ratio": 0.03 + 0.001 * index,
        "damping_ratio_std": 1e-5,
        "f0_damping_covariance_hz": 1e-8,
        "time_ns": START_NS + index * 10**9,
        "frame_id": "table",
        "blocks": 3,
    }
    return PointResult(index, attempt, **{**given, **values})


def record_point(run, index, messages=3, **values):
    """Record one whole point."""
    with run.begin_point(index) as recording:
        for k in range(messages):
            time_ns = START_NS + index * 10**9 + k * 10**6
            recording.write("/record", RECORD, time_ns, record_cdr(index))
        recording.finish(result(index, recording.attempt, **values))


def measurement(key, realisations=1, modes=((250.0, 0.02),), hum_v=0.0):
    """Messages of one measurement: topic, type, message."""
    rng = np.random.default_rng(key)
    for m in range(realisations):
        played = design_multisine(
            sample_rate_hz=RATE_HZ,
            samples_per_period=N,
            band_hz=(150.0, 350.0),
            periods=PERIODS,
            realisations=realisations,
            realisation=m,
            seed=key,
        )
        arrays = {name: getattr(played, name) for name in ("harmonics", "amplitude_v", "phase_rad")}
        arrays["harmonics"] = arrays["harmonics"].astype(np.uint32)
        yield (
            "/excitation",
            EXCITATION,
            make_message(
                EXCITATION,
                measurement_id=key,
                grid=1,
                realisation=m,
                realisations=realisations,
                periods=PERIODS,
                sample_rate_hz=RATE_HZ,
                samples_per_period=N,
                seed=key,
                **arrays,
            ),
        )
        s = 2j * np.pi * np.fft.rfftfreq(N, 1 / RATE_HZ)
        g = 0.1
        for f0_hz, zeta in modes:
            w0 = 2 * np.pi * f0_hz
            g = g + 2 * zeta * w0**2 / (s**2 + 2 * zeta * w0 * s + w0**2)
        u = np.tile(played.period(), PERIODS)
        y = np.tile(np.fft.irfft(g * np.fft.rfft(played.period()), N), PERIODS)
        y = y + 1e-3 * rng.standard_normal(y.size)
        y = y + hum_v * np.cos(2 * np.pi * 251.4 * np.arange(y.size) / RATE_HZ)
        for block in range(PERIODS):
            here = slice(block * N, (block + 1) * N)
            yield (
                "/record",
                RECORD,
                make_message(
                    RECORD,
                    measurement_id=key,
                    realisation=m,
                    block_index=block,
                    sample_rate_hz=RATE_HZ,
                    samples_per_period=N,
                    actuator_v=u[here],
                    sensor_v=y[here],
                    final=block == PERIODS - 1 and m == realisations - 1,
                ),
            )
