# SPDX-License-Identifier: Apache-2.0
"""Vibration until 10 and 12 % gelatine are distinguished, through sensors whose calibration is estimated.

The decision is that of `tactile_resonance.scan.decision`, as scan_node makes it; the classes are the poles
that the same sensor has on the two gelatines at the nominal contact, with the spread of castings, as they
would be measured as references.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from benchmarks.calibrate_benches import (
    AGES_S,
    FORCE_STD_N,
    calibrated,
    contact_record,
    excitation,
    library,
)
from benchmarks.skip_decision import PERCENT, PREPARATION_PERCENT, squared
from benchmarks.skip_point import SimulatedPoint, pole_of
from tactile_resonance._typing import FloatArray
from tactile_resonance.scan.decision import BlockLimits, Separate, Verdict, decide
from tactile_resonance.tissue.classify import TissueClass
from tactile_resonance.tissue.nominal_contact import (
    ContactLoad,
    ForceSensitivity,
    NominalContact,
    refer_to_nominal,
)

PROBABILITY = 0.99
MOST_S = 0.2
CREEP, CREEP_STD = 0.028, 0.001
"""From 0.5 to 5 s of contact, of gelatine; as config/scenes/two_gelatines.yaml has it."""
NAMES = tuple(f"{percent:g} %" for percent in PERCENT)


@dataclass(frozen=True)
class Called:
    """A point.

    Attributes
    ----------
    truth, called : str
        Class it is of, and that was decided for; empty: none.
    time_s : float
        Of vibration.
    verdict : Verdict
    contradicted : bool
        The record contradicted the calibration at some block.
    distance, nominal : float
        Squared Mahalanobis distances from the truth: of the pole, and of that at the nominal contact.
    """

    truth: str
    called: str
    time_s: float
    verdict: Verdict
    contradicted: bool
    distance: float
    nominal: float


@lru_cache(maxsize=64)
def wanted(seed: int) -> tuple[Separate, NominalContact]:
    """Classes and nominal contact of a sensor: its poles on castings, under other forces."""
    at = calibrated(seed)
    bench = at.bench
    force_n = bench.contact.force_n

    def pole(percent: float, at_n: float = force_n) -> FloatArray:
        return pole_of(bench.coupled(library().gelatine(percent), force_n=at_n), at.mode_hz)

    classes, slopes = [], []
    for name, percent in zip(NAMES, PERCENT, strict=True):
        spread = (pole(percent + 0.1) - pole(percent - 0.1)) / 0.2 * PREPARATION_PERCENT
        # references scatter a little beside that direction too
        covariance = np.outer(spread, spread) + np.diag([0.02, 2e-5]) ** 2
        classes.append(TissueClass(name, pole(percent), covariance))
        slopes.append(
            (pole(percent, 1.05 * force_n) - pole(percent, 0.95 * force_n)) / 0.1 / force_n
        )
    mean, gap = np.mean(slopes, axis=0), np.subtract(*slopes) / 2
    sensitivity = ForceSensitivity(mean, np.outer(gap, gap))
    nominal = NominalContact(force_n, 1.0, sensitivity, CREEP, CREEP_STD)
    return Separate(*classes, PROBABILITY), nominal


def decide_point(task: tuple[int, int, int, float, bool]) -> Called:
    """Bench, class, seed, block [s], disturbed: block by block until it is decided."""
    of, which, seed, block_s, disturbed = task
    at, (asked, nominal) = calibrated(of), wanted(of)
    rng = np.random.default_rng([seed, 2])
    casting = PERCENT[which] + PREPARATION_PERCENT * rng.standard_normal()
    stated_n = at.bench.contact.force_n
    force_n = stated_n + FORCE_STD_N * rng.standard_normal() * disturbed
    age_s, signal = rng.uniform(*AGES_S), excitation(block_s)
    limits = BlockLimits(1, round(MOST_S / block_s))
    tissue = library().gelatine(casting)
    point = SimulatedPoint(
        at.bench, tissue, force_n, age_s, seed=seed, distortion=disturbed, creep=disturbed
    )
    blocks, contradicted, estimator = [], False, at.estimator
    while True:
        blocks.append(point.block(signal))
        pressed = ContactLoad(stated_n, FORCE_STD_N, age_s + point.time_s / 2)
        mode = estimator(contact_record(blocks, signal), stated_n, FORCE_STD_N)
        main = mode.poles.main
        contradicted |= mode.status.value != "ok"
        decision = decide(mode.poles, pressed, nominal, len(blocks), asked, limits, block_s)
        if decision.stop:
            break
    referred = refer_to_nominal(main.estimate, main.covariance, pressed, nominal)
    nominally = at.bench.coupled(tissue, force_n=stated_n, hold_time_s=nominal.age_s)
    there, true = (pole_of(of, at.mode_hz) for of in (nominally, point.at(point.time_s / 2)))
    return Called(
        NAMES[which],
        decision.called,
        point.time_s,
        decision.verdict,
        contradicted,
        squared(main.estimate - true, main.covariance),
        squared(referred.compared - there, referred.covariance),
    )


def tasks(
    benches: int, points: int, block_s: float, disturbed: bool
) -> Sequence[tuple[int, int, int, float, bool]]:
    """So many points, shared out over benches and classes."""
    each = points // (2 * benches)
    return [
        (of, which, (of * 2 + which) * each + n, block_s, disturbed)
        for of in range(benches)
        for which in (0, 1)
        for n in range(each)
    ]
