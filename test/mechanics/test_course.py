# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from benchmarks.mechanics import RADIUS_M, force_over
from tactile_resonance.mechanics.course import layer_share, sphere_share
from tactile_resonance.mechanics.indentation import BallTip, Prony
from tactile_resonance.simulation.plant.tip import SprungIndenter
from tactile_resonance.simulation.tissue.indenter import Indenter
from tactile_resonance.simulation.tissue.library import read_tissues

SOLID = Prony(2e3, np.array([3e3]), np.array([0.7]))
ELASTIC = Prony(5e3, np.array([]), np.array([]))
BALL = BallTip(RADIUS_M)


def test_the_force_of_a_step_is_the_relaxation_modulus_times_hertz():
    time = np.concatenate([[0.0], np.geomspace(1e-3, 20, 50)])
    force, _ = force_over(BALL, time, np.full(51, 1e-3), SOLID)
    hertz = 4 / 3 / (1 - 0.49**2) * np.sqrt(RADIUS_M) * 1e-3**1.5
    np.testing.assert_allclose(force, hertz * SOLID.relaxation_modulus(time), rtol=1e-12)


def test_the_force_of_a_ramp_and_a_hold_is_lee_and_radoks_integral():
    ramp, speed = 0.5, 2e-3
    time = np.concatenate([np.linspace(0, ramp, 401), ramp + np.geomspace(1e-3, 10, 100)])
    force, _ = force_over(BALL, time, speed * np.minimum(time, ramp), SOLID)
    for at in (100, 250, 400, 430, 500):
        t = time[at]

        def slope(s, t=t):
            return SOLID.relaxation_modulus(t - s) * 1.5 * speed**1.5 * np.sqrt(s)

        expected = BALL.factor * quad(slope, 0, min(t, ramp))[0]
        assert force[at] == pytest.approx(expected, rel=2e-5)


def test_the_force_of_an_elastic_solid_goes_as_depth_to_three_halves():
    depth = np.geomspace(1e-5, 1e-3, 30)
    force, _ = force_over(BALL, np.arange(30.0), depth, ELASTIC)
    slope, _ = np.polyfit(np.log(depth), np.log(force), 1)
    assert slope == pytest.approx(1.5, abs=1e-9)


def test_unloading_is_tings():
    rise, speed = 1.0, 1e-3
    time = np.concatenate([np.linspace(0, rise, 801), rise + np.linspace(0, 1.0, 501)[1:]])
    depth = speed * np.where(time < rise, time, 2 * rise - time)
    force, _ = force_over(BALL, time, depth, SOLID, turn=800)

    def condition(t1, t):
        def rate(s):
            return SOLID.relaxation_modulus(t - s)

        return quad(rate, t1, rise)[0] - quad(rate, rise, t)[0]

    for at in (820, 870, 950):
        t = time[at]
        t1 = brentq(condition, 0.0, rise, args=(t,))

        def slope(s, t=t):
            return SOLID.relaxation_modulus(t - s) * 1.5 * speed**1.5 * np.sqrt(s)

        assert force[at] == pytest.approx(BALL.factor * quad(slope, 0, t1)[0], rel=1e-3)
    # it lets go long before the robot is back at the surface
    assert force[-1] == 0.0
    assert depth[np.flatnonzero(force)[-1]] > 2e-4


def test_an_elastic_solid_unloads_as_it_was_loaded():
    time = np.linspace(0, 2, 401)
    depth = 1e-3 * (1 - np.abs(1 - time))
    force, _ = force_over(BALL, time, depth, ELASTIC, turn=200)
    np.testing.assert_allclose(force[201:], force[:200][::-1], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("name", ["cortex", "gel10"])
@pytest.mark.parametrize("stiffness_n_per_m", [np.inf, 14.8])
def test_it_agrees_with_the_bench_over_ramp_hold_and_unloading(name, stiffness_n_per_m):
    tissue = read_tissues()[name]
    time = np.concatenate(
        [
            np.linspace(0, 0.2, 401),
            0.2 + np.geomspace(1e-3, 10, 200),
            10.2 + np.linspace(0, 0.4, 401),
        ]
    )
    time = np.unique(time)
    depth = np.interp(time, [0, 0.2, 10.2, 10.6], [0, 1e-3, 1e-3, -2e-4])
    turn = int(np.searchsorted(time, 10.2 - 1e-9))
    ball = BallTip(RADIUS_M, stiffness_n_per_m=stiffness_n_per_m)
    force, _ = force_over(ball, time, depth, tissue.prony, turn)
    bench = Indenter(tissue, tip_radius_m=RADIUS_M, poisson_ratio=0.49)
    tip, exact = bench, 1e-4
    if np.isfinite(stiffness_n_per_m):  # a light beam that is damped hardly swings
        tip, exact = (
            SprungIndenter(bench, (14.8, 1e-4, 1e-6)),
            3e-3,
        )
    tip.step(0.0, 1e-3)
    steps = zip(depth[1:], np.diff(time), strict=True)
    expected = np.array([0.0, *((tip.step(z, dt), bench.force_n)[1] for z, dt in steps)])
    np.testing.assert_allclose(force, expected, atol=exact * expected.max())


def test_behind_a_spring_the_ball_goes_on_while_the_robot_stands():
    time = np.concatenate([np.linspace(0, 0.2, 201), 0.2 + np.geomspace(1e-3, 30, 200)])
    depth = 1.5e-3 * np.minimum(time / 0.2, 1)
    ball = BallTip(RADIUS_M, stiffness_n_per_m=15.0)
    force, inside = force_over(ball, time, depth, SOLID)
    np.testing.assert_allclose(15.0 * (depth - inside), force, rtol=1e-6, atol=1e-12)
    assert (np.diff(inside[200:]) > 0).all()


def test_a_sphere_and_a_layer_against_hertz():
    # Sneddon's series: the force of a sphere at delta / R is less by about a tenth of it
    assert sphere_share(BALL, 1e-6) == pytest.approx(1.0, abs=1e-3)
    assert sphere_share(BALL, 0.1 * RADIUS_M) == pytest.approx(0.99, abs=2e-3)
    assert np.isnan(sphere_share(BALL, 1.2 * RADIUS_M))
    assert layer_share(BALL, 1e-4, 1.0) == pytest.approx(1.0, abs=1e-3)
    assert layer_share(BALL, 4e-4, 1e-3) == pytest.approx(1 + 1.133 + 1.283 + 0.769 + 0.0975)
