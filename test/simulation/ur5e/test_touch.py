# SPDX-License-Identifier: Apache-2.0
"""The arm against a rubber-like elastic block: what it feels, contact detection, force mode."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_resonance.simulation.plant.plant import Plant
from tactile_resonance.simulation.plant.surfaces import PlantSurface
from tactile_resonance.simulation.plant.tip import Tip
from tactile_resonance.simulation.tissue.library import Tissue
from tactile_resonance.simulation.ur5e.controller import SafetyMode
from tactile_resonance.simulation.ur5e.machine import MachineConfig

sys.path.insert(0, str(Path(__file__).parent))
from matrices import forward, matrix_from_pose

RADIUS_M, MODULUS_PA, POISSON = 0.005, 2e6, 0.49
TIP = np.array([0.0, 0.0, 0.12, 0.0, 0.0, 0.0])
GAP_M = 0.004
START_Z = (forward(MachineConfig().start_q) @ matrix_from_pose(TIP))[2, 3]
# Height of the ball's centre when it just touches.
TOUCH_Z = START_Z - GAP_M


def hertz(depth_m: float) -> float:
    return 4 / 3 * MODULUS_PA / (1 - POISSON**2) * np.sqrt(RADIUS_M) * max(depth_m, 0.0) ** 1.5


@pytest.fixture
def plant() -> Plant:
    rubber = Tissue("rubber", MODULUS_PA, (), ())
    tip = Tip(RADIUS_M, poisson_ratio=POISSON)
    return Plant(PlantSurface.tilted(TOUCH_Z - RADIUS_M), lambda _: rubber, tip)


@pytest.fixture
def touching(make_client, plant):
    """Return a client whose TCP is the tip, a few millimetres above the block."""
    client = make_client(plant, tip_in_flange=TIP)
    client.call(29, TIP)
    client.call(8)
    client.run(0.01)
    return client


def depth(client) -> float:
    return TOUCH_Z - client.output("actual_TCP_pose")[2]


def test_force_at_the_tcp_is_that_of_the_block(touching, plant):
    pose = touching.output("target_TCP_pose")
    touching.call(3, [*(pose - [0, 0, GAP_M + 0.001, 0, 0, 0]), 0.02, 0.5])
    touching.run(0.3)
    expected = hertz(depth(touching))
    assert expected > 5.0
    force = touching.output("actual_TCP_force")
    assert force[2] == pytest.approx(expected, rel=1e-6)
    np.testing.assert_allclose(force, [*plant.force_n, *plant.torque_nm], atol=1e-12)
    # at the flange the tip's lever turns what is sideways into a torque
    raw = touching.output("ft_raw_wrench")
    flange = Rotation.from_rotvec(touching.output("actual_TCP_pose")[3:])
    couple = flange.inv().apply(plant.torque_nm)
    np.testing.assert_allclose(raw[3:], couple + np.cross(TIP[:3], raw[:3]), atol=1e-12)


@pytest.mark.parametrize("direction", [(0, 0, -1), (0, 0, 0)])
def test_move_until_contact_returns_to_where_contact_began(touching, direction):
    touching.call(51, [0, 0, -0.02, 0, 0, 0, *direction, 0, 0, 0, 0.5])
    touching.run(0.3)
    config = touching.controller.machine.config
    # found at the threshold, back to where the force was a third of it
    pressed = touching.output("actual_TCP_force")[2]
    assert 0 < pressed < config.contact_force_n / 3
    assert pressed == pytest.approx(hertz(depth(touching)), rel=1e-6)
    assert hertz(depth(touching) + 2 * 0.02 * 0.002) > config.contact_force_n / 3


def test_contact_is_seen_along_its_direction_only(touching):
    pose = touching.output("target_TCP_pose")
    touching.call(3, [*(pose - [0, 0, GAP_M + 0.004, 0, 0, 0]), 0.02, 0.5])
    assert touching.output("actual_TCP_force")[2] > 15.0
    for direction, seen in (((0, 0, -1), True), ((0, 0, 1), False), ((1, 0, 0), False)):
        touching.stream(25, [*direction, 0, 0, 0])
        touching.run(0.004)
        assert (touching.answer > 0) is seen
    touching.write(0)


def test_contact_detection_during_an_asynchronous_move(touching):
    pose = touching.output("target_TCP_pose")
    touching.call(62, [0, 0, -1, 0, 0, 0])
    touching.call(3, [*(pose - [0, 0, 0.02, 0, 0, 0]), 0.02, 0.5], [1])
    touching.run(2.0)
    assert not touching.output("target_qd").any()
    # the main loop hears of it a cycle late
    assert 0 < hertz(depth(touching) - 2 * 0.02 * 0.002) < 5.0
    touching.call(64)
    assert touching.answer > 0
    touching.call(63)
    assert touching.answer > 0


def test_force_mode_presses_with_the_force_asked_for_and_holds_other_axes(touching):
    start = touching.output("target_TCP_pose")
    limits = [0.1, 0.1, 0.03, 0.5, 0.5, 0.5]
    touching.stream(6, [0, 0, 0, 0, 0, 0, 0, 0, -8.0, 0, 0, 0, *limits], [2, 0, 0, 1, 0, 0, 0])
    fastest = 0.0
    for _ in range(1000):
        touching.controller.step()
        fastest = max(fastest, abs(touching.output("actual_TCP_speed")[2]))
    assert fastest <= 0.03 * (1 + 1e-6)
    assert touching.output("actual_TCP_force")[2] == pytest.approx(8.0, rel=0.01)
    end = touching.output("target_TCP_pose")
    np.testing.assert_allclose(end[:2], start[:2], atol=1e-9)
    np.testing.assert_allclose(end[3:], start[3:], atol=1e-9)
    touching.call(7)
    held = touching.output("target_TCP_pose")
    touching.run(0.3)
    np.testing.assert_allclose(touching.output("target_TCP_pose"), held, atol=1e-12)


def test_force_mode_gives_way_while_the_arm_moves_sideways(touching):
    selection = [2, 0, 0, 1, 0, 0, 0]
    touching.stream(6, [0, 0, 0, 0, 0, 0, 0, 0, -8.0, 0, 0, 0, *[0.05] * 6], selection)
    touching.run(1.5)
    start = touching.output("target_TCP_pose")
    touching.stream(10, [0.01, 0, 0, 0, 0, 0, 0.1, 0.0])
    touching.run(1.0)
    assert touching.output("target_TCP_pose")[0] - start[0] == pytest.approx(0.0095, rel=0.01)
    assert touching.output("actual_TCP_force")[2] == pytest.approx(8.0, rel=0.02)
    touching.call(15, [1.0])
    touching.call(7)


@pytest.mark.parametrize(
    ("ints", "limits", "message"),
    [([4, 0, 0, 1, 0, 0, 0], [0.1] * 6, "type 4"), ([2, 0, 0, 1, 0, 0, 0], [0.0] * 6, "limits")],
)
def test_force_mode_refuses_what_it_cannot_do(touching, ints, limits, message):
    touching.stream(6, [0, 0, 0, 0, 0, 0, 0, 0, -8.0, 0, 0, 0, *limits], ints)
    touching.run(0.01)
    assert touching.controller.program is None
    assert message in touching.controller.log[-1]


def test_too_much_force_is_a_protective_stop(touching):
    pose = touching.output("target_TCP_pose")
    touching.write(3, [*(pose - [0, 0, 0.03, 0, 0, 0]), 0.05, 0.5])
    touching.run(1.5)
    assert touching.controller.safety_mode is SafetyMode.PROTECTIVE_STOP
    assert "N at the tool" in touching.controller.log[-1]
    assert touching.output("actual_TCP_force")[2] < 1.5 * 150.0


def test_the_tip_trembles_where_the_encoders_stand_still(make_client, plant):
    client = make_client(plant, machine=MachineConfig(tip_in_flange=TIP))
    client.run(0.3)
    q = client.output("actual_q")
    heights = []
    for _ in range(3000):
        client.controller.step()
        heights.append(client.controller.machine.tremble_m[2])
    assert np.array_equal(client.output("actual_q"), q)
    # 3 micrometres rms over 6 s, some hundred correlation times
    assert np.std(heights) == pytest.approx(3e-6, rel=0.25)


@pytest.mark.parametrize("move", ["movel", "movej", "servoj"])
def test_force_mode_keeps_its_force_beside_a_path(touching, move):
    limits = [0.05] * 6
    touching.stream(6, [*[0] * 6, 0, 0, -8.0, 0, 0, 0, *limits], [2, 0, 0, 1, 0, 0, 0])
    touching.run(1.5)
    start, q = touching.output("target_TCP_pose"), touching.output("target_q")
    pressed = depth(touching)
    if move == "movel":
        # 2 cm aside and 1 mm up, which the force takes back
        touching.call(3, [*(start + [0.02, 0, 0.001, 0, 0, 0]), 0.02, 0.2])
        assert touching.output("target_TCP_pose")[0] - start[0] == pytest.approx(0.02, abs=1e-9)
    else:
        # the base turns: the tip stays in its plane
        goal = q + [0.05, 0, 0, 0, 0, 0]
        if move == "movej":
            touching.call(1, [*goal, 0.05, 0.2])
        else:
            # angles without what force mode yielded, as a client plans them
            planned = goal - touching.controller.machine.target.aside_q
            touching.stream(11, [*planned, 0, 0, 0.002, 0.1, 300])
            touching.run(1.0)
        assert touching.output("target_q")[0] - q[0] == pytest.approx(0.05, abs=1e-4)
    touching.run(1.0)
    assert depth(touching) == pytest.approx(pressed, abs=3e-6)
    assert touching.output("actual_TCP_force")[2] == pytest.approx(8.0, rel=0.01)
