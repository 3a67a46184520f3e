# SPDX-License-Identifier: Apache-2.0
"""The linearised cost of a single point, with the least calls.

A batch takes its normal matrices from products with constants (`many_points`); for one point the time
is in the number of calls, not of operations: here all groups are stacked and the Jacobian is written
out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.bins import BinData, BinGroup
from tactile_resonance.identification.normal_equations import solve_one, step_and_decrement

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class StackedBasis:
    """Basis functions of all groups on their bins, one after the other; inputs are on the last group.

    Attributes
    ----------
    denominator : (a, K) complex
        Of the free coefficients of A.
    last : (K,) complex
        Of the fixed one.
    numerator : (b, K_last) complex
    transient : (c, K) complex
    values : tuple of (terms, 2 K or 2 K_last) float
        Real and imaginary parts of the three in turn.
    parts : tuple of slice
        Bins of each group.
    """

    denominator: ComplexArray
    last: ComplexArray
    numerator: ComplexArray
    transient: ComplexArray
    parts: tuple[slice, ...]
    values: tuple[FloatArray, FloatArray, FloatArray] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        values = tuple(b.view(float) for b in (self.denominator, self.numerator, self.transient))
        object.__setattr__(self, "values", values)

    @classmethod
    def of(cls, groups: Sequence[BinGroup]) -> StackedBasis:
        """Stack of groups of which only the last one has an input."""
        edges = np.cumsum([0] + [group.size for group in groups])
        whole = np.ascontiguousarray(np.concatenate([g.denominator for g in groups]).T)
        transient = np.empty((0, edges[-1]), complex)
        if groups[-1].transient is not None:
            transient = np.concatenate([np.asarray(g.transient) for g in groups]).T
        numerator = groups[-1].numerator
        assert numerator is not None
        return cls(
            whole[:-1],
            whole[-1],
            np.ascontiguousarray(numerator.T),
            np.ascontiguousarray(transient),
            tuple(slice(int(a), int(b)) for a, b in pairwise(edges)),
        )

    @property
    def kinds(self) -> tuple[slice, slice, slice]:
        """Places of the coefficients of A, of B, of C."""
        a, b, c = (basis.shape[0] for basis in self.values)
        return slice(0, a), slice(a, a + b), slice(a + b, a + b + c)


@dataclass(eq=False)
class OneValue:
    """The model of a point at some coefficients.

    Attributes
    ----------
    inverse, model, error : (K,) complex
        1 / A, Y of the model, and what Y of the data exceeds it by.
    g : (K_last,) complex
        B / A.
    root : (K,) float
        One over the standard deviation of the error, by the weights of the point.
    weighted : (K,) complex
        Error times root.
    group_cost : (groups,) float
    parts : tuple of slice
        Bins of each group.
    """

    inverse: ComplexArray
    model: ComplexArray
    error: ComplexArray
    g: ComplexArray
    root: FloatArray
    weighted: ComplexArray
    group_cost: FloatArray
    parts: tuple[slice, ...]

    @property
    def cost(self) -> float:
        """Of all groups."""
        return float(self.group_cost.sum())

    def error_of(self, part: int) -> ComplexArray:
        """(1, K_g) error on the bins of a group."""
        return self.error[None, self.parts[part]]


class OnePoint:
    """Cost, gradient and normal matrices of one point.

    Parameters
    ----------
    basis : StackedBasis
    data : sequence of BinData
        Of each group, with a batch of 1.
    """

    def __init__(self, basis: StackedBasis, data: Sequence[BinData]) -> None:
        self._basis = basis
        *others, last = data
        y = last.y[0]
        self._y = np.concatenate([*(values.y[0] for values in others), y]) if others else y
        self._u = None if last.u is None else last.u[0]
        a, b, c = self._kinds = basis.kinds
        self._jacobian = np.zeros((c.stop, basis.last.size), complex)
        self.weigh(data)

    def weigh(self, data: Sequence[BinData]) -> None:
        """Weights by the variances of `data`; y and u stay."""
        self._variances = [values.variance_y[0] for values in data]
        last = data[-1]
        self._variance_u = None if last.variance_u is None else last.variance_u[0]
        self._covariance = None if last.covariance_yu is None else last.covariance_yu[0]

    @property
    def free(self) -> int:
        """Real equations beyond the coefficients."""
        return int(max(2 * self._y.size - self._jacobian.shape[0], 1))

    @property
    def weighted_power(self) -> float:
        """``sum |y|^2 / s_Y^2``."""
        power = self._y.real**2 + self._y.imag**2
        parts = zip(self._basis.parts, self._variances, strict=True)
        return float(sum((power[part] / variance).sum() for part, variance in parts))

    def evaluate(self, theta: FloatArray) -> OneValue:
        """The model at theta (n,), unweighted: see `weight`."""
        basis = self._basis
        for_a, for_b, for_c = self._kinds
        of_a, of_b, of_c = basis.values
        a = (theta[for_a] @ of_a).view(complex)
        a += basis.last
        inverse = np.asarray(1 / a, complex)
        g = (theta[for_b] @ of_b).view(complex)
        last = basis.parts[-1]
        g *= inverse[last]
        driven = g if self._u is None else g * self._u
        if of_c.size:
            model = (theta[for_c] @ of_c).view(complex)
            model *= inverse
            model[last] += driven
        else:
            model = driven
        none = np.empty(0)
        error = self._y - model
        return OneValue(inverse, model, error, g, none, none.astype(complex), none, basis.parts)

    def weight(self, value: OneValue) -> OneValue:
        """The same with weighted errors and their cost."""
        basis = self._basis
        root = value.root = np.empty(self._y.size)
        for part, variance in zip(basis.parts, self._variances, strict=True):
            root[part] = variance
        if self._variance_u is not None:
            g = value.g
            more = self._variance_u * (g.real**2 + g.imag**2)
            if self._covariance is not None:
                more -= 2 * np.real(self._covariance * g.conj())
            root[basis.parts[-1]] += more
        np.sqrt(root, out=root)
        np.divide(1, root, out=root)
        value.weighted = value.error * root
        flat = value.weighted.view(float)
        parts = [flat[2 * part.start : 2 * part.stop] for part in basis.parts]
        value.group_cost = np.array([part @ part for part in parts])
        return value

    def normals(self, value: OneValue) -> tuple[FloatArray, FloatArray]:
        """Half the gradient (n,) of the cost, normals (groups, n, n), of a weighted value."""
        basis = self._basis
        real = self.jacobian(value)
        flat = value.weighted.view(float)
        gradient = real @ flat
        if self._variance_u is not None:
            last = basis.parts[-1]
            error, g, root = value.weighted[last], value.g, value.root[last]
            slope = self._variance_u * g.conj()
            if self._covariance is not None:
                slope -= self._covariance.conj()
            slope *= (error.real**2 + error.imag**2) * root**2
            slope *= value.inverse[last]
            for_a, for_b, _ = self._kinds
            gradient[for_b] -= basis.values[1] @ slope.conj().view(float)
            slope *= g
            here = slice(2 * last.start, 2 * last.stop)
            gradient[for_a] += basis.values[0][:, here] @ slope.conj().view(float)
        n = gradient.size
        normal = np.empty((len(basis.parts), n, n))
        for part, out in zip(basis.parts, normal, strict=True):
            rows = real[:, 2 * part.start : 2 * part.stop]
            np.matmul(rows, rows.T, out=out)
        return gradient, normal

    def jacobian(self, value: OneValue) -> FloatArray:
        """(n, 2 K) derivative of the weighted errors, real and imaginary parts; valid until the next call."""
        return self._weighted_jacobian(value.model, value.inverse * value.root)

    def step(
        self, normal: FloatArray, gradient: FloatArray, damping: float = 0.0
    ) -> tuple[FloatArray, float]:
        """Levenberg-Marquardt step to be subtracted (n,), and what it lowers the cost by."""
        total = normal[0] if len(normal) == 1 else normal[0] + normal[1]
        return step_and_decrement(total, gradient, damping)

    def residual_after(self, value: OneValue, step: FloatArray) -> ComplexArray:
        """(K_last,) weighted errors of the last group, a small step on from the latest `normals`."""
        last = self._basis.parts[-1]
        change = step @ self._jacobian.view(float)[:, 2 * last.start :]
        return np.asarray(value.weighted[last] - change.view(complex))

    def start(self, iterations: int, theta: FloatArray | None = None) -> FloatArray:
        """(n,) coefficients by Sanathanan-Koerner iterations, from weights 1 or those of theta (n,)."""
        basis = self._basis
        root = np.empty(self._y.size)
        for part, variance in zip(basis.parts, self._variances, strict=True):
            root[part] = variance
        np.sqrt(root, out=root)
        right = -self._y * basis.last
        for _ in range(iterations):
            size = root
            if theta is not None:
                a = (theta[self._kinds[0]] @ basis.values[0]).view(complex)
                a += basis.last
                size = root * np.abs(a)
            scale = 1 / size
            real = self._weighted_jacobian(self._y, scale)
            theta = solve_one(real @ real.T, real @ (right * scale).view(float))
        assert theta is not None
        return theta

    def _weighted_jacobian(self, y: ComplexArray, weight: npt.NDArray) -> FloatArray:
        """(n, 2 K) real and imaginary parts of ``weight (y p, -u q, -t)``; valid until the next call."""
        basis, jacobian = self._basis, self._jacobian
        for_a, for_b, for_c = self._kinds
        last = basis.parts[-1]
        minus = -weight
        np.multiply(basis.denominator, y * weight, out=jacobian[for_a])
        driven = minus[last] if self._u is None else self._u * minus[last]
        np.multiply(basis.numerator, driven, out=jacobian[for_b, last])
        if basis.values[2].size:
            np.multiply(basis.transient, minus, out=jacobian[for_c])
        return jacobian.view(float)
