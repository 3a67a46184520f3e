# SPDX-License-Identifier: Apache-2.0
"""Poles, zeros, residues of a model and their derivatives, against differences and closed forms."""

import dataclasses

import numpy as np
import pytest
import scipy.signal
from poles.mode_at_250_hz import BARE, LINES_HZ, W0, G, circular, frf
from scipy import stats

from tactile_resonance.frf.result import FRF
from tactile_resonance.poles.identify import identify_batch, identify_frf
from tactile_resonance.poles.joint import JointPlan
from tactile_resonance.poles.model import PolynomialBasis
from tactile_resonance.poles.result import PolesStatus, single
from tactile_resonance.poles.structure import ModelStructure


@pytest.fixture(params=["s", "z"])
def model(request):
    s = 2j * np.pi * LINES_HZ
    w0 = 2 * np.pi * 250
    g = (0.1 * s**2 + 0.2 * w0 * s + 0.14 * w0**2) / (s**2 + 0.04 * w0 * s + w0**2)
    order = {"s": 2, "z": 3}[request.param]
    structure = ModelStructure(2, order, domain=request.param, sample_rate_hz=2000.0)
    return identify_frf(FRF(LINES_HZ, g), None, structure).fit


def perturbed(model, k, step):
    """The model with one free coefficient moved: denominator first, then numerator."""
    n = model.denominator.size - 1
    name, index = ("denominator", k) if k < n else ("numerator", k - n)
    values = getattr(model, name).copy()
    values[index] += step
    return dataclasses.replace(model, **{name: values})


def test_derivatives_equal_differences(model):
    pole = model.poles_rad_s()
    pole = pole[pole.imag > 0]
    poles_by_a = model.residues_and_sensitivity(pole)[1]
    residue_by = model.residue_sensitivity(pole)
    zeros = model.zeros_rad_s()
    zero_by = model.zero_sensitivity(zeros)
    n = model.denominator.size - 1
    for k in range(n + model.numerator.size):
        step = 1e-6
        moved = [perturbed(model, k, sign * step) for sign in (1, -1)]

        def nearest(values, target):
            return values[np.argmin(np.abs(values - target))]

        new = [nearest(m.poles_rad_s(), pole[0]) for m in moved]
        residues = [m.residues_and_sensitivity(np.array([p]))[0][0] for m, p in zip(moved, new, strict=True)]
        slope = (residues[0] - residues[1]) / (2 * step)
        assert residue_by[0, k] == pytest.approx(slope, rel=1e-4, abs=1e-4 * abs(residue_by).max())
        if k < n:
            assert poles_by_a[0, k] == pytest.approx((new[0] - new[1]) / (2 * step), rel=1e-5)
        else:
            for j, zero in enumerate(zeros):
                found = [nearest(m.zeros_rad_s(), zero) for m in moved]
                expected = (found[0] - found[1]) / (2 * step)
                assert zero_by[j, k - n] == pytest.approx(
                    expected, rel=1e-3, abs=1e-4 * abs(zero_by[j]).max()
                )


@pytest.mark.parametrize("degree", [1, 2, 3, 5])
def test_roots_of_batches(degree):
    rng = np.random.default_rng(degree)
    x = 1j * np.linspace(0.5, 1, 30)
    basis = PolynomialBasis.on_lines(x, degree)
    assert np.real(basis.values.conj().T @ basis.values) / 30 == pytest.approx(
        np.eye(degree + 1), abs=1e-12
    )
    coefficients = rng.standard_normal((4, 3, degree + 1))
    roots = basis.roots(coefficients)
    assert roots.shape == (4, 3, degree)
    values, slopes = basis.at(roots)
    size = np.abs(coefficients).max() * np.abs(values).max()
    assert np.abs((values @ coefficients[..., None])[..., 0]).max() < 1e-9 * size
    step = 1e-6
    assert (basis.at(roots + step)[0] - basis.at(roots - step)[0]) / (2 * step) == pytest.approx(
        slopes, rel=1e-5, abs=1e-6
    )
    assert (basis.at(roots + step)[1] - basis.at(roots - step)[1]) / (2 * step) == pytest.approx(
        basis.at(roots, 2)[2], rel=1e-5, abs=1e-5
    )


def test_nearly_equal_real_roots_do_not_cancel():
    basis = PolynomialBasis.on_lines(1j * np.linspace(0.9, 1.1, 40), 2)
    roots = np.array([-1e-7, -1.0])
    monic = np.poly(roots)
    # the same polynomial over the basis
    coefficients = np.linalg.lstsq(
        basis.at(np.array([0.3, -0.7, 1.9], complex))[0].real,
        np.polyval(monic, [0.3, -0.7, 1.9]),
        rcond=None,
    )[0]
    assert np.sort(basis.roots(coefficients).real) == pytest.approx(np.sort(roots), rel=1e-6)


