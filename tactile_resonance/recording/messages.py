# SPDX-License-Identifier: Apache-2.0
"""Excitations, records and poles from messages, without ROS: each field of equal name is listed once, here.

A message is whatever has the fields of ``msg/Excitation.msg`` and so on: arrays may be those of rclpy
(`array.array`) or of numpy. Those of rclpy are read as views of the message's memory (``numpy.frombuffer``)
and filled in place (``array.frombytes``), without loops over samples: assigning a numpy array to a field of a
message checks it element by element, hundreds of times slower.
"""

from __future__ import annotations

import array
import math
from collections.abc import Iterable
from dataclasses import fields, replace
from enum import Enum
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import ComplexArray
from tactile_resonance.frf.result import BandDistortion
from tactile_resonance.mechanics.indentation import BallTip, IndentationRecord, Protocol
from tactile_resonance.multisine import Excitation, Grid
from tactile_resonance.poles.result import STATUS_CODE, Poles, PolesStatus
from tactile_resonance.poles.structure import ModelStructure, PoleBand
from tactile_resonance.record import (
    BetweenSamples,
    Channel,
    Contact,
    ForceSpread,
    InputKind,
    Origin,
    Record,
)
from tactile_resonance.recording.recording import MAX_RATE_HZ, MIN_RATE_HZ

# The constants of the messages.
GRIDS = {Grid.CUSTOM: 0, Grid.FULL: 1, Grid.ODD: 2, Grid.ODD_RANDOM: 3}
INPUT_KINDS = {InputKind.MEASURED: 0, InputKind.COMMANDED: 1}
BETWEEN_SAMPLES = {BetweenSamples.BAND_LIMITED: 0, BetweenSamples.ZERO_ORDER_HOLD: 1}
POLES_STATUS = {**STATUS_CODE, PolesStatus.TRUTH: 100}


def plain(kind: type) -> tuple[str, ...]:
    """Fields of a dataclass that are numbers or texts: message and object name them alike."""
    return tuple(each.name for each in fields(kind) if each.type in ("int", "float", "bool", "str"))


ORIGIN = ("measurement_id", "excitation_id", "final", "label", "simulated")
EXCITATION = (*plain(Excitation), "harmonics", "amplitude_v", "phase_rad")
POLES = (
    *("lines", "cost", "expected_cost", "condition_number", "method", "message"),
    *("f0_hz", "damping_ratio"),
)
POLES_DRIFTS = ("f0_drift_hz_per_s", "damping_drift_per_s")
POLES_COVARIANCES = ("covariance", "total_covariance", "drift_covariance")
RECORD, SPREAD = plain(Record), plain(ForceSpread)
E = TypeVar("E", bound=Enum)
M = TypeVar("M")
Plain = TypeVar("Plain", PoleBand, BandDistortion)


def excitation_from_message(message: Any) -> Excitation:
    """Excitation of a message.

    Raises
    ------
    ValueError
        If its fields contradict each other.
    """
    values = _values(message, EXCITATION)
    values["harmonics"] = values["harmonics"].astype(np.int64)
    grid = key_of(GRIDS, message.grid, "grid")
    return Excitation(**values, grid=grid, bands=each_from_message(PoleBand, message.bands))


def each_from_message(kind: type[Plain], messages: Iterable[Any]) -> tuple[Plain, ...]:
    """Objects of numbers and texts, such as the bands in which poles are wanted, of their messages."""
    return tuple(kind(**_values(message, plain(kind))) for message in messages)


def record_from_message(message: Any) -> Record:
    """Record of a message; its samples are views of the message's memory."""
    if not MIN_RATE_HZ <= message.sample_rate_hz <= MAX_RATE_HZ:
        raise ValueError(
            f"sample_rate_hz: {message.sample_rate_hz:g}, expected {MIN_RATE_HZ:g} to {MAX_RATE_HZ:g} Hz"
        )
    return Record(
        actuator=_channel(message, "actuator"),
        sensor=_channel(message, "sensor"),
        **_values(message, RECORD),
        input_kind=key_of(INPUT_KINDS, message.input_kind, "input_kind"),
        between_samples=key_of(BETWEEN_SAMPLES, message.between_samples, "between_samples"),
        origin=origin_from_message(message),
    )


