# SPDX-License-Identifier: Apache-2.0
"""Time per point against error: ours and what else there is, in turns on the same data."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.fft

from benchmarks.poles_peers import PEERS, Case
from benchmarks.poles_plant import (
    BAND_HZ,
    HARMONICS,
    SAMPLE_RATE_HZ,
    SAMPLES_PER_PERIOD,
    Plant,
)
from tactile_resonance._typing import FloatArray
from tactile_resonance.frf.result import FRF
from tactile_resonance.frf.spectra import error_variance, power, ratio, transient_free_spectra
from tactile_resonance.poles.identify import identify_batch, identify_frf
from tactile_resonance.poles.joint import JointPlan
from tactile_resonance.poles.result import PolesBatch
from tactile_resonance.poles.structure import ModelStructure

BARE = ModelStructure(2, 2)
# Points of a batch: a whole set of scans, whose few suspects are compared with other models together.
BATCH = 20000


@dataclasses.dataclass(frozen=True)
class Method:
    """Time per point [s] and root mean square error over the bound's standard deviation."""

    name: str
    time_s: float
    error: FloatArray
    note: str = ""


@dataclasses.dataclass(frozen=True)
class Contestant:
    """What is timed: a call, for how many points, and the estimates (runs, 2) in what it returns.

    Without estimates it makes the same as the one before, and has its errors.
    """

    name: str
    call: Callable[[], Any]
    points: int
    estimates: Callable[[Any], FloatArray] | None = None


def joint_plan(plant: Plant, structure: ModelStructure = BARE) -> JointPlan:
    """Joint estimator for a plant."""
    variance_y, variance_u = plant.noise
    return JointPlan(
        SAMPLE_RATE_HZ,
        SAMPLES_PER_PERIOD,
        plant.periods,
        HARMONICS,
        BAND_HZ,
        structure,
        input_noise_ratio=variance_u / variance_y if plant.periods == 1 else None,
    )


