# SPDX-License-Identifier: Apache-2.0
"""The link to the arm: command to motion, rate and gaps of states, processor time of each process.

Runs the simulated robot as a process and `UrArm` on it, over the unmodified ur_rtde.
"""

from __future__ import annotations

import contextlib
import os
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.processor import cpu_s
from benchmarks.simulated_robot import simulated_robot
from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.interfaces import ArmError
from tactile_resonance.drivers.ur_arm import UrArm
from tactile_resonance.drivers.ur_config import UrArmConfig
from tactile_resonance.simulation.plant.defaults import order
from tactile_resonance.simulation.plant.tabletop import TIP_IN_FLANGE

HOST = "127.0.77.1"
SPEED_M_S, ACCELERATION_M_S2 = 0.02, 2.0
MOVED_M_S = 0.0005
RUNS = 3
PERIOD_S = 0.004  # of the loop that commands
LOST_S = 2.0  # a command without motion for so long was lost


@dataclass(frozen=True)
class LinkResult:
    """One run.

    Attributes
    ----------
    commands_s, motions_s : (n,) arrays
        Seconds from `speed` to the state that shows motion: until it is seen here, and by the time
        stamps of the robot's states on this machine's clock.
    arrivals_s : (m,) array
        Age at first sight of each state.
    gaps_s : (m - 1,) array
        Between the robot's time stamps of states seen one after the other.
    rate_hz : float
        States received in the last second of the robot's time.
    cpu : dict
        Share of one core by process.
    clock_uncertainty_s : float
    stalls : int
        Of the simulation, longer than 10 ms.
    """

    commands_s: FloatArray
    motions_s: FloatArray
    arrivals_s: FloatArray
    gaps_s: FloatArray
    rate_hz: float
    cpu: dict[str, float]
    clock_uncertainty_s: float
    stalls: int


def run(output: Path, quick: bool) -> str:
    """Measure, draw ``robot.png`` into `output`, and return the page.

    Raises
    ------
    ValueError
        Where ur_rtde is not installed or the simulated robot does not start.
    """
    if find_spec("rtde_control") is None:
        raise ValueError("benchmark robot: ur_rtde is not installed (no wheel for Python 3.13)")
    seconds, repetitions = (3.0, 8) if quick else (20.0, 60)
    results: dict[str, LinkResult] = {}
    failures: dict[str, str] = {}
    for name, priority in (("normal priority", 0), ("SCHED_FIFO", 2)):
        if priority and not _may_take(priority):
            failures[name] = "not allowed on this machine"
            continue
        for _ in range(RUNS):  # a stall of the simulation makes a run invalid
            try:
                result = measure(seconds, repetitions, priority)
            except ArmError as error:
                failures[name] = f"in {RUNS} runs, the last ended with: {error}"
                continue
            if result.stalls == 0:
                results[name] = result
                break
            failures[name] = (
                f"in the last of {RUNS} runs the simulation stalled {result.stalls} times"
            )
    if not results:
        raise ValueError(f"benchmark robot: no run came to its end; {failures}")
    text = _report(results, failures, seconds)
    _draw(results, output / "robot.png")
    return text


def measure(seconds: float, repetitions: int, priority: int) -> LinkResult:
    """Start robot and arm, command speeds back and forth, then watch the states."""
    with simulated_robot(HOST, priority) as robot:
        arm = UrArm(
            UrArmConfig(
                HOST,
                TIP_IN_FLANGE,
                max_state_age_s=0.5,
                max_acceleration_m_s2=ACCELERATION_M_S2,
                realtime_priority=max(0, priority - 1),
            )
        )
        try:
            arm.connect()
            _rest(arm, 1.5)  # the clocks are related meanwhile
            stalls = order(HOST, "state")["stalls"]
            pairs = [_respond(arm, (-1) ** k) for k in range(repetitions)]
            assert arm.client is not None
            pids = {"simulated robot": robot.pid, "client": arm.client.pid, "owner": os.getpid()}
            before = {name: cpu_s(pid) for name, pid in pids.items()}
            start_s = time.monotonic()
            arrivals, stamps = _watch(arm, seconds)
            took_s = time.monotonic() - start_s
            cpu = {name: (cpu_s(pid) - before[name]) / took_s for name, pid in pids.items()}
            return LinkResult(
                commands_s=np.array([seen for seen, _ in pairs]),
                motions_s=np.array([stamped for _, stamped in pairs]),
                arrivals_s=arrivals,
                gaps_s=np.diff(stamps),
                rate_hz=(len(stamps) - 1) / (stamps[-1] - stamps[0]),
                cpu=cpu,
                clock_uncertainty_s=arm.clock_uncertainty_s,
                stalls=order(HOST, "state")["stalls"] - stalls,
            )
        finally:
            arm.close()


