# SPDX-License-Identifier: Apache-2.0
"""Cost of ``Y = (B U + C) / A`` on groups of bins, its derivatives, and start values.

Start values by Sanathanan-Koerner iterations (IEEE Trans. Autom. Control 8 (1963) 56-58); the cost is

    sum_k |Y - (B U + C) / A|^2 / (s_Y^2 + s_U^2 |B/A|^2 - 2 Re(s_YU conj(B/A)))

(Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012), sections
8.3, 9.11 and 12.3). The gradient is exact; the normal matrix leaves the derivative of the denominator
out, which is smaller by the signal-to-noise ratio of the input.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.bins import BinData, BinGroup
from tactile_resonance.identification.normal_equations import solve_scaled, step_and_decrement
from tactile_resonance.identification.one_point import OnePoint, StackedBasis

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

START_ITERATIONS = 2
# Values in a chunk's arrays: few enough for the cache, enough to make little of the calls.
CHUNK_VALUES = 65536


@dataclass(frozen=True, eq=False)
class Problem:
    """Groups of bins that share coefficients.

    Attributes
    ----------
    groups : tuple of BinGroup
    """

    groups: tuple[BinGroup, ...]

    @cached_property
    def places(self) -> list[npt.NDArray[np.int64]]:
        """Of each group, where its distinct normal entries stand."""
        return [group.places(self.sizes) for group in self.groups]

    @cached_property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of free coefficients of A, B and C."""
        terms = [0, 0, 0]
        for group in self.groups:
            terms[0] = group.denominator.shape[1] - 1
            if group.numerator is not None:
                terms[1] = group.numerator.shape[1]
            if group.transient is not None:
                terms[2] = group.transient.shape[1]
        return terms[0], terms[1], terms[2]

    @cached_property
    def stacked(self) -> StackedBasis:
        """Basis for one point at a time."""
        return StackedBasis.of(self.groups, self.sizes)

    @property
    def chunk(self) -> int:
        """Points that are computed together."""
        return max(1, CHUNK_VALUES // max(1, sum(group.size for group in self.groups)))

    def split(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coefficients of A (with its last), B and C, each (batch, terms)."""
        a, b, _ = self.sizes
        one = np.ones((theta.shape[0], 1))
        return (
            np.concatenate([theta[:, :a], one], axis=1),
            np.ascontiguousarray(theta[:, a : a + b]),
            np.ascontiguousarray(theta[:, a + b :]),
        )

    def model(
        self, group: BinGroup, data: BinData, theta: FloatArray
    ) -> tuple[ComplexArray, FloatArray, ComplexArray, ComplexArray | None]:
        """1 / A, its squared modulus, the modelled y, and B / A (None without input)."""
        alpha, beta, gamma = self.split(theta)
        a = group.evaluate(0, alpha)  # (batch, K)
        inverse_2 = 1 / (a.real**2 + a.imag**2)
        inverse_a = np.conj(a)
        inverse_a *= inverse_2
        g = None
        if group.transient is not None:
            y = group.evaluate(2, gamma)
            y *= inverse_a
        else:
            y = np.zeros_like(inverse_a)
        if group.numerator is not None:
            g = group.evaluate(1, beta)
            g *= inverse_a
            y += g if data.u is None else g * data.u
        return inverse_a, inverse_2, y, g

    def linearise(
        self, data: Sequence[BinData], theta: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost (batch, groups), half its gradient (batch, n), normals (batch, groups, n, n)."""
        batch, n = theta.shape
        cost = np.empty((batch, len(self.groups)))
        gradient = np.zeros((batch, n))
        normal = np.empty((batch, len(self.groups), n, n))
        for k, (group, values) in enumerate(zip(self.groups, data, strict=True)):
            inverse_a, m, y, g = self.model(group, values, theta)
            weight, slope = _weights(values, g)
            error = values.y - y
            z = np.conj(error) * inverse_a
            squared = error.real**2 + error.imag**2
            # one variance for all bins of a point: it may as well scale what the bins add up to
            last = weight if weight.shape[-1] == 1 else 1.0
            if last is not weight:
                z *= weight
                squared *= weight
                m = m * weight
            z_alpha, z_beta = z * y, z
            if group.numerator is not None and values.u is not None:
                z_beta = z * values.u
            if slope is not None and g is not None:
                h = squared * weight * slope * inverse_a
                z_alpha += h * g
                z_beta = z_beta + h
            part = self._gradient(group, z_alpha, z_beta, z)
            entries = group.normal_entries(m, y, values.u)
            if last is weight:
                part *= last
                entries *= last
            cost[:, k] = (squared * last).sum(axis=-1)
            gradient += part
            normal[:, k] = entries[:, self.places[k]]
        return cost, gradient, normal

    def rough(self, data: Sequence[BinData]) -> FloatArray:
        """(batch, n) start values and one Gauss-Newton step: residuals are then all but noise."""
        if data[0].y.shape[0] == 1:
            point = OnePoint(self.stacked, data)
            begin = point.start(START_ITERATIONS)
            _, gradient, normal = point.linearise(begin)
            step = step_and_decrement(normal.sum(axis=0), gradient)[0]
            return (begin - step if np.isfinite(step).all() else begin)[None]
        theta = self.start(data)
        _, gradient, normal = self.linearise(data, theta)
        moved = theta - solve_scaled(normal.sum(axis=1), gradient)[0]
        return np.where(np.isfinite(moved).all(axis=-1, keepdims=True), moved, theta)

    def first(self, data: Sequence[BinData]) -> FloatArray:
        """(batch, n) start values."""
        if data[0].y.shape[0] == 1:
            return OnePoint(self.stacked, data).start(START_ITERATIONS)[None]
        return self.start(data)

    def start(self, data: Sequence[BinData], iterations: int = START_ITERATIONS) -> FloatArray:
        """(batch, n) coefficients by Sanathanan-Koerner iterations."""
        batch = data[0].y.shape[0]
        n = sum(self.sizes)
        weight = [1 / values.variance_y for values in data]
        m = [
            np.broadcast_to(w, values.y.shape).copy()
            for w, values in zip(weight, data, strict=True)
        ]
        theta = np.zeros((batch, n))
        for iteration in range(iterations):
            gradient = np.zeros((batch, n))
            normal = np.zeros((batch, n, n))
            for group, values, mk, places in zip(self.groups, data, m, self.places, strict=True):
                z = np.asarray(np.conj(values.y * group.denominator[:, -1]) * mk, complex)
                z_beta = z if values.u is None else z * values.u
                gradient += self._gradient(group, z * values.y, z_beta, z)
                normal += group.normal_entries(mk, values.y, values.u)[:, places]
            theta = -solve_scaled(normal, gradient)[0]
            if iteration + 1 < iterations:
                alpha = self.split(theta)[0]
                for k, group in enumerate(self.groups):
                    a = group.evaluate(0, alpha)
                    m[k] = weight[k] / (a.real**2 + a.imag**2)
        return theta

    def _gradient(
        self, group: BinGroup, z_alpha: ComplexArray, z_beta: ComplexArray, z_gamma: ComplexArray
    ) -> FloatArray:
        """(batch, n) ``Re sum z_alpha p``, ``- Re sum z_beta q``, ``- Re sum z_gamma t``."""
        a, b, _ = self.sizes
        out = np.zeros((z_alpha.shape[0], sum(self.sizes)))
        out[:, :a] = group.gradient(0, z_alpha)
        if group.numerator is not None:
            out[:, a : a + b] = -group.gradient(1, z_beta)
        if group.transient is not None:
            out[:, a + b :] = -group.gradient(2, z_gamma)
        return out


def _weights(values: BinData, g: ComplexArray | None) -> tuple[FloatArray, ComplexArray | None]:
    """One over the variance of the residual, and half its derivative by g (or None)."""
    if values.variance_u is None or g is None:
        return np.asarray(1 / values.variance_y), None
    slope = np.asarray(values.variance_u * np.conj(g), complex)
    if values.covariance_yu is not None:
        slope = slope - np.conj(values.covariance_yu)
    return np.asarray(1 / values.residual_variance(g)), slope
