# SPDX-License-Identifier: Apache-2.0
"""Contacts on the wall clock: the same controller through ur_rtde and python-can, robot and cell simulated.

Few cases, rigid tip, cell under the sample; judged by the plant's own history. A run in which the simulation
stood still for more than 10 ms says nothing and is repeated once.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from benchmarks.contact_case import DEEPEST_M, FORCE_N, KNOWN, Outcome
from benchmarks.simulated_robot import simulated_robot
from tactile_resonance.clock import WallClock
from tactile_resonance.configuration import share_path
from tactile_resonance.contact.free_motion import STILL_M_S
from tactile_resonance.contact.geometry import touch_pose
from tactile_resonance.contact.goal import ContactGoal, State
from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.contact.loop import ContactLoop
from tactile_resonance.contact.machine import ContactController
from tactile_resonance.contact.parameters import read_contact
from tactile_resonance.drivers.force_config import CanForce, force_source, read_force_config
from tactile_resonance.drivers.ur_arm import UrArm
from tactile_resonance.drivers.ur_config import read_ur_config
from tactile_resonance.processes import may_take_priority, take_priority
from tactile_resonance.simulation.plant.defaults import TABLE_IN_BASE, order

HOST = "127.0.13.77"
PRIORITY = 20
RADIUS_M = 2.5e-3
CLEAR_M = 0.02
LIFT_M_S, LIFT_M_S2, LIFT_WITHIN_S = 0.05, 0.5, 10.0
STEP_M = 0.006  # between cases: fresh tissue
PLACES = ((1e-3, 0.0), (-1e-3, 10.0))
"""Height of the surface above where it is expected [m], and its tilt [degrees]."""
TISSUES = ("cortex", "liver", "gel10", "gel16")


@dataclass(frozen=True)
class DriversResult:
    """What became of the cases; `stalls` of the simulation in all runs, `repeated` of these."""

    outcomes: list[Outcome]
    stalls: int
    repeated: int
    overruns: int
    cycles: int


def available() -> str:
    """Why it cannot be run here; empty where it can."""
    if find_spec("rtde_control") is None:
        return "ur_rtde is not installed"
    if not may_take_priority(PRIORITY):
        return "real-time priority is not permitted"
    return ""


def run() -> DriversResult:
    """Run all cases, each a second time where the simulation stalled in it."""
    outcomes: list[Outcome] = []
    stalls = repeated = overruns = cycles = 0
    with simulated_robot(HOST, PRIORITY, "--rigid-tip"), _real_time():
        for number, (tissue, place) in enumerate((t, p) for t in TISSUES for p in PLACES):
            for attempt in range(2):
                before = order(HOST, "state")["stalls"]
                # connected anew: a fault of one case is none of the next
                with _connected() as loop:
                    outcome = _contact(loop, 2 * number + attempt, tissue, *place)
                    overruns, cycles = overruns + loop.overruns, cycles + loop.cycles
                stalled = order(HOST, "state")["stalls"] - before
                stalls += stalled
                if not stalled:
                    break
                repeated += attempt == 0
            outcomes.append(outcome)
    return DriversResult(outcomes, stalls, repeated, overruns, cycles)


@contextmanager
def _connected() -> Iterator[ContactLoop]:
    """Arm, load cell and a new controller."""
    arm = UrArm(
        replace(
            read_ur_config(share_path("config/devices/ur5e.yaml")),
            host=HOST,
            realtime_priority=PRIORITY,
        )
    )
    config = read_force_config(Path("can_simulated.yaml"))
    assert isinstance(config, CanForce)
    bus = {**config.bus, "host": HOST}
    config = replace(config, bus=bus)
    force = force_source(config, arm)
    try:
        arm.connect()
        _lift(arm)
        force.start()
        parameters, limits = read_contact()
        # tilts here are not known to the controller; the ball is held rigidly
        parameters = replace(
            parameters, beam_stiffness_n_per_m=0.0, travel_speed_m_s=0.1, **KNOWN
        )
        controller = ContactController(parameters, replace(limits, depth_m=DEEPEST_M))
        yield ContactLoop(arm, force, WallClock(), controller)
    finally:
        force.close()
        arm.close()


def _lift(arm: UrArm) -> None:
    """Off the tissue, where a case that failed may have left the tip."""
    end_s = time.monotonic() + LIFT_WITHIN_S
    while time.monotonic() < end_s:
        try:
            sample = arm.state()
            if sample.position_m[2] < TABLE_IN_BASE[2] + CLEAR_M:
                arm.speed((0.0, 0.0, LIFT_M_S, 0.0, 0.0, 0.0), LIFT_M_S2)
            elif math.hypot(*sample.velocity[:3]) > STILL_M_S:
                arm.stop(LIFT_M_S2)
            else:
                return
        except ArmError as error:
            if error.fault is not ArmFault.STALE:  # a stall of the machine, not judged here
                raise
        time.sleep(0.004)
    raise RuntimeError(f"the tip is not lifted within {LIFT_WITHIN_S:g} s")


def _contact(
    loop: ContactLoop, number: int, tissue: str, height_m: float, tilt_deg: float
) -> Outcome:
    controller = loop.controller
    x, y = TABLE_IN_BASE[0] + STEP_M * (number % 8), TABLE_IN_BASE[1] + STEP_M * (number // 8)
    # the plane goes through the base's origin at that height
    rise = np.tan(np.deg2rad(tilt_deg)) * x
    order(HOST, "place_tissue", name=tissue)
    order(
        HOST,
        "place_surface",
        height_m=TABLE_IN_BASE[2] + height_m + rise,
        tilt_rad=float(np.deg2rad(tilt_deg)),
    )
    touch = touch_pose([x, y, TABLE_IN_BASE[2]], [0, 0, 1], [0, -1, 0], RADIUS_M)
    start_s = order(HOST, "truth")["time_s"]
    loop.start(ContactGoal(touch, FORCE_N))
    loop.run_while(lambda: controller.result is None)
    held = controller.state is State.HOLD
    ready_s = order(HOST, "truth")["time_s"]
    loop.run_while(lambda: controller.state is State.HOLD, 1.05)
    result = controller.result
    assert result is not None
    if controller.state is not State.FAULT:
        loop.retract()
    time_s, force = _history(start_s)
    touched = time_s[np.argmax(force > 0)]
    if not held:
        return Outcome(np.inf, float(force.max()) / FORCE_N - 1, np.nan, 0, result.cause.value)
    second = force[(time_s > ready_s) & (time_s <= ready_s + 1.0)]
    until = force[time_s <= ready_s + 1.0]
    pushing = until > 0
    stated = np.nan, np.nan
    if result.force_n is not None and result.force_std_n is not None:
        stated = (
            result.force_std_n / FORCE_N,
            (result.force_n - second.mean()) / result.force_std_n,
        )
    return Outcome(
        float(ready_s - touched),
        float(until.max()) / FORCE_N - 1,
        float(abs(second.mean() / FORCE_N - 1)),
        int(np.sum(pushing[1:] & ~pushing[:-1])) - 1,
        result.cause.value if result.cause.value != "cancelled" else "none",
        *stated,
    )


def _history(since_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Time and true force along the normal of all steps after a time."""
    times: list[float] = []
    forces: list[float] = []
    while True:
        part = order(HOST, "history", after_s=times[-1] if times else since_s)
        if not part["time_s"]:
            return np.array(times), np.array(forces)
        times += part["time_s"]
        forces += part["normal_force_n"]


@contextmanager
def _real_time() -> Iterator[None]:
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    take_priority(PRIORITY)
    try:
        yield
    finally:
        os.sched_setscheduler(0, *before)
