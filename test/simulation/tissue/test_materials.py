# SPDX-License-Identifier: Apache-2.0
"""Gradients, random heterogeneity, and what lies under the surface; the map of their truth."""

import itertools
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.integrate import dblquad

from tactile_resonance.configuration import share_path
from tactile_resonance.mechanics.course import layer_share
from tactile_resonance.mechanics.indentation import BallTip
from tactile_resonance.scan.scene import read_scan_scene
from tactile_resonance.simulation.sensor.experiments import truth_over
from tactile_resonance.simulation.tissue.library import (
    GradientEntry,
    HeterogeneityEntry,
    TissueEntry,
    geometric_mixture,
    mixture,
    uniform,
)
from tactile_resonance.simulation.tissue.scene import (
    Box,
    Buried,
    HalfSpace,
    PhantomScene,
    Region,
    Sphere,
    energy_density,
    energy_share,
    felt_at,
    hertz_stress,
    read_scene,
)

EVERYWHERE = HalfSpace((0.0, 0.0, 1.0), (0.0, 0.0, 1.0))


def test_stresses_are_in_equilibrium():
    radial, depth = np.meshgrid(np.linspace(0.2, 3, 15), np.linspace(0.1, 4, 15))
    h = 1e-4

    def slope(component, along):
        step = np.array([h, 0]) if along == "r" else np.array([0, h])
        ends = [hertz_stress(radial + s * step[0], depth + s * step[1])[component] for s in (1, -1)]
        return (ends[0] - ends[1]) / (2 * h)

    s_r, s_theta, _, tau = hertz_stress(radial, depth)
    np.testing.assert_allclose(
        slope(0, "r") + slope(3, "z") + (s_r - s_theta) / radial, 0, atol=1e-6
    )
    np.testing.assert_allclose(slope(3, "r") + slope(2, "z") + tau / radial, 0, atol=1e-6)


def test_stresses_carry_the_load_of_hertz():
    # at the surface the pressure is 1.5 p_mean sqrt(1 - r^2); deep below, Boussinesq's point force
    radial = np.linspace(0.05, 0.95, 10)
    pressure = -hertz_stress(radial, np.full(10, 1e-9))[2]
    np.testing.assert_allclose(pressure, 1.5 * np.sqrt(1 - radial**2), rtol=1e-6)
    r, z = 30.0, 40.0
    far = -3 * np.pi * z**3 / (2 * np.pi * 50.0**5)  # the force is pi
    assert hertz_stress(r, z)[2] == pytest.approx(far, rel=1e-3)


def test_strain_energy_is_the_work_of_indentation():
    # U = 2/5 F depth; with nu = 1/2, in units of p_mean^2 a^3 / G: (2/5) pi (3 pi / 16)
    def density(angle, s):
        distance = s / (1 - s)
        radial, depth = distance * np.sin(angle), distance * np.cos(angle)
        ring = 2 * np.pi * radial * distance / (1 - s) ** 2
        return float(energy_density(radial, depth)) * ring

    energy = dblquad(density, 1e-9, 1 - 1e-9, 0, np.pi / 2, epsabs=1e-5, epsrel=1e-5)[0]
    assert energy == pytest.approx(0.4 * np.pi * 3 * np.pi / 16, rel=1e-4)


def test_energy_shares_add_up_and_do_not_depend_on_direction():
    near = energy_share(HalfSpace((0, 0, -2.0), (0.0, 0.0, -1.0)), (0, 0, 0), 1.0)
    far = energy_share(HalfSpace((0, 0, -2.0), (0.0, 0.0, 1.0)), (0, 0, 0), 1.0)
    assert near + far == pytest.approx(1)
    half = energy_share(HalfSpace((0.0, 0.0), (0.6, 0.8)), (0, 0, 0), 1e-3)
    assert half == pytest.approx(0.5, abs=2e-3)
    around = [
        energy_share(Sphere((1.5 * np.cos(t), 1.5 * np.sin(t), -1.2), 1.0), (0, 0, 0), 1.0)
        for t in np.linspace(0, 6, 13)
    ]
    assert np.ptp(around) < 0.03 * np.mean(around)


