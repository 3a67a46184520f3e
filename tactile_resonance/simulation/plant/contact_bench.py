# SPDX-License-Identifier: Apache-2.0
"""A whole contact bench in virtual time: plant, arm and load cell behind the contracts of the real drivers.

`indent_tissue` carries out mechanical tests on it, with the controller of a contact.

Time goes on only while somebody waits for it, so a run repeats to the last bit and takes as long as it takes to
compute. Arm and cell have every fault of real ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import scipy  # its parts are loaded where they are used first

from tactile_resonance._typing import FloatArray
from tactile_resonance.clock import Clock, Demand
from tactile_resonance.contact.geometry import touch_pose
from tactile_resonance.contact.goal import ContactGoal, HoldMode, State
from tactile_resonance.contact.interfaces import (
    ArmError,
    ArmFault,
    ForceError,
    ForceFault,
    ForceInfo,
)
from tactile_resonance.contact.loop import ContactLoop, IndentationRecorder
from tactile_resonance.contact.machine import ContactController
from tactile_resonance.contact.parameters import read_contact
from tactile_resonance.contact.payload import Mount, Mounting, Payload
from tactile_resonance.contact.samples import ArmSample, CellSample, Pose
from tactile_resonance.contact.vectors import nearer, six, transform_from_pose, vector
from tactile_resonance.mechanics.indentation import BallTip, IndentationRecord, Protocol
from tactile_resonance.sensor import SensorParameters
from tactile_resonance.simulation.cell.transducer import NO_NUMBER, CellParameters, Transducer
from tactile_resonance.simulation.noise import Jitter, Seed
from tactile_resonance.simulation.plant.plant import Plant
from tactile_resonance.simulation.plant.surfaces import PlantSurface
from tactile_resonance.simulation.plant.tip import Tip
from tactile_resonance.simulation.sensor.bimorph import sensor_modes
from tactile_resonance.simulation.tissue.library import Tissue
from tactile_resonance.simulation.ur5e.machine import Lag, TrackingParameters

PROTECTIVE_DECELERATION_M_S2 = 2.0
"""With which the robot brakes without a command (chosen)."""
WATCHDOG_NS = 40_000_000
"""Without a command for so long the robot stops."""
STALE_NS = 20_000_000
"""States older than this are refused."""
CELL_DELAY_NS = 1_000_000
"""From a measurement of the cell to its arrival."""


class TipMotion:
    """Six axes of a tip that obeys twists, one period at a time.

    Attributes
    ----------
    pose : Pose
        Where the tip is, vibration included.
    reported : Pose
        What the arm's encoders say: without vibration.
    twist : (6,) array
        Velocity [m/s] and angular velocity [rad/s] of `reported`.
    """

    def __init__(
        self, parameters: TrackingParameters, start: Pose, *, period_s: float = 0.002, seed: Seed = 0
    ) -> None:
        self.period_s = period_s
        self.pose = self.reported = start
        self.twist = np.zeros(6)
        self._set_twist = self._wanted = six([0.0] * 6)  # after the acceleration limit, and before
        self._acceleration_m_s2 = 1.0
        self._lag = Lag(parameters, [0.0] * 6, period_s)
        self._jitter = Jitter(
            parameters.jitter_rms_m, parameters.jitter_corner_rad_s, period_s, seed
        )

    def speed(self, twist: Sequence[float] | FloatArray, acceleration_m_s2: float) -> None:
        """Go over to a twist (6,) in the base, under an acceleration limit, and keep it."""
        self._wanted, self._acceleration_m_s2 = six(twist), acceleration_m_s2

    def step(self) -> None:
        """Advance one period."""
        dt = self.period_s
        step = self._acceleration_m_s2 * dt
        self._set_twist = nearer(self._set_twist, self._wanted, step)
        last = self.twist
        self.twist = self._lag.step(self._set_twist)
        way = (last + self.twist) / 2 * dt
        # the same object where nothing turns, so that what is computed from it can be kept
        rotation = self.reported.rotation_rad
        if way[3] or way[4] or way[5]:
            turn = scipy.spatial.transform.Rotation.from_rotvec(way[3:])
            rotation = (turn * self.reported.rotation).as_rotvec()
        self.reported = Pose(self.reported.position_m + way[:3], rotation)
        self.pose = Pose(self.reported.position_m + self._jitter.step(), rotation)


class VirtualArm:
    """An `Arm` on the bench, with the faults of a real one.

    While the link is frozen nothing is heard and no command arrives; the robot goes on as it was
    last commanded until its own watchdog stops it.

    Parameters
    ----------
    bench : ContactBench
    """

    def __init__(self, bench: ContactBench) -> None:
        self._bench, self._motion = bench, bench.motion
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
        if self._bench.time_ns - self._sample.time_ns > STALE_NS:
            self._raise_if(ArmFault.STALE)
        return self._sample

    def speed(self, twist: Sequence[float], acceleration_m_s2: float) -> None:
        """Move with a twist until the next command."""
        self._raise_if(self._broken if self._connected else ArmFault.LINK_LOST)
        if self._heard():
            self._raise_if(self._stopped)
            self._motion.speed(twist, acceleration_m_s2)

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
        """The robot stops without a command: protective or emergency stop, program stopped."""
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
        if bench.time_ns - self._heard_ns > WATCHDOG_NS and self._stopped is None:
            self.halt(ArmFault.PROGRAM_STOPPED)

    def _heard(self) -> bool:
        """Whether a command reaches the robot; the client cannot know."""
        if self._bench.time_ns < self._frozen_until_ns:
            return False
        self._heard_ns = self._bench.time_ns
        return True

    def _fresh(self) -> ArmSample:
        bench, motion = self._bench, self._motion
        self._heard_ns = bench.time_ns
        return ArmSample(
            time_ns=bench.time_ns,
            robot_time_s=bench.time_ns * 1e-9,
            position_m=vector(motion.reported.position_m),
            rotation_rad=vector(motion.reported.rotation_rad),
            velocity=six(motion.twist),
            moving_allowed=self._stopped is None,
            message="" if self._stopped is None else self._stopped.value,
        )

    @staticmethod
    def _raise_if(fault: ArmFault | None) -> None:
        if fault is not None:
            raise ArmError(fault, f"simulated fault: {fault.value}")


class VirtualCell(Transducer):
    """A `Cell` on the bench: one wrench per period of the robot.

    Parameters
    ----------
    bench : ContactBench
    mounting : Mounting
    parameters : CellParameters, optional
        By default those of ``config/load_cells/fine.yaml``.
    seed : int

    Attributes
    ----------
    faults : CellFaults
        Of the cell itself.
    error : ForceFault or None
        What `read` and `start` raise, as the driver of a cell does that finds a fault.
    """

    def __init__(
        self,
        bench: ContactBench,
        mounting: Mounting,
        parameters: CellParameters | None = None,
        seed: int = 0,
    ) -> None:
        p = CellParameters.from_yaml() if parameters is None else parameters
        super().__init__(p, seed, period_s=bench.motion.period_s)
        self.error: ForceFault | None = None
        self._bench, self.mounting = bench, mounting
        self._scale = np.repeat([1 / p.force_divisor, 1 / p.torque_divisor], 3)
        self._waiting: list[CellSample] = []
        self._count = 0
        bench.on_step.append(self._measure)

    @property
    def info(self) -> ForceInfo:
        """What it can do."""
        p = self.parameters
        return ForceInfo(
            name=p.name,
            rate_hz=1 / self._bench.motion.period_s,
            noise_rms_n=p.force_noise_rms_n,
            resolution_n=1 / p.force_divisor,
            range_n=p.force_range_n,
        )

    def start(self) -> None:
        """Begin to stream anew."""
        self._raise_if_broken()
        self._waiting.clear()

    def read(self) -> list[CellSample]:
        """Wrenches that have arrived since the last call."""
        self._raise_if_broken()
        until = self._bench.time_ns - CELL_DELAY_NS
        count = sum(sample.time_ns <= until for sample in self._waiting)
        arrived, self._waiting = self._waiting[:count], self._waiting[count:]
        return arrived

    def close(self) -> None:
        """Stop to stream."""
        self._waiting.clear()

    def _raise_if_broken(self) -> None:
        if self.error is not None:
            raise ForceError(self.error, f"simulated fault: {self.error.value}")

    def _measure(self) -> None:
        *counts, bits = self.convert_once(self._bench.plant.wrench_at_cell())
        self._count += 1
        every = self.faults.lose_second_every
        if self.faults.silent or (every and self._count % every == 0):
            return
        wrench = self._scale * counts
        wrench[np.equal(counts, NO_NUMBER)] = np.nan
        self._waiting.append(CellSample(self._bench.time_ns, six(wrench), bits != 0))


DISH_KG = 0.2
"""Of the sample with its dish on a cell under it (chosen)."""


class ContactBench(Clock):
    """Robot, plant and time; arm and cell are connected and streaming. It is the clock of the control loop.

    Parameters
    ----------
    tissue : Tissue
        Everywhere under the surface.
    surface : PlantSurface
    start : Pose
        Of the tip.
    tip : Tip
    mount : Mount
        Where the cell sits.
    tool_kg : float
        Mass beyond a tool-mounted cell [kg].
    tracking : TrackingParameters
    cell_parameters : CellParameters
    period_s : float
        Of robot and cell [s].
    seed : int

    Attributes
    ----------
    plant : Plant
    motion : TipMotion
        Of the robot.
    time_ns : int
    on_step : list of callables
        Called after every period: recorders, and faults at their time.
    arm : VirtualArm
    cell : VirtualCell
    """

    def __init__(
        self,
        tissue: Tissue,
        surface: PlantSurface,
        start: Pose,
        *,
        tip: Tip | None = None,
        mount: Mount = Mount.TABLE,
        tool_kg: float = 0.03,
        tracking: TrackingParameters | None = None,
        cell_parameters: CellParameters | None = None,
        period_s: float = 0.002,
        seed: int = 0,
    ) -> None:
        on_tool = mount is Mount.TOOL
        tool, dish = Payload(tool_kg, (-0.03, 0.0, 0.01)), Payload(DISH_KG, (0.0, 0.0, -0.01))
        self.plant = Plant(
            surface,
            lambda _: tissue,
            tip or Tip(),
            mount=mount,
            carried=tool if on_tool else dish,
        )
        # of its own: of the cell's seed the arm would be shaken by the noise of the cell, one period earlier
        shaken = [seed, 1]
        self.motion = TipMotion(
            tracking or TrackingParameters(), start, period_s=period_s, seed=shaken
        )
        self.time_ns = 0
        self.on_step: list[Callable[[], None]] = []
        self._period_ns = round(1e9 * period_s)
        self.plant.step(transform_from_pose(start.vector), period_s)
        self.arm = VirtualArm(self)
        seat = Mounting(mount, Pose.at_origin(), tool if on_tool else None)
        self.cell = VirtualCell(self, seat, cell_parameters, seed=seed)
        self.arm.connect()
        self.cell.start()

    def now_ns(self) -> int:
        """Virtual time since the start [ns]."""
        return self.time_ns

    def wait_until(self, time_ns: int, demand: Demand = Demand.FAST, /) -> None:
        """Let whole periods pass until a time is reached, whatever the demand."""
        while self.time_ns < time_ns:
            self.motion.step()
            self.plant.step(transform_from_pose(self.motion.pose.vector), self.motion.period_s)
            self.time_ns += self._period_ns
            for action in self.on_step:
                action()


START_M = 5e-3
"""Of the tip above the tissue."""
LONGER_S = 60.0
"""A test ends so long after its hold, or has failed."""


def indent_tissue(
    tissue: Tissue,
    sensor: SensorParameters,
    protocol: Protocol,
    *,
    hold_s: float,
    force_n: float = 0.01,
    unload_speed_m_s: float = 0.0,
    rigid: bool = True,
    seed: int = 0,
    poisson_ratio: float = 0.49,
    progress: Callable[[str], None] = lambda text: None,
) -> IndentationRecord:
    """Carry a test out as contact_node does, on tissue that was never touched and is known to be soft.

    Parameters
    ----------
    tissue : Tissue
    sensor : SensorParameters
        For ball and beam.
    protocol : Protocol
    hold_s, force_n, unload_speed_m_s : float
        As the action ``indent`` takes them; the limit of the hold is raised to what it needs.
    rigid : bool
        The ball on the robot itself; else at the end of the sensor's beam.
    seed : int
        Of arm and cell.
    poisson_ratio : float
    progress : callable
        Told what is done.

    Raises
    ------
    ValueError
        If a limit of the contact refuses it.
    RuntimeError
        If the test failed, with its cause.
    """
    progress(
        f"{protocol.value} of {tissue.label or tissue.name}, {hold_s:g} s at {1e3 * force_n:g} mN"
    )
    parameters, limits = read_contact()
    modes = sensor_modes(sensor)
    stiffness = math.inf if rigid else modes.static_stiffness_n_per_m
    parameters = replace(
        parameters,
        beam_stiffness_n_per_m=0.0 if rigid else stiffness,
        unknown_speed_m_s=parameters.approach_speed_m_s,  # it is no bone
    )
    limits = replace(limits, hold_s=max(limits.hold_s, hold_s + LONGER_S))
    radius_m = sensor.tip.radius_m
    touch = touch_pose([0, 0, 0], [0, 0, 1], [1, 0, 0], radius_m)
    bench = ContactBench(
        tissue,
        PlantSurface.tilted(0.0, 0.0),
        Pose(touch.position_m + [0, 0, START_M], touch.rotation_rad),
        tip=Tip(radius_m, None if rigid else modes, poisson_ratio),
        seed=seed,
    )
    hold = HoldMode.FORCE if protocol is Protocol.CREEP else HoldMode.INDENTATION
    goal = ContactGoal(touch, force_n, hold, hold_s=hold_s, unload_speed_m_s=unload_speed_m_s)
    ball = BallTip(radius_m, poisson_ratio, stiffness)
    recorder = IndentationRecorder(goal, protocol, ball, bench.cell.info.name, simulated=True)
    controller = ContactController(parameters, limits, under_sample=True)
    loop = ContactLoop(bench.arm, bench.cell, bench, controller, recorder.take)
    loop.start(goal)
    ended = (State.IDLE, State.FAULT)
    loop.run_while(lambda: controller.state not in ended, hold_s + LONGER_S)
    result = controller.result
    if result is None or not result.reached or controller.state is not State.IDLE:
        raise RuntimeError(f"test of {tissue.name}: {controller.state.value}: {result}")
    return replace(recorder.record(result), label=tissue.label or tissue.name)
