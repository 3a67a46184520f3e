# SPDX-License-Identifier: Apache-2.0
"""Between core objects and messages, in one place and without loops over samples.

Arrays are filled in place (``array.frombytes``) and read as views of the message's memory
(``numpy.frombuffer``): assigning a numpy array to a message field checks it element by element, hundreds of
times slower.
"""

from __future__ import annotations

import array
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped

from tactile_resonance import msg, srv
from tactile_resonance.frf.band_bins import BandBins
from tactile_resonance.frf.result import FRF, FrfStatus
from tactile_resonance.identification.result import Poles
from tactile_resonance.multisine import Excitation
from tactile_resonance.record import Contact, Origin, Record
from tactile_resonance.recording.from_messages import (
    BETWEEN_SAMPLES,
    GRIDS,
    INPUT_KINDS,
    POLES_STATUS,
    SPREAD,
    array_of,
    contact_from_message,  # noqa: F401 - for those who convert both ways
    excitation_from_message,  # noqa: F401 - for those who convert both ways
    key_of,
    origin_from_message,
    poles_from_message,  # noqa: F401 - for those who convert both ways
    record_from_message,  # noqa: F401 - for those who convert both ways
    time_from_message,  # noqa: F401 - for those who convert both ways
)

if TYPE_CHECKING:  # most nodes convert no truths: they need not load the simulation
    from tactile_resonance.simulation.truth import Truth

FRF_STATUS = {status: getattr(msg.FRF, f"STATUS_{status.name}") for status in FrfStatus}

COVARIANCE_ARRAYS = ("sensor_variance", "actuator_variance", "covariance_real", "covariance_imag")
FRF_ARRAYS = (
    *("real", "imag", "variance_noise", "variance_total"),
    *("sensor_real", "sensor_imag", "actuator_real", "actuator_imag"),
    *COVARIANCE_ARRAYS,
)


def excitation_to_message(excitation: Excitation, time_ns: int, frame_id: str) -> msg.Excitation:
    """Message of an excitation designed at `time_ns`."""
    message = msg.Excitation(
        measurement_id=excitation.measurement_id,
        excitation_id=excitation.excitation_id,
        realisation=excitation.realisation,
        realisations=excitation.realisations,
        periods=excitation.periods,
        grid=GRIDS[excitation.grid],
        seed=excitation.seed,
        sample_rate_hz=excitation.sample_rate_hz,
        samples_per_period=excitation.samples_per_period,
        level_v=excitation.level_v,
        random_phases=excitation.random_phases,
        label=excitation.label,
    )
    message.header.stamp = time_message(time_ns)
    message.header.frame_id = frame_id
    _fill(message.harmonics, excitation.harmonics, np.uint32)
    _fill(message.amplitude_v, excitation.amplitude_v, float)
    _fill(message.phase_rad, excitation.phase_rad, float)
    return message


def record_to_message(record: Record) -> msg.Record:
    """Message of a record."""
    message = msg.Record(
        realisation=record.realisation,
        block_index=record.block_index,
        sample_rate_hz=record.sample_rate_hz,
        samples_per_period=record.samples_per_period,
        actuator_saturated=record.actuator.saturated,
        sensor_saturated=record.sensor.saturated,
        input_kind=INPUT_KINDS[record.input_kind],
        between_samples=BETWEEN_SAMPLES[record.between_samples],
        channel_delay_s=record.channel_delay_s,
        anti_alias_filter=record.anti_alias_filter,
    )
    for name, channel in (("actuator", record.actuator), ("sensor", record.sensor)):
        if channel.is_counts:
            _fill(getattr(message, f"{name}_counts"), channel.samples, np.int32)
            setattr(message, f"{name}_scale_v", channel.scale_v)
            setattr(message, f"{name}_offset_v", channel.offset_v)
        else:
            _fill(getattr(message, f"{name}_v"), channel.samples, float)
    _write_origin(message, record.origin)
    message.contact_coverage = float(record.origin.contact.coverage)
    message.contact_reason = record.origin.contact.reason
    return message


