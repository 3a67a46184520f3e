# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from tactile_resonance.frf.result import FRF
from tactile_resonance.frf.spectra import error_variance, power, ratio
from tactile_resonance.poles.identify import identify_frf
from tactile_resonance.poles.result import PolesStatus
from tactile_resonance.poles.structure import ModelStructure

F0_HZ, DAMPING = 250.0, 0.03
BARE = ModelStructure(2, 2)


def second_order(frequency_hz, f0_hz=F0_HZ, damping=DAMPING):
    """Feed-through and one mode, as at the sensor."""
    s, w0 = 2j * np.pi * frequency_hz, 2 * np.pi * f0_hz
    return 0.02 + 100.0 * s / (s**2 + 2 * damping * w0 * s + w0**2)


def noisy(rng, std, dof, frequency_hz, pooled=True):
    """FRF with circular noise, its sample variance of `dof` complex degrees of freedom."""
    g = second_order(frequency_hz)
    noise = rng.standard_normal((2, g.size)) @ np.eye(g.size) * std / np.sqrt(2)
    sample = std**2 * rng.chisquare(2 * dof, g.size) / (2 * dof)
    if not pooled:
        # far from flat, so that lines are weighted one by one
        scale = np.where(np.arange(g.size) % 2, 10.0, 1.0)
        noise, sample = noise * scale, sample * scale**2
    return FRF(frequency_hz, g + noise[0] + 1j * noise[1], variance_noise=sample, noise_dof=dof)


LINES_HZ = np.arange(200.0, 300.1, 2.5)


def test_exact_data_give_the_exact_pole():
    frf = FRF(
        LINES_HZ,
        second_order(LINES_HZ),
        variance_noise=np.full(LINES_HZ.size, 1e-12),
        noise_dof=10,
    )
    poles = identify_frf(frf, structure=BARE)
    w0 = 2 * np.pi * F0_HZ
    expected = w0 * (-DAMPING + 1j * np.sqrt(1 - DAMPING**2))
    np.testing.assert_allclose(poles.poles_rad_s, [expected], rtol=1e-11)
    np.testing.assert_allclose(poles.f0_hz, F0_HZ, rtol=1e-11)
    np.testing.assert_allclose(poles.damping_ratio, DAMPING, rtol=1e-10)
    # 100 s / A has the residue 100 p / A'(p) at the pole p, with A' = 2 p + 2 damping w0
    residue = 100 * expected / (2 * expected + 2 * DAMPING * w0)
    np.testing.assert_allclose(poles.residues, [residue], rtol=1e-9)
    np.testing.assert_allclose(poles.fit.response(LINES_HZ), second_order(LINES_HZ), rtol=1e-11)


@pytest.mark.parametrize(
    ("pooled", "dof", "kind"), [(True, 6, "flat"), (False, 6, "per line"), (False, 12, "per line")]
)
def test_stated_covariance_is_that_of_the_estimates(pooled, dof, kind):
    """Mahalanobis distance to the truth over 1000 runs: mean of chi-square with two degrees of freedom."""
    rng = np.random.default_rng(1)
    runs, squared, costs, expected, kinds = 1000, [], [], [], []
    for _ in range(runs):
        poles = identify_frf(noisy(rng, 1e-3, dof, LINES_HZ, pooled), structure=BARE)
        kinds.append(poles.variance_model)
        error = np.array([poles.f0_hz[0] - F0_HZ, poles.damping_ratio[0] - DAMPING])
        squared.append(error @ np.linalg.solve(poles.covariance[0], error))
        costs.append(poles.cost)
        expected.append(poles.expected_cost)
    # flat is rejected wrongly once in a thousand
    assert kinds.count(kind) >= runs - 8
    # std of chi-square(2) is 2; heavier tails with weights of few degrees of freedom: five of its std
    assert abs(np.mean(squared) - 2) < 5 * 2 / np.sqrt(runs) + (0.0 if pooled else 0.1)
    assert np.mean(costs) == pytest.approx(np.mean(expected), rel=0.02)


def test_model_error_is_seen_and_enlarges_the_total_covariance():
    g = second_order(LINES_HZ) + 0.02 * second_order(LINES_HZ, 280.0, 0.01)
    frf = FRF(LINES_HZ, g, variance_noise=np.full(g.size, 1e-10), noise_dof=20)
    poles = identify_frf(frf, structure=BARE)
    assert poles.status is PolesStatus.MODEL_ERROR
    assert np.trace(poles.total_covariance[0]) > 10 * np.trace(poles.covariance[0])
    assert "cost" in poles.message


def test_too_few_lines_and_no_variance_are_said():
    frf = FRF(LINES_HZ[:3], second_order(LINES_HZ[:3]))
    poles = identify_frf(frf)
    assert poles.status is PolesStatus.TOO_FEW_LINES
    assert poles.poles_rad_s.size == 0
    poles = identify_frf(FRF(LINES_HZ, second_order(LINES_HZ)), structure=BARE)
    assert poles.status is PolesStatus.NO_COVARIANCE
    assert poles.covariance is None
    assert poles.f0_hz[0] == pytest.approx(F0_HZ, rel=1e-9)


def test_lines_without_a_finite_response_are_left_out():
    g = second_order(LINES_HZ)
    g[5] = np.nan
    frf = FRF(LINES_HZ, g, variance_noise=np.full(g.size, 1e-10), noise_dof=20)
    poles = identify_frf(frf, structure=BARE)
    assert poles.lines == LINES_HZ.size - 1
    assert poles.f0_hz[0] == pytest.approx(F0_HZ, rel=1e-9)
    assert "1 lines" in poles.message


def test_error_variance_over_input_power_is_the_first_order_propagation():
    """Against a numerical derivative of Y/U in the direction of correlated errors."""
    mean = np.array([[1.0 + 2j], [3.0 - 1j]])
    rng = np.random.default_rng(3)
    root = 1e-6 * (rng.standard_normal((2, 2)) + 1j * rng.standard_normal((2, 2)))
    draws = rng.standard_normal((2, 200_000)) + 1j * rng.standard_normal((2, 200_000))
    errors = root @ draws / np.sqrt(2)
    scatter = (mean[0] + errors[0]) / (mean[1] + errors[1]) - mean[0] / mean[1]
    stated = error_variance(ratio(mean), (root @ root.conj().T)[..., None]) / power(mean[1])
    assert np.mean(np.abs(scatter) ** 2) == pytest.approx(stated[0], rel=4 / np.sqrt(200_000))


@pytest.mark.parametrize(("periods", "said"), [(2, True), (8, False)])
@pytest.mark.parametrize("method", ["fast local polynomial method, order 2", "mean of 7 of 8"])
def test_a_transient_too_narrow_for_local_polynomials_is_said(periods, said, method):
    """Half the width is 7.5 Hz: 6 bins of two periods, 24 of eight."""
    rng = np.random.default_rng(1)
    frf = replace(noisy(rng, 1e-4, 6, LINES_HZ), periods=periods, method=method)
    message = identify_frf(frf, structure=BARE).message
    assert ("half the width of the mode is 6.0 bins" in message) == (said and "local" in method)
