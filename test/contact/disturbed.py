# SPDX-License-Identifier: Apache-2.0
"""A contact whose arm and force source can be made to lie, and what must hold whatever they say."""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tactile_resonance.contact.goal import TOUCHING, Cause, State
from tactile_resonance.contact.loop import ContactLoop

sys.path.insert(0, str(Path(__file__).parent))
from contacts import contact

REST_S, AT_REST_M_S = 0.15, 3e-4


class Lying:
    """A device seen through what changes its samples; all else is passed on."""

    def __init__(self, device):
        self._device = device
        self.late_ns = 0
        self.change = lambda sample: sample
        self.deaf = False

    def __getattr__(self, name):
        return getattr(self._device, name)

    def _seen(self, sample):
        return self.change(sample._replace(time_ns=sample.time_ns - self.late_ns))


class LyingArm(Lying):
    def state(self):
        return self._seen(self._device.state())

    def speed(self, twist, acceleration_m_s2):
        if not self.deaf:
            self._device.speed(twist, acceleration_m_s2)

    def stop(self, deceleration_m_s2):
        if not self.deaf:
            self._device.stop(deceleration_m_s2)


class LyingForce(Lying):
    """Its wrenches at the tip are changed: it is its own mounting."""

    @property
    def mounting(self):
        return self

    @property
    def mount(self):
        return self._device.mounting.mount

    def to_tip(self, samples, tip_m, tip_turn):
        return [self._seen(s) for s in self._device.mounting.to_tip(samples, tip_m, tip_turn)]


@dataclass
class Disturbed:
    """A contact, its lying devices, and what truly happened in each period."""

    contact: object
    arm: LyingArm
    force: LyingForce
    states: list
    twists: list
    heights_m: list

    def __getattr__(self, name):
        return getattr(self.contact, name)


def disturbed(tissue, **options):
    made = contact(tissue, **options)
    bench = made.bench
    arm, force = LyingArm(bench.arm), LyingForce(bench.cell)
    made.loop = ContactLoop(arm, force, bench, made.controller)
    rig = Disturbed(made, arm, force, [], [], [])
    touch = made.goal.touch

    def record():
        motion = bench.motion
        rig.states.append(made.controller.state)
        rig.twists.append(motion.twist.copy())
        rig.heights_m.append(float(motion.reported.position_m[2] - touch.position_m[2]))

    bench.on_step.append(record)
    return rig


def broken_promises(rig):
    """What docs/safety.md promises and did not hold, in sentences; of a goal whose normal is +z."""
    limits, parameters = rig.controller.limits, rig.controller.parameters
    height, twist = np.array(rig.heights_m), np.array(rig.twists)
    force = np.array(rig.contact.force_n[-len(height) :])
    inwards = -twist[:, 2]
    along = np.linalg.norm(twist[:, :2], axis=1)
    near = height < limits.near_m
    touching = np.array([state in TOUCHING for state in rig.states])
    bounds = (
        ("force", force.max(), limits.hard_force_n),
        ("speed", np.linalg.norm(twist[:, :3], axis=1).max(), 1.02 * limits.free_speed_m_s),
        ("near", np.max(inwards[near], initial=0), 1.1 * limits.near_speed_m_s),
        ("along", np.max(along[touching], initial=0), 1.1 * limits.lateral_speed_m_s),
        ("deep", -height.min(), parameters.search_m + limits.depth_m + 5e-4),
    )
    told = [
        f"{name}: {value:.4g}, at most {most:.4g}" for name, value, most in bounds if value > most
    ]
    for n in range(1, len(height)):
        if rig.states[n] is State.FAULT and rig.states[n - 1] is not State.FAULT:
            later = slice(n + round(REST_S / 0.002), n + round(REST_S / 0.002) + 50)
            stays = all(s in (State.FAULT, State.RETRACT) for s in rig.states[later])
            if stays and np.max(inwards[later], initial=0) > AT_REST_M_S:
                told.append(f"goes down after the fault in period {n}")
    result = rig.controller.result
    if result is None or result.cause is Cause.NONE or not result.message:
        told.append(f"no reason: {result}")
    if rig.controller.state is not State.IDLE:
        told.append(f"in the end {rig.controller.state.value}")
    elif np.abs(twist[-1]).max() > AT_REST_M_S:
        told.append(f"moves in the end with {twist[-1]}")
    return told
