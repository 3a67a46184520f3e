# SPDX-License-Identifier: Apache-2.0
"""Which force source is used and what it can do: read from YAML (``config/force``) and checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from tactile_resonance.configuration import shared_file
from tactile_resonance.contact.cell_checks import CellLimits
from tactile_resonance.contact.interfaces import ForceInfo, Mount
from tactile_resonance.contact.mounting import Mounting
from tactile_resonance.contact.payload import Payload
from tactile_resonance.contact.requirements import require_fit
from tactile_resonance.contact.samples import Pose
from tactile_resonance.contact.vectors import Six, Vector
from tactile_resonance.drivers.can_frames import CanDescription, read_can_description
from tactile_resonance.fields import build, read, read_dataclass, read_yaml, require

Stamps = Literal["adapter", "arrival"]
LONGEST_S = 1.0
"""Of delays and filters: with more, no contact is controlled."""


@dataclass(frozen=True)
class CanConfig:
    """What is only asked of a cell on CAN.

    Attributes
    ----------
    bus : dict
        Arguments of ``can.Bus``: interface, channel, bitrate, host ...
    description : CanDescription
    scale : (6, 6) array
        From counts to N and N m.
    stamps : str
        Time stamps of the adapter, related to this machine's clock, or times of arrival.
    shortest_delay_s, delay_std_s : float
        From the adapter's stamp to the arrival [s].
    """

    bus: dict[str, Any]
    description: CanDescription
    scale: np.ndarray
    stamps: Stamps
    shortest_delay_s: float
    delay_std_s: float


@dataclass(frozen=True)
class ForceConfig:
    """A force source.

    Attributes
    ----------
    kind : str
        One of can, rtde, topic.
    info : ForceInfo
    range_nm : float
        Largest torque [N m].
    mounting : Mounting
    inertia_window_s : float
        See `contact.tip_force.TipForce`.
    latency_s : float
        From the force to the time stamp, filters of the sensor included [s].
    limits : CellLimits
    can : CanConfig or None
    topic : str
        Empty unless `kind` is topic.
    """

    kind: str
    info: ForceInfo
    range_nm: float
    mounting: Mounting
    inertia_window_s: float
    latency_s: float
    limits: CellLimits
    can: CanConfig | None = None
    topic: str = ""


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
    kind = read(Literal["can", "rtde", "topic"], content.get("kind"), f"{where} kind")
    file: _File = read_dataclass(_KINDS[kind], content, where)
    config = build(_config, where, file, path.parent)
    if force_n is not None:
        require_fit(config.info, force_n)
    return config


@dataclass(frozen=True)
class _Frame:
    position_m: Vector
    rotation_rad: Vector


def _read_frame(value: object, where: str) -> Pose:
    frame = read(_Frame, value, where)
    return Pose(np.array(frame.position_m), np.array(frame.rotation_rad))


@dataclass(frozen=True, kw_only=True)
class _File:
    """What every file states; what only one kind of source has is added below."""

    kind: str
    rate_hz: float
    noise_rms_n: float
    range_n: float
    range_nm: float
    mount: Mount
    frame: Annotated[Pose, _read_frame]
    name: str = ""
    latency_s: float = 0.0
    payload: Payload | None = None
    inertia_window_s: float = 0.0
    limits: CellLimits = field(default_factory=CellLimits)

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name in _POSITIVE:
                require(value is None or value > 0, name, value, "a number above 0")
            if name in _SHORT:
                require(0 <= value <= LONGEST_S, name, value, f"0 to {LONGEST_S:g} s")
        silent_s = self.limits.silent_s
        good = silent_s * self.rate_hz >= 2
        require(good, "limits.silent_s", silent_s, "two periods of rate_hz or more")


@dataclass(frozen=True, kw_only=True)
class _Rtde(_File):
    resolution_n: float


@dataclass(frozen=True, kw_only=True)
class _Topic(_Rtde):
    topic: str

    def __post_init__(self) -> None:
        super().__post_init__()
        require(bool(self.topic), "topic", self.topic, "the name of a topic")


@dataclass(frozen=True, kw_only=True)
class _Can(_File):
    bus: Mapping[str, Any]
    frames: str
    counts_per_n: float | None = None
    counts_per_nm: float | None = None
    matrix: tuple[Six, Six, Six, Six, Six, Six] | None = None
    resolution_n: float | None = None
    stamps: Stamps = "arrival"
    shortest_delay_s: float = 0.0
    delay_std_s: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        interface, host, port = (self.bus.get(name) for name in ("interface", "host", "port"))
        require(isinstance(interface, str), "bus.interface", interface, "a name")
        if interface == "socketcand":
            good = isinstance(host, str) and bool(host)
            require(good, "bus.host", host, "a name or an address")
            good = type(port) is int and 0 < port < 1 << 16
            require(good, "bus.port", port, "an integer from 1 to 65535")
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
        # with a matrix the step depends on the direction
        good = self.matrix is None or self.resolution_n is not None
        require(good, "resolution_n", self.resolution_n, "a number above 0 beside matrix")

    @property
    def scale(self) -> np.ndarray:
        """(6, 6) from counts to N and N m."""
        if self.matrix is not None:
            return np.array(self.matrix)
        return np.diag(np.repeat([1 / self.counts_per_n, 1 / self.counts_per_nm], 3))

    def can(self, folder: Path) -> CanConfig:
        """What the driver needs; `folder` is that of the file."""
        beside = folder / self.frames
        description = read_can_description(beside if beside.is_file() else Path(self.frames))
        if rates := description.commands.rates:
            require(self.rate_hz in rates, "rate_hz", self.rate_hz, f"one of {sorted(rates)}")
        # without it the kernel holds small packets back for tens of milliseconds
        tuned = {"tcp_tune": True} if self.bus["interface"] == "socketcand" else {}
        return CanConfig(
            bus={**tuned, **self.bus},
            description=description,
            scale=self.scale,
            stamps=self.stamps,
            shortest_delay_s=self.shortest_delay_s,
            delay_std_s=self.delay_std_s,
        )


_KINDS = {"can": _Can, "rtde": _Rtde, "topic": _Topic}
_POSITIVE = frozenset(
    {
        "rate_hz",
        "noise_rms_n",
        "range_n",
        "range_nm",
        "resolution_n",
        "counts_per_n",
        "counts_per_nm",
    }
)
_SHORT = frozenset({"latency_s", "inertia_window_s", "shortest_delay_s", "delay_std_s"})


def _config(file: Any, folder: Path) -> ForceConfig:
    step_n = file.resolution_n
    return ForceConfig(
        kind=file.kind,
        info=ForceInfo(
            name=file.name or file.kind,
            rate_hz=file.rate_hz,
            noise_rms_n=file.noise_rms_n,
            resolution_n=1 / file.counts_per_n if step_n is None else step_n,
            range_n=file.range_n,
            mount=file.mount,
        ),
        range_nm=file.range_nm,
        mounting=Mounting(file.mount, file.frame, file.payload),
        inertia_window_s=file.inertia_window_s,
        latency_s=file.latency_s,
        limits=file.limits,
        can=file.can(folder) if file.kind == "can" else None,
        topic=file.topic if file.kind == "topic" else "",
    )
