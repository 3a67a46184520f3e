# SPDX-License-Identifier: Apache-2.0
"""Small runs for the tests, and the table of a run read back."""

import csv
from dataclasses import asdict, fields

import numpy as np

from tactile_resonance.scan.messages import make_message, to_cdr
from tactile_resonance.scan.point_result import COLUMNS, PointKind, PointOutcome, PointResult
from tactile_resonance.scan.scan_point import ScanPoint

POLES = "tactile_resonance/msg/Poles"
RECORD = "tactile_resonance/msg/Record"
START_NS = 1_700_000_000_000_000_000


# how a value of each type stands in results.csv
VALUES = {
    "int": int,
    "float": float,
    "str": str,
    "bool": {"True": True, "False": False}.__getitem__,
    "PointKind": PointKind,
    "PointOutcome": lambda text: PointOutcome[text.upper()],
}


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
