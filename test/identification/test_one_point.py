# SPDX-License-Identifier: Apache-2.0
"""One point by itself, and the same point in a batch: two ways of computing, one answer."""

import numpy as np
import pytest

from tactile_resonance.identification.basis import PolynomialBasis
from tactile_resonance.identification.bins import BinData, BinGroup
from tactile_resonance.identification.normal_equations import solve_one, solve_scaled
from tactile_resonance.identification.one_point import OnePoint
from tactile_resonance.identification.problem import Problem
from tactile_resonance.identification.solver import minimise

RNG = np.random.default_rng(4)


def normal(*shape):
    return RNG.standard_normal((*shape, 2)).view(complex)[..., 0]


def problem_and_data(batch, errors_in_variables, transient):
    """A group with input and one without, of points that differ in everything."""
    x = 1j * np.linspace(0.8, 1.2, 60)
    excited = np.arange(60) % 4 == 0
    denominator = PolynomialBasis.on_lines(x, 2).values
    numerator = PolynomialBasis.on_lines(x[excited], 4).values
    third = PolynomialBasis.on_lines(x, 2).values if transient else None
    groups = [BinGroup(denominator[excited], numerator, third[excited] if transient else None)]
    u = 1 + 0.3 * normal(batch, 15)
    poles = 0.02 + 0.02 * RNG.random((batch, 1))
    a = x**2 + 2 * poles * x + 1
    y = 0.5 * u / a[:, excited] + 0.01 * normal(batch, 15)
    extra = (None, None)
    if errors_in_variables:
        extra = (1e-4 * (1 + RNG.random((batch, 15))), 3e-5 * normal(batch, 15))
    data = [BinData(y, u, 1e-4 * (1 + RNG.random((batch, 15))), *extra)]
    if transient:
        groups.insert(0, BinGroup(denominator[~excited], None, third[~excited]))
        y_o = (0.05 + 0.02 * x[~excited]) / a[:, ~excited] + 0.01 * normal(batch, 45)
        data.insert(0, BinData(y_o, None, np.full((batch, 1), 2e-4)))
    return Problem(tuple(groups)), data


@pytest.mark.parametrize("transient", [True, False])
@pytest.mark.parametrize("errors_in_variables", [True, False])
def test_equal_the_batch(errors_in_variables, transient):
    problem, data = problem_and_data(5, errors_in_variables, transient)
    start = problem.start(data, 2)
    whole = problem.linearise(data, start)
    fitted = minimise(problem, data)
    for k in range(5):
        row = [values.rows(slice(k, k + 1)) for values in data]
        point = OnePoint(problem.stacked, row)
        assert point.start(2) == pytest.approx(start[k], rel=1e-9)
        cost, gradient, square = (values[k] for values in whole)
        mine = point.linearise(start[k])
        assert mine[0] == pytest.approx(cost, rel=1e-10)
        # near the minimum the gradient is a small difference of products this large
        size = np.sqrt(cost.sum() * np.diag(square.sum(axis=0)).max())
        assert np.abs(mine[1] - gradient).max() < 1e-12 * size
        assert np.abs(mine[2] - square).max() < 1e-12 * np.abs(square).max()
        alone = minimise(problem, row)
        assert alone.converged[0]
        assert fitted.converged[k]
        assert alone.theta[0] == pytest.approx(fitted.theta[k], rel=1e-7, abs=1e-9)
        assert alone.cost[0] == pytest.approx(fitted.cost[k], rel=1e-10)


def test_gradient_is_that_of_the_cost():
    problem, data = problem_and_data(1, True, True)
    point = OnePoint(problem.stacked, data)
    theta = point.start(2)
    gradient = point.linearise(theta)[1]
    for k in range(theta.size):
        step = np.zeros_like(theta)
        step[k] = 1e-6 * max(abs(theta[k]), 0.1)
        up, down = (point.linearise(theta + sign * step)[0].sum() for sign in (1, -1))
        slope = (up - down) / (2 * step[k])
        assert 2 * gradient[k] == pytest.approx(slope, rel=1e-4, abs=1e-3)


def test_solution_of_one_system():
    matrix = RNG.standard_normal((9, 6)) * np.logspace(-6, 6, 6)
    square, right = matrix.T @ matrix, RNG.standard_normal(6)
    for damping in (0.0, 0.3):
        damped = square + damping * np.diag(np.diag(square))
        scale = 1 / np.sqrt(np.diag(square))
        expected = scale * np.linalg.solve(damped * np.outer(scale, scale), scale * right)
        assert solve_one(square, right, damping) == pytest.approx(expected, rel=1e-8)
    indefinite = np.array([[1.0, 2.0], [2.0, 1.0]])
    assert np.isnan(solve_one(indefinite, np.ones(2))).all()
    # the general solver takes over then
    step, _ = solve_scaled(indefinite[None], np.ones((1, 2)))
    assert step[0] == pytest.approx([1 / 3, 1 / 3])
