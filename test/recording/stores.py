# SPDX-License-Identifier: Apache-2.0
"""Measurements for stores in tests."""

from typing import NamedTuple

import numpy as np

from tactile_resonance.multisine import design_multisine
from tactile_resonance.record import (
    BetweenSamples,
    Channel,
    Contact,
    ForceSpread,
    InputKind,
    Origin,
    Record,
)
from tactile_resonance.recording.store import list_measurements

SAMPLES = 40


def excitations(measurement_id=7, realisations=2, periods=3):
    return [
        design_multisine(
            sample_rate_hz=1000.0,
            samples_per_period=SAMPLES,
            band_hz=(25.0, 300.0),
            seed=5,
            realisation=realisation,
            realisations=realisations,
            periods=periods,
            measurement_id=measurement_id,
            excitation_id=100 * measurement_id + realisation,
            label="gelatine 10 %, point 1",
        )
        for realisation in range(realisations)
    ]


def record(excitation, block_index, rng=None):
    """A block with counts on one channel and volts on the other, nothing at its default."""
    rng = rng or np.random.default_rng([excitation.excitation_id, block_index])
    counts = rng.integers(-(2**15), 2**15, SAMPLES).astype(np.int32)
    final = (
        excitation.realisation == excitation.realisations - 1
        and block_index == excitation.periods - 1
    )
    return Record(
        actuator=Channel(counts, 3.0517578125e-4, -1e-3, saturated=True),
        sensor=Channel(rng.standard_normal(SAMPLES)),
        sample_rate_hz=excitation.sample_rate_hz,
        samples_per_period=SAMPLES,
        realisation=excitation.realisation,
        block_index=block_index,
        input_kind=InputKind.COMMANDED,
        between_samples=BetweenSamples.ZERO_ORDER_HOLD,
        channel_delay_s=1 / 3e6,
        anti_alias_filter="40 kHz, 8th order, both",
        origin=Origin(
            measurement_id=excitation.measurement_id,
            excitation_id=excitation.excitation_id,
            time_ns=1_700_000_000_123_456_789 + 40_000_000 * block_index,
            final=final,
            frame_id="left/tip",
            label="gelatine 10 %, point 1",
            simulated=True,
            contact=Contact(
                force_n=0.1 / 3,
                force_std_n=1e-4 / 3,
                position_m=(0.1, -0.2 / 3, 1e-300),
                orientation_xyzw=(0.0, 0.6, 0.0, 0.8),
                frame_id="table",
                time_ns=1_700_000_000_000_000_001,
                spread=ForceSpread(1e-3 / 3, 0.1 / 3 - 2e-3, 0.1 / 3 + 2e-3),
            ),
        ),
    )


def write(store, measurement_id=7, realisations=2, periods=3):
    """A whole measurement; returns what was written."""
    planned = excitations(measurement_id, realisations, periods)
    store.begin(planned)
    records = []
    for excitation in planned:
        store.add_excitation(excitation)
        for block in range(periods):
            records.append(record(excitation, block))
            store.add_record(records[-1])
    return planned, records


class Content(NamedTuple):
    """All measurements of a store, in the order they were begun, and what could not be read."""

    measurements: list
    problems: list


def read_store(folder):
    """Everything readable of a store."""
    entries, problems = list_measurements(folder)
    measurements = [entry.read() for entry in entries]
    named = [problem for measurement in measurements for problem in measurement.problems]
    return Content(measurements, problems + named)


def assert_same(found, expected):
    """Every field of two dataclasses equal, to the bit and the type."""
    from dataclasses import fields, is_dataclass

    assert type(found) is type(expected)
    if is_dataclass(expected):
        for field in fields(expected):
            assert_same(getattr(found, field.name), getattr(expected, field.name))
    elif isinstance(expected, np.ndarray):
        assert found.dtype == expected.dtype
        assert found.tobytes() == expected.tobytes()
    elif isinstance(expected, float):
        assert np.float64(found).tobytes() == np.float64(expected).tobytes()
    else:
        assert found == expected
