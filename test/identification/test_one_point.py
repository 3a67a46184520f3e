# SPDX-License-Identifier: Apache-2.0
"""One point by itself, and the same point in a batch: two ways of computing, one answer."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_resonance.identification.basis import PolynomialBasis
from tactile_resonance.identification.bins import BinData, BinGroup
from tactile_resonance.identification.covariance import invert_normal
from tactile_resonance.identification.dense import refit_failed
from tactile_resonance.identification.normal_equations import MANY, solve_one, solve_scaled
from tactile_resonance.identification.problem import Problem
from tactile_resonance.identification.shared_points import minimise_shared
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
    many = problem.many_points(data)
    start = many.start(2)
    whole = many.weight(many.evaluate(start))
    gradients, squares = many.normals(whole)
    fitted = minimise(problem, data)
    for k in range(5):
        row = [values.rows(slice(k, k + 1)) for values in data]
        point = problem.one_point(row)
        assert point.start(2) == pytest.approx(start[k], rel=1e-9)
        value = point.weight(point.evaluate(start[k]))
        gradient, square = point.normals(value)
        assert value.group_cost == pytest.approx(whole.group_cost[k], rel=1e-10)
        # near the minimum the gradient is a small difference of products this large
        size = np.sqrt(value.cost * np.diag(squares[k].sum(axis=0)).max())
        assert np.abs(gradient - gradients[k]).max() < 1e-12 * size
        assert np.abs(square - squares[k]).max() < 1e-12 * np.abs(square).max()
        alone = minimise(problem, row)
        assert alone.converged[0]
        assert fitted.converged[k]
        assert alone.theta[0] == pytest.approx(fitted.theta[k], rel=1e-7, abs=1e-9)
        assert alone.cost[0] == pytest.approx(fitted.cost[k], rel=1e-10)
        assert np.abs(alone.residual[0] - fitted.residual[k]).max() < 1e-3


def test_points_that_a_batch_lost_are_found_by_the_dense_solver():
    """Searches ended at once, all or some of a batch: what comes back is what they would have found."""
    problem, data = problem_and_data(5, False, True)
    found = minimise(problem, data)
    lost = minimise(problem, data, max_iterations=0)
    assert found.converged.all()
    assert not lost.converged.any()
    assert_same(refit_failed(problem, lost, data), found)
    some = replace(found, converged=np.arange(5) != 2, theta=found.theta.copy())
    some.theta[2] = lost.theta[2]
    assert_same(refit_failed(problem, some, data), found)
    # and a point that is several records
    shared = minimise_shared(problem, data, 5)
    assert shared.converged.all()
    assert_same(minimise_shared(problem, data, 5, max_iterations=0), shared)


def assert_same(solution, other):
    """To a hundredth of a standard deviation; sums and residuals accordingly."""
    assert solution.converged.all()
    square = other.normal.sum(axis=-3)
    moved = solution.theta - other.theta
    assert np.einsum("...i,...ij,...j->...", moved, square, moved).max() < 1e-4
    size = np.sqrt(np.einsum("...ii->...i", square))
    scale = size[..., None, :, None] * size[..., None, None, :]
    assert np.abs((solution.normal - other.normal) / scale).max() < 1e-2
    assert solution.cost == pytest.approx(other.cost, rel=1e-5)
    assert solution.group_cost == pytest.approx(other.group_cost, rel=1e-3)
    assert np.abs(solution.residual - other.residual).max() < 1e-2


def test_gradient_is_that_of_the_cost():
    problem, data = problem_and_data(1, True, True)
    point = problem.one_point(data)
    theta = point.start(2)

    def cost(at):
        return point.weight(point.evaluate(at)).cost

    gradient = point.normals(point.weight(point.evaluate(theta)))[0]
    for k in range(theta.size):
        step = np.zeros_like(theta)
        step[k] = 1e-6 * max(abs(theta[k]), 0.1)
        slope = (cost(theta + step) - cost(theta - step)) / (2 * step[k])
        assert 2 * gradient[k] == pytest.approx(slope, rel=1e-4, abs=1e-3)


def test_start_values_from_weights_of_the_bins_with_an_input():
    """The first iteration on few bins, the second on all: as near as two on all."""
    problem, data = problem_and_data(5, False, True)
    many = problem.many_points(data)
    assert problem.driven is not problem
    twice, mixed = many.start(2), problem.start(many, data)
    _, square = many.normals(many.weight(many.evaluate(twice)))
    deviation = np.sqrt(np.einsum("bi,bij,bj->b", mixed - twice, square.sum(axis=1), mixed - twice))
    assert deviation.max() < 1
    one = problem.start(
        problem.one_point([v.rows(slice(2, 3)) for v in data]), [v.rows(slice(2, 3)) for v in data]
    )
    assert one == pytest.approx(mixed[2], rel=1e-8)


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


@pytest.mark.parametrize("n", [2, 7, 16])
def test_elimination_of_many_systems_at_once(n):
    """Scales of 24 decades, damping, a matrix without inverse, an indefinite one and one of NaN."""
    batch = 2 * MANY
    matrix = RNG.standard_normal((batch, n + 4, n))
    square, right = np.swapaxes(matrix, 1, 2) @ matrix, RNG.standard_normal((batch, n))
    scale = 10.0 ** RNG.uniform(-6, 6, (batch, n))
    wide = square * scale[:, :, None] * scale[:, None, :]
    for damping in (0.0, np.linspace(0, 3, batch)):
        damped = square + square * np.eye(n) * np.reshape(damping, (-1, 1, 1))
        expected = np.linalg.solve(damped, right[..., None])[..., 0] / scale
        step, decrement = solve_scaled(wide, right * scale, damping)
        assert step == pytest.approx(expected, rel=1e-7)
        assert decrement == pytest.approx(np.sum(expected * right * scale, axis=-1), rel=1e-9)
    inverse, condition = invert_normal(wide)
    eye = inverse * scale[:, :, None] * scale[:, None, :] @ square
    assert eye == pytest.approx(np.broadcast_to(np.eye(n), eye.shape), abs=1e-9)
    wide[3] = np.nan
    wide[5] = 0.0
    wide[7] *= -1
    step, _ = solve_scaled(wide, right * scale)
    assert np.isnan(step[3]).all()
    assert np.isfinite(step[[4, 5, 6]]).all()
    assert step[[4, 6]] == pytest.approx(
        np.linalg.solve(square[[4, 6]], right[[4, 6], :, None])[..., 0] / scale[[4, 6]], rel=1e-7
    )
    inverse, condition = invert_normal(wide)
    assert np.isnan(inverse[[3, 5, 7]]).all()
    assert np.isinf(condition[[3, 5, 7]]).all()
    assert np.isfinite(inverse[[4, 6]]).all()
