# SPDX-License-Identifier: Apache-2.0
"""The joint estimator through compiled code: the same answers, for one mode, in less time.

`numba` is an optional dependency (``pip install tactile_resonance[compiled]``); the first fit of a
process loads the compiled code, the first one after an installation compiles it, which takes some
ten seconds. numba keeps it beside the source or, where that cannot be written, in its own cache
(NUMBA_CACHE_DIR).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import special

from tactile_resonance.identification import one_mode
from tactile_resonance.identification.bins import BinData
from tactile_resonance.identification.compiled import kernel
from tactile_resonance.identification.covariance import BAND_MARGIN
from tactile_resonance.identification.joint import METHOD, JointPlan
from tactile_resonance.identification.joint_noise import BINS_PER_BAND, FEWEST_PIECES
from tactile_resonance.identification.judgement import LARGEST_CONDITION_NUMBER
from tactile_resonance.identification.kernel_tables import GroupTable, interleaved
from tactile_resonance.identification.lacking import asks, lacking_terms
from tactile_resonance.identification.model import RationalModel
from tactile_resonance.identification.model_error import MODEL_ERROR_PROBABILITY
from tactile_resonance.identification.noise_level import FALSE_ALARM, flat_limit
from tactile_resonance.identification.result import (
    STATUS_CODE,
    PolesBatch,
    PolesStatus,
)
from tactile_resonance.identification.significance import significant_modes
from tactile_resonance.identification.solver import MAX_ITERATIONS, ROUNDING, STEP_TOLERANCE
from tactile_resonance.identification.whiteness import are_smooth

# Points whose residuals still are in the cache when they are judged.
CHUNK = 2000

ComplexArray = npt.NDArray[np.complex128]
FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CompiledJointPlan(JointPlan):
    """`JointPlan` whose ordinary points are fitted by compiled code.

    Ordinary is a point with finite bins, noise that is flat and independent on both channels, a fit
    that converges without damping and that nothing contradicts, and its pole in the band. All
    others are fitted by `JointPlan`.

    Raises
    ------
    ImportError
        Without numba.
    ValueError
        As `JointPlan`, and for structures other than one mode in the s-domain, and where there are
        no bins between harmonics or more than fit the kernel's memory.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.structure.order != 2 or self.structure.domain != "s":
            raise ValueError(
                f"structure: order {self.structure.order} in {self.structure.domain}, compiled is "
                "order 2 in s"
            )
        if self.other_bins.size == 0:
            raise ValueError(
                f"periods: {self.periods} without bins between harmonics, compiled needs at least 2 "
                "periods of a periodic input"
            )
        most = kernel("joint_kernel").MOST_BINS
        if max(self.other_bins.size, self.excited_bins.size) > most:
            raise ValueError(
                f"periods: {self.periods} make {self.other_bins.size} bins between harmonics of "
                f"{self.band_hz} Hz, compiled takes up to {most}"
            )

    def from_bins(self, u: ComplexArray, y: ComplexArray) -> PolesBatch:
        """Poles from the bins of the band of the DFT of whole records; see `JointPlan.from_bins`."""
        u, y = self._checked(u, y)
        if self.problem.driven is self.problem:
            return super().from_bins(u, y)  # which takes few lines
        code = kernel("joint_kernel")
        shape = y.shape[:-1]
        flat_u, flat_y = (
            np.ascontiguousarray(v, complex).reshape(-1, self.bins.size) for v in (u, y)
        )
        batch = flat_y.shape[0]
        n = sum(self.problem.sizes)
        ordinary = np.zeros(batch, bool)
        theta = np.empty((batch, n))
        covariance = np.empty((batch, n, n))
        residual = np.zeros((batch, self.excited_bins.size), complex)
        figures = np.empty((batch, one_mode.FIGURES))
        out = (ordinary, theta, covariance, residual, figures)
        for first in range(0, batch, CHUNK):
            rows = slice(first, first + CHUNK)
            part = tuple(values[rows] for values in out)
            code.fit_points(flat_u[rows], flat_y[rows], *self._constants, part)
            ordinary[rows] &= ~are_smooth(residual[rows], self.structure.parameters)
            cost, expected = (part[-1][:, k] for k in (one_mode.COST, one_mode.EXPECTED))
            ordinary[rows] &= ~self._lack(
                np.flatnonzero(ordinary[rows] & asks(self, cost, expected, residual[rows])),
                (flat_u[rows], flat_y[rows], *part),
            )
        result = self._ordinary(theta, covariance, residual, figures)
        if not ordinary.all():
            rest = np.flatnonzero(~ordinary)
            result = _replaced(result, rest, super().from_bins(flat_u[rest], flat_y[rest]))
        return result if shape == (batch,) else _reshaped(result, shape)

    def _lack(
        self, asked: npt.NDArray[np.int64], points: tuple[npt.NDArray, ...]
    ) -> npt.NDArray[np.bool_]:
        """(batch,) which points, of those asked for, need more than the model has; see `lacking`."""
        lack = np.zeros(points[0].shape[0], bool)
        if not asked.size:
            return lack
        u, y, _, theta, _, _, figures = (values[asked] for values in points)
        noise = figures[:, one_mode.NOISE_Y : one_mode.NOISE_Y + 2]
        variance_y, variance_u = (np.ascontiguousarray(noise[:, k : k + 1]) for k in (0, 1))
        u_e, y_e = (values.take(self.excited_at, axis=1) for values in (u, y))
        data = [
            BinData(y.take(self.others_at, axis=1), None, variance_y),
            BinData(y_e, u_e, variance_y, variance_u),
        ]
        lack[asked] = np.isfinite(lacking_terms(self, data, theta)[:, 0])
        return lack

    def _ordinary(
        self,
        theta: FloatArray,
        covariance: FloatArray,
        residual: ComplexArray,
        figures: FloatArray,
    ) -> PolesBatch:
        batch = theta.shape[0]
        a, b, _ = self.problem.sizes
        denominator = np.ones((batch, a + 1))
        denominator[:, :a] = theta[:, :a]
        pole, of_pole, of_f0 = one_mode.POLE, one_mode.POLE_COVARIANCE, one_mode.COVARIANCE
        places = figures[:, pole : pole + 4].copy().view(complex)
        quantities = {
            "poles_rad_s": places[:, :1],
            "f0_hz": figures[:, one_mode.F0_HZ, None],
            "damping_ratio": figures[:, one_mode.DAMPING, None],
            "residues": places[:, 1:],
            "pole_covariance": figures[:, of_pole : of_pole + 4].reshape(batch, 1, 2, 2),
            "covariance": figures[:, of_f0 : of_f0 + 4].reshape(batch, 1, 2, 2),
        }
        model = RationalModel(
            denominator,
            theta[:, a : a + b],
            self.variable,
            self.denominator_basis,
            self.numerator_basis,
            theta[:, a + b :],
        )
        lines = np.full(batch, self.excited_bins.size)
        significant = significant_modes(model, quantities, covariance, lines)
        code = np.where(
            significant[:, 0], STATUS_CODE[PolesStatus.OK], STATUS_CODE[PolesStatus.NO_RESONANCE]
        )
        return PolesBatch(
            **quantities,
            total_covariance=np.full((batch, 1, 2, 2), np.nan),
            coefficient_covariance=covariance,
            cost=figures[:, one_mode.COST],
            expected_cost=figures[:, one_mode.EXPECTED],
            condition_number=figures[:, one_mode.CONDITION],
            residual=residual,
            lines=lines,
            significant=significant,
            status_code=code.astype(np.uint8),
            noise_variance=figures[:, one_mode.NOISE_Y : one_mode.NOISE_Y + 2],
            lacking=np.full((batch, 3), np.nan),
            fit=model,
            structure=self.structure,
            band_hz=self.band_hz,
            variance_model=np.full(batch, "flat", "U8"),
            method=METHOD,
        )

    @cached_property
    def _constants(self) -> tuple:
        """Arguments of `joint_kernel.fit_points` between the bins and the results."""
        a, b, c = self.problem.sizes
        bands = self.noise_bands
        others = self.other_bins.size
        margin = BAND_MARGIN * (self.band_hz[1] - self.band_hz[0])
        tested = bands.starts.size >= FEWEST_PIECES
        limits = np.array(
            [
                1 - FALSE_ALARM ** (1 / max(others - 1, 1)),
                flat_limit(bands.starts.size, BINS_PER_BAND) if tested else 0.0,
                others / max(others - c / 2, 1.0),
                ROUNDING**2,
                STEP_TOLERANCE**2 / max(2 * self.bins.size - (a + b + c), 1),
                MAX_ITERATIONS,
                special.ndtri(1 - MODEL_ERROR_PROBABILITY),
                LARGEST_CONDITION_NUMBER,
                self.variable.scale_rad_s,
                self.band_hz[0] - margin,
                self.band_hz[1] + margin,
            ]
        )
        others_in_turn = interleaved(bands.counts)
        sizes = self.problem.sizes
        tables = (
            GroupTable.of(self.problem.groups[0], sizes, others_in_turn),
            GroupTable.of(self.problem.groups[1], sizes),
        )
        return (
            (
                (self.others_at, np.argsort(others_in_turn)),
                (self.excited_at, np.arange(self.excited_at.size)),
            ),
            tables,
            bands.counts,
            (self.denominator_basis.hessenberg, self.numerator_basis.hessenberg),
            limits,
            kernel("joint_kernel").workspace(tables, a + b + c),
        )


