# SPDX-License-Identifier: Apache-2.0
"""Between objects of the core and messages: the only place that converts them in nodes.

Beside it `recording.messages`, which needs no ROS, reads what is recorded, and `nodes.scan_actions` what only
scan_node takes and sends: the others do not load scans.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, WrenchStamped

from tactile_resonance import msg
from tactile_resonance.action import Indent, MakeContact
from tactile_resonance.contact.geometry import touch_pose
from tactile_resonance.contact.goal import ContactGoal, HoldMode, State
from tactile_resonance.contact.vectors import Vector, quaternion_from_vector, turn_from_quaternion
from tactile_resonance.frf.result import FRF, PER_LINE, BandBins, BandDistortion, FrfStatus
from tactile_resonance.multisine import Excitation
from tactile_resonance.poles.result import Poles
from tactile_resonance.poles.structure import PoleBand
from tactile_resonance.record import Contact, ForceSpread, Origin, Record
from tactile_resonance.recording.messages import (
    BETWEEN_SAMPLES,
    EXCITATION,
    GRIDS,
    INPUT_KINDS,
    ORIGIN,
    POLES,
    POLES_COVARIANCES,
    POLES_DRIFTS,
    POLES_STATUS,
    RECORD,
    SPREAD,
    array_of,
    complex_of,
    each_from_message,
    fill,
    fill_complex,
    key_of,
    optional,
    origin_from_message,
    plain,
    write_header,
    write_values,
)
from tactile_resonance.srv import ForceOver

if TYPE_CHECKING:  # nodes without contact control do not load it
    from tactile_resonance.contact.contact_filter import ContactEstimate
    from tactile_resonance.contact.goal import ContactResult
    from tactile_resonance.contact.loop import Cycle
    from tactile_resonance.contact.samples import Pose, WrenchSample

FRF_STATUS = {status: getattr(msg.FRF, f"STATUS_{status.name}") for status in FrfStatus}

# Fields of equal name in message and object.
FRF_EQUAL = plain(FRF)
FRF_OPTIONAL = tuple(name for name in PER_LINE if name not in ("frequency_hz", "g"))

_OF_RECORD_CONTACT = ("coverage", "reason")  # fields of a contact that records alone have
UNKNOWN_SPREAD = ForceSpread()
CONTACT_FIGURES = (
    *("force_n", "force_std_n", "depth_m", "stiffness_n_per_m", "surface_m", "surface_std_m"),
    *("contact_s", "total_s", "peak_force_n"),
)

NO_RECORDS = "record_folder: "
"""The message of a measurement that failed because records cannot be written begins so."""

M = TypeVar("M")
RosTime = Callable[[int], int]
"""From a time of the loop's clock [ns] to ROS time [ns]."""

HOLDS = {
    HoldMode.FORCE: MakeContact.Goal.HOLD_FORCE,
    HoldMode.INDENTATION: MakeContact.Goal.HOLD_INDENTATION,
}


def excitation_to_message(excitation: Excitation, time_ns: int, frame_id: str) -> msg.Excitation:
    """Message of an excitation designed at `time_ns`."""
    message = msg.Excitation(grid=GRIDS[excitation.grid], bands=each_to_message(msg.Band, excitation.bands))
    write_header(message.header, time_ns, frame_id)
    return write_values(message, (*EXCITATION, "level_v"), excitation)


def each_to_message(make: type[M], objects: Sequence[PoleBand | BandDistortion]) -> list[M]:
    """Messages of objects of numbers and texts, such as the bands in which poles are wanted."""
    return [write_values(make(), plain(type(each)), each) for each in objects]