def _respond(arm: UrArm, sign: int) -> tuple[float, float]:
    """Seconds from a command to motion: seen, and by the state's own time."""
    commanded_ns = arm.clock.now_ns()
    arm.speed(np.array([0, 0, sign * SPEED_M_S, 0, 0, 0]), ACCELERATION_M_S2)
    end_s = time.monotonic() + LOST_S
    while abs((sample := arm.state()).velocity[2]) <= MOVED_M_S:
        if time.monotonic() > end_s:
            raise ValueError(f"benchmark robot: no motion within {LOST_S:g} s of a command")
        time.sleep(0.0001)
    seen_ns = arm.clock.now_ns()
    _rest(arm, 0.05)
    arm.stop(ACCELERATION_M_S2)
    _rest(arm, 0.15 + 0.02 * np.random.default_rng(seen_ns).random())
    return (seen_ns - commanded_ns) * 1e-9, (sample.time_ns - commanded_ns) * 1e-9


def _rest(arm: UrArm, seconds: float) -> None:
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        with contextlib.suppress(ArmError):
            arm.state()
        time.sleep(PERIOD_S)


def _watch(arm: UrArm, seconds: float) -> tuple[FloatArray, FloatArray]:
    """Age at first sight and robot time of every state seen while a speed is commanded."""
    ages: list[float] = []
    stamps: list[float] = []
    end_s = time.monotonic() + seconds
    next_s = 0.0
    while (now_s := time.monotonic()) < end_s:
        if now_s >= next_s:
            # back and forth: the tip stays within some millimetres
            direction = 1 if int(now_s) % 2 else -1
            arm.speed(np.array([0, 0, direction * 0.002, 0, 0, 0]), ACCELERATION_M_S2)
            next_s = now_s + PERIOD_S
        sample = arm.state()
        if not stamps or sample.robot_time_s > stamps[-1]:
            ages.append((arm.clock.now_ns() - sample.time_ns) * 1e-9)
            stamps.append(sample.robot_time_s)
        time.sleep(0.0003)
    arm.stop(ACCELERATION_M_S2)
    return np.array(ages), np.array(stamps)


def _may_take(priority: int) -> bool:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    except (AttributeError, OSError):
        return False
    return True


def _report(results: dict[str, LinkResult], failures: dict[str, str], seconds: float) -> str:
    rows = [
        "# The link to the arm",
        "",
        "`tactile_resonance benchmark robot`. The robot is simulated (`simulate-ur`, with tissue and load",
        "cell), the client the unmodified ur_rtde 1.6.5, all on one machine over loopback: these are figures",
        "of the software, not of a robot, whose network and controller add their own. The simulated arm",
        "follows with 4 ms dead time and a lag of 10 ms, which are part of the time to motion; motion is",
        f"{MOVED_M_S * 1e3:g} mm/s of {SPEED_M_S * 1e3:g} mm/s asked for, {ACCELERATION_M_S2:g} m/s2. "
        f"States are watched for {seconds:g} s while a",
        f"velocity is commanded every {PERIOD_S * 1e3:g} ms. Two cores; shares are of one core.",
        "",
        "| | " + " | ".join(results) + " |",
        "|---|" + "---|" * len(results),
    ]

    def row(name: str, cells: list[str]) -> None:
        rows.append(f"| {name} | " + " | ".join(cells) + " |")

    def spread(values: FloatArray) -> str:
        low, middle, high = np.quantile(values, [0.5, 0.99, 1.0]) * 1e3
        return f"{low:.1f} / {middle:.1f} / {high:.1f}"

    each = list(results.values())
    row(
        "command to motion, seen by its owner: median / 99 % / max [ms]",
        [spread(r.commands_s) for r in each],
    )
    row("the same by the robot's time stamp [ms]", [spread(r.motions_s) for r in each])
    row(
        "age of a state at first sight: median / 99 % / max [ms]",
        [spread(r.arrivals_s) for r in each],
    )
    row("states a second, received", [f"{r.rate_hz:.0f}" for r in each])
    row("states a second, seen by the owner", [f"{1 / r.gaps_s.mean():.0f}" for r in each])
    row("longest gap between states seen [ms]", [f"{r.gaps_s.max() * 1e3:.0f}" for r in each])
    row(
        "clock of the robot known to, 1 sigma [ms]",
        [f"{r.clock_uncertainty_s * 1e3:.2f}" for r in each],
    )
    for name in each[0].cpu:
        row(f"processor, {name} [%]", [f"{100 * r.cpu[name]:.0f}" for r in each])
    rows += [
        "",
        "A run in which the simulation stalled for more than 10 ms is not valid, and repeated. States are seen",
        "by an owner that sleeps 0.3 ms between two looks.",
    ]
    rows += [
        f"No run with {name}: {text}." for name, text in failures.items() if name not in results
    ]
    return "\n".join(rows) + "\n"


def _draw(results: dict[str, LinkResult], path: Path) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    for name, result in results.items():
        for axes, values in ((left, result.commands_s), (right, result.arrivals_s)):
            ordered = np.sort(values) * 1e3
            axes.step(ordered, 1 - np.arange(len(ordered)) / len(ordered), where="post", label=name)
    left.set_xlabel("command to motion, seen by its owner [ms]")
    right.set_xlabel("age of a state at first sight [ms]")
    for axes in (left, right):
        axes.set_yscale("log")
        axes.set_ylabel("share of values above")
        axes.legend()
    figure.suptitle("Link to the arm (simulated robot on loopback)")
    figure.savefig(path, dpi=130)
    plt.close(figure)