def _arrays(result: PolesBatch) -> dict[str, Any]:
    values = {f.name: getattr(result, f.name) for f in fields(result)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def _replaced(result: PolesBatch, rows: npt.NDArray, other: PolesBatch) -> PolesBatch:
    """With other results in some rows."""

    def merged(values: npt.NDArray, new: npt.NDArray) -> npt.NDArray:
        values = values.astype(np.result_type(values, new), copy=False)
        values[rows] = new
        return values

    theirs = _arrays(other)
    model = replace(
        result.fit,
        denominator=merged(result.fit.denominator, other.fit.denominator),
        numerator=merged(result.fit.numerator, other.fit.numerator),
        transient=merged(result.fit.transient, other.fit.transient),
    )
    changed: dict[str, Any] = {
        name: merged(values, theirs[name]) for name, values in _arrays(result).items()
    }
    return replace(result, fit=model, **changed)


def _reshaped(result: PolesBatch, shape: tuple[int, ...]) -> PolesBatch:
    """With leading axes `shape` instead of one of all points."""

    def batch(values: npt.NDArray) -> npt.NDArray:
        return values.reshape((*shape, *values.shape[1:]))

    model = result.fit
    model = replace(
        model,
        denominator=batch(model.denominator),
        numerator=batch(model.numerator),
        transient=batch(model.transient),
    )
    changed: dict[str, Any] = {name: batch(values) for name, values in _arrays(result).items()}
    return replace(result, fit=model, **changed)
