# SPDX-License-Identifier: Apache-2.0
"""Arm and load cell on the plant, in virtual time: the contracts of the real drivers, every fault.

Time goes on only while somebody waits for it, so a run repeats to the last bit and takes as long as
it takes to compute.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_resonance.contact.interfaces import (
    ArmError,
    ArmFault,
    ForceError,
    ForceFault,
    ForceInfo,
    Mount,
)
from tactile_resonance.contact.samples import ArmSample, Pose, WrenchSample
from tactile_resonance.simulation.fields import require
from tactile_resonance.simulation.plant import GRAVITY_M_S2, Plant
from tactile_resonance.simulation.tracking import TipMotion, TrackingParameters

FloatArray = NDArray[np.float64]

PROTECTIVE_DECELERATION_M_S2 = 2.0
"""With which the robot brakes by itself (chosen)."""


class VirtualBench:
    """Robot, plant and time. It is the clock of the control loop.

    Parameters
    ----------
    plant : Plant
    start : Pose
        Of the tip at time 0.
    tracking : TrackingParameters
    period_s : float
        Of the robot [s].
    seed : int

    Attributes
    ----------
    time_ns : int
    motion : TipMotion
    on_step : list of callables
        Called after every period: recorders, and faults at their time.
    """

    def __init__(
        self,
        plant: Plant,
        start: Pose,
        *,
        tracking: TrackingParameters | None = None,
        period_s: float = 0.002,
        seed: int = 0,
    ) -> None:
        self.plant = plant
        self.time_ns = 0
        self.motion = TipMotion(
            tracking or TrackingParameters(), start, period_s=period_s, seed=seed
        )
        self.on_step: list[Callable[[], None]] = []
        self._period_ns = round(1e9 * period_s)
        plant.step(start, period_s)

    def now_ns(self) -> int:
        """Virtual time since the start [ns]."""
        return self.time_ns

    def wait_until(self, time_ns: int) -> None:
        """Let whole periods pass until a time is reached."""
        while self.time_ns < time_ns:
            self.motion.step()
            self.plant.step(self.motion.pose, self.motion.period_s)
            self.time_ns += self._period_ns
            for action in self.on_step:
                action()


class VirtualArm:
    """An `Arm` on the bench, with the faults of a real one.

    While the link is frozen nothing is heard and no command arrives; the robot goes on as it was
    last told until its own watchdog stops it.

    Parameters
    ----------
    bench : VirtualBench
    watchdog_s : float
        Without a command for so long the robot stops [s]: 25 Hz.
    stale_s : float
        `state` refuses states older than this [s].
    """

    def __init__(
        self, bench: VirtualBench, *, watchdog_s: float = 0.04, stale_s: float = 0.02
    ) -> None:
        self._bench, self._motion = bench, bench.motion
        self._watchdog_ns, self._stale_ns = round(1e9 * watchdog_s), round(1e9 * stale_s)
        self._connected = False
        self._broken: ArmFault | None = None  # what connect and all commands meet
        self._stopped: ArmFault | None = None  # why the robot does not move
        self._frozen_until_ns = -1
        self._heard_ns = 0  # last command, or sign of life of the client
        self._sample = self._fresh()
        bench.on_step.append(self._step)

    # the contract

    def connect(self) -> None:
        """Connect; ends a stop by the watchdog, but no protective or emergency stop."""
        self._raise_if(self._broken)
        if self._stopped in (ArmFault.PROTECTIVE_STOP, ArmFault.EMERGENCY_STOP):
            self._raise_if(self._stopped)
        self._stopped = None
        self._connected = True
        self._heard_ns = self._bench.time_ns
        self._sample = self._fresh()

    def state(self) -> ArmSample:
        """Newest state that was heard."""
        self._raise_if(self._broken if self._connected else ArmFault.LINK_LOST)
        if self._bench.time_ns >= self._frozen_until_ns:
            self._sample = self._fresh()
        if self._bench.time_ns - self._sample.time_ns > self._stale_ns:
            self._raise_if(ArmFault.STALE)
        return self._sample

    def speed(self, twist: FloatArray, acceleration_m_s2: float) -> None:
        """Move with a twist until the next command."""
        if self._may_move():
            self._motion.speed(twist, acceleration_m_s2)

    def move(self, pose: Pose, speed_m_s: float, acceleration_m_s2: float) -> None:
        """Begin a straight move."""
        if self._may_move():
            self._motion.move(pose, speed_m_s, acceleration_m_s2)

    def moving(self) -> bool:
        """Whether the last move is still under way."""
        return self._motion.moving()

    def stop(self, deceleration_m_s2: float) -> None:
        """Stop."""
        self._raise_if(self._broken if self._connected else ArmFault.LINK_LOST)
        if self._heard():
            self._motion.speed(np.zeros(6), deceleration_m_s2)

    def close(self) -> None:
        """Stop and disconnect."""
        if self._connected and self._broken is None and self._heard():
            self._motion.speed(np.zeros(6), 1.0)
        self._connected = False

    # faults

    def freeze(self, duration_s: float) -> None:
        """Nothing is heard and no command arrives for a time."""
        self._frozen_until_ns = self._bench.time_ns + round(1e9 * duration_s)

    def halt(self, fault: ArmFault) -> None:
        """The robot stops by itself: protective or emergency stop, program stopped."""
        self._stopped = fault
        self._motion.speed(np.zeros(6), PROTECTIVE_DECELERATION_M_S2)

    def break_link(self, fault: ArmFault) -> None:
        """Every call meets this fault until `repair`: link lost, client died, registers in use ..."""
        self._broken = fault

    def repair(self) -> None:
        """All faults end; `connect` makes the arm usable."""
        self._broken = self._stopped = None
        self._frozen_until_ns = -1
        self._connected = False

    def _step(self) -> None:
        """The robot's own watchdog, which a live client on a live link keeps quiet."""
        bench = self._bench
        alive = self._connected and self._broken is None
        if alive and bench.time_ns >= self._frozen_until_ns:
            return
        if bench.time_ns - self._heard_ns > self._watchdog_ns and self._stopped is None:
            self.halt(ArmFault.PROGRAM_STOPPED)

    def _heard(self) -> bool:
        """Whether a command reaches the robot; the client cannot tell."""
        if self._bench.time_ns < self._frozen_until_ns:
            return False
        self._heard_ns = self._bench.time_ns
        return True

    def _may_move(self) -> bool:
        self._raise_if(self._broken if self._connected else ArmFault.LINK_LOST)
        heard = self._heard()
        if heard:
            self._raise_if(self._stopped)
        return heard

    def _fresh(self) -> ArmSample:
        bench, motion = self._bench, self._motion
        self._heard_ns = bench.time_ns
        return ArmSample(
            time_ns=bench.time_ns,
            robot_time_s=bench.time_ns * 1e-9,
            tip=motion.reported,
            tip_velocity=motion.twist,
            moving_allowed=self._stopped is None,
            message="" if self._stopped is None else self._stopped.value,
        )

    @staticmethod
    def _raise_if(fault: ArmFault | None) -> None:
        if fault is not None:
            raise ArmError(fault, f"simulated fault: {fault.value}")


