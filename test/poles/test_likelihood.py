# SPDX-License-Identifier: Apache-2.0
"""The cost against its formula, the fit against full precision, points against the same in a batch."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from benchmarks.poles_plant import BAND_HZ, HARMONICS, SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, Plant
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.fit import Linearised, least_squares, minimise, refit_failed
from tactile_resonance.poles.joint import JointPlan
from tactile_resonance.poles.likelihood import Rules, _inverted, moments
from tactile_resonance.poles.model import PolynomialBasis
from tactile_resonance.poles.result import PolesBatch, PolesStatus
from tactile_resonance.poles.structure import ModelStructure
from tactile_resonance.poles.tables import Problem

RNG = np.random.default_rng(4)
BARE = ModelStructure(2, 2)
POINTS = 30


def normal(*shape):
    return RNG.standard_normal((*shape, 2)).view(complex)[..., 0]


def problem_and_data(points, records, errors_in_variables, transient, driven=15):
    """Driven and undriven bins, of points that differ in everything."""
    x = 1j * np.linspace(0.8, 1.2, 4 * driven)
    excited = np.arange(x.size) % 4 == 0
    order = np.append(np.flatnonzero(~excited), np.flatnonzero(excited))
    if not transient:
        order = np.flatnonzero(excited)
    undriven = order.size - driven
    denominator = PolynomialBasis.on_lines(x, 2).values[order]
    numerator = PolynomialBasis.on_lines(x[excited], 4).values
    own = PolynomialBasis.on_lines(x, 2).values[order] if transient else np.empty((order.size, 0))
    a = (x**2 + 0.04 * x * (1 + RNG.random((points, 1, 1))) + 1)[..., order]
    u = 0.01 * normal(points, records, order.size)
    u[..., undriven:] += 1.0
    y = 0.01 * normal(points, records, order.size) + 0.5 * u / a * (
        np.arange(order.size) >= undriven
    )
    if transient:
        y += (0.05 * RNG.random((points, records, 1)) + 0.02 * x[order]) / a
    data = BinData.of(
        y,
        u,
        undriven=undriven,
        variance_y=1e-4 * (1 + RNG.random((points, driven))),
        rest=2e-4 * (1 + RNG.random((points, max(undriven, 1)))),
    )
    if errors_in_variables:
        data = data.weighted(
            variance_u=1e-4 * (1 + RNG.random((points, driven))),
            covariance_yu=3e-5 * normal(points, driven),
        )
    return Problem(denominator, numerator, own), data


def start_values(problem, data):
    return minimise(problem, data, None, Rules(iterations=0)).theta


def flat_theta(problem, theta):
    """(s + M c,) of (M, n)."""
    shared = sum(problem.sizes[:2])
    return np.concatenate([theta[0, :shared], theta[:, shared:].ravel()])


@pytest.mark.parametrize("driven", [15, 48, 61])
@pytest.mark.parametrize("records", [1, 3])
@pytest.mark.parametrize("transient", [True, False])
@pytest.mark.parametrize("errors_in_variables", [True, False])
def test_cost_and_normal_matrix_are_those_of_the_formula(
    errors_in_variables, transient, records, driven
):
    """Blocks that are full, that are not, and several of them."""
    problem, data = problem_and_data(3, records, errors_in_variables, transient, driven)
    theta = start_values(problem, data)
    cost, _, found = moments(problem.tables, data, theta)
    a, b, own = problem.sizes
    for k in range(3):
        at = Linearised.of(problem, data.rows(slice(k, k + 1)), flat_theta(problem, theta[k]))
        power = np.abs(at.residual) ** 2
        expected = power[:, : problem.undriven].sum(), power[:, problem.undriven :].sum()
        assert cost[k] == pytest.approx(expected, rel=1e-10)
        slope = at.slope / np.sqrt(at.variance)[..., None]
        for m in range(records):
            columns = np.r_[: a + b, a + b + m * own : a + b + (m + 1) * own]
            for part, here in enumerate(
                (slice(0, problem.undriven), slice(problem.undriven, None))
            ):
                j = slope[m, here][:, columns]
                square = np.real(j.conj().T @ j)
                size = max(np.abs(square).max(initial=0), 1e-30)
                assert np.abs(found[k, m, part] - square).max() < 1e-12 * size


@pytest.mark.parametrize("records", [1, 2])
@pytest.mark.parametrize("errors_in_variables", [True, False])
def test_gradient_is_that_of_the_cost(errors_in_variables, records):
    problem, data = problem_and_data(1, records, errors_in_variables, True)
    theta = start_values(problem, data)
    shared = sum(problem.sizes[:2])

    def cost(at):
        return moments(problem.tables, data, at)[0].sum()

    gradient = moments(problem.tables, data, theta)[1][0]
    for i in range(theta.shape[-1]):
        step = np.zeros_like(theta)
        which = slice(None) if i < shared else 0  # what records share changes in all
        step[0, which, i] = 1e-6 * max(abs(theta[0, 0, i]), 0.1)
        slope = (cost(theta + step) - cost(theta - step)) / (2 * step[0, 0, i])
        assert 2 * gradient[which, i].sum() == pytest.approx(slope, rel=1e-4, abs=1e-3)


@pytest.mark.parametrize("records", [1, 3])
@pytest.mark.parametrize("transient", [True, False])
@pytest.mark.parametrize("errors_in_variables", [True, False])
def test_the_minimum_is_that_of_full_precision(errors_in_variables, transient, records):
    """Coefficients, their covariance and the condition number."""
    problem, data = problem_and_data(4, records, errors_in_variables, transient)
    found = minimise(problem, data)
    assert found.converged.all()
    shared = sum(problem.sizes[:2])
    for k in range(4):
        dense = least_squares(problem, data.rows(slice(k, k + 1)))
        assert dense.converged
        marginal = dense.marginal[0]
        size = np.sqrt(np.diagonal(marginal, axis1=1, axis2=2))
        assert np.all(np.abs(found.theta[k] - dense.theta[0]) < 1e-2 * np.sqrt(0.5) * size)
        assert np.all(found.theta[k, :, :shared] == found.theta[k, :1, :shared])
        assert found.cost[k] == pytest.approx(dense.cost[0], rel=1e-4)
        assert np.abs(found.residual[k] - dense.residual[0]).max() < 1e-2
        apart = (found.marginal[k] - marginal) / (size[:, :, None] * size[:, None, :])
        assert np.abs(apart[:, :shared, :shared]).max() < 0.05
        assert 1 / 3 < found.condition[k] / dense.condition[0] < 15


@pytest.mark.parametrize("records", [1, 3])
def test_points_that_steps_lost_are_found_at_full_precision(records):
    """Searches ended at once, all or some of a batch: what comes back is what they would have found."""
    problem, data = problem_and_data(5, records, False, True)
    found = minimise(problem, data)
    lost = minimise(problem, data, None, Rules(iterations=0))
    assert found.converged.all()
    assert not lost.converged.any()
    some = found._replace(converged=np.arange(5) != 2, theta=found.theta.copy())
    some.theta[2] = lost.theta[2]
    refit_failed(problem, lost, data)
    assert_same(lost, found)
    refit_failed(problem, some, data)
    assert_same(some, found)


def assert_same(solution, other):
    """To a hundredth of a standard deviation; sums and residuals accordingly."""
    assert solution.converged.all()
    size = np.sqrt(np.einsum("...ii->...i", other.marginal))
    assert np.abs((solution.theta - other.theta) / size).max() < 1e-2
    scale = size[..., :, None] * size[..., None, :]
    assert np.abs((solution.marginal - other.marginal) / scale).max() < 1e-2
    assert solution.condition == pytest.approx(other.condition, rel=1e-2)
    assert solution.leverage == pytest.approx(other.leverage, abs=1e-2)
    assert solution.cost == pytest.approx(other.cost, rel=1e-4)
    assert solution.part_cost == pytest.approx(other.part_cost, rel=1e-3)
    assert np.abs(solution.residual - other.residual).max() < 2e-2


def inverses_of(matrices):
    """And condition numbers."""
    inverses, (n, _) = np.empty_like(matrices), matrices.shape[1:]
    pairs = zip(matrices, inverses, strict=True)
    return inverses, np.array([_inverted(*pair, np.empty(n), np.empty(n)) for pair in pairs])


@pytest.mark.parametrize("n", [1, 2, 7, 16])
def test_inverses(n):
    """Scales of 24 decades, a matrix without inverse, an indefinite one and one of NaN."""
    batch = 12
    matrix = RNG.standard_normal((batch, n + 4, n))
    square = np.swapaxes(matrix, 1, 2) @ matrix
    scale = 10.0 ** RNG.uniform(-6, 6, (batch, n))
    wide = square * scale[:, :, None] * scale[:, None, :]
    inverse, condition = inverses_of(wide)
    eye = inverse * scale[:, :, None] * scale[:, None, :] @ square
    assert eye == pytest.approx(np.broadcast_to(np.eye(n), eye.shape), abs=1e-9)
    column = np.linalg.norm(matrix, axis=1, keepdims=True)
    exact = np.linalg.cond(matrix / column)
    assert np.all((condition > 0.9 * exact) & (condition < 1.1 * n * exact))
    wide[3] = np.nan
    wide[5] = 0.0
    wide[7] *= -1
    inverse, condition = inverses_of(wide)
    assert np.isnan(inverse[[3, 5, 7]]).all()
    assert np.isinf(condition[[3, 5, 7]]).all()
    assert np.isfinite(inverse[[4, 6]]).all()


@pytest.mark.parametrize("n", [3, 7])
def test_a_singular_matrix_has_an_inverse_in_two_of_a_hundred_at_most(n):
    """One column of a Jacobian is the sum of two others: rounding alone decides what sweeps make of it."""
    jacobian = RNG.standard_normal((2000, 30, n))
    alone = jacobian[..., -1].copy()
    for known, gap in ((False, 0.0), (True, 1e-6)):
        jacobian[..., -1] = jacobian[..., 0] + jacobian[..., 1] + gap * alone
        inverse, condition = inverses_of(np.swapaxes(jacobian, 1, 2) @ jacobian)
        found = np.isfinite(condition)
        assert (np.isfinite(inverse).all(axis=(1, 2)) == found).all()
        assert found.all() if known else np.mean(found) < 0.02


def plan_of(periods: int, structure: ModelStructure, **options) -> JointPlan:
    return JointPlan(
        SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, periods, HARMONICS, BAND_HZ, structure, **options
    )


def points_of(plant: Plant) -> tuple[np.ndarray, np.ndarray]:
    return plant.noisy(np.random.default_rng(3), POINTS, plant.bins())


def assert_rows(batch: PolesBatch, rows, other: PolesBatch) -> None:
    """Points of a batch against the same points fitted otherwise; a single one is asked more."""
    told = other.status_code != PolesStatus.MODEL_ERROR
    assert np.mean(batch.status_code[rows] != other.status_code) <= 0.1
    std = np.sqrt(np.diagonal(other.covariance, axis1=-2, axis2=-1))
    for k, name in enumerate(("f0_hz", "damping_ratio")):
        difference = (getattr(batch, name)[rows] - getattr(other, name)) / std[..., k]
        assert np.nanmax(np.abs(difference[told])) < 1e-2, name


@pytest.mark.parametrize("structure", [BARE, ModelStructure()], ids=["bare", "default"])
@pytest.mark.parametrize(("damping", "snr_db"), [(0.005, 10.0), (0.02, 40.0), (0.1, 80.0)])
@pytest.mark.parametrize("periods", [2, 8])
def test_one_point_and_more_axes(structure, periods, damping, snr_db):
    plan = plan_of(periods, structure)
    u, y = points_of(Plant(damping, snr_db, periods))
    batch = plan.from_bins(u, y)
    shape = (2, POINTS // 2, -1)
    folded = plan.from_bins(u.reshape(shape), y.reshape(shape))
    assert folded.f0_hz.reshape(batch.f0_hz.shape) == pytest.approx(batch.f0_hz, nan_ok=True)
    for k in range(5):
        assert_rows(batch, slice(k, k + 1), plan.from_bins(u[k : k + 1], y[k : k + 1]))


def test_no_points_lists_and_one_input_for_many_outputs():
    plan = plan_of(8, BARE)
    u, y = points_of(Plant(0.02, 40.0, 8))
    assert plan.from_bins(u[:0], y[:0]).f0_hz.shape == (0, 1)
    listed = plan.from_bins(u[:2].tolist(), y[:2].tolist())
    assert listed.f0_hz == pytest.approx(plan.from_bins(u[:2], y[:2]).f0_hz)
    same = np.broadcast_to(u[0], y.shape)
    assert plan.from_bins(u[0], y).f0_hz == pytest.approx(
        plan.from_bins(same, y).f0_hz, nan_ok=True
    )
    with pytest.raises(ValueError, match="y: shape"):
        plan.from_bins(u, y[:, :-1])


@pytest.mark.parametrize("terms", [1, 3, 4, 5])
@pytest.mark.parametrize("numerator_order", [0, 1, 3, 4])
def test_every_length_of_numerators(terms, numerator_order):
    """Odd ones and even ones: products are taken in pairs."""
    plan, enough = plan_of(8, ModelStructure(2, numerator_order)), plan_of(8, ModelStructure(2, 5))
    problem = replace(plan.problem, transient=enough.problem.transient[:, :terms])
    plant = Plant(0.02, 10.0, 8)
    u, y = points_of(plant)
    one = np.full((POINTS, 1), plant.noise[0])
    data = BinData.of(
        y[:, None], u[:, None], plan.order, plan.others_at.size, rest=one, variance_y=one
    )
    found = minimise(problem, data)
    refit_failed(problem, found, data)
    for k in range(3):
        dense = least_squares(problem, data.rows(slice(k, k + 1)))
        std = np.sqrt(0.5 * np.diag(dense.marginal[0, 0]))
        assert np.all(np.abs(found.theta[k, 0] - dense.theta[0, 0]) < 3e-2 * std)


def test_odd_points_leave_the_others_of_a_batch_alone():
    plant = Plant(0.02, 40.0, 8)
    plan = plan_of(8, BARE)
    u, y = points_of(plant)
    clean = plan.from_bins(u, y)
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((POINTS, 2 * y.shape[1])).view(complex) * np.sqrt(plant.noise[0])
    others = np.isin(plan.bins, plan.bins[plan.others_at])
    y[1, 100] += 300 * noise[1, 100]  # a wild bin
    u[2, 7] = np.nan
    y[3] += noise[3] * np.linspace(0, 5, y.shape[1])  # sloped noise
    y[4] += np.where(others, 3 * noise[4], 0)  # a disturbance of both channels alike
    u[4] += np.where(others, noise[4], 0)
    y[5] *= np.linspace(1, 1.5, y.shape[1])  # no second-order system
    y[6] = noise[6]  # no resonance
    y[7] = u[7] = 0.0
    found = plan.from_bins(u, y)
    assert_rows(found, slice(8, None), plan.from_bins(u[8:], y[8:]))
    assert np.mean(found.status_code[8:] == clean.status_code[8:]) > 0.9
    assert found.variance_model[3] != "flat"
    assert found.status(5) is PolesStatus.MODEL_ERROR
    assert np.isfinite(found.total_covariance[5]).all()
    assert np.isnan(found.f0_hz[2])
    assert not found.has_status(PolesStatus.OK)[[2, 5, 6, 7]].any()


def test_noise_free_records():
    plant = Plant(0.02, 80.0, 8)
    found = plan_of(8, BARE).from_bins(plant.input(plant.bins()), plant.output(plant.bins()))
    assert found.f0_hz[0] == pytest.approx(250.0, rel=1e-9)
    assert found.damping_ratio[0] == pytest.approx(0.02, rel=1e-7)
    assert found.status() is PolesStatus.OK


def test_many_bins():
    """A record of 120 periods has thousands of bins between harmonics."""
    plant = Plant(0.02, 20.0, 120)
    u, y = plant.noisy(np.random.default_rng(8), 4, plant.bins())
    result = plan_of(120, BARE).from_bins(u, y)
    assert result.has_status(PolesStatus.OK).all()
    errors = np.stack([result.f0_hz[:, 0] - 250, result.damping_ratio[:, 0] - 0.02], axis=-1)
    chi = np.einsum("bi,bij,bj->b", errors, np.linalg.inv(result.covariance[:, 0]), errors)
    assert stats.chi2.sf(chi.sum(), 8) > 1e-3
