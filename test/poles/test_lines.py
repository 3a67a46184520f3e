# SPDX-License-Identifier: Apache-2.0
"""On which lines the poles of a fit rest, against derivatives of the response by differences."""

import numpy as np
import pytest

from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.lines import ratio_at_modes

BINS, A, B = 12, 2, 3


@pytest.mark.parametrize("delay", [False, True])
@pytest.mark.parametrize("correlated", [False, True])
def test_lines_count_as_the_response_there_moves_poles(delay, correlated):
    rng = np.random.default_rng(3)

    def circular(*shape):
        return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)

    basis_a, basis_b = circular(BINS, A + 1), circular(BINS, B)
    theta = rng.standard_normal((1, A + B + delay))
    phase = rng.uniform(0.5, 2.0, BINS) if delay else np.empty(0)
    taken = rng.standard_normal((1, 1, 2, theta.size))
    u, variance_u = circular(1, 1, BINS), rng.uniform(0.1, 0.2, (1, BINS))

    def response(of):
        g = (basis_b @ of[A : A + B]) / (basis_a[:, :A] @ of[:A] + basis_a[:, A])
        return g * np.exp(-1j * phase * of[-1]) if delay else g

    def weighted(variance_y):
        covariance = 0.05 * circular(1, BINS) if correlated else np.empty((1, 0))
        given = BinData.of(u[0] * response(theta[0]), u, variance_y=variance_y, variance_u=variance_u)
        return given.weighted(covariance_yu=covariance)

    data, sample = (weighted(rng.uniform(3.0, 5.0, (1, BINS))) for _ in range(2))
    bases = (np.stack([of.real.T, of.imag.T]) for of in (basis_a, basis_b))
    ratio, squares = np.empty((2, *taken.shape[:-1]))
    ratio_at_modes(taken, theta, *bases, phase, data, sample, ratio, squares)
    g, step = response(theta[0]), 1e-6
    slope = np.array(
        [(response(theta[0] + d) - response(theta[0] - d)) / (2 * step) for d in step * np.eye(theta.size)]
    )  # (n, K)
    of_data, of_sample = (each.residual_variance(g[None])[0] for each in (data, sample))
    share = np.abs(taken[0, 0] @ slope) ** 2 * np.abs(u[0, 0]) ** 2 / of_data  # (2, K)
    share /= share.sum(axis=-1, keepdims=True)
    assert ratio[0, 0] == pytest.approx(share @ (of_sample / of_data), rel=1e-6)
    assert squares[0, 0] == pytest.approx(np.sum(share**2, axis=-1), rel=1e-6)
