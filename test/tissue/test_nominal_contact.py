# SPDX-License-Identifier: Apache-2.0
"""Poles at the nominal force and age of contact, against the simulated bench's own."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_resonance.configuration import share_path
from tactile_resonance.scan.scene import read_scan_scene
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.tissue.classify import UNKNOWN, classify
from tactile_resonance.tissue.nominal_contact import (
    ContactLoad,
    ForceSensitivity,
    NominalContact,
    refer_to_nominal,
    sensitivity_of_preloads,
)
from tactile_resonance.tissue.references import parse_nominal_contact

BENCH, TISSUES = SimulatedBench.from_configuration(), read_tissues()
NOISE = np.diag([0.008**2, 4e-5**2])  # of a point of the demonstration
FORCE_N, AGE_S = 0.01, 1.0
# 99.9 % of a chi-square variable with two degrees of freedom
WITHIN = 13.8
DEMO = read_scan_scene(share_path("config/scenes/demo.yaml"))


def poles(tissue="gel10", force_n=FORCE_N, age_s=AGE_S):
    """(2,) truth of the bench."""
    mode = BENCH.coupled(TISSUES[tissue], force_n=force_n, hold_time_s=age_s).mode_near(255)
    return np.array([mode.f0_hz, mode.damping_ratio])


def slope(tissue="gel10"):
    """(2,) of the bench's poles over the force, at the nominal contact."""
    step_n = 1e-5
    above, below = (poles(tissue, FORCE_N + side * step_n) for side in (1, -1))
    return (above - below) / (2 * step_n)


def nominal(tissue="gel10", **changes):
    exact = ForceSensitivity(slope(tissue), np.zeros((2, 2)))
    return NominalContact(FORCE_N, AGE_S, exact, **changes)


def distance2(off, covariance):
    return off @ np.linalg.solve(covariance, off)


def call(x, contact, reference=DEMO.nominal_contact, unknown_level=0.01):
    at = refer_to_nominal(x, NOISE, contact, reference)
    return classify(at.compared, at.covariance, DEMO.tissue_classes, unknown_level)


@pytest.mark.parametrize("force_n", [9.5e-3, 10e-3, 10.5e-3])
@pytest.mark.parametrize("age_s", [1.0, 2.0, 5.0])
def test_gelatine_is_called_so_whatever_its_force_and_age(force_n, age_s):
    x = poles(force_n=force_n, age_s=age_s)
    found = call(x, ContactLoad(force_n, 1e-5, age_s), unknown_level=0.3)
    assert (found.name, found.reason) == ("gelatine 10 %", "")
    assert found.probability > 0.9


def test_unreferred_the_same_gelatine_is_unknown():
    """What is mended: 0.5 mN less than nominal is outside of 99 % of the class, by its damping."""
    x = poles(force_n=9.5e-3, age_s=1.0)
    assert call(x, ContactLoad(9.5e-3, 1e-5, 1.0), None).name == UNKNOWN


@pytest.mark.parametrize("tissue", ["gel10", "gel16", "cortex", "white", "liver", "tumour"])
@pytest.mark.parametrize("force_n", [9e-3, 9.5e-3, 10.5e-3, 11e-3])
def test_poles_at_another_force_are_referred_to_the_truth_at_the_nominal_one(tissue, force_n):
    """Within what curvature alone is stated to leave: the sensitivity is exact, there is no noise."""
    x, truth = poles(tissue, force_n), poles(tissue)
    contact = ContactLoad(force_n, 0.0, AGE_S)
    at = refer_to_nominal(x, np.zeros((2, 2)), contact, nominal(tissue))
    std = np.sqrt(np.diag(at.covariance))
    assert np.all(np.abs(at.compared - truth) < std)
    # and that is little of what force did
    assert abs(at.compared[1] - truth[1]) < 0.06 * abs(x[1] - truth[1])
    # the measured pole stays
    np.testing.assert_array_equal(x, poles(tissue, force_n))