@dataclass(frozen=True)
class CellParameters:
    """What the simulated load cell adds to the true wrench.

    Attributes
    ----------
    noise_rms_n, resolution_n, range_n : float
        White noise of one force, smallest step, largest force [N].
    noise_rms_nm : float
        White noise of one torque [N m].
    bias_n : tuple of three float
        What it shows without load [N].
    delay_s : float
        From the measurement to its arrival [s].
    """

    noise_rms_n: float = 1e-3
    resolution_n: float = 2e-4
    range_n: float = 2.0
    noise_rms_nm: float = 2e-5
    bias_n: tuple[float, ...] = (0.05, -0.03, 0.12)
    delay_s: float = 0.001

    def __post_init__(self) -> None:
        for name in ("noise_rms_n", "resolution_n", "noise_rms_nm", "delay_s"):
            value = getattr(self, name)
            require(0 <= value < math.inf, name, value, "a number, 0 or above")
        require(0 < self.range_n < math.inf, "range_n", self.range_n, "a number above 0")
        require(len(self.bias_n) == 3, "bias_n", self.bias_n, "three numbers")


@dataclass
class CellFaults:
    """What is wrong with the cell now; exchange the fields at any time.

    Attributes
    ----------
    error : ForceFault or None
        Raised by `read`, as the driver of a real cell does when it finds a fault.
    silent, stuck, invalid, overload : bool
        No samples; the last one again and again; no numbers; beyond the range.
    sign : float
        -1: flipped.
    bias_n : (3,) array
        Added to the force [N].
    lose : int
        Of the next samples so many are lost.
    """

    error: ForceFault | None = None
    silent: bool = False
    stuck: bool = False
    invalid: bool = False
    overload: bool = False
    sign: float = 1.0
    bias_n: FloatArray = field(default_factory=lambda: np.zeros(3))
    lose: int = 0


