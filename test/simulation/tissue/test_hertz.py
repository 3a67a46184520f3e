# SPDX-License-Identifier: Apache-2.0
"""Viscoelastic tissue, its contact, and relaxation tests."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from tactile_resonance.simulation.tissue.indenter import Indenter, indent
from tactile_resonance.simulation.tissue.library import Tissue, hertz_contact

NAMES = ["gel10", "gel12", "gel14", "gel16", "cortex", "white", "liver"]
RADIUS = 2.5e-3


def ball(tissue):
    return Indenter(tissue, tip_radius_m=RADIUS, poisson_ratio=0.49)


@pytest.fixture(params=NAMES)
def tissue(request, library):
    return library[request.param]


def test_modulus_at_one_second_is_the_given_one(tissue):
    assert tissue.prony.relaxation_modulus(1.0) == pytest.approx(tissue.relaxation_modulus_1s_pa)
    times = np.geomspace(1e-5, 1e3, 200)
    assert np.all(np.diff(tissue.prony.relaxation_modulus(times)) < 0)


def test_complex_modulus_is_the_laplace_transform_of_relaxation(tissue):
    s = 30.0
    transform = quad(
        lambda t: float(tissue.prony.relaxation_modulus(t)) * np.exp(-s * t), 0, 2, limit=400,
        points=[1e-4, 1e-3, 1e-2, 1e-1],
    )[0]  # fmt: skip
    assert complex(tissue.prony.complex_modulus(s)).real == pytest.approx(s * transform, rel=1e-6)


def test_complex_modulus_runs_from_equilibrium_to_glass(tissue):
    assert complex(tissue.prony.complex_modulus(1e-9j)) == pytest.approx(tissue.prony.equilibrium_pa)
    assert complex(tissue.prony.complex_modulus(1e12j)) == pytest.approx(tissue.prony.instantaneous_pa)


def test_creep_is_the_inverse_of_relaxation(tissue):
    assert tissue.prony.creep_compliance(0.0) == pytest.approx(1 / tissue.prony.instantaneous_pa)
    assert tissue.prony.creep_compliance(1e9) == pytest.approx(1 / tissue.prony.equilibrium_pa)
    # integral_0^t E(t - t') J(t') dt' = t
    t = 0.05
    value = quad(
        lambda x: float(tissue.prony.relaxation_modulus(t - x) * tissue.prony.creep_compliance(x)), 0, t,
        limit=400, points=[3e-4, 3e-3, t - 3e-3, t - 3e-4],
    )[0]  # fmt: skip
    assert value == pytest.approx(t, rel=1e-7)


def test_moduli_near_250_hz_are_the_published_ones(library):
    s = 2j * np.pi * 250
    for name, storage_pa in (("cortex", 8.5e3), ("white", 11.6e3)):
        assert complex(library[name].prony.complex_modulus(s)).real == pytest.approx(storage_pa, rel=0.01)
    gelatine = complex(library["gel10"].prony.complex_modulus(s))
    assert gelatine.imag / gelatine.real == pytest.approx(0.26, abs=0.005)


def test_hertz_contact(tissue, library):
    contact = hertz_contact(tissue, RADIUS, library.contact)
    modulus = tissue.relaxation_modulus_1s_pa / (1 - 0.49**2)
    # F = 4/3 E* sqrt(R) depth^(3/2)
    force = 4 / 3 * modulus * np.sqrt(RADIUS) * contact.indentation_m**1.5
    assert force == pytest.approx(0.01)
    eightfold = hertz_contact(tissue, RADIUS, library.contact, force_n=0.08)
    assert eightfold.contact_radius_m == pytest.approx(2 * contact.contact_radius_m)
    # small vibration: tangent of the force-depth curve with the relaxed modulus
    tangent = 1.5 * force / contact.indentation_m
    static = contact.stiffness_factor_m * tissue.relaxation_modulus_1s_pa
    assert static == pytest.approx(tangent)


def test_brain_contact_is_beyond_strict_hertz(library):
    ratios = [
        hertz_contact(library[name], RADIUS, library.contact).contact_radius_m / RADIUS
        for name in ("cortex", "white")
    ]
    assert ratios == pytest.approx([0.75, 0.67], abs=0.006)


def test_dynamic_stiffness_never_gives_energy(tissue, library):
    frequency = np.geomspace(1e-4, 1e5, 2000)
    contact = hertz_contact(tissue, RADIUS, library.contact)
    assert np.all(contact.dynamic_stiffness(2j * np.pi * frequency).imag > 0)


def test_without_radiation_only_the_material_is_left(tissue, library):
    still = replace(library.contact, radiation=False)
    contact = hertz_contact(tissue, RADIUS, still)
    s = 2j * np.pi * 250
    expected = 2 * contact.contact_radius_m / (1 - 0.49**2) * tissue.prony.complex_modulus(s)
    assert complex(contact.dynamic_stiffness(s)) == pytest.approx(complex(expected))


def test_contact_creeps_as_the_compliance(tissue, library):
    early, late = (
        hertz_contact(tissue, RADIUS, library.contact, hold_time_s=t).contact_radius_m
        for t in (1.0, 4.2)
    )
    grown = tissue.prony.creep_compliance(4.2) / tissue.prony.creep_compliance(1.0)
    assert (late / early) ** 3 == pytest.approx(float(grown))


@pytest.mark.parametrize(
    ("name", "drop_10s", "drop_180s"),
    [
        ("cortex", 65, 77),
        ("white", 65, 77),
        ("liver", 61, 74),
        ("gel10", 15, 30),
        ("gel16", 15, 30),
    ],
)
def test_force_drops_as_published_after_a_rigid_ramp(library, name, drop_10s, drop_180s):
    ramp = np.linspace(0, 0.2, 401)
    time = np.concatenate([ramp, [10.0, 180.0]])
    depth = 1e-3 * np.minimum(time / 0.2, 1)
    force, _ = indent(ball(library[name]), time, depth)
    assert force.argmax() == 400
    percent = 100 * (1 - force[-2:] / force[400])
    # the figures are rounded to a whole per cent, which puts liver's 73.5 % at the edge
    assert percent == pytest.approx([drop_10s, drop_180s], abs=0.55)


def test_elastic_limit_of_indentation_is_hertz():
    solid = Tissue("solid", 10e3, (1.0,), (0.0,))
    depth = np.linspace(0, 1e-3, 11)
    force, radius = indent(ball(solid), np.linspace(0, 1, 11), depth)
    expected = 4 / 3 * 10e3 / (1 - 0.49**2) * np.sqrt(RADIUS) * depth**1.5
    np.testing.assert_allclose(force, expected, rtol=1e-12)
    np.testing.assert_allclose(radius, np.sqrt(RADIUS * depth), rtol=1e-12)


def test_a_depth_put_on_at_once_relaxes_as_the_modulus(tissue):
    time = np.concatenate([[0.0], np.geomspace(1e-4, 100, 30)])
    force, _ = indent(ball(tissue), time, np.full(31, 3e-4))
    elastic = 4 / 3 / (1 - 0.49**2) * np.sqrt(RADIUS) * 3e-4**1.5
    np.testing.assert_allclose(force, elastic * tissue.prony.relaxation_modulus(time), rtol=1e-5)


@pytest.mark.parametrize(
    ("time", "depth", "named"),
    [
        ([0, 1, 1], [0, 0, 0], "time_s.*ascending"),
        ([0, 1], [0, 0, 0], "depth_m.*shape"),
        ([0, 1], [0, np.nan], "depth_m.*finite"),
    ],
)
def test_bad_tests_of_indentation_are_refused_by_name(library, time, depth, named):
    with pytest.raises(ValueError, match=named):
        indent(ball(library["gel10"]), time, depth)


def test_energy_giving_materials_are_refused():
    with pytest.raises(ValueError, match="prony_ratios"):
        Tissue("bad", 1e3, (100.0,), (1.2,))
    with pytest.raises(ValueError, match="prony_ratios"):
        Tissue("bad", 1e3, (0.1,), (-0.5,))