def local_polynomial_spectra(
    plant: Plant,
    u: npt.NDArray,
    y: npt.NDArray,
    bins: npt.NDArray,
    band_hz: tuple[float, float] = BAND_HZ,
) -> tuple[npt.NDArray, npt.NDArray, npt.NDArray, int]:
    """Lines [Hz], transient-free spectra (runs, 2, F), their covariance, degrees of freedom."""
    line_hz = SAMPLE_RATE_HZ / SAMPLES_PER_PERIOD
    harmonics = np.arange(round(band_hz[0] / line_hz), round(band_hz[1] / line_hz) + 1)
    whole = np.zeros((2, SAMPLES_PER_PERIOD * plant.periods // 2 + 1), complex)
    results = []
    for pair in np.stack(
        [y, u], axis=1
    ):  # (2, K), one run after the other: whole spectra are large
        whole[:, bins] = pair
        # all of a Spectrum that is read: there are no samples
        record: Any = SimpleNamespace(
            bins=whole, periods=plant.periods, samples_per_period=SAMPLES_PER_PERIOD
        )
        results.append(transient_free_spectra(record, harmonics))
    spectra = np.stack([of.spectra for of in results])
    covariance = np.stack([of.covariance for of in results])
    return harmonics * line_hz, spectra, covariance, results[0].noise_dof


def compare_methods(quick: bool) -> list[Method]:
    """Time per point against error on one cell: damping 2 %, 40 dB, 8 periods."""
    plant = Plant(0.02, 40.0, 8)
    runs = 200 if quick else 2000
    wide = plant.bins(10.0, 1030.0)
    inside = np.isin(wide, plant.bins())
    rng = np.random.default_rng(7)
    u, y = plant.noisy(rng, runs, wide)
    joint_u, joint_y = np.ascontiguousarray(u[:, inside]), np.ascontiguousarray(y[:, inside])
    frequency_hz, spectra, covariance, dof = local_polynomial_spectra(plant, u, y, wide)
    frf = FRF(
        frequency_hz,
        ratio(spectra),
        variance_noise=error_variance(ratio(spectra), covariance) / power(spectra[:, 1]),
        noise_dof=dof,
    )
    records = np.random.default_rng(0).standard_normal((10, 2, 8 * SAMPLES_PER_PERIOD))
    contestants = [
        Contestant(
            "Fourier transform of the record, 2 channels",
            # one channel after the other, as `JointPlan` does; every record a new one
            lambda: [scipy.fft.rfft(channel) for record in records for channel in record],
            len(records),
            lambda _: np.full((1, 2), np.nan),
        )
    ]
    missing = []
    few_frfs = [_row(frf, k) for k in range(50)]
    times = BATCH // 10 // runs if quick else BATCH // runs
    batch = _repeated(frf, times)
    many_u, many_y = (np.tile(values, (times, 1)) for values in (joint_u, joint_y))
    for structure, model in ((BARE, "2nd order"), (ModelStructure(), "mode + 6 residual terms")):
        plan = joint_plan(plant, structure)
        contestants += [
            Contestant(
                f"joint, {model}, batched",
                lambda p=plan: p.from_bins(many_u, many_y),
                len(many_y),
                lambda result: estimates_of(result)[:runs],
            ),
            Contestant(
                f"joint, {model}, single",
                lambda p=plan: [p.from_bins(joint_u[k], joint_y[k]) for k in range(50)],
                50,
            ),
        ]
        contestants += [
            Contestant(
                f"FRF, {model}, batched",
                lambda s=structure: identify_batch(batch, structure=s),
                batch.g.shape[0],
                lambda result: estimates_of(result)[:runs],
            ),
            Contestant(
                f"FRF, {model}, single",
                lambda s=structure: [identify_frf(f, structure=s) for f in few_frfs],
                50,
            ),
        ]
    few = 40 if quick else 200
    wide_hz, wide_spectra, _, _ = local_polynomial_spectra(
        plant, u[:few], y[:few], wide, (20.0, 1000.0)
    )
    joint = (plant.bins(), joint_u, joint_y)
    wide_frf = (wide_hz, wide_spectra[:, 0] / wide_spectra[:, 1])
    for name, peer in PEERS:
        case = Case(plant, frequency_hz, frf.g, frf.variance_noise, joint, *wide_frf)
        try:
            function = peer(case)
        except ImportError as error:
            missing.append(_missing(name, error))
            continue
        estimates = np.array([function(k) for k in range(few)])
        contestants.append(
            Contestant(
                name,
                lambda f=function: [f(k) for k in range(20)],
                20,
                lambda _, e=estimates: e,
            )
        )
    return _measured(contestants, np.sqrt(np.diag(plant.bound()))) + missing


def _measured(contestants: list[Contestant], bound: FloatArray, rounds: int = 15) -> list[Method]:
    """Least processor time of several rounds in which all take turns, after a first call.

    In turns, so that a machine that is busy for a while slows all of them.
    """
    results = [c.call() for c in contestants]
    times = np.full((rounds, len(contestants)), np.nan)
    for row in times:
        for k, c in enumerate(contestants):
            start = time.process_time()
            c.call()
            row[k] = (time.process_time() - start) / c.points
    methods: list[Method] = []
    for c, result, time_s in zip(contestants, results, times.min(axis=0), strict=True):
        error, note = methods[-1].error if methods else np.full(2, np.nan), ""
        if c.estimates is not None:
            estimates = c.estimates(result)
            with np.errstate(invalid="ignore"):
                error = np.sqrt(_mean_square(estimates - [250.0, 0.02])) / bound
            failed = int(np.sum(~np.isfinite(estimates).all(axis=-1)))
            if 0 < failed < len(estimates):
                note = f"{failed} of {len(estimates)} without a pole"
        methods.append(Method(c.name, float(time_s), error, note))
    return methods


def _mean_square(errors: npt.NDArray) -> FloatArray:
    """(2,) over the rows that are finite; NaN where there is none."""
    good = errors[np.isfinite(errors).all(axis=-1)]
    return np.mean(good**2, axis=0) if good.size else np.full(2, np.nan)


def _missing(name: str, error: ImportError) -> Method:
    return Method(name, np.nan, np.full(2, np.nan), f"not measured: {error}")


def estimates_of(result: PolesBatch) -> FloatArray:
    """(runs, 2) f0 and damping ratio."""
    return np.stack([result.f0_hz[:, 0], result.damping_ratio[:, 0]], -1)


def _repeated(frf: FRF, times: int) -> FRF:
    return dataclasses.replace(
        frf, g=np.tile(frf.g, (times, 1)), variance_noise=np.tile(frf.variance_noise, (times, 1))
    )


def _row(frf: FRF, k: int) -> FRF:
    return dataclasses.replace(frf, g=frf.g[k], variance_noise=frf.variance_noise[k])
