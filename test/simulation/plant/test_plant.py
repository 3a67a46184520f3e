# SPDX-License-Identifier: Apache-2.0
"""The plant: forces of the indenter in the base, friction, and what the load cell feels."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_resonance.contact.payload import Mount, Payload
from tactile_resonance.contact.vectors import transform_from_pose, vector
from tactile_resonance.sensor import read_sensor
from tactile_resonance.simulation.plant.plant import SLIP, Plant
from tactile_resonance.simulation.plant.surfaces import PlantSurface, relative_radius_m
from tactile_resonance.simulation.plant.tip import (
    BONE_PA,
    BONE_POISSON_RATIO,
    OnSoft,
    SprungIndenter,
    Tip,
    bone,
)
from tactile_resonance.simulation.sensor.bimorph import sensor_modes
from tactile_resonance.simulation.tissue.indenter import Indenter
from tactile_resonance.simulation.tissue.library import Tissue

RADIUS_M, NU = 2.5e-3, 0.49
ELASTIC = Tissue("elastic", 10e3, (), ())
SOFT = Tissue("soft", 5e3, (0.3,), (1.5,))
G = 9.80665


RIGID = Tip(RADIUS_M, poisson_ratio=NU)


def plant(tissue=ELASTIC, *, surface=None, tip=RIGID, **options):
    surface = PlantSurface.tilted(0.0) if surface is None else surface
    return Plant(surface, lambda _: tissue, tip, **options)


def at(*place, turn=(0.0, 0.0, 0.0)):
    """The tip, as the plant takes it."""
    return transform_from_pose([*place, *turn])


def hertz(depth_m):
    return 4 / 3 * 10e3 / (1 - NU**2) * np.sqrt(RADIUS_M) * depth_m**1.5


def test_force_of_a_pressed_ball_is_that_of_hertz_along_the_normal():
    p = plant()
    for height in (1e-3, 0.0, -2e-4, -5e-4):
        p.step(at(0, 0, RADIUS_M + height), 0.002)
        np.testing.assert_allclose(p.force_n, [0, 0, hertz(max(0, -height))], rtol=1e-4, atol=1e-9)
    assert p.in_contact
    assert p.touches == 1
    assert p.depth_m == pytest.approx(5e-4)
    p.step(at(0, 0, RADIUS_M + 1e-3), 0.002)
    assert not p.in_contact


def test_tilted_surface_pushes_along_its_normal_and_slides_with_friction():
    tilt = np.deg2rad(10)
    p = plant(surface=PlantSurface.tilted(0.0, tilt, 0.0), friction=0.0)
    normal = np.array([np.sin(tilt), 0, np.cos(tilt)])
    for depth in np.linspace(-1e-4, 4e-4, 26):
        p.step(at(*(normal * RADIUS_M - [0, 0, depth])), 0.002)
    want = hertz(4e-4 * np.cos(tilt)) * normal
    np.testing.assert_allclose(p.force_n, want, rtol=1e-3)


CENTRE_M, CURVED_M = np.array([0.01, -0.02, 0.05]), 10e-3
UP = np.array([0.0, 0.0, 1.0])


def sphere(centre_m, radius_m, hollow):
    curvature = -1 / radius_m if hollow else 1 / radius_m
    return PlantSurface(centre_m + UP / curvature, UP, curvature)


@pytest.mark.parametrize("hollow", [False, True])
@pytest.mark.parametrize("polar_rad", [0.0, 0.5])
def test_sphere_pushes_along_its_own_normal_with_the_force_of_two_curved_bodies(hollow, polar_rad):
    surface = sphere(CENTRE_M, CURVED_M, hollow)
    p = plant(surface=surface, friction=0.0)
    # from the centre to the contact; the tissue is inside of the sphere, or outside of the hollow
    out = np.array([np.sin(polar_rad), 0, np.cos(polar_rad)]) * (-1 if hollow else 1)
    normal = -out if hollow else out
    for depth in np.linspace(-1e-4, 4e-4, 26):
        p.step(at(*(CENTRE_M + CURVED_M * out + (RADIUS_M - depth) * normal)), 0.002)
    assert p.depth_m == pytest.approx(4e-4, rel=1e-9)
    # Hertz: 1/R = 1/r + 1/R of a sphere, less 1/R in a hollow
    radius = 1 / (1 / 2.5e-3 - 1 / 10e-3) if hollow else 1 / (1 / 2.5e-3 + 1 / 10e-3)
    want = 4 / 3 * 10e3 / (1 - NU**2) * np.sqrt(radius) * 4e-4**1.5
    np.testing.assert_allclose(p.force_n, want * normal, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(p.torque_nm, 0, atol=1e-12)


def test_a_plane_in_place_of_a_dome_is_pressed_as_a_plane():
    p = plant(surface=sphere(np.zeros(3), CURVED_M, False))
    top_m = CURVED_M + RADIUS_M
    for height in (1e-3, -4e-4, 1e-3):
        p.step(at(0, 0, top_m + height), 0.002)
    p.surface = PlantSurface.tilted(0.0)
    for height in (1e-3, 0.0, -4e-4):
        p.step(at(5e-3, 0, RADIUS_M + height), 0.002)
    assert p.normal_force_n == pytest.approx(hertz(4e-4), rel=1e-4)


def test_sphere_without_bounds_is_a_plane_and_a_ball_must_fit_into_its_hollow():
    assert relative_radius_m(RADIUS_M, PlantSurface.tilted(0.1)) == RADIUS_M
    for hollow in (False, True):
        far = PlantSurface(np.zeros(3), UP, -1e-6 if hollow else 1e-6)
        height, normal = far.height_of((0.01, 0.02, 3e-3))
        assert height == pytest.approx(3e-3, abs=1e-9)
        np.testing.assert_allclose(normal, [0, 0, 1], atol=1e-7)
        assert relative_radius_m(RADIUS_M, far) == pytest.approx(RADIUS_M, rel=1e-8)
    with pytest.raises(ValueError, match="below the radius of the hollow, 0.002 m"):
        relative_radius_m(RADIUS_M, sphere(CENTRE_M, 2e-3, True))


def test_friction_sticks_below_its_limit_and_slides_at_it():
    p = plant(friction=0.3)
    p.step(at(0, 0, RADIUS_M), 0.002)
    p.step(at(0, 0, RADIUS_M - 4e-4), 0.002)
    normal = hertz(4e-4)
    stiffness = 2 * (1 - NU) / (2 - NU) * 1.5 * normal / 4e-4
    p.step(at(1e-5, 0, RADIUS_M - 4e-4), 0.002)
    np.testing.assert_allclose(p.force_n, [-stiffness * 1e-5, 0, normal], rtol=1e-3)
    # friction acts at the lowest point of the ball
    np.testing.assert_allclose(p.torque_nm, [0, RADIUS_M * stiffness * 1e-5, 0], rtol=1e-3)
    for x in np.linspace(1e-5, 1e-3, 50):
        p.step(at(x, 0, RADIUS_M - 4e-4), 0.002)
        assert np.hypot(p.force_n[0], p.force_n[1]) <= 0.3 * p.force_n[2] * (1 + 1e-9)
    assert -p.force_n[0] == pytest.approx(0.3 * normal, rel=1e-3)


def test_friction_builds_up_with_the_contact_and_gives_no_energy():
    # pressed obliquely on elastic tissue: the integral of the stiffness, which goes as the root of the depth
    p = plant(friction=5.0)
    for part in np.linspace(0.0, 1.0, 1001):
        p.step(at(2e-5 * part, 0, RADIUS_M - 4e-4 * part), 0.002)
    stiffness = SLIP * 1.5 * hertz(4e-4) / 4e-4
    assert -p.force_n[0] == pytest.approx(2 / 3 * stiffness * 2e-5, rel=2e-3)
    # sheared under a light press and released under a hard one, and the other way round
    corners = [(0, 5e-5), (2e-5, 5e-5), (2e-5, 3e-4), (0, 3e-4)]
    for cycle in (corners, corners[::-1]):
        p, work = plant(friction=5.0), 0.0
        p.step(at(0, 0, RADIUS_M - cycle[0][1]), 0.002)
        for start, end in pairwise([*cycle, cycle[0], *cycle[1:], cycle[0]]):
            for part in np.linspace(0, 1, 101)[1:]:
                x, depth = np.array(start) + part * (np.array(end) - start)
                before, force = np.array(p.tip_m), np.array(p.force_n)
                p.step(at(x, 0, RADIUS_M - depth), 0.002)
                work += (force + p.force_n) / 2 @ (np.array(p.tip_m) - before)
        assert work < 0


def test_a_fresh_place_is_unrelaxed_and_the_old_one_remembers():
    def press(p, x):
        for height in [*np.linspace(1e-3, -4e-4, 20), -4e-4]:
            p.step(at(x, 0, RADIUS_M + height), 0.002)
        return p.force_n[2]

    def lift(p, x):
        for height in np.linspace(-4e-4, 1e-3, 20):
            p.step(at(x, 0, RADIUS_M + height), 0.002)

    p = plant(SOFT)
    first = press(p, 0.0)
    for _ in range(200):
        p.step(at(0, 0, RADIUS_M - 4e-4), 0.002)
    assert p.force_n[2] < 0.8 * first
    lift(p, 0.0)
    again = press(p, 0.0)
    assert again < 0.99 * first
    lift(p, 0.0)
    assert press(p, 0.02) == pytest.approx(first, rel=1e-9)


def test_what_is_felt_is_what_lies_under_the_touch_not_where_the_tip_came_near():
    """On tissue whose modulus rises along x, touched at several places closer than a ball's radius."""
    p = Plant(
        PlantSurface.tilted(0.0),
        lambda place: Tissue("slope", 10e3 * (1 + 100 * place[0]), (), ()),
        RIGID,
    )
    p.step(at(-2e-3, 0, RADIUS_M + 3e-3), 0.002)
    for x in (0.0, 1e-3, 1.5e-3):
        for part in np.linspace(0, 1, 20):
            p.step(at(x - 1e-3 * (1 - part), 0, RADIUS_M + 3e-3), 0.002)
        for height in np.linspace(3e-3, -3e-4, 60):
            p.step(at(x, 0, RADIUS_M + height), 0.002)
        assert p.normal_force_n == pytest.approx((1 + 100 * x) * hertz(3e-4), rel=1e-3)
        np.testing.assert_allclose(p.site_m[0], x, atol=1e-9)
        for height in np.linspace(-3e-4, 3e-3, 60):
            p.step(at(x, 0, RADIUS_M + height), 0.002)


