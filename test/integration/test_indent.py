# SPDX-License-Identifier: Apache-2.0
"""Tests of tissue through contact_node and the real drivers, judged by the tissue of the bench."""

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")
pytest.importorskip("rtde_control", reason="ur-rtde is not here")

from rclpy.action import ActionClient
from tactile_resonance.action import Indent
from tactile_resonance.msg import Indentation

from benchmarks.contact_client import goal_message
from tactile_resonance.contact.parameters import read_contact
from tactile_resonance.mechanics.fit import fit_indentation
from tactile_resonance.nodes.client import HANGS_S
from tactile_resonance.recording.messages import indentation_from_message
from tactile_resonance.simulation.tissue.library import read_tissues

sys.path.insert(0, str(Path(__file__).parent))
from contact_rig import height_m

STANDOFF_M = read_contact()[0].standoff_m


def asked(protocol, hold_s, **fields):
    point = goal_message()
    return Indent.Goal(protocol=protocol, pose=point.pose, force_n=0.012, hold_s=hold_s, **fields)


def outcome(client, goal):
    action = ActionClient(client._node, Indent, "indent")
    client.wait(action.server_is_ready, HANGS_S, "indent")
    sent = action.send_goal_async(goal)
    client.wait(sent.done, HANGS_S, "an answer to the goal")
    assert sent.result().accepted
    future = sent.result().get_result_async()
    client.wait(future.done, HANGS_S, "the result")
    action.destroy()
    return future.result().result


def test_a_relaxation_is_carried_out_and_gives_the_modulus_of_the_tissue(bench, client):
    result = outcome(client, asked(Indentation.RELAXATION, 10.0))
    assert (result.done, result.cause) == (True, "none"), result.message
    client.idle()
    assert height_m(bench) > STANDOFF_M - 2e-4
    record = result.record
    assert record.simulated
    assert record.hold_s == 10.0
    assert record.beam_stiffness_n_per_m == pytest.approx(14.8)
    test = indentation_from_message(record)
    rate_hz = 1 / np.median(np.diff(test.time_s))
    assert rate_hz == pytest.approx(1000, rel=0.01)
    assert test.time_s[0] < -0.3
    assert test.time_s[-1] > 10.3
    fit = fit_indentation(test)
    assert 10.0 < fit.hold_s < 10.5
    truth = read_tissues()["gel10"].prony.relaxation_modulus(3.0)
    value, std = fit.modulus(3.0)
    assert abs(np.log(value / truth)) < 4 * std
    assert std < 0.5
    # the beam unbends while the robot keeps its place: the ball goes on
    contact = (fit.time_s > fit.ramp_s) & (fit.time_s < 9)
    # means of five parts, for neighbours may differ by noise: 1 mN bends the beam by 68 um
    parts = [part.mean() for part in np.array_split(fit.indentation_m[contact], 5)]
    assert np.all(np.diff(parts) > 0)


def test_what_lies_beyond_the_limits_is_refused_in_one_line(bench, client):
    for goal, words in (
        (asked(Indentation.RELAXATION, 1e4), "hold_s: got 10000.0; accepted is up to 120"),
        (asked(Indentation.INDENTATION, 0.0), "unload_speed_m_s: 0, accepted with INDENTATION"),
        (asked(9, 1.0), "protocol: 9, accepted are"),
    ):
        result = outcome(client, goal)
        assert (result.done, result.cause) == (False, "refused")
        assert words in result.message
        assert not result.record.time_s
