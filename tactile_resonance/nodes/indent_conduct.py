# SPDX-License-Identifier: Apache-2.0
"""One goal of the action `indent`: what it asks of the controller, and its result with the record."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable

from tactile_resonance.action import Indent
from tactile_resonance.contact.goal import Aim, ContactGoal, HoldMode
from tactile_resonance.contact.interfaces import ForceInfo
from tactile_resonance.contact.loop import IndentationRecorder
from tactile_resonance.contact.result import Cause, ContactResult
from tactile_resonance.fields import check_not_negative
from tactile_resonance.mechanics.indentation import BallTip, Protocol
from tactile_resonance.nodes.messages import time_message, touch_of
from tactile_resonance.recording.messages import PROTOCOLS, key_of, write_indentation


class IndentConduct:
    """A mechanical test under way.

    Parameters
    ----------
    request : Indent.Goal
    base_frame : str
    ball : BallTip
        With what holds it.
    force : ForceInfo
        Of the force source.
    simulated : bool

    Attributes
    ----------
    goal : ContactGoal
        For the controller.
    recorder : IndentationRecorder
        To be given every cycle.

    Raises
    ------
    ValueError
        If the request is wrong.
    """

    def __init__(
        self,
        request: Indent.Goal,
        base_frame: str,
        ball: BallTip,
        force: ForceInfo,
        *,
        simulated: bool,
    ) -> None:
        self._request, self._base_frame = request, base_frame
        protocol = key_of(PROTOCOLS, request.protocol, "protocol")
        check_not_negative(request, "hold_s", "press_speed_m_s", "unload_speed_m_s")
        if protocol is Protocol.INDENTATION and not request.unload_speed_m_s:
            raise ValueError("unload_speed_m_s: 0, accepted with INDENTATION is a speed above 0")
        hold = HoldMode.FORCE if protocol is Protocol.CREEP else HoldMode.INDENTATION
        self.goal = ContactGoal(
            touch_of(request, base_frame, ball.radius_m),
            Aim(request.force_n, hold),
            press_speed_m_s=request.press_speed_m_s or math.inf,
            hold_s=request.hold_s,
            unload_speed_m_s=request.unload_speed_m_s,
        )
        self.recorder = IndentationRecorder(
            self.goal, protocol, ball, force.name, simulated=simulated
        )

    def result(self, outcome: ContactResult, ros_ns: Callable[[int], int]) -> Indent.Result:
        """What became of it; nothing that was recorded is lost where it was not done.

        Parameters
        ----------
        outcome : ContactResult
        ros_ns : callable
            From a time of the loop's clock [ns] to ROS time [ns].
        """
        done = outcome.reached and outcome.cause is Cause.HOLD_ENDED
        cause = Cause.NONE if done else outcome.cause
        result = Indent.Result(done=done, cause=cause.value, message=outcome.message)
        record = result.record
        with contextlib.suppress(ValueError):  # the tissue was not touched
            write_indentation(record, self.recorder.record(outcome))
            record.header.stamp = time_message(ros_ns(self.recorder.begun_ns))
        record.header.frame_id = self._base_frame
        record.pose, record.hold_s = self._request.pose.pose, self._request.hold_s
        moved_n, std_m = outcome.zero_change_n, outcome.surface_std_m
        record.zero_moved_n = math.nan if moved_n is None else moved_n
        record.depth_std_m = math.nan if std_m is None else std_m
        return result
