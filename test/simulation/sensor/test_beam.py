# SPDX-License-Identifier: Apache-2.0
"""Modes of the beam: textbook cantilever, orthogonality, statics."""

from dataclasses import replace

import mpmath
import numpy as np
import pytest

from tactile_resonance.cantilever import (
    cantilever_eigenvalues,
    frequency_equation,
    mode_shape,
)
from tactile_resonance.simulation.sensor.beam import mass_per_length, sensor_modes


def test_bare_cantilever_has_textbook_eigenvalues():
    # e.g. Rao, Mechanical Vibrations, table of beam end conditions: fixed-free
    expected = [1.87510407, 4.69409113, 7.85475744, 10.99554073, 14.13716839]
    np.testing.assert_allclose(cantilever_eigenvalues(0.0, 5), expected, rtol=1e-9)


def test_heavy_tip_gives_the_clamped_pinned_beam():
    # roots of tan = tanh: 3.92660231, 7.06858275, 10.21017612
    roots = cantilever_eigenvalues(1e9, 4)
    np.testing.assert_allclose(roots[1:], [3.92660231, 7.06858275, 10.21017612], rtol=1e-8)
    assert roots[0] < 0.01


@pytest.mark.parametrize("mass_ratio", [0.0, 0.01, 0.0983, 1.0, 30.0])
def test_eigenvalues_satisfy_the_transcendental_equation_and_none_is_missed(mass_ratio):
    beta = cantilever_eigenvalues(mass_ratio, 10)
    equation = 1 + np.cos(beta) * np.cosh(beta)
    equation += mass_ratio * beta * (np.cos(beta) * np.sinh(beta) - np.sin(beta) * np.cosh(beta))
    assert np.all(np.abs(equation) < 1e-6 * np.cosh(beta))
    dense = np.linspace(1e-3, 10 * np.pi, 20001)
    values = np.array([frequency_equation(b, mass_ratio) for b in dense])
    assert np.count_nonzero(values[1:] * values[:-1] < 0) == beta.size


def test_modal_frequencies_are_roots_of_the_transcendental_equation(sensor):
    """To 1e-6: the equation changes sign within that of every root, in mpmath's arithmetic."""
    modes = sensor_modes(sensor)
    beam = sensor.beam
    line_mass, length = mass_per_length(beam), beam.free_length_m
    mu = mpmath.mpf(sensor.tip.mass_kg) / (line_mass * length)
    for natural in modes.natural_rad_s:
        values = []
        for factor in (1 - 1e-6, 1 + 1e-6):
            # beta from the frequency by the beam's dispersion
            ratio = natural * factor * np.sqrt(line_mass / modes.bending_stiffness_nm2)
            b = mpmath.mpf(np.sqrt(ratio) * length)
            inertia = mu * b * (mpmath.cos(b) * mpmath.sinh(b) - mpmath.sin(b) * mpmath.cosh(b))
            values.append(1 + mpmath.cos(b) * mpmath.cosh(b) + inertia)
        assert values[0] * values[1] < 0


def test_forty_modes_do_not_overflow():
    beta = cantilever_eigenvalues(0.1, 40)
    shape = mode_shape(beta, np.linspace(0, 1, 1001))
    assert np.all(np.isfinite(shape))
    assert np.abs(shape).max() < 2.1
    np.testing.assert_allclose(shape[:, 0], 0, atol=1e-12)


def test_modes_are_orthonormal_in_mass_with_the_tip(sensor):
    modes = sensor_modes(sensor)
    nodes, weights = np.polynomial.legendre.leggauss(300)
    x = (nodes + 1) / 2
    shape = mode_shape(modes.eigenvalues, x)  # (n, x)
    tip = mode_shape(modes.eigenvalues, np.ones(1))[:, 0]
    scale = modes.tip_deflection / tip
    mass = mass_per_length(sensor.beam) * sensor.beam.free_length_m
    gram = mass * (shape * weights / 2) @ shape.T + sensor.tip.mass_kg * np.outer(tip, tip)
    np.testing.assert_allclose(gram * np.outer(scale, scale), np.eye(scale.size), atol=1e-10)


def test_modal_sums_give_static_deflection_and_slope(sensor):
    many = replace(sensor, beam=replace(sensor.beam, mode_count=40))
    modes = sensor_modes(many)
    length, stiffness = modes.length_m, modes.bending_stiffness_nm2
    compliance = np.sum(modes.tip_deflection**2 / modes.natural_rad_s**2)
    assert compliance == pytest.approx(length**3 / (3 * stiffness), rel=1e-6)
    slope = np.sum(modes.tip_deflection * modes.tip_slope / modes.natural_rad_s**2)
    assert slope == pytest.approx(length**2 / (2 * stiffness), rel=1e-4)


def test_static_stiffness_is_the_published_one(sensor):
    assert sensor_modes(sensor).static_stiffness_n_per_m == pytest.approx(14.8, abs=0.05)
