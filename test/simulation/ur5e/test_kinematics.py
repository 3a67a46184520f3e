# SPDX-License-Identifier: Apache-2.0
"""UR5e: forward and inverse against a product of exponentials made from the drawing's lengths."""

import itertools
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from tactile_resonance.contact.vectors import (
    inverse_transform,
    pose_from_transform,
    transform_from_pose,
)
from tactile_resonance.simulation.ur5e import kinematics
from tactile_resonance.simulation.ur5e.kinematics import Posture

sys.path.insert(0, str(Path(__file__).parent))
from matrices import floats, forward, matrix, matrix_from_pose, transform, turn_between

# The arm stretched along -x, all angles 0: axes and points on them, from the maker's lengths.
UPPER, FORE, HEIGHT, OFFSET, WRIST_2, WRIST_3 = 0.425, 0.3922, 0.1625, 0.1333, 0.0997, 0.0996
REACH = -(UPPER + FORE)
SCREWS = [
    ((0, 0, 1), (0, 0, 0)),
    ((0, -1, 0), (0, 0, HEIGHT)),
    ((0, -1, 0), (-UPPER, 0, HEIGHT)),
    ((0, -1, 0), (REACH, 0, HEIGHT)),
    ((0, 0, -1), (REACH, -OFFSET, HEIGHT)),
    ((0, -1, 0), (REACH, -OFFSET, HEIGHT - WRIST_2)),
]
HOME = np.eye(4)
HOME[:3, :3] = Rotation.from_euler("x", 90, degrees=True).as_matrix()
HOME[:3, 3] = (REACH, -OFFSET - WRIST_3, HEIGHT - WRIST_2)


