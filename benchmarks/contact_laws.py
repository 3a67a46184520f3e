# SPDX-License-Identifier: Apache-2.0
"""Simple control laws, for comparison: what one would write first.

All see the same bench: the force less a bias from 0.4 s at rest, and the tip's height. Each is called
ready when its measured force, averaged over 50 ms, has been within 5 % for 50 ms; those that stop
at the force and hold the position, 50 ms after they stop.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Protocol

import numpy as np

from benchmarks.contact_case import FORCE_N, Case, Outcome, Rig, Setup
from tactile_resonance.contact.vectors import vector

TOUCH_N = 3e-3
LONGEST_S = 25.0


class Law(Protocol):
    """Speed along the normal from the force; away from the surface positive."""

    holds_position: bool

    def speed(self, force_n: float, dt_s: float) -> float | None:
        """Speed [m/s]; None to stop for good."""
        ...


class Constant:
    """Down at one speed until the force is there, then hold the position."""

    holds_position = True

    def __init__(self, speed_m_s: float) -> None:
        self._speed_m_s = speed_m_s
        self._recent: deque[float] = deque(maxlen=4)

    def speed(self, force_n: float, dt_s: float) -> float | None:
        self._recent.append(force_n)
        return None if np.mean(self._recent) >= FORCE_N else -self._speed_m_s


class TwoSpeeds:
    """5 mm/s until the touch, 0.3 mm/s until the force, then proportional."""

    holds_position = False

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=4)
        self._touched = self._reached = False

    def speed(self, force_n: float, dt_s: float) -> float | None:
        self._recent.append(force_n)
        force = float(np.mean(self._recent))
        self._touched |= force > TOUCH_N
        self._reached |= force >= FORCE_N
        if self._reached:
            return (force - FORCE_N) / (80.0 * 0.08)
        return -0.3e-3 if self._touched else -5e-3


class FixedPI:
    """4 mm/s until the touch, then proportional and integral for the stiffest tissue."""

    holds_position = False

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=4)
        self._touched, self._sum = False, 0.0

    def speed(self, force_n: float, dt_s: float) -> float | None:
        self._recent.append(force_n)
        force = float(np.mean(self._recent))
        self._touched |= force > TOUCH_N
        if not self._touched:
            return -4e-3
        error = FORCE_N - force
        gain = 1 / (80.0 * 0.03)
        wish = -gain * (error + self._sum)
        if abs(wish) < 4e-3:  # no wind-up
            self._sum += error * dt_s / 0.4
        return min(4e-3, max(-4e-3, wish))


class StiffnessFilter:
    """4 mm/s, a linear Kalman filter on force and stiffness, ``v = (F_set - F) / (k 0.08 s)``.

    The law of the first simulations of this project, with integral.
    """

    holds_position = False

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=4)
        self._x, self._p = np.array([0.0, 30.0]), np.diag([1e-6, 900.0])
        self._touched, self._last, self._sum = False, 0.0, 0.0

    def speed(self, force_n: float, dt_s: float) -> float | None:
        self._recent.append(force_n)
        if not self._touched:
            self._touched = bool(np.mean(self._recent) > TOUCH_N)
            self._last = -4e-3
            return self._last
        f = np.array([[1, -self._last * dt_s], [0, 1]])
        self._x = f @ self._x
        self._p = f @ self._p @ f.T + np.diag([(2e-4) ** 2 * dt_s / 0.01, 30.0**2 * dt_s])
        gain = self._p[:, 0] / (self._p[0, 0] + 1e-6)
        self._x = self._x + gain * (force_n - self._x[0])
        self._p = self._p - np.outer(gain, self._p[0])
        stiffness = max(5.0, float(self._x[1]))
        error = FORCE_N - float(self._x[0])
        wish = -(error + self._sum) / (stiffness * 0.08)
        if abs(wish) < 4e-3:
            self._sum += error * dt_s / 0.3
        self._last = min(4e-3, max(-4e-3, wish))
        return self._last


LAWS = {
    "constant 0.25 mm/s, then hold position": lambda: Constant(0.25e-3),
    "constant 2 mm/s, then hold position": lambda: Constant(2e-3),
    "two speeds 5 / 0.3 mm/s, proportional": TwoSpeeds,
    "fixed PI": FixedPI,
    "filter on force and stiffness, PI": StiffnessFilter,
}


class Admittance:
    """4 mm/s until the touch, then as a mass of 0.1 kg in a damping of 5 N s/m that the force error drives."""

    holds_position = False

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=4)
        self._touched, self._speed = False, -4e-3

    def speed(self, force_n: float, dt_s: float) -> float | None:
        self._recent.append(force_n)
        force = float(np.mean(self._recent))
        self._touched |= force > TOUCH_N
        if self._touched:
            self._speed += (force - FORCE_N - 5.0 * self._speed) * dt_s / 0.1
        return self._speed


LIVING_LAWS = {"admittance": Admittance, "PI": FixedPI}
"""The laws that are put beside ours on tissue that moves."""


def steps_of(rig: Rig, law: Law, force_n: float = FORCE_N) -> Iterator[bool]:
    """Run a simple law on a bench, period by period; tell whether the force has been there for 50 ms."""
    bench, dt = rig.bench, rig.bench.motion.period_s
    period_ns = round(1e9 * dt)
    forces: deque[float] = deque(maxlen=25)
    bias: list[float] = []
    within, stopped = 0, False
    for n in range(round(LONGEST_S / dt)):
        bench.wait_until((n + 1) * period_ns)
        tip = bench.arm.state().tip
        felt = bench.cell.mounting.to_tip(bench.cell.read(), vector(tip.position_m), tip.turn)
        samples = [float(sample.force_n[2]) for sample in felt]
        if n * dt < 0.4:
            bias += samples
            continue
        speed: float | None = 0.0
        for sample in samples:
            force = sample - float(np.mean(bias))
            forces.append(force)
            speed = law.speed(force, dt)
        if samples:
            stopped = stopped or speed is None
            twist = np.zeros(6)
            twist[2] = 0.0 if stopped or speed is None else speed
            bench.arm.speed(twist, 0.5)
        bench.arm.state()
        if law.holds_position:
            within = within + 1 if stopped else 0
        else:
            good = abs(np.mean(forces) / force_n - 1) < 0.05
            within = within + 1 if good else 0
        yield within * dt >= 0.05


def run_law(case: Case, setup: Setup, law: Law, record: list[float] | None = None) -> Outcome:
    """Run a simple law on a case; the true force of each period is appended to `record`."""
    rig = Rig(case, setup)
    dt = rig.bench.motion.period_s
    ready: int | None = None
    for now_ready in steps_of(rig, law):
        if ready is None and now_ready:
            ready = len(rig.force_n)
        if ready is not None and len(rig.force_n) >= ready + round(1 / dt):
            break
    if record is not None:
        record += rig.force_n
    return rig.outcome(ready, "none" if ready is not None else "time")
