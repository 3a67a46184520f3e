# SPDX-License-Identifier: Apache-2.0
"""Payload and mounting against closed forms, and identification against its own covariance."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tactile_resonance.contact.payload import Mount, Mounting, Payload, identify_payload
from tactile_resonance.contact.samples import CellSample, Pose
from tactile_resonance.contact.vectors import NO_TURN, ZERO, six, vector

G = 9.80665
vectors = st.lists(st.floats(-1, 1), min_size=3, max_size=3).map(np.array)


def pose(position=(0.0, 0.0, 0.0), rotvec=(0.0, 0.0, 0.0)):
    return Pose(np.array(position, float), np.array(rotvec, float))


def turn(rotvec):
    return tuple(Rotation.from_rotvec(rotvec).as_matrix().ravel().tolist())


def felt(mounting, wrench, at, attitude):
    """The wrench at the tip, at a place and turned, from that on the cell."""
    (sample,) = mounting.to_tip([CellSample(5, six(wrench))], vector(at), turn(attitude))
    assert (sample.time_ns, sample.overload) == (5, False)
    return np.concatenate([sample.force_n, sample.torque_nm])


def tilts(*rotvecs):
    return Rotation.from_rotvec(np.array(rotvecs, float)).as_matrix()


def test_weight_of_a_payload_upright_and_on_its_side():
    payload = Payload(0.1, (0.0, 0.0, 0.05))
    np.testing.assert_allclose(payload.wrench(NO_TURN), [0, 0, -0.1 * G, 0, 0, 0], atol=1e-15)
    # the cell's z axis along the base's x: gravity is the cell's +x, lever 50 mm about y
    side = turn([0, np.pi / 2, 0])
    np.testing.assert_allclose(
        payload.wrench(side), [0.1 * G, 0, 0, 0, 0.05 * 0.1 * G, 0], atol=1e-15
    )


@settings(max_examples=50, deadline=None)
@given(vectors, vectors, vectors, vectors, vectors, vectors)
def test_the_tool_mounted_cell_gives_back_the_contact(force, torque, place, frame, at, attitude):
    mounting = Mounting(Mount.TOOL, pose(place, frame), Payload(0.08, (0.01, 0.0, 0.04)))
    own = Rotation.from_rotvec(frame).as_matrix()
    # balance of moments about the cell: the contact acts at the tip, the weight at its centre
    weight = own.T @ Rotation.from_rotvec(attitude).inv().apply([0, 0, -0.08 * G])
    on_cell = np.concatenate(
        [
            own.T @ force + weight,
            own.T @ (torque + np.cross(-place, force)) + np.cross([0.01, 0, 0.04], weight),
        ]
    )
    np.testing.assert_allclose(
        felt(mounting, on_cell, at, attitude), [*force, *torque], rtol=0, atol=1e-12
    )


@settings(max_examples=50, deadline=None)
@given(vectors, vectors, vectors, vectors, vectors)
def test_the_cell_under_the_sample_feels_the_opposite(force, place, frame, at, attitude):
    mounting = Mounting(Mount.TABLE, pose(place, frame))
    own = Rotation.from_rotvec(frame).as_matrix()
    in_base = Rotation.from_rotvec(attitude).apply(force)
    on_cell = np.concatenate([own.T @ -in_base, own.T @ np.cross(at - place, -in_base)])
    got = felt(mounting, on_cell, at, attitude)
    np.testing.assert_allclose(got, [*force, 0, 0, 0], rtol=0, atol=1e-12)


def test_pressing_down_is_a_positive_z_force_at_the_tip():
    # tip upright: +z out of the surface; the cell under the sample is pushed down by 10 mN
    mounting = Mounting(Mount.TABLE, pose((0.3, 0.0, -0.05)))
    torque = np.cross([0, 0.01, 0.05], [0, 0, -0.01])
    got = felt(mounting, [0, 0, -0.01, *torque], (0.3, 0.01, 0.0), (0, 0, 0))
    np.testing.assert_allclose(got, [0, 0, 0.01, 0, 0, 0], atol=1e-15)


def test_a_sample_is_no_payload():
    with pytest.raises(ValueError, match="payload"):
        Mounting(Mount.TABLE, pose(), Payload(0.1, ZERO))


ORIENTATIONS = tilts((0, 0, 0), (0.8, 0, 0), (-0.8, 0, 0), (0, 0.8, 0), (0, -0.8, 0))
TRUTH = np.array([0.06, 0.004, -0.002, 0.035, 0.02, -0.01, 0.03, 2e-4, -1e-4, 5e-5])
STD = np.repeat([1e-4, 5e-6], 3)


def wrenches_of(payload, rotations):
    return np.array([payload.wrench(tuple(matrix.ravel())) for matrix in rotations])


def readings(rng=None):
    payload = Payload(TRUTH[0], vector(TRUTH[1:4]))
    clean = wrenches_of(payload, ORIENTATIONS) + TRUTH[4:]
    return clean if rng is None else clean + STD * rng.standard_normal(clean.shape)


def test_the_payload_is_exact_without_noise():
    found = identify_payload(ORIENTATIONS, readings(), STD)
    got = np.array([found.payload.mass_kg, *found.payload.centre_m, *found.bias])
    np.testing.assert_allclose(got, TRUTH, rtol=1e-10)
    assert found.dof == 20
    assert found.consistent


def test_the_stated_covariance_is_that_of_the_errors():
    rng = np.random.default_rng(7)
    n = 400
    z, chi = [], []
    for _ in range(n):
        found = identify_payload(ORIENTATIONS, readings(rng), STD)
        got = np.array([found.payload.mass_kg, *found.payload.centre_m, *found.bias])
        error = got - TRUTH
        z.append(error @ np.linalg.solve(found.covariance, error))
        chi.append(found.chi_square)
    # chi square of 10 and of 20 degrees of freedom; five standard errors of the mean
    assert np.mean(z) == pytest.approx(10, abs=5 * np.sqrt(20 / n))
    assert np.mean(chi) == pytest.approx(20, abs=5 * np.sqrt(40 / n))


@pytest.mark.parametrize(
    "turns",
    [
        [(0, 0, 0), (0, 0, 1), (0, 0, 2)],  # about the vertical: gravity stays where it is
        [(0, 0, 0), (0.02, 0, 0), (0, 0.02, 0), (-0.02, 0, 0)],  # by one degree
        [(0, 0, 0), (0.5, 0, 0), (1e-6, 0, 0)],  # two alike
    ],
)
def test_orientations_that_tell_nothing_are_refused(turns):
    rotations = tilts(*turns)
    wrenches = wrenches_of(Payload(0.06, (0.0, 0.0, 0.03)), rotations)
    with pytest.raises(ValueError, match="condition number"):
        identify_payload(rotations, wrenches, STD)


def test_a_wrong_sign_is_found():
    with pytest.raises(ValueError, match="mass_kg: got .-0.06"):
        identify_payload(ORIENTATIONS, -readings(), STD)


def test_a_cable_that_pulls_is_no_noise():
    wrenches = readings()
    wrenches[2, 0] += 0.02
    assert not identify_payload(ORIENTATIONS, wrenches, STD).consistent


@pytest.mark.parametrize("rotations", [ORIENTATIONS[:2], ORIENTATIONS[:4]])
def test_shapes_are_checked(rotations):
    with pytest.raises(ValueError, match=r"orientations|shapes"):
        identify_payload(rotations, readings()[: 2 if len(rotations) == 2 else 3], STD)


@pytest.mark.parametrize("factor", [2.0, -1.0, np.nan])
def test_what_is_no_rotation_is_refused(factor):
    rotations = Rotation.from_euler("xy", [[0, 0], [60, 0], [-60, 0], [0, 60], [0, -60]], True)
    with pytest.raises(ValueError, match="rotations: got .* accepted is rotation matrices"):
        identify_payload(factor * rotations.as_matrix(), np.zeros((5, 6)), np.ones(6))