@pytest.mark.parametrize("tissue", ["gel10", "cortex", "liver"])
def test_age_is_a_force_by_the_creep_compliance(tissue):
    """A contact of 4 s under 10 mN has the poles of one of 1 s under 10 mN x J(4 s) / J(1 s), exactly."""
    compliance = TISSUES[tissue].prony.creep_compliance
    grown = compliance(4.0) / compliance(AGE_S)
    power = np.log(grown) / np.log(4.0 / AGE_S)
    np.testing.assert_allclose(poles(tissue, age_s=4.0), poles(tissue, FORCE_N * grown), rtol=1e-9)
    # a force that makes up for it leaves nothing to refer
    x = poles(tissue, FORCE_N / grown, 4.0)
    contact = ContactLoad(FORCE_N / grown, 0.0, 4.0)
    at = refer_to_nominal(x, NOISE, contact, nominal(tissue, creep=power))
    np.testing.assert_allclose(at.compared, poles(tissue), rtol=1e-9)
    np.testing.assert_allclose(at.covariance, NOISE, rtol=1e-9)


@pytest.mark.parametrize("age_s", [0.5, 2.0, 4.0])
def test_a_force_that_relaxes_under_a_held_place_leaves_the_pole_where_it_is(age_s):
    """The contact stays, and so does the pole; the force alone would have it moved."""
    tissue = TISSUES["gel10"]
    force_n = FORCE_N * float(tissue.prony.relaxation_modulus(age_s) / tissue.prony.relaxation_modulus(AGE_S))
    x, contact = poles(), ContactLoad(force_n, 0.0, age_s)
    at = refer_to_nominal(x, np.zeros((2, 2)), contact, nominal(creep=0.03, creep_std=0.003))
    assert np.all(np.abs(at.compared - x) < np.sqrt(np.diag(at.covariance)))
    off = refer_to_nominal(x, np.zeros((2, 2)), contact, nominal())
    assert np.abs(off.compared - x)[0] > 4 * np.abs(at.compared - x)[0]


def test_creep_of_the_scenes_is_that_of_the_bench():
    compliance, told = TISSUES["gel10"].prony.creep_compliance, DEMO.nominal_contact
    for age_s in (0.5, 2.0, 4.0, 5.0):
        power = np.log(compliance(age_s) / compliance(AGE_S)) / np.log(age_s / AGE_S)
        assert abs(power - told.creep) < told.creep_std
    for tissue in ("gel10", "gel12", "gel14"):
        off = slope(tissue) - told.sensitivity.per_n
        assert distance2(off, told.sensitivity.covariance) < WITHIN


def test_the_covariance_for_tissue_holds_the_truth_as_often_as_it_says():
    """Force, its scale, age, sensitivity, creep and noise drawn as stated; 95 % ellipses, 4000 points.

    Linear poles and forces near nominal, so that the term for curvature does not hide that another is missing.
    """
    rng, runs = np.random.default_rng(5), 4000
    truth, inside = poles(), {"all": 0, "pole": 0}
    mean, spread = slope(), np.diag([40.0**2, 0.1**2])
    force_std, scale_std, creep, creep_std = 1e-4, 0.01, 0.03, 0.01
    reference = NominalContact(
        FORCE_N,
        AGE_S,
        ForceSensitivity(mean, spread),
        creep=creep,
        creep_std=creep_std,
        force_scale_std=scale_std,
    )
    for _ in range(runs):
        force = FORCE_N + 2e-4 * rng.standard_normal()
        age_s = float(AGE_S * np.exp(0.7 * rng.standard_normal()))
        own = rng.multivariate_normal(mean, spread)
        power = creep + creep_std * rng.standard_normal()
        equivalent = force * (age_s / AGE_S) ** power
        x = rng.multivariate_normal(truth + own * (equivalent - FORCE_N), NOISE)
        told = force * (1 + scale_std * rng.standard_normal()) + force_std * rng.standard_normal()
        at = refer_to_nominal(x, NOISE, ContactLoad(told, force_std, age_s), reference)
        inside["all"] += distance2(at.compared - truth, at.covariance) < 5.991
        inside["pole"] += distance2(x - truth, NOISE) < 5.991
    share, std = inside["all"] / runs, np.sqrt(0.95 * 0.05 / runs)
    # the term for curvature is on the safe side: at most 1 % more
    assert 0.95 - 4 * std < share < 0.95 + 4 * std + 0.01
    assert inside["pole"] / runs < 0.3  # the pole's own covariance is not one for tissue