def frf_to_message(frf: FRF, origin: Origin, level_v: float, saturated: bool) -> msg.FRF:
    """Message of an FRF with (F,) arrays."""
    message = msg.FRF(
        noise_dof=frf.noise_dof,
        total_dof=frf.total_dof,
        periods=frf.periods,
        realisations=frf.realisations,
        method=frf.method,
        level_v=level_v,
        saturated=saturated,
        status=FRF_STATUS[frf.status],
        message=frf.message,
    )
    _write_origin(message, origin)
    _fill(message.frequency_hz, frf.frequency_hz, float)
    _fill_complex(message, "", frf.g)
    for name in ("variance_noise", "variance_total"):
        variance = getattr(frf, name)
        if variance is not None:
            _fill(getattr(message, name), variance, float)
    if frf.spectra is not None:
        _fill_complex(message, "sensor_", frf.spectra[0])
        _fill_complex(message, "actuator_", frf.spectra[1])
    if frf.spectra_covariance is not None:
        _fill(message.sensor_variance, frf.spectra_covariance[0, 0].real, float)
        _fill(message.actuator_variance, frf.spectra_covariance[1, 1].real, float)
        _fill_complex(message, "covariance_", frf.spectra_covariance[0, 1])
    if frf.bins is not None:
        _write_bins(message, frf.bins)
    return message


def frf_from_message(message: msg.FRF) -> tuple[FRF, Origin]:
    """FRF of a message, and what it belongs to."""
    lines = len(message.frequency_hz)
    for name in FRF_ARRAYS:
        values = getattr(message, name)
        if len(values) != lines and (len(values) or name in ("real", "imag")):
            raise ValueError(f"{name}: {len(values)} values for {lines} lines, expected as many")
    groups = (("sensor_real", "sensor_imag", "actuator_real", "actuator_imag"), COVARIANCE_ARRAYS)
    for names in groups:
        if len({len(getattr(message, name)) for name in names}) > 1:
            raise ValueError(f"{', '.join(names)}: some empty, expected all or none")
    spectra = covariance = None
    if len(message.sensor_real):
        spectra = np.stack([_complex(message, "sensor_"), _complex(message, "actuator_")])
    if len(message.sensor_variance):
        cross = _complex(message, "covariance_")
        covariance = np.array(
            [
                [array_of(message.sensor_variance), cross],
                [cross.conj(), array_of(message.actuator_variance)],
            ]
        )
    frf = FRF(
        frequency_hz=array_of(message.frequency_hz),
        g=_complex(message, ""),
        variance_noise=_optional(message.variance_noise),
        variance_total=_optional(message.variance_total),
        noise_dof=message.noise_dof,
        total_dof=message.total_dof,
        spectra=spectra,
        spectra_covariance=covariance,
        bins=_bins(message),
        periods=message.periods,
        realisations=message.realisations,
        method=message.method,
        status=key_of(FRF_STATUS, message.status, "status"),
        message=message.message,
    )
    return frf, origin_from_message(message)


def poles_to_message(poles: Poles, origin: Origin) -> msg.Poles:
    """Message of poles."""
    message = msg.Poles(
        order=poles.structure.order,
        numerator_order=poles.structure.numerator_order,
        band_low_hz=float(poles.band_hz[0]),
        band_high_hz=float(poles.band_hz[1]),
        lines=poles.lines,
        cost=float(poles.cost),
        expected_cost=float(poles.expected_cost),
        condition_number=float(poles.condition_number),
        instant_s=float("nan") if poles.instant_s is None else poles.instant_s,
        method=poles.method,
        status=POLES_STATUS[poles.status],
        message=poles.message,
    )
    _write_origin(message, origin)
    _fill(message.real_rad_s, poles.poles_rad_s.real, float)
    _fill(message.imag_rad_s, poles.poles_rad_s.imag, float)
    _fill(message.f0_hz, poles.f0_hz, float)
    _fill(message.damping_ratio, poles.damping_ratio, float)
    _fill(message.residue_real, poles.residues.real, float)
    _fill(message.residue_imag, poles.residues.imag, float)
    drifts = ("f0_drift_hz_per_s", "damping_drift_per_s", "drift_covariance")
    for name in ("covariance", "total_covariance", *drifts):
        known = getattr(poles, name)
        if known is not None:
            _fill(getattr(message, name), known, float)
    return message


