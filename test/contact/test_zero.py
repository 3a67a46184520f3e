# SPDX-License-Identifier: Apache-2.0
"""The zero from one contact to the next: its stated deviation against Monte Carlo, and what is no walk.

And the weight on a cell under the sample, part of it, under a tip that is turned between tare and hold.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_resonance.contact.geometry import touch_pose
from tactile_resonance.contact.goal import ContactGoal, State
from tactile_resonance.contact.loop import ContactLoop
from tactile_resonance.contact.machine import ContactController
from tactile_resonance.contact.observer import Zero
from tactile_resonance.contact.parameters import Limits
from tactile_resonance.contact.samples import Pose
from tactile_resonance.simulation.plant.contact_bench import ContactBench
from tactile_resonance.simulation.plant.surfaces import PlantSurface
from tactile_resonance.simulation.plant.tip import Tip

sys.path.insert(0, str(Path(__file__).parent))
from contacts import FORCE_N, QUICK, RADIUS_M, SOFT

WALK, STD_N, EVERY_S = 5e-5, 9e-5, 2.5


def look(force_n, time_ns):
    return Zero(np.asarray(force_n, float), np.full(3, STD_N), time_ns)


def test_deviation_of_a_zero_that_walks_is_honest_and_below_that_of_one_look():
    rng = np.random.default_rng(1)
    z, stds = [], []
    for _ in range(300):
        true = np.zeros(3)
        zero = Zero(true + STD_N * rng.standard_normal(3), np.full(3, STD_N), 0)
        for k in range(1, 9):
            true = true + WALK * np.sqrt(EVERY_S) * rng.standard_normal(3)
            seen = look(true + STD_N * rng.standard_normal(3), round(k * EVERY_S * 1e9))
            zero = zero.with_look(seen, WALK) or seen
        z.append((zero.force_n - true) / zero.std_n)
        stds.append(zero.std_n)
    # chi square over 900 values, five standard errors
    assert np.mean(np.square(z)) == pytest.approx(1.0, abs=5 * np.sqrt(2 / 900))
    # the stationary variance P solves (P + q) r / (P + q + r) = P
    q, r = WALK**2 * EVERY_S, STD_N**2
    steady = np.sqrt((-q + np.sqrt(q * q + 4 * q * r)) / 2)
    assert np.mean(stds) == pytest.approx(steady, rel=0.02)
    assert steady < 0.8 * STD_N


def test_long_after_it_was_known_a_zero_is_that_of_the_look():
    zero = Zero(np.zeros(3), np.full(3, 1e-6), 0).with_look(look([2e-4, 0, 0], 10**13), WALK)
    np.testing.assert_allclose(zero.force_n, [2e-4, 0, 0], rtol=1e-3)
    np.testing.assert_allclose(zero.std_n, STD_N, rtol=1e-3)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_zero_that_stepped_is_not_known(axis):
    before = Zero(np.zeros(3), np.full(3, STD_N), 0)
    spread = np.sqrt(2 * STD_N**2 + WALK**2)
    for share, known in ((3.9, True), (4.1, False)):
        force_n = np.zeros(3)
        force_n[axis] = share * spread
        assert (before.with_look(look(force_n, 10**9), WALK) is not None) == known


def test_looks_never_make_it_less_certain():
    zero = Zero(np.zeros(3), np.full(3, 1e-3), 0)
    for k in range(1, 20):
        before, zero = zero, zero.with_look(look(np.zeros(3), k), 0.0)
        assert np.all(zero.std_n < before.std_n)
    # without a walk it is the weighted mean of all
    assert zero.std_n[0] == pytest.approx((1e6 + 19 / STD_N**2) ** -0.5)


def test_an_axis_that_shows_one_number_is_known_by_it():
    one = np.array([0.0, 0.0, STD_N])  # a cell of one axis
    before = Zero(np.array([0.0, 1e-3, 0.0]), one, 0)
    zero = before.with_look(Zero(np.array([0.0, 1e-3, 0.0]), one, 10**9), 0.0)
    np.testing.assert_allclose(zero.force_n, [0.0, 1e-3, 0.0])
    np.testing.assert_allclose(zero.std_n, [0.0, 0.0, STD_N / np.sqrt(2)])
    assert before.with_look(Zero(np.array([1e-6, 1e-3, 0.0]), one, 10**9), 0.0) is None


@pytest.mark.parametrize("turned_rad", [-0.004, 0.004, 0.02])
def test_the_weight_on_a_cell_under_the_sample_does_not_turn_with_the_tip(turned_rad):
    # 2 N on the cell: 1 mrad about y is 2 mN along x of the tip, on a slope of 0.5 rad 1 mN along its z
    normal = np.array([np.sin(0.5), 0.0, np.cos(0.5)])
    touch = touch_pose([0, 0, 0], normal, [1, 0, 0], RADIUS_M)
    turn = Rotation.from_rotvec([0, turned_rad, 0]) * touch.rotation
    start = Pose(touch.position_m + 2.5e-3 * normal, turn.as_rotvec())
    bench = ContactBench(SOFT, PlantSurface(np.zeros(3), normal), start, tip=Tip(RADIUS_M))
    controller = ContactController(QUICK, Limits(), under_sample=True)
    loop = ContactLoop(bench.arm, bench.cell, bench, controller)
    loop.start(ContactGoal(touch, FORCE_N))
    loop.run_while(lambda: controller.state not in (State.HOLD, State.FAULT), 20.0)
    assert controller.state is State.HOLD, controller.result
    true_n = []
    bench.on_step.append(lambda: true_n.append(normal @ bench.plant.force_n))
    loop.run_while(lambda: True, 0.3)
    result = controller.result
    assert abs(result.force_n - np.mean(true_n)) < 4 * result.force_std_n