def curvature(x, off_n, variance):
    """What is left to second order of a force off by a Gaussian, root mean square, in any direction."""
    fourth = off_n**4 + 6 * off_n**2 * variance + 3 * variance**2
    left_hz = np.hypot(slope()[0], x[0] * slope()[1]) * np.sqrt(fourth) / FORCE_N / 3
    return np.diag([left_hz, left_hz / x[0]]) ** 2


@pytest.mark.parametrize(
    "changes",
    [
        {"force_std_n": 2e-4},
        {"force_scale_std": 0.02},
        {"creep_std": 0.03},
        {"covariance": np.diag([200.0**2, 0.5**2])},
    ],
)
def test_each_source_of_uncertainty_widens_the_covariance_for_tissue_alone(changes):
    """By its variance to first order, s s' V; the measured pole keeps its own."""
    force_n, age_s = 10.2e-3, 2 * AGE_S
    x, own, base = poles(), NOISE.copy(), nominal(creep=0.03)
    force_std = changes.pop("force_std_n", 0.0)
    variance, extra = force_std**2, np.zeros((2, 2))
    equivalent = force_n * 2**0.03
    if "force_scale_std" in changes:
        variance += (changes["force_scale_std"] * force_n) ** 2
    variance *= 2**0.06
    if "creep_std" in changes:
        variance += (equivalent * np.log(2) * changes["creep_std"]) ** 2
    if "covariance" in changes:
        spread = changes.pop("covariance")
        extra = spread * (equivalent - FORCE_N) ** 2
        base = replace(base, sensitivity=ForceSensitivity(slope(), spread))
    contact = ContactLoad(force_n, force_std, age_s)
    at = refer_to_nominal(x, own, contact, replace(base, **changes))
    expected = NOISE + np.outer(slope(), slope()) * variance + extra
    curved = curvature(x, equivalent - FORCE_N, variance)
    np.testing.assert_allclose(at.covariance, expected + curved, rtol=1e-9)
    assert np.sqrt(at.covariance[1, 1]) > 2 * np.sqrt(NOISE[1, 1])
    np.testing.assert_array_equal(own, NOISE)


def test_an_unknown_force_is_no_shift_and_wide_or_no_statement():
    x, unknown = poles(), ContactLoad(age_s=AGE_S)
    at = refer_to_nominal(x, NOISE, unknown, nominal(unknown_force_std_n=3e-4))
    np.testing.assert_array_equal(at.compared, x)
    expected = NOISE + np.outer(slope(), slope()) * 3e-4**2
    np.testing.assert_allclose(at.covariance, expected + curvature(x, 0.0, 3e-4**2))
    # a sensitivity along one axis alone says nothing of the other, but curvature may
    along = replace(
        nominal(unknown_force_std_n=3e-3),
        sensitivity=ForceSensitivity(np.array([220.0, 0.0]), 0 * NOISE),
    )
    assert refer_to_nominal(x, NOISE, unknown, along).covariance[1, 1] > 10 * NOISE[1, 1]
    lifted = refer_to_nominal(x, NOISE, ContactLoad(-3e-4, 1e-5, AGE_S), along)
    assert np.isnan(lifted.compared).all()
    assert lifted.note == "the force is -0.3 mN: the tip was not pressed on"
    assert at.referred
    assert at.note == "force unknown, taken as 10 +- 0.3 mN"
    # a force without a deviation is worth no more than none
    unsure = refer_to_nominal(
        x, NOISE, ContactLoad(9e-3, np.nan, AGE_S), nominal(unknown_force_std_n=3e-4)
    )
    np.testing.assert_array_equal(unsure.compared, x)
    assert unsure.note == at.note
    # unless it is far from what is stated of forces that were not measured
    loud = ContactLoad(25e-3, np.nan, AGE_S)
    far = refer_to_nominal(poles(force_n=25e-3), NOISE, loud, nominal(unknown_force_std_n=3e-4))
    assert np.isnan(far.compared).all()
    assert not far.referred
    assert far.note.startswith("the force is 25 mN, its standard deviation unknown")
    # nothing says how far it may be off: nothing is said of the tissue, the pole stays
    none = refer_to_nominal(x, NOISE, unknown, nominal())
    assert not none.referred
    assert np.isnan(none.compared).all()
    assert np.isnan(none.covariance).all()
    np.testing.assert_array_equal(x, poles())
    assert none.note == "the force is unknown, and nominal_contact has no unknown_force_std_n"
    assert classify(none.compared, none.covariance, DEMO.tissue_classes).name == UNKNOWN