def test_nothing_there_is_nothing_felt():
    p = Plant(PlantSurface.tilted(0.0), lambda _: None, RIGID)
    p.step(at(0, 0, 0), 0.002)
    np.testing.assert_array_equal(p.force_n, 0)


def test_cell_under_the_sample_feels_reaction_and_weight_wherever_the_tip_turns():
    centre = np.array([0.1, 0.01, -0.01])
    p = plant(mount=Mount.TABLE, carried=Payload(0.2, vector(centre)))
    p.step(at(0, 0, RADIUS_M), 0.002)
    p.step(at(0, 0, RADIUS_M - 4e-4, turn=(0.1, 0, 0)), 0.002)
    force, torque = np.reshape(p.wrench_at_cell(), (2, 3))
    normal = hertz(4e-4)
    np.testing.assert_allclose(force, [0, 0, -normal - 0.2 * G], rtol=1e-4)
    want = np.cross(centre, [0, 0, -0.2 * G])  # the tip presses above the cell's origin
    np.testing.assert_allclose(torque, want, rtol=1e-4, atol=1e-9)


def test_cell_on_the_tool_feels_contact_weight_and_inertia_in_its_own_frame():
    centre = np.array([-0.03, 0, 0.01])
    p = plant(mount=Mount.TOOL, carried=Payload(0.03, vector(centre)))
    turn = (0.0, 0.3, 0.0)
    acceleration = np.array([0.2, 0.0, 0.5])
    for n in range(3):
        place = np.array([0, 0, 0.05]) + acceleration * (0.002 * n) ** 2 / 2
        p.step(at(*place, turn=turn), 0.002)
    force, torque = np.reshape(p.wrench_at_cell(), (2, 3))
    cell = Rotation.from_rotvec(turn)
    load = 0.03 * (np.array([0, 0, -G]) - acceleration)
    np.testing.assert_allclose(force, cell.inv().apply(load), rtol=1e-6, atol=1e-9)
    arm = cell.apply(centre)
    np.testing.assert_allclose(torque, cell.inv().apply(np.cross(arm, load)), atol=1e-9)


