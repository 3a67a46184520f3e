# SPDX-License-Identifier: Apache-2.0
"""Which force source is used and what it can do: read from YAML (``config/force``) and checked."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from tactile_resonance.configuration import shared_file
from tactile_resonance.contact.cell_checks import CellLimits
from tactile_resonance.contact.interfaces import ForceInfo, Mount
from tactile_resonance.contact.mounting import Mounting
from tactile_resonance.contact.payload import Payload
from tactile_resonance.contact.requirements import require_fit
from tactile_resonance.contact.samples import Pose
from tactile_resonance.contact.vectors import vector
from tactile_resonance.drivers.can_frames import CanDescription, read_can_description
from tactile_resonance.fields import (
    known_keys,
    number,
    numbers,
    read_yaml,
    require,
    section,
)

KINDS = ("can", "rtde", "topic")
STAMPS = ("adapter", "arrival")
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
        One of `STAMPS`: time stamps of the adapter, related to this machine's clock, or times of arrival.
    shortest_delay_s, delay_std_s : float
        From the adapter's stamp to the arrival [s].
    """

    bus: dict[str, Any]
    description: CanDescription
    scale: np.ndarray
    stamps: str
    shortest_delay_s: float
    delay_std_s: float


@dataclass(frozen=True)
class ForceConfig:
    """A force source.

    Attributes
    ----------
    kind : str
        One of `KINDS`.
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
    try:
        config = _config(content, path.parent)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from error
    if force_n is not None:
        require_fit(config.info, force_n)
    return config


def _config(content: dict[str, Any], folder: Path) -> ForceConfig:
    kind = content.get("kind")
    require(kind in KINDS, "kind", kind, f"one of {', '.join(KINDS)}")
    shared = {"kind", "name", "rate_hz", "noise_rms_n", "range_n", "range_nm", "latency_s"}
    shared |= {"mount", "frame", "payload", "inertia_window_s", "limits"}
    own = {
        "can": {"bus", "frames", "counts_per_n", "counts_per_nm", "matrix", "resolution_n"}
        | {"stamps", "shortest_delay_s", "delay_std_s"},
        "rtde": {"resolution_n"},
        "topic": {"resolution_n", "topic"},
    }
    known_keys(content, shared | own[kind], "")
    mount = content.get("mount")
    require(mount in ("tool", "table"), "mount", mount, "tool or table")
    can = _can(content, folder) if kind == "can" else None
    # where the scale is a matrix the step depends on the direction: it is stated
    counted = can is not None and "matrix" not in content and "resolution_n" not in content
    resolution_n = 1 / content["counts_per_n"] if counted else _positive(content, "resolution_n")
    info = ForceInfo(
        name=str(content.get("name", kind)),
        rate_hz=_positive(content, "rate_hz"),
        noise_rms_n=_positive(content, "noise_rms_n"),
        resolution_n=resolution_n,
        range_n=_positive(content, "range_n"),
        mount=Mount(mount),
    )
    if can is not None and can.description.rates:
        rates = can.description.rates
        require(info.rate_hz in rates, "rate_hz", info.rate_hz, f"one of {sorted(rates)}")
    topic = content.get("topic", "")
    good = isinstance(topic, str) and bool(topic)
    require(kind != "topic" or good, "topic", topic, "the name of a topic")
    given = dict(section(content, "limits", "") if content.get("limits") is not None else {})
    stuck = given.pop("stuck_samples", None)
    good = stuck is None or type(stuck) is int
    require(good, "limits.stuck_samples", stuck, "an integer")
    names = {f.name for f in fields(CellLimits)} - {"stuck_samples"}
    known_keys(given, names, "limits")
    for name in ("overload_samples", "lost_tolerated"):
        good = name not in given or type(given[name]) is int
        require(good, f"limits.{name}", given.get(name), "an integer")
    for name in ("silent_s", "jump_n"):
        if name in given:
            given[name] = number(given[name], f"limits.{name}")
    try:
        limits = CellLimits(stuck_samples=stuck, **given)
    except ValueError as error:
        raise ValueError(f"limits.{error}") from error
    periods = limits.silent_s * info.rate_hz
    require(periods >= 2, "limits.silent_s", limits.silent_s, "two periods of rate_hz or more")
    return ForceConfig(
        kind=kind,
        info=info,
        range_nm=_positive(content, "range_nm"),
        mounting=_mounting(content, Mount(mount)),
        inertia_window_s=_short(content, "inertia_window_s"),
        latency_s=_short(content, "latency_s"),
        limits=limits,
        can=can,
        topic=topic,
    )


def _can(content: dict[str, Any], folder: Path) -> CanConfig:
    bus = dict(section(content, "bus", ""))
    require(isinstance(bus.get("interface"), str), "bus.interface", bus.get("interface"), "a name")
    if bus["interface"] == "socketcand":
        # without it the kernel holds small packets back for tens of milliseconds
        bus.setdefault("tcp_tune", True)
        host, port = bus.get("host"), bus.get("port")
        require(isinstance(host, str) and bool(host), "bus.host", host, "a name or an address")
        good = type(port) is int and 0 < port < 1 << 16
        require(good, "bus.port", port, "an integer from 1 to 65535")
    frames = content.get("frames")
    require(isinstance(frames, str) and bool(frames), "frames", frames, "a file")
    beside = folder / str(frames)
    description = read_can_description(beside if beside.is_file() else Path(str(frames)))
    if content.get("matrix") is not None:
        rows = content["matrix"]
        require(isinstance(rows, list) and len(rows) == 6, "matrix", rows, "6 rows of 6 numbers")
        scale = np.array([numbers(row, f"matrix[{i}]", 6) for i, row in enumerate(rows)])
        # some load would be shown as none
        blind = np.linalg.matrix_rank(scale / np.maximum(np.abs(scale).max(1), 1e-300)[:, None]) < 6
        require(not blind, "matrix", rows, "rows that are independent")
        for name in ("counts_per_n", "counts_per_nm"):
            require(name not in content, name, content.get(name), "nothing beside matrix")
    else:
        per_n, per_nm = _positive(content, "counts_per_n"), _positive(content, "counts_per_nm")
        scale = np.diag(np.repeat([1 / per_n, 1 / per_nm], 3))
    stamps = content.get("stamps", "arrival")
    require(stamps in STAMPS, "stamps", stamps, f"one of {', '.join(STAMPS)}")
    return CanConfig(
        bus=bus,
        description=description,
        scale=scale,
        stamps=stamps,
        shortest_delay_s=_short(content, "shortest_delay_s"),
        delay_std_s=_short(content, "delay_std_s"),
    )


def _mounting(content: dict[str, Any], mount: Mount) -> Mounting:
    part = section(content, "frame", "")
    known_keys(part, {"position_m", "rotation_rad"}, "frame")
    pose = Pose(
        np.array(numbers(part.get("position_m"), "frame.position_m", 3)),
        np.array(numbers(part.get("rotation_rad"), "frame.rotation_rad", 3)),
    )
    payload = None
    if content.get("payload") is not None:
        mass = section(content, "payload", "")
        known_keys(mass, {"mass_kg", "centre_m"}, "payload")
        centre = vector(numbers(mass.get("centre_m"), "payload.centre_m", 3))
        payload = Payload(number(mass.get("mass_kg"), "payload.mass_kg"), centre)
    return Mounting(mount, pose, payload)


def _positive(content: dict[str, Any], name: str) -> float:
    value = number(content.get(name), name)
    require(value > 0, name, value, "a number above 0")
    return value


def _short(content: dict[str, Any], name: str) -> float:
    value = number(content.get(name, 0.0), name)
    require(0 <= value <= LONGEST_S, name, value, f"0 to {LONGEST_S:g} s")
    return value