def test_an_unknown_age_is_no_shift_and_wide_or_no_statement():
    x, unknown = poles(), ContactLoad(FORCE_N, 0.0)
    at = refer_to_nominal(x, NOISE, unknown, nominal(creep=0.03, unknown_age_factor=2.0))
    np.testing.assert_array_equal(at.compared, x)
    variance = (FORCE_N * 0.03 * np.log(2)) ** 2
    expected = NOISE + np.outer(slope(), slope()) * variance + curvature(x, 0.0, variance)
    np.testing.assert_allclose(at.covariance, expected)
    assert at.note == "age of contact unknown, taken as 1 s within 2 times"
    none = refer_to_nominal(x, NOISE, unknown, nominal(creep=0.03))
    assert np.isnan(none.compared).all()
    assert "no unknown_age_factor" in none.note
    # nothing creeps: the age does not matter
    still = refer_to_nominal(x, NOISE, unknown, nominal())
    np.testing.assert_allclose(still.covariance, NOISE)
    assert still.note == ""


def test_a_force_never_measured_makes_tissue_less_sure_not_the_pole():
    """Gelatine at a force that nobody measured: called with the deviation stated for it, unknown without."""
    x = poles(force_n=9.7e-3)
    assert call(x, ContactLoad(age_s=AGE_S)).name == "gelatine 10 %"
    silent = replace(DEMO.nominal_contact, unknown_force_std_n=float("nan"))
    assert call(x, ContactLoad(age_s=AGE_S), silent).name == UNKNOWN


def test_without_a_nominal_contact_the_pole_is_compared_as_it_is_and_that_is_said():
    x = poles()
    at = refer_to_nominal(x, NOISE, ContactLoad(9e-3, 1e-5, 1.0), None)
    np.testing.assert_array_equal(at.compared, x)
    np.testing.assert_array_equal(at.covariance, NOISE)
    assert not at.referred
    assert at.note.startswith("force and age of contact are not accounted for")


@pytest.mark.parametrize("tissue", ["gel10", "gel16", "cortex"])
def test_two_preloads_give_the_sensitivity_as_far_as_they_say(tissue):
    """Poles and forces drawn with their noise; 95 % ellipses hold the bench's derivative, 2000 pairs."""
    rng, runs, force_std = np.random.default_rng(6), 2000, np.array([5e-5, 5e-5])
    forces, derivative = np.array([9e-3, 11e-3]), slope(tissue)
    truth = np.array([poles(tissue, force) for force in forces])
    inside = 0
    for _ in range(runs):
        x = truth + rng.multivariate_normal([0, 0], NOISE, 2)
        told = forces + force_std * rng.standard_normal(2)
        found = sensitivity_of_preloads(x, [NOISE, NOISE], told, force_std)
        inside += distance2(found.per_n - derivative, found.covariance) < 5.991
    assert inside / runs == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / runs))


def test_preloads_too_close_are_refused():
    truth = [poles(force_n=force) for force in (9.9e-3, 10.1e-3)]
    with pytest.raises(
        ValueError, match=r"force_n: got \[0.0099, 0.0101\]; accepted is forces apart by 5"
    ):
        sensitivity_of_preloads(truth, [NOISE, NOISE], [9.9e-3, 10.1e-3], [5e-5, 5e-5])