def product_of_exponentials(q: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    for angle, (axis, point) in zip(q, SCREWS, strict=True):
        twist = np.zeros((4, 4))
        twist[:3, :3] = np.cross(np.eye(3), axis)
        twist[:3, 3] = -np.cross(axis, point)
        pose = pose @ expm(twist * angle)
    return pose @ HOME


def inverse(wanted: np.ndarray, wrist_angle: float = 0.0) -> list[tuple[float, ...]]:
    """All solutions, of which `nearest_inverse` takes one."""
    signs = itertools.product((1.0, -1.0), repeat=3)
    found = [kinematics._solution(*transform(wanted), *each, wrist_angle) for each in signs]
    return [joints for joints in found if np.isfinite(joints).all()]


def nearest_inverse(wanted: np.ndarray, near: np.ndarray):
    return kinematics.nearest_inverse(transform(wanted), floats(near))


@pytest.fixture(scope="module")
def postures() -> np.ndarray:
    return np.random.default_rng(7).uniform(-np.pi, np.pi, (300, 6))


def test_forward_agrees_with_a_product_of_exponentials(postures):
    for q in postures:
        np.testing.assert_allclose(forward(q), product_of_exponentials(q), atol=1e-12)


def test_every_inverse_solution_reaches_the_pose_and_one_is_the_posture(postures):
    counts = set()
    for q in postures:
        wanted = product_of_exponentials(q)
        solutions = inverse(wanted)
        counts.add(len(solutions))
        for solution in solutions:
            np.testing.assert_allclose(forward(np.array(solution)), wanted, atol=1e-9)
        away = [np.abs(np.exp(1j * np.array(s)) - np.exp(1j * q)).max() for s in solutions]
        assert min(away) < 1e-6
    assert 8 in counts


def test_nearest_inverse_keeps_whole_turns_within_the_joints_range(postures):
    rng = np.random.default_rng(8)
    for q in postures[:100]:
        turned = q + 2 * np.pi * rng.integers(-1, 2, 6)
        turned = np.where(np.abs(turned) > 2 * np.pi, q, turned)
        found = nearest_inverse(forward(turned), turned)
        np.testing.assert_allclose(found, turned, atol=1e-6)


def test_a_path_through_whole_turns_stays_continuous():
    q = np.array([0.3, -1.2, 1.4, -1.7, -1.5, 0.0])
    for angle in np.arange(0.0, 6.2, 0.01):
        wanted = q.copy()
        wanted[5] = angle
        found = nearest_inverse(forward(wanted), np.where(np.arange(6) == 5, angle - 0.01, q))
        np.testing.assert_allclose(found, wanted, atol=1e-8)


def test_parallel_wrist_axes_take_the_wrist_angle_given():
    q = np.array([0.3, -1.2, 1.4, -1.7, 0.0, 0.8])
    found = nearest_inverse(forward(q), q)
    np.testing.assert_allclose(found, q, atol=1e-7)
    np.testing.assert_allclose(forward(found), forward(q), atol=1e-12)


@pytest.mark.parametrize("fifth", [0.0, np.pi])
@pytest.mark.parametrize("off", [0.0, 1e-8, 1e-7, 1e-6, 1e-4])
def test_wrist_axes_that_are_almost_parallel_lose_no_digits(postures, fifth, off):
    for q in postures[:100].copy():
        q[4] = fifth - np.copysign(off, fifth - 1.0)
        wanted = product_of_exponentials(q)
        solutions = inverse(wanted, q[5])
        assert solutions
        for solution in solutions:
            np.testing.assert_allclose(forward(np.array(solution)), wanted, atol=1e-9)


@pytest.mark.parametrize("position", [(1.2, 0, 0.3), (0, 0, 1.3), (0.05, 0.0, 0.3)])
def test_out_of_reach_has_no_solution(position):
    flange = np.eye(4)
    flange[:3, 3] = position
    assert inverse(flange) == []
    assert nearest_inverse(flange, np.zeros(6)) is None


def test_the_nearest_solution_is_the_nearest_of_all_eight(postures):
    rng = np.random.default_rng(9)
    for q in postures:
        # at a joint's turning point two solutions meet: the one that is tried first may be the wrong one
        bent = q.copy()
        bent[rng.choice([2, 4])] *= rng.choice([1.0, 1e-2, 1e-4, 0.0])
        near = bent + rng.standard_normal(6) * rng.choice([1e-5, 1e-3, 0.1, 1.0])
        wanted = product_of_exponentials(bent)
        ways = [
            np.abs(np.remainder(np.array(each) - near + np.pi, 2 * np.pi) - np.pi).sum()
            for each in inverse(wanted, near[5])
        ]
        found = nearest_inverse(wanted, near)
        np.testing.assert_allclose(forward(found), wanted, atol=1e-9)
        assert np.abs(found - near).sum() == pytest.approx(min(ways), abs=1e-9)


def test_twist_is_the_derivative_of_a_tool_point(postures):
    tool = matrix_from_pose([0.02, -0.05, 0.13, 0.4, 0.1, -0.2])
    for q in postures[:50]:
        posture = Posture(floats(q))
        point = floats((matrix(posture.flange) @ tool)[:3, 3])
        step = 1e-6
        for shift in step * np.eye(6):
            ahead, behind = forward(q + shift) @ tool, forward(q - shift) @ tool
            velocity = (ahead - behind)[:3, 3] / (2 * step)
            turn = turn_between(behind, ahead) / (2 * step)
            twist = posture.twist(point, floats(shift / step))
            np.testing.assert_allclose(twist, [*velocity, *turn], atol=1e-8)


TCP = transform_from_pose([0.02, -0.05, 0.13, 0.4, 0.1, -0.2])
TCPS = (*TCP, *inverse_transform(TCP))


def posture_at(motion):
    """Posture, its joint speeds and how far it is, of `motion_to` or `motion_towards`."""
    return Posture(motion[:6]), np.array(motion[6:12]), motion[12]


def test_a_motion_of_the_tool_is_that_of_the_joints_and_torques_do_the_same_work(postures):
    rng = np.random.default_rng(10)
    for q in postures:
        posture = Posture(floats(q))
        point = posture.tool(TCP)[1]
        qd, wrench = floats(rng.standard_normal(6)), floats(rng.standard_normal(6))
        twist = posture.twist(point, qd)
        near = floats(q + 1e-3)
        found, speeds, away = posture_at(
            kinematics.motion_to(*posture.tool(TCP), twist, near, *TCPS)
        )
        np.testing.assert_allclose(found.q, q, atol=1e-8)
        np.testing.assert_allclose(matrix(found.flange), matrix(posture.flange), atol=1e-9)
        np.testing.assert_allclose(speeds, qd, atol=1e-6)
        assert away == pytest.approx(6e-3, rel=1e-4)
        torques = posture.torques(point, wrench)
        assert np.dot(torques, qd) == pytest.approx(np.dot(wrench, twist), abs=1e-12)


@pytest.mark.parametrize("straight", [False, True])
def test_a_twist_comes_nearer_to_its_goal_and_the_tool_moves_by_the_mean_of_both(
    postures, straight
):
    postures, rng = postures.copy(), np.random.default_rng(11)
    period_s, most = 1e-3, 5e-3
    for q in postures[:100]:
        q[[2, 4]] = 1.5 + 0.2 * q[[2, 4]]  # away from the edges of its reach
        posture, qd = Posture(floats(q)), floats(0.1 * rng.standard_normal(6))
        tool = posture.tool(TCP)
        before = np.array(posture.twist(tool[1], qd))
        for size in (0.5 * most, 10 * most):
            way = rng.standard_normal(6)
            way[:3] *= size / np.linalg.norm(way[:3])
            way[3:] *= 0.5 * size / np.linalg.norm(way[3:])
            motion = kinematics.motion_towards(
                floats(q), qd, floats(before + way), most, period_s, straight, *TCPS
            )
            found, speeds, away = posture_at(motion)
            assert away < 0.1
            reached = size <= most
            assert motion[13] == reached
            if not reached:
                way[:3] *= most / size
                way[3:] *= most / size if straight else most / (0.5 * size)
            place = found.tool(TCP)
            now = np.array(found.twist(place[1], floats(speeds)))
            np.testing.assert_allclose(now, before + way, atol=1e-9)
            mean = (before + now) / 2 * period_s
            np.testing.assert_allclose(np.subtract(place[1], tool[1]), mean[:3], atol=1e-9)
            np.testing.assert_allclose(
                turn_between(matrix(tool), matrix(place)), mean[3:], atol=1e-9
            )


@pytest.mark.parametrize(("joint", "angle"), [(2, 0.0), (4, 0.0)])
def test_at_a_singularity_no_speeds_are_found(joint, angle):
    q = np.array([0.0, -1.2, 1.4, -1.7, -1.5, 0.3])
    q[joint] = angle
    q[1] = 0.0
    posture, upwards = Posture(floats(q)), (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
    assert np.isnan(kinematics._speeds(posture._numbers, posture.flange[1], upwards)).all()


def test_a_frame_that_the_flange_carries_is_the_product(postures):
    posture = Posture(floats(postures[0]))
    for pose in ([0.02, -0.05, 0.13, 0.4, 0.1, -0.2], [0.0] * 6, [0.1, 0, 0, 0, np.pi, 0]):
        wanted = matrix(posture.flange) @ matrix_from_pose(pose)
        carried = transform_from_pose(pose)
        for _ in range(2):
            np.testing.assert_allclose(matrix(posture.tool(carried)), wanted, atol=1e-15)


def test_poses_and_transforms_are_inverse_to_each_other(postures):
    for q in postures[:50]:
        flange = Posture(floats(q)).flange
        again = transform_from_pose(pose_from_transform(flange))
        np.testing.assert_allclose(matrix(again), matrix(flange), atol=1e-12)
