# SPDX-License-Identifier: Apache-2.0
"""One goal of the action `indent`: what it asks of the controller, and its result with the record."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable

from tactile_resonance.action import Indent
from tactile_resonance.contact.indentation_record import IndentationRecorder
from tactile_resonance.contact.interfaces import ForceInfo
from tactile_resonance.contact.result import ContactResult
from tactile_resonance.mechanics.indentation import BallTip
from tactile_resonance.nodes.messages import indent_goal, indent_result, time_message
from tactile_resonance.recording.messages import write_indentation


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
        self.goal, protocol = indent_goal(request, base_frame, ball.radius_m)
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
        result = indent_result(outcome)
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
