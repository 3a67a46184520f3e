# SPDX-License-Identifier: Apache-2.0
"""The closed forms of a known sensor against the bench, whose residues are those of its eigenvectors."""

import numpy as np
import pytest

from tactile_resonance.calibration.model import AIR, ContactStiffness, SensorModel
from tactile_resonance.simulation.sensor.experiments import true_sensor

TISSUES = ("gel10", "gel16", "cortex", "liver", "tumour")


@pytest.mark.parametrize("tissue", TISSUES)
def test_response_poles_and_residues_are_those_of_the_bench(bench, library, tissue):
    coupled, model = bench.coupled(library[tissue]), true_sensor(bench)
    contact = coupled.contact.stiffness
    s = 2j * np.pi * np.geomspace(5, 12e3, 200)
    np.testing.assert_allclose(contact.at(s), coupled.contact.dynamic_stiffness(s), rtol=1e-12)
    np.testing.assert_allclose(model.response(s, contact.at(s)), coupled.response(s), rtol=1e-10)
    poles = model.poles(contact)
    poles = poles[np.lexsort((poles.real, poles.imag))]
    np.testing.assert_allclose(
        np.sort_complex(poles), np.sort_complex(coupled.poles_rad_s), rtol=1e-8
    )
    for mode in coupled.modes:
        residue = model.residues(np.array([mode.pole_rad_s]), contact)
        np.testing.assert_allclose(residue, mode.residue_rad_s, rtol=1e-6)


def test_in_air_the_contact_is_not_there(bench):
    model, air = true_sensor(bench), bench.coupled(None)
    s = 2j * np.pi * np.geomspace(5, 12e3, 50)
    np.testing.assert_allclose(model.response(s), air.response(s), rtol=1e-10)
    np.testing.assert_allclose(model.response(s, AIR.at(s)), air.response(s), rtol=1e-10)
    poles = model.poles(AIR)
    pole = poles[np.argmin(np.abs(poles - 2j * np.pi * 250))]
    np.testing.assert_allclose(pole, air.mode_near(250.0).pole_rad_s, rtol=1e-9)


def test_a_delay_and_a_gain_multiply_the_response(bench):
    here, later = true_sensor(bench), true_sensor(bench, 1e-5)
    s = 2j * np.pi * np.array([100.0, 5e3])
    np.testing.assert_allclose(later.response(s), here.response(s) * np.exp(-s * 1e-5))


def test_parameters_in_one_array_and_back_also_stacked(bench):
    model = true_sensor(bench)
    values = np.stack([model.values, 1.01 * model.values])
    stack = SensorModel.of_values(values)
    np.testing.assert_array_equal(stack.values, values)
    assert len(model.names) == values.shape[1]
    contact = ContactStiffness(50.0, np.array([20.0]), np.array([1e-3]))
    both = stack.poles(contact)
    for one, found in zip(values, both, strict=True):
        alone = SensorModel.of_values(one).poles(contact)
        np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(alone), rtol=1e-10)


def test_a_relaxation_of_nothing_changes_no_residue(bench):
    """Its pole -1 / tau cancels: there k is not finite, and the residue 0."""
    model, times_s = true_sensor(bench), np.array([1e-3])
    plain, none = ContactStiffness(50.0), ContactStiffness(50.0, np.zeros(1), times_s)
    poles = np.append(model.poles(plain), -1 / times_s)
    expected = np.append(model.residues(poles[:-1], plain), 0.0)
    np.testing.assert_allclose(model.residues(poles, none), expected, rtol=1e-12)