def test_what_is_buried_is_found_with_little_memory():
    """A simulated robot asks for it as it moves: memory from the system takes longer than one of its steps."""
    inclusion = Sphere((2e-3, -1e-3, -0.0122), 0.012)
    energy_share(inclusion, (0, 0, 0), 1e-3)  # computes the points
    tracemalloc.start()
    try:
        share = energy_share(inclusion, (1e-3, 0, 0), 1e-3)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert 0.1 < share < 0.9
    assert peak_bytes < 1 << 20


@pytest.mark.parametrize("depth", [0.3, 1.0, 3.0, 10.0])
def test_a_layer_on_a_rigid_base_is_felt_no_stiffer_than_it_is(library, depth):
    """Against the series of Dimitriadis et al. (2002) for a bonded incompressible layer."""
    soft = library["gel10"]
    rigid = mixture(soft, library["gel12"], 0.5, 1e12)
    base = Buried("table", HalfSpace((0.0, 0.0, -depth), (0.0, 0.0, 1.0)), rigid)
    felt = felt_at(np.zeros(3), soft, [base], 1.0).relaxation_modulus_1s_pa
    truth = layer_share(BallTip(1.0), 1.0, depth)  # where sqrt(R indentation) is 1
    ratio = felt / soft.relaxation_modulus_1s_pa
    assert 1 < ratio < truth
    if depth == 10:
        assert ratio - 1 > 0.5 * (truth - 1)


def test_inclusions_are_felt_more_the_shallower_and_the_nearer(library):
    soft, hard = library["white"], library["tumour"]
    scene = [
        PhantomScene(
            "one", 0.01, (Region("all", EVERYWHERE, uniform(soft)),),
            (Buried("ball", Sphere((0.0, 0.0, -0.002 - below), 0.002), hard),),
        )
        for below in (0.0, 1e-3, 3e-3, 1e-2)
    ]  # fmt: skip
    modulus = [s.tissue_at((0.0, 0.0)).relaxation_modulus_1s_pa for s in scene]
    assert np.all(np.diff(modulus) < 0)
    assert soft.relaxation_modulus_1s_pa < modulus[-1] < 1.01 * soft.relaxation_modulus_1s_pa
    assert modulus[0] < hard.relaxation_modulus_1s_pa
    away = [scene[1].tissue_at((x, 0.0)).relaxation_modulus_1s_pa for x in (0, 1e-3, 3e-3, 2e-2)]
    assert np.all(np.diff(away) < 0)
    # the same tissue buried is not felt at all
    same = Buried("same", Sphere((0, 0, -0.002), 0.002), soft)
    felt = felt_at(np.zeros(3), soft, [same], 1e-3)
    assert felt.relaxation_modulus_1s_pa == pytest.approx(soft.relaxation_modulus_1s_pa)


def test_several_inclusions_are_felt_by_their_shares_in_any_order(library):
    soft, hard = library["white"], library["tumour"]
    ball = Buried("ball", Sphere((0.0, 0.0, -0.006), 0.005), hard)
    deeper = HalfSpace((0.0, 0.0, -0.0111), (0.0, 0.0, 1.0))
    shares = [energy_share(shape, np.zeros(3), 1.7e-3) for shape in (ball.shape, deeper)]
    assert min(shares) > 0.1

    def felt(*buried):
        return felt_at(np.zeros(3), soft, buried, 1.7e-3).relaxation_modulus_1s_pa

    layer = Buried("layer", deeper, library["cortex"])
    moduli = [t.relaxation_modulus_1s_pa for t in (soft, hard, library["cortex"])]
    want = 1 / np.sum(np.array([1 - sum(shares), *shares]) / moduli)
    assert felt(ball, layer) == pytest.approx(want, rel=1e-12)
    assert felt(layer, ball) == pytest.approx(want, rel=1e-12)
    # a layer that is none takes nothing from the ball
    assert felt(ball, Buried("none", deeper, soft)) == pytest.approx(felt(ball), rel=1e-12)
    # where they overlap the later one is there
    around = Buried("around", Sphere((0.0, 0.0, -0.0065), 0.006), soft)
    assert felt(ball, around) == pytest.approx(moduli[0], rel=1e-12)
    assert felt(around, ball) == pytest.approx(felt(ball), rel=1e-12)
    assert felt(around, Buried("all", EVERYWHERE, hard)) == pytest.approx(moduli[1], rel=1e-12)


