# SPDX-License-Identifier: Apache-2.0
"""Which noise counts: on the bins that poles rest on, and on excited lines alone."""

import numpy as np
import pytest
from scipy import special

from tactile_resonance.frf.result import FRF
from tactile_resonance.poles import noise_level
from tactile_resonance.poles.data import BinData
from tactile_resonance.poles.fit import Linearised, minimise
from tactile_resonance.poles.identify import identify_batch
from tactile_resonance.poles.joint import PoleEstimator
from tactile_resonance.poles.structure import ModelStructure

RECORDS, PERIODS, SAMPLES, RATE_HZ = 2, 3, 200, 1000.0


def test_bins_count_as_their_noise_moves_poles(monkeypatch):
    """Of the variance on driven bins the part that is noise; against derivatives of the fit by differences."""
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

    monkeypatch.setattr(noise_level, "at_modes", at_modes)
    noise_level.noise_at_modes(plan, data, solution, np.ones(1), part)

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


@pytest.mark.parametrize("estimator", ["record", "frf"])
def test_noise_that_repeats_in_every_period_counts(estimator):
    """As of a converter with coarse steps: on excited lines alone, and too little to be a model error."""
    rng, points, lines = np.random.default_rng(11), 1000, np.arange(80, 121)
    variance, more = 1e-6, 0.55  # of the mean over periods, and what repeats, of that
    structure, band_hz = ModelStructure(2, 3), (200.0, 300.0)
    plan = PoleEstimator(5000.0, 2000, 4, lines, band_hz, structure)
    s, w0 = 2j * np.pi * plan.frequency_hz, 2 * np.pi * 250
    u = plan.driven * np.exp(2j * np.pi * rng.random((points, s.size)))
    y = 0.04 * w0**2 / (s**2 + 0.04 * w0 * s + w0**2) * u
    noise = np.sqrt(variance / 2 * (1 + more * plan.driven))
    y = y + noise * rng.standard_normal((*y.shape, 2)).view(complex)[..., 0]
    found = plan.from_bins(u[:, None], y[:, None])
    if estimator == "frf":
        at = plan.excited_at
        known = np.full((points, at.size), variance)
        frf = FRF(plan.frequency_hz[at], y[:, at] / u[:, at], variance_noise=known, noise_dof=3)
        found = identify_batch(frf, band_hz, structure)
    fine = found.status_code == 0
    error = np.stack([found.f0_hz[:, 0] - 250, found.damping_ratio[:, 0] - 0.02], axis=-1)[fine]
    distance2 = error[:, None] @ np.linalg.solve(found.covariance[fine, 0], error[..., None])
    inside = distance2 < special.chdtri(2, 0.05)
    assert fine.mean() > 0.6
    assert 0.915 < inside.mean() < 0.97