class VirtualCell:
    """A `ForceSource` on the bench: one wrench per period of the robot, weight taken away.

    The inertia of a tool beyond a tool-mounted cell stays in what it shows.

    Attributes
    ----------
    faults : CellFaults
    """

    def __init__(
        self, bench: VirtualBench, parameters: CellParameters | None = None, *, seed: int = 0
    ) -> None:
        self.faults = CellFaults()
        self._bench = bench
        self._parameters = parameters or CellParameters()
        self._rng = np.random.default_rng([seed, 1])
        self._waiting: list[WrenchSample] = []
        self._last: WrenchSample | None = None
        bench.on_step.append(self._measure)

    @property
    def info(self) -> ForceInfo:
        """What it can do."""
        p = self._parameters
        return ForceInfo(
            name="simulated load cell",
            rate_hz=1 / self._bench.motion.period_s,
            noise_rms_n=p.noise_rms_n,
            resolution_n=p.resolution_n,
            range_n=p.range_n,
            mount=self._bench.plant.mounting.mount,
        )

    def start(self) -> None:
        """Begin to stream anew."""
        if self.faults.error is not None:
            raise ForceError(self.faults.error, f"simulated fault: {self.faults.error.value}")
        self._waiting.clear()

    def read(self) -> list[WrenchSample]:
        """Wrenches that have arrived since the last call."""
        if self.faults.error is not None:
            raise ForceError(self.faults.error, f"simulated fault: {self.faults.error.value}")
        until = self._bench.time_ns - round(1e9 * self._parameters.delay_s)
        count = sum(sample.time_ns <= until for sample in self._waiting)
        arrived, self._waiting = self._waiting[:count], self._waiting[count:]
        return arrived

    def close(self) -> None:
        """Stop to stream."""
        self._waiting.clear()

    def _measure(self) -> None:
        faults = self.faults
        noise = self._rng.standard_normal(6)
        if faults.silent:
            return
        if faults.lose > 0:
            faults.lose -= 1
            return
        time_ns = self._bench.time_ns
        if faults.stuck and self._last is not None:
            last = self._last
            self._waiting.append(WrenchSample(time_ns, last.force_n, last.torque_nm))
            return
        self._last = self._sample(time_ns, noise)
        self._waiting.append(self._last)

    def _sample(self, time_ns: int, noise: FloatArray) -> WrenchSample:
        p, plant, faults = self._parameters, self._bench.plant, self.faults
        force, torque = plant.wrench_at_cell()
        force = force + np.asarray(p.bias_n) + p.noise_rms_n * noise[:3]
        if p.resolution_n > 0:
            force = np.round(force / p.resolution_n) * p.resolution_n
        torque = torque + p.noise_rms_nm * noise[3:]
        overload = faults.overload or bool(np.abs(force).max() > p.range_n)
        force = np.clip(force, -p.range_n, p.range_n)
        force, torque = self._at_tip(force, torque)
        force = faults.sign * force + faults.bias_n
        if faults.invalid:
            force = np.full(3, np.nan)
        return WrenchSample(time_ns, force, torque, overload)

    def _at_tip(self, force: FloatArray, torque: FloatArray) -> tuple[FloatArray, FloatArray]:
        """From the cell's frame to the frame `tip`, without the weight the cell carries."""
        plant = self._bench.plant
        mounting, pose = plant.mounting, self._bench.motion.reported
        turn = pose.rotation
        if mounting.mount is Mount.TABLE:
            cell, origin, centre, sign = (
                mounting.frame.rotation, mounting.frame.position_m, mounting.centre_m, -1.0,
            )  # fmt: skip
        else:
            cell, sign = turn * mounting.frame.rotation, 1.0
            origin = pose.position_m + turn.apply(mounting.frame.position_m)
            centre = pose.position_m + turn.apply(mounting.centre_m)
        weight = mounting.carried_kg * GRAVITY_M_S2
        force = sign * (cell.apply(force) - weight)
        torque = sign * (cell.apply(torque) - np.cross(centre - origin, weight))
        torque = torque - np.cross(pose.position_m - origin, force)
        return turn.inv().apply(force), turn.inv().apply(torque)