def test_gelatine_gradient_is_linear_in_concentration(library):
    ends = [TissueEntry(gelatine_percent=percent) for percent in (10.0, 16.0)]
    entry = GradientEntry(from_=ends[0], to=ends[1], start_m=(0.0, 0.0, 0.0), end_m=(0.1, 0.0, 0.0))
    material = entry.gradient_of(library)
    for x, percent in ((-1, 10), (0, 10), (0.05, 13), (0.1, 16), (0.5, 16)):
        assert material(np.array([x, 0.3, -0.1])).gelatine_percent == pytest.approx(percent)


def test_mixtures_stay_passive_and_run_from_one_to_the_other(library):
    frequency = 2j * np.pi * np.geomspace(1e-4, 1e5, 200)
    for first, second in itertools.permutations(("gel10", "cortex", "liver"), 2):
        one, two = library[first], library[second]
        assert geometric_mixture(one, two, 0.0) is one
        assert geometric_mixture(one, two, 1.0) is two
        moduli = []
        for share in (1e-9, 0.25, 0.5, 0.75, 1 - 1e-9):
            mixed = geometric_mixture(one, two, share)
            assert np.all(mixed.prony.complex_modulus(frequency).imag > 0)
            moduli.append(mixed.relaxation_modulus_1s_pa)
        assert np.all(np.diff(moduli) > 0) or np.all(np.diff(moduli) < 0)
        assert moduli[0] == pytest.approx(one.relaxation_modulus_1s_pa)


def test_random_field_has_the_stated_correlation():
    """Over 4000 seeds: mean 0, variance 1, exp(-1/2) at one correlation length, each at 5 sigma."""
    places = np.array([[0.0, 0.0, 0.0], [4e-3, 0.0, 0.0], [0.0, 0.0, 8e-3]])
    known = {"correlation_length_m": 4e-3, "modulus_spread": 0.1}
    fields = [HeterogeneityEntry(seed=seed, **known) for seed in range(4000)]
    values = np.array([field.value(places) for field in fields])  # (s, 3)
    expected = np.exp([[0, -0.5, -2], [-0.5, 0, -2.5], [-2, -2.5, 0]])
    found = values.T @ values / 4000
    # of a product of standard Gaussians: variance 1 + correlation^2
    np.testing.assert_array_less(np.abs(found - expected), 5 * np.sqrt((1 + expected**2) / 4000))
    assert np.all(np.abs(values.mean(axis=0)) < 5 / np.sqrt(4000))
    fourth = np.mean(values**4)
    assert fourth == pytest.approx(3, abs=5 * np.sqrt(96 / 12000))


def test_heterogeneity_repeats_and_keeps_the_mean_modulus(library):
    gel = library["gel10"]
    material = HeterogeneityEntry(correlation_length_m=2e-3, seed=7, modulus_spread=0.1).over(uniform(gel))
    again = HeterogeneityEntry(correlation_length_m=2e-3, seed=7, modulus_spread=0.1).over(uniform(gel))
    place = np.array([0.01, -0.02, 0.0])
    assert material(place) == again(place)
    x = np.linspace(0, 2.0, 2001)  # a thousand correlation lengths
    moduli = np.array([material(np.array([v, 0.0, 0.0])).relaxation_modulus_1s_pa for v in x])
    logs = np.log(moduli / gel.relaxation_modulus_1s_pa)
    independent = 2.0 / (np.sqrt(2 * np.pi) * 2e-3)  # length over the integral of the correlation
    assert logs.mean() == pytest.approx(-0.005, abs=5 * 0.1 / np.sqrt(independent))
    assert logs.std() == pytest.approx(0.1, rel=5 * np.sqrt(0.5 / independent))