def test_beam_in_series_is_softer_by_its_own_compliance():
    beam = sensor_modes(read_sensor())
    p = plant(tip=Tip(RADIUS_M, beam, NU))
    for height in [*np.linspace(1e-3, -8e-4, 400), *[-8e-4] * 2000]:
        p.step(at(0, 0, RADIUS_M + height), 0.002)
    # what the beam bends by is what the ball stays behind
    assert p.force_n[2] == pytest.approx(
        beam.static_stiffness_n_per_m * (8e-4 - p.depth_m), rel=1e-4
    )
    assert p.force_n[2] == pytest.approx(hertz(p.depth_m), rel=1e-4)


def test_beam_keeps_swinging_while_the_tip_comes_down_along_a_tilt():
    """Its swing is the beam's, not the tissue's: the same tissue asked for again does not stop it."""
    made = []

    def counted(ball):
        made.append(ball)
        return ball

    tip = Tip(RADIUS_M, sensor_modes(read_sensor()), NU, meets=counted)
    tilted = PlantSurface.tilted(0.0, np.deg2rad(10.0))
    p = Plant(tilted, lambda _: Tissue("soft", 10e3, (), ()), tip)
    for height in np.linspace(4e-3, -3e-4, 500):
        p.step(at(0, 0, RADIUS_M + height), 0.002)
    assert p.in_contact
    assert len(made) == 1


