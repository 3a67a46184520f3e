# SPDX-License-Identifier: Apache-2.0
"""Contacts of limited duration: held for a time, drawn back at constant speed, and recorded."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.contact.goal import Cause, HoldMode, State
from tactile_resonance.contact.loop import IndentationRecorder
from tactile_resonance.mechanics.indentation import BallTip, Protocol

sys.path.insert(0, str(Path(__file__).parent))
from contacts import RADIUS_M, contact


def made(**goal):
    rig = contact(hold=HoldMode.INDENTATION, height_m=0.0, under_sample=True)
    rig.goal = replace(rig.goal, **goal)
    recorder = IndentationRecorder(
        rig.goal, Protocol.INDENTATION, BallTip(RADIUS_M), "cell", simulated=True
    )
    rig.loop._listener = recorder.take
    rig.loop.start(rig.goal)
    return rig, recorder


def test_it_is_drawn_back_after_the_time_that_was_asked_for():
    rig, recorder = made(hold_s=1.5)
    assert rig.run_until(State.HOLD)
    begun_ns = rig.bench.now_ns()
    assert rig.run_until(State.RETRACT, 5.0)
    assert (rig.bench.now_ns() - begun_ns) * 1e-9 == pytest.approx(1.5, abs=0.02)
    assert rig.run_until(State.IDLE, 5.0)
    result = rig.controller.result
    assert (result.reached, result.cause) == (True, Cause.HOLD_ENDED)
    assert result.message == "held for 1.5 s as asked"
    record = recorder.record(result)
    # what the tip truly felt, as the cell tells it, from above the surface to above it
    truth = np.array(rig.force_n)
    assert record.force_n.max() == pytest.approx(truth.max(), abs=4e-3)
    assert record.depth_m[0] < -5e-4
    assert record.depth_m[-1] < -5e-4
    held = (record.time_s > 1.0) & (record.time_s < 1.5)
    assert np.std(record.depth_m[held]) < 1e-5
    assert np.mean(np.diff(record.time_s)) == pytest.approx(2e-3, rel=0.02)


def test_it_is_unloaded_at_an_even_speed():
    speed = 5e-4
    rig, _ = made(hold_s=0.3, unload_speed_m_s=speed)
    assert rig.run_until(State.HOLD)
    rig.run(0.4)
    assert rig.controller.state is State.HOLD
    rig.run(0.3)
    assert np.mean(rig.speed_m_s[-100:]) == pytest.approx(speed, rel=0.05)
    assert rig.run_until(State.IDLE, 10.0)
    assert rig.controller.result.cause is Cause.HOLD_ENDED


def test_the_way_into_the_tissue_is_no_faster_than_asked_for():
    rig, _ = made(hold_s=0.1, press_speed_m_s=1e-3)
    assert rig.run_until(State.APPROACH)
    begun = len(rig.speed_m_s)
    assert rig.run_until(State.HOLD)
    assert -1.1e-3 < min(rig.speed_m_s[begun:]) < -0.9e-3


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ({"hold_s": 1e3}, "hold_s: got 1000.0; accepted is up to 120"),
        ({"hold_s": 119.0, "unload_speed_m_s": 1e-3}, "hold_s: got 119.0; accepted is up to 117"),
        ({"hold_s": 1.0, "unload_speed_m_s": 0.5}, "unload_speed_m_s: got 0.5; accepted is up to"),
        ({"hold_s": 1.0, "press_speed_m_s": 1e-5}, "approach_speed_m_s"),
    ],
)
def test_what_lies_beyond_the_limits_is_refused(goal, message):
    with pytest.raises(ValueError, match=message):
        made(**goal)