def test_inclusion_scene_has_a_map_with_the_inclusion_in_it(bench, library):
    scene = read_scene(library, share_path("config/scenes/inclusion.yaml"))
    x = np.linspace(-0.015, 0.015, 13)
    points = np.stack(np.meshgrid(x, x), axis=-1)
    assert points[0, 1, 0] > points[0, 0, 0]
    truth = truth_over(bench, scene, points[::3, ::3])
    assert truth.shape == (5, 5)
    f0_hz = np.array([[at.mode_near(250).f0_hz for at in row] for row in truth])
    centre = scene.buried[0].shape.center_m
    (top,) = truth_over(bench, scene, [centre[:2]])
    assert top.mode_near(250).f0_hz > f0_hz.max()
    assert top.mode_near(250).f0_hz - np.median(f0_hz) > 2.0
    # nothing else moves it by more than the heterogeneity does: 1 % of E is 0.1 Hz
    distance = np.linalg.norm(points[::3, ::3] - np.array(centre[:2]), axis=-1)
    assert np.ptp(f0_hz[distance > 0.01]) < 0.5
    # consistent with the question asked one by one
    coupled = bench.coupled(scene.tissue_at(points[3, 6]), force_n=scene.force_n)
    assert truth[1, 2].mode_near(250).pole_rad_s == coupled.mode_near(250).pole_rad_s
    assert truth[1, 2].contact.indentation_m == coupled.contact.indentation_m
    inside, outside = truth_over(bench, scene, [[0.0, 0.0], [1.0, 0.0]])
    assert inside is not None
    assert outside is None
    with pytest.raises(ValueError, match="position_m"):
        truth_over(bench, scene, [[1.0, 0.0]])


def scene_of(tmp_path, library, **change):
    content = yaml.safe_load(share_path("config/scenes/inclusion.yaml").read_text())
    content["regions"][0] = {
        "box": {"low_m": [-1, -1], "high_m": [1, 1]},
        "gradient": {
            "from": {"tissue": "white"}, "to": {"tissue": "tumour"},
            "start_m": [0, 0, 0], "end_m": [0.01, 0, 0],
        },
    }  # fmt: skip
    for keys, value in change.items():
        *path, last = keys.split("__")
        inner = content
        for key in path:
            inner = inner[int(key) if key.isdigit() else key]
        inner[int(last) if last.isdigit() else last] = value
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return read_scene(library, path)


def test_gradient_scene_is_read(tmp_path, library):
    scene = scene_of(tmp_path, library, buried=[])
    middle = scene.tissue_at((0.005, 0.0))
    assert middle.relaxation_modulus_1s_pa == pytest.approx(np.sqrt(3e3 * 6e3))
    assert scene.regions[0].name == "gradient"


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"regions__0__gradient__end_m": [0, 0, 0]}, r"gradient\.end_m.*other than start_m"),
        ({"regions__0__tissue": "liver"}, r"regions\[0\].*no tissue beside a gradient"),
        (
            {"regions__0__heterogeneity": {"modulus_spread": 0.1, "correlation_length_m": 0.0}},
            r"heterogeneity\.correlation_length_m.*above 0",
        ),
        (
            {"regions__0__heterogeneity": {"modulus_spread": 2.0, "correlation_length_m": 1.0}},
            r"heterogeneity\.modulus_spread.*0 to 1",
        ),
        ({"buried__0__gelatine_percent": 99.0}, r"buried\[0\]\.gelatine_percent"),
        ({"buried__0__disc": {}}, r"buried\[0\]\.disc"),
    ],
)
def test_wrong_materials_are_named(tmp_path, library, change, named):
    with pytest.raises(ValueError, match=named):
        scene_of(tmp_path, library, **change)


def test_a_box_can_be_buried(library):
    box = Box((-0.01, -0.01, -0.01), (0.01, 0.01, -0.001))
    felt = felt_at(np.zeros(3), library["gel10"], [Buried("box", box, library["gel16"])], 1e-3)
    assert 18.3e3 < felt.relaxation_modulus_1s_pa < 48.5e3


def test_the_scene_of_the_documentation_is_read(tmp_path, library):
    page = Path(__file__).resolve().parents[3] / "docs" / "simulation.md"
    if not page.exists():
        pytest.skip("the source tree's docs are not here")
    text = page.read_text(encoding="utf-8").split("```yaml\n")[1].split("```")[0]
    path = tmp_path / "scene.yaml"
    path.write_text(text, encoding="utf-8")
    scene = read_scene(library, path)
    assert len(read_scan_scene(path).positions_m) == 81
    over, beside = (scene.tissue_at(point) for point in ((0.1, 0.0), (0.12, 0.02)))
    assert over.relaxation_modulus_1s_pa > beside.relaxation_modulus_1s_pa
    percent = library.gelatine(13.0).relaxation_modulus_1s_pa
    assert scene.regions[0].material(np.array([0.025, 0, 0])) == library.gelatine(13.0)
    # under it the cortex of the deeper layer is felt too
    assert scene.tissue_at((0.025, 0.0)).relaxation_modulus_1s_pa < percent