def truth_to_response(truth: Truth, response: srv.Truth.Response) -> None:
    """Fill the answer of the simulated bench."""
    response.success = True
    response.feedthrough = truth.feedthrough
    if truth.tissue is not None:
        response.tissue = truth.tissue.name
        response.force_n = truth.force_n
        response.contact_radius_m = truth.contact_radius_m
        response.indentation_m = truth.indentation_m
        response.relaxation_modulus_1s_pa = truth.tissue.relaxation_modulus_1s_pa
    _fill(response.pole_real_rad_s, truth.poles_rad_s.real, float)
    _fill(response.pole_imag_rad_s, truth.poles_rad_s.imag, float)
    _fill(response.residue_real_rad_s, truth.residues_rad_s.real, float)
    _fill(response.residue_imag_rad_s, truth.residues_rad_s.imag, float)
    _fill(response.f0_hz, np.array([mode.f0_hz for mode in truth.modes]), float)
    _fill(response.damping_ratio, np.array([mode.damping_ratio for mode in truth.modes]), float)
    _fill_complex(response, "response_", truth.response)
    if truth.contact_stiffness_n_per_m is not None:
        stiffness = truth.contact_stiffness_n_per_m
        _fill(response.stiffness_real_n_per_m, stiffness.real, float)
        _fill(response.stiffness_imag_n_per_m, stiffness.imag, float)


def time_message(time_ns: int) -> Time:
    """UNIX time as a stamp."""
    return Time(sec=time_ns // 10**9, nanosec=time_ns % 10**9)


def pose_to_message(contact: Contact) -> PoseStamped:
    """Tip pose; an empty frame where the position is unknown."""
    message = PoseStamped()
    if contact.position_m is None:
        return message
    message.header.stamp = time_message(contact.time_ns)
    message.header.frame_id = contact.frame_id
    point, turn = message.pose.position, message.pose.orientation
    point.x, point.y, point.z = contact.position_m
    turn.x, turn.y, turn.z, turn.w = contact.orientation_xyzw
    return message


def _write_bins(message: msg.FRF, bins: BandBins) -> None:
    _fill_complex(message, "bins_actuator_", bins.u)
    _fill_complex(message, "bins_sensor_", bins.y)
    _fill(message.bins_harmonics, bins.harmonics, np.uint32)
    message.bins_first = bins.first_bin
    message.bins_sample_rate_hz = bins.sample_rate_hz
    message.bins_samples_per_period = bins.samples_per_period
    message.bins_periods = bins.periods


def _bins(message: msg.FRF) -> BandBins | None:
    """Those of the realisations one after the other."""
    names = [f"bins_{c}_{part}" for c in ("actuator", "sensor") for part in ("real", "imag")]
    sizes = {len(getattr(message, name)) for name in names}
    if sizes == {0}:
        return None
    if len(sizes) > 1:
        raise ValueError(f"{', '.join(names)}: sizes {sorted(sizes)}, expected as many of each")
    records = max(1, message.realisations)
    if max(sizes) % records:
        raise ValueError(
            f"{names[0]}: size {max(sizes)}, expected as many of each of {records} realisations"
        )
    return BandBins(
        message.bins_first,
        _complex(message, "bins_actuator_").reshape(records, -1),
        _complex(message, "bins_sensor_").reshape(records, -1),
        array_of(message.bins_harmonics).astype(np.int64),
        message.bins_sample_rate_hz,
        message.bins_samples_per_period,
        message.bins_periods,
    )


def _write_origin(message: msg.Record | msg.FRF | msg.Poles, origin: Origin) -> None:
    message.header.stamp = time_message(origin.time_ns)
    message.header.frame_id = origin.frame_id
    for name in ("measurement_id", "excitation_id", "final", "label", "simulated"):
        setattr(message, name, getattr(origin, name))
    message.tip_pose = pose_to_message(origin.contact)
    message.contact_force_n = float(origin.contact.force_n)
    message.contact_force_std_n = float(origin.contact.force_std_n)
    for name in SPREAD:
        setattr(message, f"contact_force_{name}", float(getattr(origin.contact.spread, name)))


def _fill(target: array.array, values: npt.NDArray, dtype: npt.DTypeLike) -> None:
    target.frombytes(np.ascontiguousarray(values, dtype).ravel().view(np.uint8))


def _fill_complex(message: object, prefix: str, values: npt.NDArray[np.complex128]) -> None:
    _fill(getattr(message, f"{prefix}real"), values.real, float)
    _fill(getattr(message, f"{prefix}imag"), values.imag, float)


def _optional(values: array.array) -> npt.NDArray[np.float64] | None:
    return array_of(values) if len(values) else None


def _complex(message: object, prefix: str) -> npt.NDArray[np.complex128]:
    real = array_of(getattr(message, f"{prefix}real"))
    return real + 1j * array_of(getattr(message, f"{prefix}imag"))
