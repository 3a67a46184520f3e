# SPDX-License-Identifier: Apache-2.0
"""Simulated sensors that are a few percent off each other, calibrated from records, and points on them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from benchmarks.skip_point import SimulatedPoint, pole_of
from tactile_resonance._typing import FloatArray
from tactile_resonance.calibration.contact import TissueContact
from tactile_resonance.calibration.estimator import CalibratedEstimator, ContactRecord
from tactile_resonance.calibration.fit import calibrate
from tactile_resonance.calibration.model import Calibration
from tactile_resonance.calibration.records import Load
from tactile_resonance.cantilever import tip_mass
from tactile_resonance.multisine import Excitation, design_multisine
from tactile_resonance.record import Record
from tactile_resonance.sensor import read_sensor
from tactile_resonance.simulation.sensor.bench import BenchEffects, SimulatedBench
from tactile_resonance.simulation.sensor.experiments import (
    another_sensor,
    calibration_records,
    true_sensor,
)
from tactile_resonance.simulation.tissue.library import Tissue, TissueLibrary, read_tissues

MASS_KG, MASS_RELATIVE_STD = 5e-5, 1e-3
SKEW_STD_S = 2e-6
RATE_HZ, BAND_HZ = 50e3, (200.0, 620.0)
FORCE_STD_N = 1.5e-4
"""Of the force about that which is stated."""
AGES_S = (0.3, 2.0)
"""Of the contact when the first block begins: anywhere between."""


MADE: dict[tuple[int, bool], CalibratedBench] = {}


@dataclass(frozen=True, eq=False)
class CalibratedBench:
    """A bench, and its calibration from records of it alone.

    Attributes
    ----------
    bench : SimulatedBench
    calibration : Calibration
    off : (p,) float
        Errors of the parameters over their deviations; NaN where the number of modes is wrong.
    tip_mass_off : float
        Likewise; NaN where it is not determined.
    """

    bench: SimulatedBench
    calibration: Calibration
    off: FloatArray
    tip_mass_off: float

    @cached_property
    def mode_hz(self) -> float:
        """The first mode in air that the band holds, whose pole is given."""
        modes = self.bench.coupled(None).modes
        return min(mode.f0_hz for mode in modes if mode.f0_hz >= BAND_HZ[0])

    @property
    def estimator(self) -> CalibratedEstimator:
        """Of contacts, through the estimated sensor."""
        return CalibratedEstimator(self.calibration, self.bench.sensor.tip.radius_m)


@lru_cache(maxsize=64)
def library() -> TissueLibrary:
    """Of this process."""
    return read_tissues()


def calibrated(seed: int, skewed: bool = False) -> CalibratedBench:
    """See `make_bench`; once in a process and those that it forks."""
    if (seed, skewed) not in MADE:
        MADE[seed, skewed] = make_bench(seed, skewed)
    return MADE[seed, skewed]


def make_bench(seed: int, skewed: bool) -> CalibratedBench:
    """A sensor whose mass at the tip weighs a little other than it says, and whose channels are apart."""
    rng = np.random.default_rng([seed, 4])
    skew_s = SKEW_STD_S * rng.standard_normal() if skewed else 0.0
    bench = SimulatedBench(another_sensor(read_sensor(), seed), library().contact)
    weighs_kg = MASS_KG * (1 + MASS_RELATIVE_STD * rng.standard_normal())
    made = calibration_records(
        bench, masses_kg=[weighs_kg], effects=BenchEffects(channel_skew_s=skew_s), seed=100 * seed
    )
    stated = {"value": MASS_KG, "value_std": MASS_RELATIVE_STD * MASS_KG}
    records = [replace(of, **stated) if of.load is Load.MASS else of for of in made]
    calibration = calibrate(records).calibration
    truth = true_sensor(bench, skew_s).values
    off = np.full(calibration.std.size, np.nan)
    if truth.size == off.size:
        off = (calibration.model.values - truth) / calibration.std
    mass_kg, std_kg, _ = tip_mass(calibration)
    return CalibratedBench(bench, calibration, off, (mass_kg - bench.sensor.tip.mass_kg) / std_kg)


def excitation(block_s: float) -> Excitation:
    """Lines of the band as high as those of the whole range at 1 V rms, sounding one after the other."""
    low, high = BAND_HZ
    lines = np.floor(high * block_s + 1e-9) - np.ceil(low * block_s - 1e-9) + 1
    return design_multisine(
        sample_rate_hz=RATE_HZ,
        samples_per_period=round(RATE_HZ * block_s),
        band_hz=BAND_HZ,
        level_v=float(np.sqrt(lines / (9990 * block_s + 1))),
        sweep=True,
    )


def contact_record(blocks: list[Record], signal: Excitation) -> ContactRecord:
    """All blocks so far, from rest."""
    u, y = (
        np.array([getattr(block, name).volts() for block in blocks])
        for name in ("actuator", "sensor")
    )
    return ContactRecord.of_samples(
        u, y, sample_rate_hz=RATE_HZ, harmonics=signal.harmonics, band_hz=BAND_HZ
    )


@dataclass(frozen=True, eq=False)
class Measured:
    """One contact against its truth.

    Attributes
    ----------
    found : TissueContact
    off : (4,) float
        Errors of stiffness (real, imaginary), f0, damping ratio over their total deviations.
    error : (4,) float
        Themselves.
    """

    found: TissueContact
    off: FloatArray
    error: FloatArray


def measure(
    at: CalibratedBench, tissue: Tissue, block_s: float, blocks: int, seed: int, disturbed: bool
) -> Measured:
    """A point from rest; `disturbed`: force off, distortion, creep."""
    rng = np.random.default_rng([seed, 1])
    stated_n = at.bench.contact.force_n
    force_n = stated_n + FORCE_STD_N * rng.standard_normal() * disturbed
    age_s, signal = rng.uniform(*AGES_S), excitation(block_s)
    point = SimulatedPoint(
        at.bench, tissue, force_n, age_s, seed=seed, distortion=disturbed, creep=disturbed
    )
    record = contact_record([point.block(signal) for _ in range(blocks)], signal)
    found = at.estimator(record, stated_n, FORCE_STD_N)
    true = point.at(point.time_s / 2)
    assert true.contact is not None
    k = complex(true.contact.dynamic_stiffness(2j * np.pi * found.poles.f0_hz[0]))
    main, gap = found.poles.main, found.stiffness_n_per_m - k
    error = np.append([gap.real, gap.imag], main.estimate - pole_of(true, at.mode_hz))
    std = np.append(np.sqrt(np.diag(found.stiffness_total)), main.std)
    return Measured(found, error / std, error)
