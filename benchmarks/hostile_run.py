# SPDX-License-Identifier: Apache-2.0
"""A small run with everything that a run's folder may hold, for inputs that are to be damaged."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tactile_resonance.multisine import design_multisine
from tactile_resonance.scan.kept_bins import keep_bins
from tactile_resonance.scan.messages import make_message, to_cdr
from tactile_resonance.scan.point_result import PointResult
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.recorded import EXCITATION, RECORD
from tactile_resonance.scan.run_directory import RunDirectory

POINTS, PERIODS, SAMPLES, RATE_HZ = 3, 3, 400, 2000.0
BAND_HZ = (200.0, 300.0)
START_NS = 1_700_000_000_000_000_000
SCENE = "force_n: 0.01\nsensor: {band_low_hz: 200.0, band_high_hz: 300.0}\n"


def make_run(run: Path, points: int = POINTS) -> Path:
    """Points of one measurement each, an air reference, and the kept bins."""
    plan = [
        ScanPoint(k, (0.002 * k, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0), f"point {k}")
        for k in range(points)
    ]
    with RunDirectory.create(run, SCENE, plan, {"seed": 1}) as made:
        for k in range(-1, points):
            begun = made.begin_reference("air") if k < 0 else made.begin_point(k)
            time_ns = START_NS + k * 10**9
            with begun as recording:
                for number, (topic, kind, message) in enumerate(measurement(101 + k)):
                    recording.write(topic, kind, time_ns + number, to_cdr(message))
                recording.finish(_result(k, time_ns + 10**6))
    keep_bins(run, BAND_HZ)
    return run


def measurement(key: int) -> Iterator[tuple[str, str, Any]]:
    """Topic, type and message of what is played and sampled at a point: one mode of 250 Hz."""
    rng = np.random.default_rng(key)
    played = design_multisine(
        sample_rate_hz=RATE_HZ,
        samples_per_period=SAMPLES,
        band_hz=(150.0, 350.0),
        periods=PERIODS,
        seed=key,
    )
    common = {"measurement_id": key, "sample_rate_hz": RATE_HZ, "samples_per_period": SAMPLES}
    arrays = {name: getattr(played, name) for name in ("amplitude_v", "phase_rad")}
    arrays["harmonics"] = played.harmonics.astype(np.uint32)
    yield "/excitation", EXCITATION, make_message(
        EXCITATION, grid=1, realisations=1, periods=PERIODS, seed=key, **common, **arrays
    )
    s, w0 = 2j * np.pi * np.fft.rfftfreq(SAMPLES, 1 / RATE_HZ), 2 * np.pi * (250.0 + 0.1 * key)
    g = 0.1 + 0.04 * w0**2 / (s**2 + 0.04 * w0 * s + w0**2)
    clean = np.fft.irfft(g * np.fft.rfft(played.period()), SAMPLES)
    for block in range(PERIODS):
        y = clean + 1e-3 * rng.standard_normal(SAMPLES)
        final = block == PERIODS - 1
        yield "/record", RECORD, make_message(
            RECORD, block_index=block, final=final, actuator_v=played.period(), sensor_v=y, **common
        )  # fmt: skip


def _result(k: int, time_ns: int) -> PointResult:
    """Of a point; of the reference the number is that of no point."""
    return PointResult(
        max(k, 0),
        0,
        label=f"point {k}",
        x_m=0.002 * k,
        y_m=0.0,
        z_m=0.0,
        f0_hz=250.0 + k,
        f0_std_hz=0.01,
        damping_ratio=0.02,
        damping_ratio_std=1e-5,
        f0_damping_covariance_hz=1e-8,
        measurement_id=101 + k,
        time_ns=time_ns,
        frame_id="table",
        blocks=PERIODS,
    )
