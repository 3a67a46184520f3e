# SPDX-License-Identifier: Apache-2.0
"""Goals, results, wrenches and states of contact control, from and to messages."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped

from tactile_resonance import msg
from tactile_resonance.action import MakeContact
from tactile_resonance.contact.estimator import ContactEstimate
from tactile_resonance.contact.geometry import touch_pose
from tactile_resonance.contact.goal import ContactGoal
from tactile_resonance.contact.law import Aim, HoldMode
from tactile_resonance.contact.loop import Cycle
from tactile_resonance.contact.result import ContactResult
from tactile_resonance.contact.samples import ArmSample, WrenchSample
from tactile_resonance.contact.vectors import Vector, quaternion_from_vector, turn_from_quaternion
from tactile_resonance.nodes.conversions import time_message

RosTime = Callable[[int], int]
"""From a time of the loop's clock [ns] to ROS time [ns]."""

_HOLDS = {
    MakeContact.Goal.HOLD_FORCE: HoldMode.FORCE,
    MakeContact.Goal.HOLD_INDENTATION: HoldMode.INDENTATION,
}


def contact_goal(request: MakeContact.Goal, base_frame: str, ball_radius_m: float) -> ContactGoal:
    """What a request asks for.

    Raises
    ------
    ValueError
        If its frame is not that of the base, the way to hold is unknown, or orientation or normal is invalid.
    """
    frame = request.pose.header.frame_id
    if frame != base_frame:
        raise ValueError(f"pose: in frame {frame!r}, accepted is {base_frame!r}")
    if request.hold not in _HOLDS:
        raise ValueError(f"hold: {request.hold}, accepted are {sorted(_HOLDS)}")
    point, turn = request.pose.pose.position, request.pose.pose.orientation
    quaternion = [turn.x, turn.y, turn.z, turn.w]
    if not 0.99 < math.hypot(*quaternion) < 1.01:
        raise ValueError(f"pose: orientation {quaternion}, expected a unit quaternion")
    axes = np.reshape(turn_from_quaternion(*quaternion), (3, 3))
    given = np.array([request.normal.x, request.normal.y, request.normal.z])
    normal = given if given.any() else axes[:, 2]
    touch = touch_pose([point.x, point.y, point.z], normal, axes[:, 0], ball_radius_m)
    return ContactGoal(touch, Aim(request.force_n, _HOLDS[request.hold]))


def result_message(result: ContactResult) -> MakeContact.Result:
    """What became of a contact; NaN for what is not known."""
    message = MakeContact.Result(
        reached=result.reached, cause=result.cause.value, message=result.message
    )
    for name in (
        *("force_n", "force_std_n", "depth_m", "stiffness_n_per_m"),
        *("surface_m", "surface_std_m"),
        *("contact_s", "total_s", "peak_force_n"),
    ):
        value = getattr(result, name)
        setattr(message, name, math.nan if value is None else float(value))
    return message


def feedback_message(state: str, estimate: ContactEstimate | None) -> MakeContact.Feedback:
    """How far a contact is."""
    force_n, depth_m, _ = known(estimate)
    return MakeContact.Feedback(state=state, force_n=force_n, depth_m=depth_m)


def wrench_message(
    wrenches: Sequence[WrenchSample], cycle: Cycle, ros_ns: RosTime, frame_id: str
) -> WrenchStamped:
    """Mean of these, less the tare, at the middle of their times."""
    wrench = WrenchStamped()
    wrench.header.stamp = time_message(ros_ns((wrenches[0].time_ns + wrenches[-1].time_ns) // 2))
    wrench.header.frame_id = frame_id
    count, parts = len(wrenches), wrench.wrench
    x, y, z = (sum(values) / count for values in zip(*(w.force_n for w in wrenches), strict=True))
    bias_x, bias_y, bias_z = cycle.bias_n
    parts.force.x, parts.force.y, parts.force.z = x - bias_x, y - bias_y, z - bias_z
    parts.torque.x, parts.torque.y, parts.torque.z = (
        sum(values) / count for values in zip(*(w.torque_nm for w in wrenches), strict=True)
    )
    return wrench


def pose_message(arm: ArmSample, ros_ns: RosTime, base_frame: str) -> PoseStamped:
    """Where the tip is."""
    pose = PoseStamped()
    pose.header.stamp = time_message(ros_ns(arm.time_ns))
    pose.header.frame_id = base_frame
    place_tip(pose, arm.position_m, arm.rotation_rad)
    return pose


def place_tip(pose: PoseStamped, position_m: Vector, rotation_rad: Vector) -> None:
    """Write place and rotation vector of the tip into a pose."""
    place, turn = pose.pose.position, pose.pose.orientation
    place.x, place.y, place.z = position_m
    turn.x, turn.y, turn.z, turn.w = quaternion_from_vector(rotation_rad)


def state_message(
    cycle: Cycle,
    ros_ns: RosTime,
    estimate: ContactEstimate | None,
    result: ContactResult | None,
    frame_id: str,
) -> msg.ContactState:
    """What the controller does and knows, without the loop's counts."""
    state = msg.ContactState(state=cycle.state.value)
    state.header.stamp = time_message(ros_ns(cycle.time_ns))
    state.header.frame_id = frame_id
    state.force_n, state.depth_m, state.stiffness_n_per_m = known(estimate)
    if result is not None:
        state.cause, state.message = result.cause.value, result.message
    moved_n = None if result is None else result.zero_change_n
    state.zero_moved_n = math.nan if moved_n is None else moved_n
    return state


def known(estimate: ContactEstimate | None) -> tuple[float, float, float]:
    """Force, depth and stiffness; NaN where there is no contact."""
    if estimate is None:
        return math.nan, math.nan, math.nan
    return estimate.force_n, estimate.depth_m, estimate.stiffness_n_per_m