def _channel(message: Any, name: str) -> Channel:
    counts = array_of(getattr(message, f"{name}_counts"))
    volts = array_of(getattr(message, f"{name}_v"))
    if (counts.size > 0) == (volts.size > 0):
        raise ValueError(
            f"{name}: {counts.size} counts and {volts.size} voltages, expected one of the two"
        )
    saturated = getattr(message, f"{name}_saturated")
    if not counts.size:
        return Channel(volts, saturated=saturated)
    scale_v, offset_v = getattr(message, f"{name}_scale_v"), getattr(message, f"{name}_offset_v")
    return Channel(counts, scale_v, offset_v, saturated)


def poles_from_message(message: Any) -> tuple[Poles, Origin]:
    """Poles of a message, and what they belong to; the fitted model itself does not travel."""
    # one within a result of an earlier version has no such field
    further = tuple(_poles_of_band(band) for band in getattr(message, "further", ()))
    return replace(_poles_of_band(message), further=further), origin_from_message(message)


def _poles_of_band(message: Any) -> Poles:
    """Of a message of ``Poles`` those of its first band, or of ``BandPoles``."""
    poles_rad_s = complex_of(message, "", "_rad_s")
    optionals: dict[str, Any] = {name: optional(getattr(message, name)) for name in POLES_DRIFTS}
    for name in POLES_COVARIANCES:
        covariance, shape = optional(getattr(message, name)), (poles_rad_s.size, 2, 2)
        optionals[name] = None if covariance is None else covariance.reshape(shape)
    structure = ModelStructure()
    if message.order:
        structure = ModelStructure(message.order, message.numerator_order)
    return Poles(
        poles_rad_s=poles_rad_s,
        residues=complex_of(message, "residue_"),
        **optionals,
        **_values(message, POLES),
        instant_s=None if math.isnan(message.instant_s) else message.instant_s,
        structure=structure,
        band_hz=(message.band_low_hz, message.band_high_hz),
        status=key_of(POLES_STATUS, message.status, "status"),
    )


def origin_from_message(message: Any) -> Origin:
    """What a record, FRF or poles belong to."""
    contact = contact_from_message(
        message.tip_pose, message.contact_force_n, message.contact_force_std_n
    )
    return Origin(
        **_values(message, ORIGIN),
        time_ns=time_from_message(message.header.stamp),
        frame_id=message.header.frame_id,
        contact=replace(
            contact,
            spread=spread_from_message(message, "contact_force_"),
            # of records alone
            coverage=getattr(message, "contact_coverage", math.nan),
            reason=getattr(message, "contact_reason", ""),
        ),
    )


def contact_from_message(message: Any, force_n: float, force_std_n: float) -> Contact:
    """Contact of a tip pose and a force."""
    if not message.header.frame_id:
        return Contact(force_n, force_std_n)
    point, turn = message.pose.position, message.pose.orientation
    return Contact(
        force_n,
        force_std_n,
        (point.x, point.y, point.z),
        (turn.x, turn.y, turn.z, turn.w),
        message.header.frame_id,
        time_from_message(message.header.stamp),
    )


def spread_from_message(message: Any, prefix: str) -> ForceSpread:
    """How a force moved, of a message whose fields begin with `prefix`."""
    return ForceSpread(*(getattr(message, prefix + name) for name in SPREAD))


PROTOCOLS = {Protocol.RELAXATION: 1, Protocol.CREEP: 2, Protocol.INDENTATION: 3}
"""Constants of ``msg/Indentation``."""
INDENTATION = ("time_s", "force_n", "depth_m", "force_std_n", "simulated")


