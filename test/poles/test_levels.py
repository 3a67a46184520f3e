# SPDX-License-Identifier: Apache-2.0
"""On which bins the poles of records rest, against derivatives of the fit by differences."""

import numpy as np
import pytest

from tactile_resonance.poles import levels
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.fit import Linearised, minimise
from tactile_resonance.poles.joint import PoleEstimator
from tactile_resonance.poles.structure import ModelStructure

RECORDS, PERIODS, SAMPLES, RATE_HZ = 2, 3, 200, 1000.0


def test_bins_count_as_their_noise_moves_poles(monkeypatch):
    """Of the variance on driven bins the part that is noise."""
    rng, lines = np.random.default_rng(3), np.arange(20, 80)
    plan = PoleEstimator(RATE_HZ, SAMPLES, PERIODS, lines, (100.0, 395.0), ModelStructure(2, 2))
    s, w0 = 2j * np.pi * plan.frequency_hz, 2 * np.pi * 250
    u = plan.driven * np.exp(2j * np.pi * rng.random((1, RECORDS, s.size)))
    y = (0.1 + 0.1 * w0**2 / (s**2 + 0.1 * w0 * s + w0**2)) * u
    y = y + 1e-3 * rng.standard_normal((*y.shape, 2)).view(complex)[..., 0]
    first, driven = plan.others_at.size, plan.excited_at.size
    rest, variance_y = (rng.uniform(1e-6, 4e-6, (1, bins)) for bins in (first, driven))
    data = BinData.of(y, u, plan.order, first, rest=rest, variance_y=variance_y)
    solution, part = minimise(plan.problem, data), rng.uniform(0.1, 1.0, (1, driven))
    seen = {}

    def at_modes(ratio, dof):
        seen["dof"] = dof
        return np.ones(len(dof))

    monkeypatch.setattr(levels, "at_modes", at_modes)
    levels.noise_at_modes(plan, data, solution, np.ones(1), part)

    theta, own = solution.theta, plan.problem.sizes[2]
    shared = theta.shape[2] - own
    together = np.concatenate([theta[0, 0, :shared], theta[0, :, shared:].ravel()])
    jacobian = Linearised.of(plan.problem, data, together).jacobian  # (M, K, 2, n)
    rows = jacobian.reshape(-1, together.size)
    moved = np.linalg.solve(rows.T @ rows, rows.T)[:2]  # of A, by each weighted error
    turn = []
    for step in 1e-6 * np.eye(2):
        up, down = (np.append(theta[0, 0, :2] + sign * step, theta[0, 0, 2:])[None] for sign in (1, -1))
        turn.append((plan.poles_in_band(up) - plan.poles_in_band(down))[0, 0] / 2e-6)
    by_error = np.stack([np.real(turn), np.imag(turn)]) @ moved  # (2, M K 2)
    share = np.sum(by_error.reshape(2, RECORDS, -1, 2) ** 2, axis=(1, 3))
    share[:, first:] *= part
    share /= share.sum(axis=-1, keepdims=True)
    own_bins = np.where(np.arange(first + driven) < first, 1.0, first / driven)
    assert seen["dof"][0, 0] == pytest.approx(RECORDS / (share**2 / own_bins).sum(axis=-1), rel=1e-5)
