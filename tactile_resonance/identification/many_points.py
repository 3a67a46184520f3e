# SPDX-License-Identifier: Apache-2.0
"""The linearised cost of many points at once; see `one_point` for a single one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.bins import BinData, BinGroup
from tactile_resonance.identification.normal_equations import solve_scaled

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


@dataclass(eq=False)
class GroupValue:
    """The model on the bins of a group.

    Attributes
    ----------
    inverse : (batch, K) complex
        1 / A.
    inverse_2 : (batch, K) float
        Its squared modulus.
    model, error : (batch, K) complex
        Y of the model, and what Y of the data exceeds it by.
    g : (batch, K) complex or None
        B / A; None without input.
    """

    inverse: ComplexArray
    inverse_2: FloatArray
    model: ComplexArray
    error: ComplexArray
    g: ComplexArray | None


@dataclass(eq=False)
class ManyValues:
    """The model of a batch at some coefficients.

    Attributes
    ----------
    groups : list of GroupValue
    squared : list of (batch, K) float
        Squared moduli of the weighted errors of each group.
    group_cost : (batch, groups) float
    """

    groups: list[GroupValue]
    squared: list[FloatArray]
    group_cost: FloatArray

    @property
    def cost(self) -> FloatArray:
        """(batch,) of all groups."""
        return np.asarray(self.group_cost.sum(axis=-1))

    def error_of(self, part: int) -> ComplexArray:
        """(batch, K_g) error on the bins of a group."""
        return self.groups[part].error


class ManyPoints:
    """Cost, gradients and normal matrices of a batch.

    The Jacobian of the weighted error is a fixed basis times one complex weight per bin and kind of
    coefficient, so the normal matrices are products of these weights with constants.

    Parameters
    ----------
    groups : sequence of BinGroup
        Of which only the last one has an input.
    places : sequence of (n, n) int
        Of each group, where its distinct normal entries stand: see `BinGroup.places`.
    sizes : (int, int, int)
        Numbers of free coefficients of A, B and C.
    data : sequence of BinData
        Of each group, with the same batch.
    """

    def __init__(
        self,
        groups: Sequence[BinGroup],
        places: Sequence[npt.NDArray[np.int64]],
        sizes: tuple[int, int, int],
        data: Sequence[BinData],
    ) -> None:
        self._groups, self._places, self._sizes = groups, places, sizes
        self._data = list(data)

    def weigh(self, data: Sequence[BinData]) -> None:
        """Weights by the variances of `data`; y and u stay."""
        self._data = list(data)

    def rows(self, which: slice | npt.NDArray) -> ManyPoints:
        """Some of the points."""
        data = [values.rows(which) for values in self._data]
        return ManyPoints(self._groups, self._places, self._sizes, data)

    @property
    def free(self) -> int:
        """Real equations beyond the coefficients."""
        bins = sum(group.size for group in self._groups)
        return int(max(2 * bins - sum(self._sizes), 1))

    @property
    def weighted_power(self) -> FloatArray:
        """(batch,) ``sum |y|^2 / s_Y^2``."""
        powers = [(v.y.real**2 + v.y.imag**2) / v.variance_y for v in self._data]
        return np.asarray(sum(power.sum(axis=-1) for power in powers))

    def evaluate(self, theta: FloatArray) -> ManyValues:
        """The model at theta (batch, n), unweighted: see `weight`."""
        pairs = zip(self._groups, self._data, strict=True)
        return ManyValues(
            [self._group_value(group, values, theta) for group, values in pairs], [], np.empty(0)
        )

    def weight(self, value: ManyValues) -> ManyValues:
        """The same with the cost of the weighted errors."""
        value.squared = []
        value.group_cost = np.empty((value.groups[0].error.shape[0], len(value.groups)))
        for k, (at, values) in enumerate(zip(value.groups, self._data, strict=True)):
            squared = at.error.real**2
            squared += at.error.imag**2
            variance = values.residual_variance(at.g)
            # one variance for all bins of a point: it may as well scale what the bins add up to
            if variance.shape[-1] > 1:
                squared /= variance
                value.group_cost[:, k] = squared.sum(axis=-1)
            else:
                value.group_cost[:, k] = squared.sum(axis=-1) / variance[:, 0]
            value.squared.append(squared)
        return value

    def normals(self, value: ManyValues) -> tuple[FloatArray, FloatArray]:
        """Half the gradients (batch, n), normals (batch, groups, n, n), of a weighted value."""
        batch, n = value.group_cost.shape[0], sum(self._sizes)
        gradient = np.zeros((batch, n))
        normal = np.empty((batch, len(self._groups), n, n))
        for k, (group, at, values) in enumerate(
            zip(self._groups, value.groups, self._data, strict=True)
        ):
            weight, slope = _weights(values, at.g)
            z = np.conj(at.error)
            z *= at.inverse
            m, last = at.inverse_2, weight if weight.shape[-1] == 1 else None
            if last is None:
                z *= weight
                m = m * weight
            z_alpha, z_beta = z * at.model, z
            if group.numerator is not None and values.u is not None:
                z_beta = z * values.u
            if slope is not None and at.g is not None:
                slope *= at.inverse
                slope *= value.squared[k] * weight
                z_beta = z_beta + slope
                slope *= at.g
                z_alpha += slope
            part = self._gradient(group, z_alpha, z_beta, z)
            entries = group.normal_entries(m, at.model, values.u)
            if last is not None:
                part *= last
                entries *= last
            gradient += part
            normal[:, k] = entries[:, self._places[k]]
        return gradient, normal

    def step(
        self, normal: FloatArray, gradient: FloatArray, damping: FloatArray | float = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Levenberg-Marquardt steps to be subtracted (batch, n), and what they lower the cost by."""
        total = normal[:, 0] if normal.shape[1] == 1 else normal[:, 0] + normal[:, 1]
        return solve_scaled(total, gradient, damping)

    def last_residual(self, theta: FloatArray) -> ComplexArray:
        """(batch, K) weighted errors of the last group at theta."""
        values = self._data[-1]
        at = self._group_value(self._groups[-1], values, theta)
        return np.asarray(at.error / np.sqrt(values.residual_variance(at.g)))

    def start(self, iterations: int, theta: FloatArray | None = None) -> FloatArray:
        """(batch, n) coefficients by Sanathanan-Koerner iterations, from weights 1 or those of theta."""
        for _ in range(iterations):
            gradient, normal = self.start_equations(theta)
            theta = -solve_scaled(normal, gradient)[0]
        assert theta is not None
        return theta

    def start_equations(self, theta: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """Gradient (batch, n) and normal matrices (batch, n, n) of a Sanathanan-Koerner iteration.

        Of coefficients that solve them with a minus; weights are 1 or those of theta (batch, n).
        """
        data, groups = self._data, self._groups
        batch, n = data[0].y.shape[0], sum(self._sizes)
        gradient = np.zeros((batch, n))
        normal = np.zeros((batch, n, n))
        for group, values, places in zip(groups, data, self._places, strict=True):
            size: npt.NDArray = values.variance_y
            if theta is not None:
                a = group.evaluate(0, self._split(theta)[0])
                size = size * (a.real**2 + a.imag**2)
            m = np.broadcast_to(1 / size, values.y.shape)
            z = np.conj(values.y * group.denominator[:, -1])
            z *= m
            z_beta = z if values.u is None else z * values.u
            gradient += self._gradient(group, z * values.y, z_beta, z)
            normal += group.normal_entries(m, values.y, values.u)[:, places]
        return gradient, normal

    def _group_value(self, group: BinGroup, values: BinData, theta: FloatArray) -> GroupValue:
        alpha, beta, gamma = self._split(theta)
        a = group.evaluate(0, alpha)  # (batch, K)
        inverse_2 = a.real**2
        inverse_2 += a.imag**2
        np.divide(1, inverse_2, out=inverse_2)
        inverse = np.conj(a, out=a)
        inverse *= inverse_2
        g: ComplexArray | None = None
        model: ComplexArray | None = None
        if group.transient is not None:
            model = group.evaluate(2, gamma)
            model *= inverse
        if group.numerator is not None:
            g = group.evaluate(1, beta)
            g *= inverse
            driven = g if values.u is None else g * values.u
            model = driven if model is None else np.add(model, driven, out=model)
        assert model is not None
        return GroupValue(inverse, inverse_2, model, values.y - model, g)

    def _split(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coefficients of A (with its last), B and C, each (batch, terms)."""
        a, b, _ = self._sizes
        alpha = np.ones((theta.shape[0], a + 1))
        alpha[:, :a] = theta[:, :a]
        return alpha, theta[:, a : a + b], theta[:, a + b :]

    def _gradient(
        self, group: BinGroup, z_alpha: ComplexArray, z_beta: ComplexArray, z_gamma: ComplexArray
    ) -> FloatArray:
        """(batch, n) ``Re sum z_alpha p``, ``- Re sum z_beta q``, ``- Re sum z_gamma t``."""
        a, b, _ = self._sizes
        out = np.zeros((z_alpha.shape[0], sum(self._sizes)))
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
        slope -= np.conj(values.covariance_yu)
    return np.asarray(1 / values.residual_variance(g)), slope