def record_to_message(record: Record) -> msg.Record:
    """Message of a record."""
    message = msg.Record(
        input_kind=INPUT_KINDS[record.input_kind],
        between_samples=BETWEEN_SAMPLES[record.between_samples],
    )
    write_values(message, RECORD, record)
    for name, channel in (("actuator", record.actuator), ("sensor", record.sensor)):
        setattr(message, f"{name}_saturated", channel.saturated)
        if channel.is_counts:
            fill(getattr(message, f"{name}_counts"), channel.samples)
            write_values(message, ("scale_v", "offset_v"), channel, f"{name}_")
        else:
            fill(getattr(message, f"{name}_v"), channel.samples)
    _write_origin(message, record.origin)
    return write_values(message, _OF_RECORD_CONTACT, record.origin.contact, "contact_")


def write_record_contact(message: msg.Record, contact: Contact) -> None:
    """Write the contact over a record into its message, which has none yet."""
    _write_contact(message, contact)
    write_values(message, _OF_RECORD_CONTACT, contact, "contact_")


def poles_to_message(poles: Poles, origin: Origin) -> msg.Poles:
    """Message of poles."""
    further = [_write_band(msg.BandPoles(), each) for each in poles.further]
    message = _write_band(msg.Poles(further=further), poles)
    _write_origin(message, origin)
    return message


def _write_band(message: Any, poles: Poles) -> Any:
    message.order, message.numerator_order = poles.structure.order, poles.structure.numerator_order
    message.band_low_hz, message.band_high_hz = map(float, poles.band_hz)
    message.status = POLES_STATUS[poles.status]
    fill_complex(message, "", poles.poles_rad_s, "_rad_s")
    fill_complex(message, "residue_", poles.residues)
    return write_values(message, (*POLES, *POLES_DRIFTS, *POLES_COVARIANCES, "instant_s"), poles)


def _write_origin(message: msg.Record | msg.FRF | msg.Poles, origin: Origin) -> None:
    """What a record, FRF or poles belong to."""
    write_header(message.header, origin.time_ns, origin.frame_id)
    write_values(message, ORIGIN, origin)
    _write_contact(message, origin.contact)


def _write_contact(message: msg.Record | msg.FRF | msg.Poles, contact: Contact) -> None:
    _write_pose(message.tip_pose, contact)
    write_values(message, ("force_n", "force_std_n"), contact, "contact_")
    write_values(message, SPREAD, contact.spread, "contact_force_")