@pytest.mark.parametrize("elastic_pa", [None, 5e4, 2e5, 1e6])  # None: bone
@pytest.mark.parametrize("above_m", [1e-4, 5e-4])
def test_what_is_elastic_neither_gives_nor_takes_energy_of_a_ball_on_the_beam(elastic_pa, above_m):
    # moved above it in one step, the ball swings and hits it; the base stands
    tissue = Tissue("elastic", elastic_pa or 1.0, (), ())
    ball = Indenter(tissue, tip_radius_m=RADIUS_M, poisson_ratio=NU)
    plane_pa = tissue.relaxation_modulus_1s_pa / (1 - NU**2)
    if elastic_pa is None:
        ball = OnSoft(ball, bone(0.0, RADIUS_M))
        plane_pa = BONE_PA / (1 - BONE_POISSON_RATIO**2)
    k, m = 14.8, 2.65e-4
    tip = SprungIndenter(ball, (k, 0.0, m))
    base_m, stiffness = -5e-5, 4 / 3 * plane_pa * np.sqrt(RADIUS_M)
    tip.step(base_m - above_m, 0.002)
    energy, hits = [], 0
    for _ in range(200):
        tip.step(base_m, 0.002)
        depth_m = tip.tip_depth_m
        hits += depth_m > 0
        swing = k / 2 * (base_m - depth_m) ** 2 + m / 2 * tip._speed**2
        energy.append(swing + 2 / 5 * stiffness * max(0.0, depth_m) ** 2.5)
    assert hits > 5
    np.testing.assert_allclose(energy, energy[0], rtol=0.05)


def test_not_stepped_is_said():
    with pytest.raises(RuntimeError, match="not been stepped"):
        plant().wrench_at_cell()
