# SPDX-License-Identifier: Apache-2.0
"""Which poles are a reference of air and which tell a touch, by when their measurement was taken."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from tactile_resonance import msg
from tactile_resonance.contact.goal import State
from tactile_resonance.nodes.messages import time_message
from tactile_resonance.nodes.touch_from_poles import TouchFromPoles

SECOND_NS = 10**9
BEGAN_NS = 1000 * SECOND_NS
AIR, GELATINE = (246.60, 0.0119), (249.0, 0.020)
STD = np.array([0.01, 5e-5])


def poles(pole, middle_ns, *, final=True, covariance=True):
    damped = 2 * np.pi * pole[0]
    message = msg.Poles(
        final=final,
        f0_hz=[pole[0]],
        damping_ratio=[pole[1]],
        real_rad_s=[-pole[1] * damped],
        imag_rad_s=[damped],
        residue_real=[0.0],
        residue_imag=[1.0],
        order=2,
        numerator_order=2,
    )
    if covariance:
        message.covariance = np.diag(STD**2).ravel().tolist()
    message.header.stamp = time_message(int(middle_ns))
    return message


class Listener:
    """A `TouchFromPoles` with a clock that is told."""

    def __init__(self, references=3):
        self.told, self.now_ns = 0, BEGAN_NS + 2 * SECOND_NS
        self.rng = np.random.default_rng(2)
        self.touch = TouchFromPoles(1e-6, BEGAN_NS)
        for _ in range(references):
            self.hear(AIR, State.IDLE)

    def hear(self, pole, state, length_s=0.8, passed=False, **fields):
        """Let a measurement of so long go by, unless it has passed, and hear of it at its end."""
        self.now_ns += 0 if passed else round(length_s * SECOND_NS)
        self.touch.moved(state, self.now_ns)
        pole = np.array(pole) + STD * self.rng.standard_normal(2)
        middle_ns = self.now_ns - length_s * SECOND_NS / 2
        touched = self.touch.hear(poles(pole, middle_ns, **fields), state, self.now_ns)
        self.told += touched
        return touched

    def stay(self, state, seconds):
        for _ in range(round(seconds / 0.1)):
            self.now_ns += SECOND_NS // 10
            self.touch.moved(state, self.now_ns)


def test_poles_that_change_in_an_approach_tell_the_touch():
    listener = Listener()
    listener.stay(State.APPROACH, 0.5)
    for _ in range(5):
        assert not listener.hear(AIR, State.APPROACH)
    assert listener.hear(GELATINE, State.APPROACH)
    assert listener.told == 1


def test_without_three_measurements_in_air_nothing_is_told():
    listener = Listener(references=2)
    # what it holds is part of what the next poles of the same measurement say again
    listener.hear(AIR, State.IDLE, final=False)
    assert not listener.hear(GELATINE, State.APPROACH)
    assert listener.told == 0


def test_measurement_that_began_in_contact_is_no_reference_and_no_touch():
    listener = Listener()
    listener.stay(State.HOLD, 1.0)
    listener.stay(State.RETRACT, 0.3)
    listener.stay(State.IDLE, 0.3)
    # half of it in the tissue: no reference, however far off
    listener.hear(GELATINE, State.IDLE, length_s=1.2, passed=True)
    # seen live: taken wholly after the contact, and yet of the contact
    listener.stay(State.IDLE, 0.2)
    listener.hear(GELATINE, State.IDLE, length_s=0.4, passed=True)
    listener.stay(State.HOLD, 1.0)
    listener.stay(State.TRAVEL, 0.2)
    listener.stay(State.APPROACH, 0.2)
    # it began in the last contact
    assert not listener.hear(GELATINE, State.APPROACH, passed=True)
    listener.stay(State.APPROACH, 0.5)
    assert not listener.hear(AIR, State.APPROACH)
    assert listener.hear(GELATINE, State.APPROACH)


def test_measurement_that_began_before_all_that_is_known_is_no_reference():
    listener = Listener(references=0)
    # whether the tip was in air then nobody can tell
    listener.hear(AIR, State.IDLE, length_s=1.5, passed=True)
    for _ in range(2):
        listener.hear(AIR, State.IDLE)
    listener.stay(State.APPROACH, 1.5)
    assert not listener.hear(GELATINE, State.APPROACH)
    assert listener.told == 0


def test_poles_without_covariance_are_said_to_be_of_no_use():
    with pytest.raises(ValueError, match="covariance: unknown"):
        Listener(references=3).hear(AIR, State.APPROACH, covariance=False)