def test_joint_estimator_in_the_z_domain_is_exact_for_a_sampled_system():
    """A filter that starts from rest, with a periodic input: no band limit, no approximation."""
    sample_rate_hz, samples, periods = 2000.0, 800, 3
    w0 = 2 * np.pi * 250
    b, a, _ = scipy.signal.cont2discrete(
        ([0.1, 0.1 * w0, 0.14 * w0**2], [1, 0.04 * w0, w0**2]), 1 / sample_rate_hz
    )
    rng = np.random.default_rng(1)
    harmonics = np.arange(20, 300)
    spectrum = np.zeros(samples // 2 + 1, complex)
    spectrum[harmonics] = np.exp(2j * np.pi * rng.random(harmonics.size))
    u = np.tile(np.fft.irfft(spectrum, samples), periods)
    y = scipy.signal.lfilter(np.ravel(b), a, u)
    structure = ModelStructure(2, 2, domain="z", sample_rate_hz=sample_rate_hz)
    plan = JointPlan(sample_rate_hz, samples, periods, harmonics, (200.0, 300.0), structure)
    result = plan(u.reshape(periods, samples), y.reshape(periods, samples))
    assert result.f0_hz[0] == pytest.approx(250, rel=1e-9)
    assert result.damping_ratio[0] == pytest.approx(0.02, rel=1e-7)


def test_joint_estimator_without_periodicity():
    """A burst of noise and its ring-down in one record: all bins are excited."""
    sample_rate_hz, samples = 2000.0, 4000
    w0 = 2 * np.pi * 250
    b, a, _ = scipy.signal.cont2discrete(
        ([0.1, 0.1 * w0, 0.14 * w0**2], [1, 0.04 * w0, w0**2]), 1 / sample_rate_hz
    )
    u = np.zeros(samples)
    u[:500] = np.random.default_rng(2).standard_normal(500)
    y = scipy.signal.lfilter(np.ravel(b), a, u)
    structure = ModelStructure(2, 2, domain="z", sample_rate_hz=sample_rate_hz)
    plan = JointPlan(
        sample_rate_hz, samples, 1, None, (200.0, 300.0), structure, input_noise_ratio=0.0
    )
    noise = 1e-3 * np.random.default_rng(3).standard_normal((100, 1, samples))
    result = plan(np.broadcast_to(u, noise.shape), y + noise)
    deviation = (result.f0_hz[:, 0] - 250) / np.sqrt(result.covariance[:, 0, 0, 0])
    assert 62 < np.sum(deviation**2) < 149  # 99.8 % of chi-square with 100 degrees of freedom


def test_residues_and_zeros_scatter_as_their_covariances_say():
    """``.1 + .04 w^2 / (s^2 + .04 w s + w^2)``, noise of known variance; residue and zeros in closed form."""
    rng, runs = np.random.default_rng(5), 300
    pole = W0 * complex(-0.02, np.sqrt(1 - 0.02**2))
    residue = 0.04 * W0**2 / (pole - pole.conjugate())
    zero = np.roots([0.1, 0.1 * 0.04 * W0, 0.14 * W0**2])[0]
    zero = complex(zero.real, abs(zero.imag))
    distances = []
    for _ in range(runs):
        poles = identify_frf(frf(g=G + circular(rng, (41,), 1e-6), noise_dof=1000), structure=BARE)
        k = np.argmax(poles.zeros_rad_s.imag)
        pairs = (
            (poles.residues[0] - residue, poles.residue_covariance[0]),
            (poles.zeros_rad_s[k] - zero, poles.zero_covariance[k]),
        )
        errors = [(np.array([e.real, e.imag]), covariance) for e, covariance in pairs]
        distances.append([e @ np.linalg.solve(c, e) for e, c in errors])
    total = np.sum(distances, axis=0)
    assert np.all(stats.chi2.ppf(5e-4, 2 * runs) < total)
    assert np.all(total < stats.chi2.ppf(1 - 5e-4, 2 * runs))


def test_residues_of_a_model_with_a_delay_are_those_of_the_response():
    """Residual terms stand for much of a delay: what it and the residue of B / A are off by cancels in G."""
    runs, delay_s = 60, 1e-3
    pole = W0 * complex(-0.02, np.sqrt(1 - 0.02**2))
    residue = 0.04 * W0**2 / (pole - pole.conjugate()) * np.exp(-pole * delay_s)
    g = G * np.exp(-2j * np.pi * LINES_HZ * delay_s) + circular(np.random.default_rng(6), (runs, 41), 1e-6)
    structure = ModelStructure(2, 4, delay=True)
    result = identify_batch(frf(g=g, noise_dof=1000), structure=structure)
    used = np.flatnonzero(result.has_status(PolesStatus.OK))
    assert used.size > 0.8 * runs
    poles = [single(result, (int(k),)) for k in used]
    errors = [np.array([e.real, e.imag]) for e in (each.residues[0] - residue for each in poles)]
    covariances = [each.residue_covariance[0] for each in poles]
    total = sum(e @ np.linalg.solve(c, e) for e, c in zip(errors, covariances, strict=True))
    assert stats.chi2.ppf(5e-4, 2 * used.size) < total < stats.chi2.ppf(1 - 5e-4, 2 * used.size)


def test_without_a_covariance_of_coefficients_there_is_none_of_residues_and_zeros():
    poles = identify_frf(frf(), structure=BARE)
    assert (poles.residues.size, poles.zeros_rad_s.size) == (1, 2)
    without = dataclasses.replace(poles, coefficient_covariance=None)
    assert without.residue_covariance is None
    assert without.zero_covariance is None
    assert dataclasses.replace(poles, fit=None).zeros_rad_s.size == 0
