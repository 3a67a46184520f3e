# SPDX-License-Identifier: Apache-2.0
"""Excitations, records and poles of messages, of ROS and of any reader of its recordings alike.

A message is whatever has the fields of ``msg/Excitation.msg`` and so on: arrays may be those of rclpy
(`array.array`) or of numpy.
"""

from __future__ import annotations

import array
import math
from dataclasses import replace
from enum import Enum
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from tactile_resonance.contact.force_spread import ForceSpread
from tactile_resonance.identification.result import Poles, PolesStatus
from tactile_resonance.identification.structure import ModelStructure
from tactile_resonance.multisine import Excitation, Grid
from tactile_resonance.record import BetweenSamples, Channel, Contact, InputKind, Origin, Record
from tactile_resonance.recording.recording import MAX_RATE_HZ, MIN_RATE_HZ

# The constants of the messages.
GRIDS = {Grid.CUSTOM: 0, Grid.FULL: 1, Grid.ODD: 2, Grid.ODD_RANDOM: 3}
INPUT_KINDS = {InputKind.MEASURED: 0, InputKind.COMMANDED: 1}
BETWEEN_SAMPLES = {BetweenSamples.BAND_LIMITED: 0, BetweenSamples.ZERO_ORDER_HOLD: 1}
POLES_STATUS = {
    PolesStatus.OK: 0,
    PolesStatus.MODEL_ERROR: 1,
    PolesStatus.NOT_CONVERGED: 2,
    PolesStatus.TOO_FEW_LINES: 3,
    PolesStatus.ILL_CONDITIONED: 4,
    PolesStatus.UNSTABLE_POLE: 5,
    PolesStatus.NO_COVARIANCE: 6,
    PolesStatus.NO_RESONANCE: 7,
    PolesStatus.FAILED: 8,
    PolesStatus.TRUTH: 100,
}
SPREAD = ("rms_n", "min_n", "max_n")  # of a contact's force

E = TypeVar("E", bound=Enum)


def excitation_from_message(message: Any) -> Excitation:
    """Excitation of a message.

    Raises
    ------
    ValueError
        If its fields contradict each other.
    """
    return Excitation(
        harmonics=array_of(message.harmonics),
        amplitude_v=array_of(message.amplitude_v),
        phase_rad=array_of(message.phase_rad),
        sample_rate_hz=message.sample_rate_hz,
        samples_per_period=message.samples_per_period,
        periods=message.periods,
        realisation=message.realisation,
        realisations=message.realisations,
        grid=key_of(GRIDS, message.grid, "grid"),
        seed=message.seed,
        random_phases=message.random_phases,
        measurement_id=message.measurement_id,
        excitation_id=message.excitation_id,
        label=message.label,
    )


def record_from_message(message: Any) -> Record:
    """Record of a message; its samples are views of the message's memory."""
    if not MIN_RATE_HZ <= message.sample_rate_hz <= MAX_RATE_HZ:
        raise ValueError(
            f"sample_rate_hz: {message.sample_rate_hz:g}, expected {MIN_RATE_HZ:g} to {MAX_RATE_HZ:g} Hz"
        )
    channels = []
    for name in ("actuator", "sensor"):
        counts = array_of(getattr(message, f"{name}_counts"))
        volts = array_of(getattr(message, f"{name}_v"))
        if (counts.size > 0) == (volts.size > 0):
            raise ValueError(
                f"{name}: {counts.size} counts and {volts.size} voltages, expected one of the two"
            )
        saturated = getattr(message, f"{name}_saturated")
        if counts.size:
            scale_v = getattr(message, f"{name}_scale_v")
            offset_v = getattr(message, f"{name}_offset_v")
            channels.append(Channel(counts, scale_v, offset_v, saturated))
        else:
            channels.append(Channel(volts, saturated=saturated))
    return Record(
        actuator=channels[0],
        sensor=channels[1],
        sample_rate_hz=message.sample_rate_hz,
        samples_per_period=message.samples_per_period,
        realisation=message.realisation,
        block_index=message.block_index,
        input_kind=key_of(INPUT_KINDS, message.input_kind, "input_kind"),
        between_samples=key_of(BETWEEN_SAMPLES, message.between_samples, "between_samples"),
        channel_delay_s=message.channel_delay_s,
        anti_alias_filter=message.anti_alias_filter,
        origin=origin_from_message(message),
    )


def poles_from_message(message: Any) -> tuple[Poles, Origin]:
    """Poles of a message, and what they belong to; the fitted model itself does not travel."""
    real = array_of(message.real_rad_s)
    n = real.size

    def blocks(values: Any) -> npt.NDArray[np.float64] | None:
        return array_of(values).reshape(n, 2, 2) if len(values) else None

    def known(values: Any) -> npt.NDArray[np.float64] | None:
        return array_of(values) if len(values) else None

    structure = ModelStructure()
    if message.order:
        structure = ModelStructure(message.order, message.numerator_order)
    poles = Poles(
        poles_rad_s=real + 1j * array_of(message.imag_rad_s),
        f0_hz=array_of(message.f0_hz),
        damping_ratio=array_of(message.damping_ratio),
        residues=array_of(message.residue_real) + 1j * array_of(message.residue_imag),
        covariance=blocks(message.covariance),
        total_covariance=blocks(message.total_covariance),
        f0_drift_hz_per_s=known(message.f0_drift_hz_per_s),
        damping_drift_per_s=known(message.damping_drift_per_s),
        drift_covariance=blocks(message.drift_covariance),
        instant_s=None if math.isnan(message.instant_s) else message.instant_s,
        structure=structure,
        band_hz=(message.band_low_hz, message.band_high_hz),
        lines=message.lines,
        cost=message.cost,
        expected_cost=message.expected_cost,
        condition_number=message.condition_number,
        method=message.method,
        status=key_of(POLES_STATUS, message.status, "status"),
        message=message.message,
    )
    return poles, origin_from_message(message)


def time_from_message(stamp: Any) -> int:
    """Stamp as UNIX time [ns]."""
    return stamp.sec * 10**9 + stamp.nanosec


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


def origin_from_message(message: Any) -> Origin:
    """What a record, FRF or poles belong to."""
    return Origin(
        measurement_id=message.measurement_id,
        excitation_id=message.excitation_id,
        time_ns=time_from_message(message.header.stamp),
        final=message.final,
        frame_id=message.header.frame_id,
        label=message.label,
        simulated=message.simulated,
        contact=replace(
            contact_from_message(
                message.tip_pose, message.contact_force_n, message.contact_force_std_n
            ),
            spread=spread_from_message(message, "contact_force_"),
            # of records alone
            coverage=getattr(message, "contact_coverage", float("nan")),
            reason=getattr(message, "contact_reason", ""),
        ),
    )


def array_of(values: Any) -> npt.NDArray:
    """Array of a message as numpy sees it, without a copy."""
    if isinstance(values, array.array):
        return np.frombuffer(values, dtype=values.typecode)
    return np.asarray(values)


def key_of(table: dict[E, int], value: int, name: str) -> E:
    """Member of an enumeration whose number is `value`; ValueError that lists the others."""
    for key, number in table.items():
        if number == value:
            return key
    raise ValueError(f"{name}: {value}, accepted are {sorted(table.values())}")