def time_message(time_ns: int) -> Time:
    """UNIX time as a stamp."""
    return Time(sec=time_ns // 10**9, nanosec=time_ns % 10**9)


def pose_to_message(contact: Contact) -> PoseStamped:
    """Tip pose; an empty frame where the position is unknown."""
    return _write_pose(PoseStamped(), contact)


def _write_pose(message: PoseStamped, contact: Contact) -> PoseStamped:
    if contact.position_m is None:
        return message
    write_header(message.header, contact.time_ns, contact.frame_id)
    point, turn = message.pose.position, message.pose.orientation
    point.x, point.y, point.z = contact.position_m
    turn.x, turn.y, turn.z, turn.w = contact.orientation_xyzw
    return message


def frf_to_message(frf: FRF, origin: Origin, level_v: float, saturated: bool) -> msg.FRF:
    """Message of an FRF with (F,) arrays."""
    message = msg.FRF(
        level_v=level_v,
        saturated=saturated,
        status=FRF_STATUS[frf.status],
        bands=each_to_message(msg.Band, frf.bands),
        distortion=each_to_message(msg.Distortion, frf.distortion),
    )
    _write_origin(message, origin)
    write_values(message, (*FRF_EQUAL, "frequency_hz", *FRF_OPTIONAL), frf)
    fill_complex(message, "", frf.g)
    if (first := frf.bins) is not None:
        for bins in (first, *frf.further_bins):
            fill_complex(message, "bins_actuator_", bins.u)
            fill_complex(message, "bins_sensor_", bins.y)
            fill(message.bins_harmonics, bins.harmonics)
        message.bins_first = first.first_bin
        fill(message.further_bins_first, [bins.first_bin for bins in frf.further_bins])
        fill(message.further_bins_count, [bins.count for bins in frf.further_bins])
        message.bins_sample_rate_hz = first.sample_rate_hz
        message.bins_samples_per_period = first.samples_per_period
        message.bins_periods = first.periods
    return message


def frf_from_message(message: msg.FRF) -> tuple[FRF, Origin]:
    """FRF of a message, and what it belongs to."""
    lines = len(message.frequency_hz)
    for name in ("real", "imag", *FRF_OPTIONAL):
        values = getattr(message, name)
        if len(values) != lines and (len(values) or name in ("real", "imag")):
            raise ValueError(f"{name}: {len(values)} values for {lines} lines, expected as many")
    bins = _bins(message)
    frf = FRF(
        frequency_hz=array_of(message.frequency_hz),
        g=complex_of(message, ""),
        **{name: optional(getattr(message, name)) for name in FRF_OPTIONAL},
        **{name: getattr(message, name) for name in FRF_EQUAL},
        bins=bins[0] if bins else None,
        further_bins=bins[1:],
        bands=each_from_message(PoleBand, message.bands),
        distortion=each_from_message(BandDistortion, message.distortion),
        status=key_of(FRF_STATUS, message.status, "status"),
    )
    return frf, origin_from_message(message)


def _bins(message: msg.FRF) -> tuple[BandBins, ...]:
    """Of each band; in it those of the realisations one after the other."""
    names = [f"bins_{c}_{part}" for c in ("actuator", "sensor") for part in ("real", "imag")]
    sizes = {len(getattr(message, name)) for name in names}
    if sizes == {0}:
        return ()
    if len(sizes) > 1:
        raise ValueError(f"{', '.join(names)}: sizes {sorted(sizes)}, expected as many of each")
    (size,), records = sizes, max(1, message.realisations)
    counts = np.array([0, *message.further_bins_count], np.int64)
    firsts = [message.bins_first, *message.further_bins_first]
    counts[0] = size // records - counts.sum()
    if size % records or counts[0] <= 0 or len(firsts) != counts.size:
        raise ValueError(
            f"{names[0]}: size {size}, expected as many of each of {records} realisations, in "
            f"{len(firsts)} bands, of which the further ones have {counts[1:].tolist()}"
        )
    ends = np.cumsum(counts)[:-1] * records
    u, y = (np.split(complex_of(message, f"bins_{c}_"), ends) for c in ("actuator", "sensor"))
    # a line where two bands touch came with both
    harmonics = np.array(sorted({*message.bins_harmonics}), np.int64)
    bins = harmonics * message.bins_periods
    return tuple(
        BandBins(
            first,
            u[k].reshape(records, -1),
            y[k].reshape(records, -1),
            harmonics[(bins >= first) & (bins < first + counts[k])],
            message.bins_sample_rate_hz,
            message.bins_samples_per_period,
            message.bins_periods,
        )
        for k, first in enumerate(firsts)
    )


def contact_goal(request: MakeContact.Goal, base_frame: str, ball_radius_m: float) -> ContactGoal:
    """What a request asks for.

    Raises
    ------
    ValueError
        If its frame is not that of the base, the way to hold is unknown, or orientation or normal is invalid.
    """
    hold = key_of(HOLDS, request.hold, "hold")
    touch = touch_of(request, base_frame, ball_radius_m)
    return ContactGoal(touch, request.force_n, hold, request.standoff_m or math.inf)


def touch_of(
    request: MakeContact.Goal | Indent.Goal, base_frame: str, ball_radius_m: float
) -> Pose:
    """Pose of the tip where the ball just touches the point that a request names."""
    frame = request.pose.header.frame_id
    if frame != base_frame:
        raise ValueError(f"pose: in frame {frame!r}, accepted is {base_frame!r}")
    point, turn = request.pose.pose.position, request.pose.pose.orientation
    quaternion = [turn.x, turn.y, turn.z, turn.w]
    if not 0.99 < math.hypot(*quaternion) < 1.01:
        raise ValueError(f"pose: orientation {quaternion}, expected a unit quaternion")
    axes = np.reshape(turn_from_quaternion(*quaternion), (3, 3))
    given = np.array([request.normal.x, request.normal.y, request.normal.z])
    normal = given if given.any() else axes[:, 2]
    return touch_pose([point.x, point.y, point.z], normal, axes[:, 0], ball_radius_m)


def contact_result(result: ContactResult) -> MakeContact.Result:
    """What became of a contact; NaN for what is not known."""
    message = MakeContact.Result(cause=result.cause.value)
    return write_values(message, ("reached", "message", *CONTACT_FIGURES), result)


def contact_feedback(
    kind: type[MakeContact] | type[Indent], state: str, estimate: ContactEstimate | None
) -> MakeContact.Feedback | Indent.Feedback:
    """How far a contact of an action is."""
    force_n, depth_m, _ = _known(estimate)
    return kind.Feedback(state=state, force_n=force_n, depth_m=depth_m)


def write_force_over(
    response: ForceOver.Response,
    reason: str = "",
    force_n: float = math.nan,
    force_std_n: float = math.nan,
    spread: ForceSpread = UNKNOWN_SPREAD,
) -> ForceOver.Response:
    """Write the force over an interval, or why it is not known."""
    response.reason, response.force_n, response.force_std_n = reason, force_n, force_std_n
    return write_values(response, SPREAD, spread, "force_")


def wrench_message(
    wrenches: Sequence[WrenchSample], cycle: Cycle, ros_ns: RosTime, frame_id: str
) -> WrenchStamped:
    """Mean of these at the middle of their times; of the force, not of the torque, the tare is taken off."""
    wrench = WrenchStamped()
    middle_ns = (wrenches[0].time_ns + wrenches[-1].time_ns) // 2
    write_header(wrench.header, ros_ns(middle_ns), frame_id)
    count, parts = len(wrenches), wrench.wrench
    x, y, z = (sum(values) / count for values in zip(*(w.force_n for w in wrenches), strict=True))
    bias_x, bias_y, bias_z = cycle.bias_n
    parts.force.x, parts.force.y, parts.force.z = x - bias_x, y - bias_y, z - bias_z
    parts.torque.x, parts.torque.y, parts.torque.z = (
        sum(values) / count for values in zip(*(w.torque_nm for w in wrenches), strict=True)
    )
    return wrench


def tip_pose(time_ns: int, frame_id: str, position_m: Vector, rotation_rad: Vector) -> PoseStamped:
    """Where the tip is: its place and rotation vector in a frame."""
    turn = quaternion_from_vector(rotation_rad)
    return pose_to_message(
        Contact(position_m=position_m, orientation_xyzw=turn, frame_id=frame_id, time_ns=time_ns)
    )


def contact_state(
    controller: State,
    time_ns: int,
    estimate: ContactEstimate | None,
    result: ContactResult | None,
    frame_id: str,
) -> msg.ContactState:
    """What the controller does and knows, without the loop's counts."""
    state = msg.ContactState(state=controller.value, tissue_moves_m=math.nan)
    write_header(state.header, time_ns, frame_id)
    state.force_n, state.depth_m, state.stiffness_n_per_m = _known(estimate)
    if result is not None:
        state.cause, state.message = result.cause.value, result.message
    moved_n = None if result is None else result.zero_change_n
    state.zero_moved_n = math.nan if moved_n is None else moved_n
    return state


def _known(estimate: ContactEstimate | None) -> tuple[float, float, float]:
    """Force, depth and stiffness; NaN where there is no contact."""
    if estimate is None:
        return math.nan, math.nan, math.nan
    return estimate.force_n, estimate.depth_m, estimate.stiffness_n_per_m