def indentation_from_message(message: Any, label: str = "") -> IndentationRecord:
    """Record of a mechanical test.

    Raises
    ------
    ValueError
        If its protocol is unknown, or it holds too few samples, or some that are not finite.
    """
    stiffness = message.beam_stiffness_n_per_m
    return IndentationRecord(
        protocol=key_of(PROTOCOLS, message.protocol, "protocol"),
        **_values(message, INDENTATION),
        ball=BallTip(message.tip_radius_m, stiffness_n_per_m=stiffness or math.inf),
        label=label,
        source=message.force_source,
    )


def write_indentation(message: Any, test: IndentationRecord) -> None:
    """Write a record into a message."""
    message.protocol = PROTOCOLS[test.protocol]
    write_values(message, INDENTATION, test)
    stiffness = test.ball.stiffness_n_per_m
    message.beam_stiffness_n_per_m = stiffness if math.isfinite(stiffness) else 0.0
    message.tip_radius_m = test.ball.radius_m
    message.force_source = test.source


def time_from_message(stamp: Any) -> int:
    """Stamp as UNIX time [ns]."""
    return stamp.sec * 10**9 + stamp.nanosec


def write_header(header: Any, time_ns: int, frame_id: str) -> None:
    """Write UNIX time [ns] and frame."""
    header.stamp.sec, header.stamp.nanosec = divmod(time_ns, 10**9)
    header.frame_id = frame_id


def array_of(values: Any) -> npt.NDArray:
    """Array of a message as numpy sees it, without a copy."""
    if isinstance(values, array.array):
        return np.frombuffer(values, dtype=values.typecode)
    return np.asarray(values)


def optional(values: Any) -> npt.NDArray | None:
    """Array of a message; None where it is empty."""
    return array_of(values) if len(values) else None


def complex_of(message: Any, prefix: str, suffix: str = "") -> ComplexArray:
    """Array whose parts are the fields ``real`` and ``imag`` between a prefix and a suffix."""
    real = array_of(getattr(message, f"{prefix}real{suffix}"))
    return real + 1j * array_of(getattr(message, f"{prefix}imag{suffix}"))


def fill(target: array.array, values: npt.ArrayLike) -> None:
    """Fill an array of a message that is empty."""
    whole = np.ascontiguousarray(values, dtype=target.typecode)
    target.frombytes(whole.ravel().view(np.uint8).data)


def fill_complex(message: Any, prefix: str, values: ComplexArray, suffix: str = "") -> None:
    """Fill the arrays of `complex_of`."""
    fill(getattr(message, f"{prefix}real{suffix}"), values.real)
    fill(getattr(message, f"{prefix}imag{suffix}"), values.imag)


def key_of(table: dict[E, int], value: int, name: str) -> E:
    """Member of an enumeration whose number is `value`; ValueError that lists the others."""
    for key, number in table.items():
        if number == value:
            return key
    raise ValueError(f"{name}: {value}, accepted are {sorted(table.values())}")


def _values(message: Any, names: Iterable[str]) -> dict[str, Any]:
    """Fields by name, arrays as numpy sees them."""
    values = {name: getattr(message, name) for name in names}
    return {
        name: array_of(value) if isinstance(value, array.array) else value
        for name, value in values.items()
    }


def write_values(message: M, names: Iterable[str], source: object, prefix: str = "") -> M:
    """Write what an object has under these names to the fields of the same names after a prefix; return it.

    Numbers of numpy become those of Python, which alone rclpy takes; where the object has None, an array stays
    empty and a number is NaN.
    """
    for name in names:
        value, target = getattr(source, name), getattr(message, prefix + name)
        if isinstance(target, (array.array, np.ndarray)):
            if value is None:
                continue
            if isinstance(target, array.array):
                fill(target, value)
            else:
                setattr(message, prefix + name, value)
        else:
            kind = type(target)
            setattr(message, prefix + name, kind(math.nan if value is None else value))
    return message