def test_a_scene_gives_the_sensitivity_by_two_preloads_or_in_numbers():
    rows = [
        {
            "force_n": force,
            "force_std_n": 5e-5,
            "f0_hz": float(x[0]),
            "damping_ratio": float(x[1]),
            "f0_std_hz": 0.008,
            "damping_ratio_std": 4e-5,
        }
        for force, x in ((f, poles(force_n=f)) for f in (9e-3, 11e-3))
    ]
    content = {"nominal_contact": {"force_n": FORCE_N, "age_s": AGE_S, "preloads": rows}}
    measured = parse_nominal_contact(content, "scene.yaml:")
    np.testing.assert_allclose(measured.sensitivity.per_n, slope(), rtol=0.02)
    f0_std, damping_std = np.sqrt(np.diag(measured.sensitivity.covariance))
    given = {
        "force_n": FORCE_N,
        "age_s": AGE_S,
        "f0_hz_per_n": float(measured.sensitivity.per_n[0]),
        "damping_ratio_per_n": float(measured.sensitivity.per_n[1]),
        "f0_std_hz_per_n": float(f0_std),
        "damping_ratio_std_per_n": float(damping_std),
        "correlation": float(measured.sensitivity.covariance[0, 1] / f0_std / damping_std),
    }
    same = parse_nominal_contact({"nominal_contact": given}, "scene.yaml:").sensitivity
    np.testing.assert_allclose(same.covariance, measured.sensitivity.covariance, rtol=1e-9)


def preloads(*forces_n):
    row = {"force_std_n": 1e-5, "f0_hz": 250.0, "f0_std_hz": 0.01}
    row |= {"damping_ratio": 0.03, "damping_ratio_std": 1e-4}
    return [{"force_n": force_n, **row} for force_n in forces_n]


GIVEN = {
    "force_n": 0.01,
    "age_s": 2.0,
    "f0_hz_per_n": 220.0,
    "damping_ratio_per_n": 1.3,
    "f0_std_hz_per_n": 20.0,
    "damping_ratio_std_per_n": 0.1,
}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"force_n": 0}, "nominal_contact.force_n: got 0.0; accepted is a number above 0"),
        ({"age_s": None}, "nominal_contact.age_s: got None"),
        ({"f0_hz_per_n": None}, "nominal_contact.f0_hz_per_n: got None"),
        ({"f0_std_hz_per_n": -1}, "nominal_contact.f0_std_hz_per_n: got -1.0"),
        ({"correlation": 1.5}, "nominal_contact.correlation: got 1.5; accepted is -1 to 1"),
        ({"creep": -0.1}, "nominal_contact.creep: got -0.1; accepted is 0 or above, below 1"),
        ({"creep_std": -0.1}, "nominal_contact.creep_std: got -0.1"),
        ({"force_scale_std": -1}, "nominal_contact.force_scale_std: got -1.0"),
        ({"unknown_force_std_n": 0}, "nominal_contact.unknown_force_std_n: got 0.0"),
        ({"unknown_age_factor": 0.5}, "nominal_contact.unknown_age_factor: got 0.5"),
        ({"preload": []}, "nominal_contact.preload: got []"),
        (
            {"preloads": [{}]},
            "nominal_contact.preloads: got [{}]; accepted is a list of 2 entries",
        ),
        ({"preloads": [{}, {}]}, "nominal_contact.preloads[0].f0_hz: got None"),
        (
            {"preloads": [], "correlation": 0.0},
            "nominal_contact: got ['correlation']; accepted is none of these beside preloads",
        ),
        (
            {"preloads": preloads(0.011, 0.012)},
            "nominal_contact.preloads.force_n: got [0.011, 0.012]; accepted is forces on either side",
        ),
    ],
)
def test_what_is_wrong_in_it_is_named(changes, message):
    given = {"force_n": 0.01, "age_s": 2.0} if "preloads" in changes else GIVEN
    with pytest.raises(ValueError, match="nominal_contact") as error:
        parse_nominal_contact({"nominal_contact": given | changes}, "scene.yaml:")
    assert str(error.value).startswith(f"scene.yaml: {message}")
    assert str(error.value).count("nominal_contact") == 1
