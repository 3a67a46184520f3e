# SPDX-License-Identifier: Apache-2.0
"""Which force source is used and what it can do: read from YAML (``config/force``), checked, and made.

A cell on CAN is in `can_wrench`; the robot's own sensor, as the robot's state brings it, is here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from tactile_resonance.configuration import shared_file
from tactile_resonance.contact.cell_checks import CellChecks, CellLimits, require_fit
from tactile_resonance.contact.interfaces import (
    ArmError,
    Cell,
    ForceError,
    ForceFault,
    ForceInfo,
    NodeArm,
)
from tactile_resonance.contact.payload import Mount, Mounting
from tactile_resonance.contact.samples import ArmSample, CellSample
from tactile_resonance.contact.vectors import Six, rotated_back, turn_from_vector
from tactile_resonance.drivers.can_frames import CanDescription, read_can_description
from tactile_resonance.fields import (
    AboveZero,
    Checked,
    FileName,
    Range,
    build,
    read,
    read_dataclass,
    read_file_name,
    read_yaml,
    require,
)

Delay = Annotated[float, Range(0.0, 1.0)]
"""With more [s], no contact is controlled."""


def _read_bus(value: object, where: str) -> dict[str, Any]:
    bus = read(dict[str, Any], value, where)
    interface, port = bus.get("interface"), bus.get("port")
    require(isinstance(interface, str), f"{where}.interface", interface, "a name")
    if interface != "socketcand":
        return bus
    for name, accepted in (("host", "a name or an address"), ("channel", "the name of a CAN interface")):
        good = isinstance(bus.get(name), str) and bool(bus[name])
        require(good, f"{where}.{name}", bus.get(name), accepted)
    good = type(port) is int and 0 < port < 1 << 16
    require(good, f"{where}.port", port, "an integer from 1 to 65535")
    # without it the kernel holds small packets back for tens of milliseconds
    return {"tcp_tune": True, **bus}


@dataclass(frozen=True, kw_only=True)
class ForceConfig(Mounting, ForceInfo):
    """A force source: what it can do, as its file in ``config/force`` states, and where it sits.

    Attributes
    ----------
    kind : str
        What brings the wrenches; also selects the class of the configuration.
    rate_hz : float
    noise_rms_n : float
        Of one sample, white, on each axis [N].
    range_n, range_nm : float
        Largest force and torque of each axis [N], [N m].
    name : str
        In files its kind, where it is left out.
    latency_s : float
        From the force to the time stamp, filters of the sensor included [s].
    limits : CellLimits
    resolution_n : float
        Smallest step [N]; in files that of a cell on CAN may be left out, where it is a count.
    """

    kind: str
    name: str
    rate_hz: AboveZero
    noise_rms_n: AboveZero
    resolution_n: AboveZero
    range_n: AboveZero
    range_nm: AboveZero
    latency_s: Delay = 0.0
    limits: CellLimits = field(default_factory=CellLimits)

    def __post_init__(self) -> None:
        super().__post_init__()
        Checked.__post_init__(self)
        silent_s = self.limits.silent_s
        good = silent_s * self.rate_hz >= 2
        require(good, "limits.silent_s", silent_s, "two periods of rate_hz or more")


@dataclass(frozen=True, kw_only=True)
class TopicForce(ForceConfig):
    """A force source that a topic brings."""

    topic: str

    def __post_init__(self) -> None:
        super().__post_init__()
        require(bool(self.topic), "topic", self.topic, "the name of a topic")


@dataclass(frozen=True, kw_only=True)
class CanForce(ForceConfig):
    """A cell on CAN.

    Attributes
    ----------
    bus : dict
        Arguments of ``can.Bus``: interface, channel, bitrate, host ...
    frames : str
        File of the description.
    description : CanDescription
    counts_per_n, counts_per_nm : float or None
    matrix : 6 rows of 6 or None
        In place of both: from counts to N and N m.
    stamps : str
        Time stamps of the adapter, related to this machine's clock, or times of arrival.
    shortest_delay_s, delay_std_s : float
        From the adapter's stamp to the arrival [s].
    """

    bus: Annotated[dict[str, Any], _read_bus]
    frames: FileName
    description: CanDescription
    counts_per_n: AboveZero | None = None
    counts_per_nm: AboveZero | None = None
    matrix: tuple[Six, Six, Six, Six, Six, Six] | None = None
    stamps: Literal["adapter", "arrival"] = "arrival"
    shortest_delay_s: Delay = 0.0
    delay_std_s: Delay = 0.0

    def __post_init__(self) -> None:
        if self.matrix is not None:
            rows = np.array(self.matrix)
            # some load would be shown as none
            largest = np.maximum(np.abs(rows).max(axis=1, keepdims=True), 1e-300)
            seen = bool(np.linalg.matrix_rank(rows / largest) == 6)
            require(seen, "matrix", self.matrix, "rows that are independent")
        for name in ("counts_per_n", "counts_per_nm"):
            value = getattr(self, name)
            good = (value is None) == (self.matrix is not None)
            require(good, name, value, "a number above 0, or a matrix in place of both")
        super().__post_init__()
        rates = self.description.commands.rates
        good = not rates or self.rate_hz in rates
        require(good, "rate_hz", self.rate_hz, f"one of {sorted(rates)}")

    @property
    def scale(self) -> np.ndarray:
        """(6, 6) from counts to N and N m."""
        if self.matrix is not None:
            return np.array(self.matrix)
        return np.diag(np.repeat([1 / self.counts_per_n, 1 / self.counts_per_nm], 3))


_KINDS = {"can": CanForce, "rtde": ForceConfig, "topic": TopicForce}


def read_force_config(path: Path, force_n: float | None = None) -> ForceConfig:
    """Read and check a force source.

    Parameters
    ----------
    path : Path
        A bare name that is no file here is one of ``config/force``.
    force_n : float or None
        Contact force that will be asked of it [N]; None: not known yet.

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted; or says with which figures the source cannot
        control this force.
    """
    path = shared_file(path, "config/force")
    content = read_yaml(path)
    where = f"{path.name}:"
    kind = content.get("kind")
    known = type(kind) is str and kind in _KINDS
    require(known, f"{where} kind", kind, f"one of {', '.join(_KINDS)}")
    given: dict[str, Any] = {}
    if content.get("name", "") == "":
        content["name"] = kind
    if kind == "can":
        counts = content.get("counts_per_n")
        # with a matrix the step depends on the direction
        alone = counts is not None or content.get("matrix") is None
        if alone and content.get("resolution_n") is None:
            good = type(counts) in (int, float) and 0 < counts < math.inf
            accepted = "a number above 0, or a matrix in place of both"
            require(good, f"{where} counts_per_n", counts, accepted)
            content["resolution_n"] = 1 / counts
        frames = read_file_name(content.get("frames"), f"{where} frames")
        beside = path.parent / frames
        file = beside if beside.is_file() else Path(frames)
        given["description"] = build(read_can_description, where, file)
    config: ForceConfig = read_dataclass(_KINDS[kind], content, where, **given)
    if force_n is not None:
        require_fit(config, force_n)
    return config


class RtdeWrench:
    """Wrenches of the robot's sensor in the frame `tip` (a `contact.interfaces.Cell`).

    The controller has taken the payload off and moved the wrench to the tool centre point, which is the
    tip: so the mounting is the identity, and the payload is set at the robot.

    Parameters
    ----------
    config : ForceConfig
    arm : NodeArm
        Silence is judged on its clock.
    """

    def __init__(self, config: ForceConfig, arm: NodeArm) -> None:
        moved = config.frame.vector.any() or config.payload is not None
        if moved or config.mount is not Mount.TOOL:
            raise ValueError(
                "mount, frame, payload: expected tool, zeros and none, the controller knows them"
            )
        self.mounting: Mounting = config
        self.info: ForceInfo = config
        self._config, self._arm, self._clock = config, arm, arm.clock
        self._checks = CellChecks(config, config.range_nm, config.limits)
        self._robot_time_s = -math.inf
        self._new_s = 0.0

    def start(self) -> None:
        """Begin anew; the arm is connected by its owner. Raises `ForceError`."""
        self._checks.restart()
        state = self._state()
        self._robot_time_s, self._new_s = state.robot_time_s, self._now_s()

    def read(self) -> list[CellSample]:
        """The newest wrench where there is a new one. Raises `ForceError`."""
        state = self._state()
        now_s = self._now_s()
        if state.robot_time_s == self._robot_time_s:
            if now_s - self._new_s > self._config.limits.silent_s:
                text = f"{self.info.name}: no new state for {(now_s - self._new_s) * 1e3:.0f} ms"
                raise ForceError(ForceFault.SILENT, text)
            return []
        self._robot_time_s, self._new_s = state.robot_time_s, now_s
        assert state.tool_wrench is not None
        turn, (x, y, z, tx, ty, tz) = turn_from_vector(state.rotation_rad), state.tool_wrench
        wrench = *rotated_back(turn, (x, y, z)), *rotated_back(turn, (tx, ty, tz))
        overload = self._checks.check(wrench)
        stamp_ns = state.time_ns - round(self._config.latency_s * 1e9)
        return [CellSample(stamp_ns, wrench, overload)]

    def close(self) -> None:
        """Nothing is to be let go: the arm belongs to someone else."""

    def _now_s(self) -> float:
        return self._clock.now_ns() * 1e-9

    def _state(self) -> ArmSample:
        try:
            state = self._arm.recent()
        except ArmError as error:
            raise ForceError(ForceFault.LINK_LOST, f"{self._config.name}: {error}") from error
        if state.tool_wrench is None:
            text = f"{self._config.name}: the arm brings no wrench"
            raise ForceError(ForceFault.REFUSED, text)
        return state


def force_source(
    config: ForceConfig, arm: NodeArm, topic: Callable[[TopicForce], Cell] | None = None
) -> Cell:
    """Make the source; nothing is opened before its `start`.

    Parameters
    ----------
    config : ForceConfig
    arm : NodeArm
        That carries the tip; wrenches are dated on its clock.
    topic : callable or None
        Makes the cell of a topic; only a node can.

    Raises
    ------
    ValueError
        If python-can is not installed, or a topic is asked for outside of a node.
    """
    if isinstance(config, CanForce):
        try:
            from tactile_resonance.drivers.can_wrench import CanWrench
        except ImportError as error:
            raise ValueError("kind: can needs python-can: pip install python-can") from error
        return CanWrench(config, arm.clock)
    if isinstance(config, TopicForce):
        if topic is None:
            raise ValueError("kind: topic is for nodes only")
        return topic(config)
    if type(config) is ForceConfig:
        return RtdeWrench(config, arm)
    raise TypeError(f"no source of force for {type(config).__name__}")
