# SPDX-License-Identifier: Apache-2.0
"""Scans and calibrations for a node of your own: asked for and followed without spinning or blocking."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from geometry_msgs.msg import Point, Pose, PoseArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from tactile_resonance.action import CalibrateTable, Scan
from tactile_resonance.msg import PointResult
from tactile_resonance.nodes.goal_conduct import AskedGoal, Ending, GoalConduct
from tactile_resonance.nodes.goals import GoalClient
from tactile_resonance.nodes.running import RESULTS


@dataclass(frozen=True)
class ScanOutcome:
    """How a scan ended; ``action/Scan.action`` gives unit and meaning of each field.

    Attributes
    ----------
    ending : Ending
    message : str
        Why, in a sentence.
    done, failed, skipped : int or None
        None where scan_node went away: the run has them.
    """

    ending: Ending
    message: str
    run_directory: str = ""
    points: int = 0
    done: int | None = 0
    failed: int | None = 0
    skipped: int | None = 0
    blocks: int = 0
    blocks_saved: int = 0
    saved_s: float = 0.0
    repeats: int = 0
    sensor_drifted: bool = False
    sensor_health: str = ""


@dataclass(frozen=True)
class CalibrationOutcome:
    """How a calibration ended; ``action/CalibrateTable.action`` gives unit and meaning of each field.

    Attributes
    ----------
    ending : Ending
    message : str
        Why, in a sentence; of a table that was found correction and residuals.
    """

    ending: Ending
    message: str
    table_in_base: Sequence[float] = (math.nan,) * 6
    height_m: float = math.nan
    tilt_x_rad: float = math.nan
    tilt_y_rad: float = math.nan
    covariance: Sequence[float] = (math.nan,) * 9
    residuals_m: Sequence[float] = ()
    std_m: Sequence[float] = ()
    reduced_chi_square: float = math.nan
    file: str = ""


_SCAN = {
    Scan.Result.COMPLETE: Ending.COMPLETE,
    Scan.Result.ENDED: Ending.ENDED,
    Scan.Result.REFUSED: Ending.REFUSED,
}
_CALIBRATION = {
    CalibrateTable.Result.DONE: Ending.COMPLETE,
    CalibrateTable.Result.FAILED: Ending.ENDED,
    CalibrateTable.Result.REFUSED: Ending.REFUSED,
}


class TactileClient:
    """Client of scan_node; futures and callbacks, one at a time, come in the executor that spins the node.

    Futures may also be awaited in coroutines of that executor.

    Parameters
    ----------
    node : Node
        Of the caller, who spins it.
    namespace : str
        Of scan_node; empty: that of the node.
    """

    def __init__(self, node: Node, namespace: str = "") -> None:
        self._node = node
        prefix = f"{namespace.rstrip('/')}/" if namespace else ""
        # of its own: a callback of the caller that awaits would keep all others of its group waiting
        group = MutuallyExclusiveCallbackGroup()
        self._scans = GoalClient(node, Scan, f"{prefix}scan", callback_group=group)
        name = f"{prefix}calibrate_table"
        self._calibrations = GoalClient(node, CalibrateTable, name, callback_group=group)
        self._services = {
            name: node.create_client(Trigger, f"{prefix}scan/{name}", callback_group=group)
            for name in ("pause", "resume", "skip_point", "repeat_point", "rejection")
        }
        self._points = node.create_subscription(
            PointResult, f"{prefix}point_result", self._on_point, RESULTS, callback_group=group
        )
        self._conduct = GoalConduct(node, group, partial(self._call, "rejection"))

    def scan(
        self,
        *,
        scene: str | Path = "",
        poses: Sequence[Pose] = (),
        frame: str = "",
        force_n: float = 0.0,
        f0_std_hz: float = 0.0,
        damping_ratio_std: float = 0.0,
        run_directory: str | Path = "",
        resume: bool = False,
        seed: int = 0,
        notes: str = "",
        on_feedback: Callable[[Scan.Feedback], None] | None = None,
        on_point: Callable[[PointResult], None] | None = None,
        wait_s: float = 60.0,
    ) -> Future:
        """Ask for a scan of a scene, or of poses.

        Parameters
        ----------
        scene, force_n, f0_std_hz, damping_ratio_std, run_directory, resume, seed, notes
            Fields of the goal (``action/Scan.action``); paths are those of scan_node's machine.
        poses : sequence of Pose
            Points on the surface: +z out of the tissue, +x from clamp to tip.
        frame : str
            Of the poses: scan_node's ``table_frame`` or ``base_frame``; where tf2 is installed, any frame
            that it connects with them.
        on_feedback, on_point : callable
            Called with each feedback and with each finished attempt at a point.
        wait_s : float
            How long an active scan_node is waited for [s].

        Returns
        -------
        Future
            Its result is a `ScanOutcome`, whatever happens.

        Raises
        ------
        RuntimeError
            If a goal of this client is under way.
        ValueError
            If a value is not of the type or in the range of its field.
        """
        header = _checked(Header, frame_id=frame)
        goal = _checked(
            Scan.Goal,
            scene=str(scene),
            poses=_checked(PoseArray, header=header, poses=list(poses)),
            force_n=float(force_n),
            f0_std_hz=float(f0_std_hz),
            damping_ratio_std=float(damping_ratio_std),
            run_directory=str(run_directory),
            resume=resume,
            seed=seed,
            notes=notes,
        )
        client, kind = self._scans, ScanOutcome
        return self._conduct.begin(
            AskedGoal(client, kind, _SCAN, goal, wait_s, on_feedback, on_point)
        )

    def calibrate_table(
        self,
        points: Sequence[Point],
        *,
        force_n: float = 0.0,
        search_m: float = 0.0,
        flatness_m: float = 0.0,
        most_tilt_rad: float = 0.0,
        heading_rad: float = 0.0,
        sensor: str = "",
        file: str | Path = "",
        on_feedback: Callable[[CalibrateTable.Feedback], None] | None = None,
        wait_s: float = 60.0,
    ) -> Future:
        """Ask for the table's place in the base, found by touch, for the next start of the nodes.

        Parameters
        ----------
        points, force_n, search_m, flatness_m, most_tilt_rad, heading_rad, sensor, file
            Fields of the goal (``action/CalibrateTable.action``).
        on_feedback : callable
            Called with each feedback.
        wait_s : float
            How long an active scan_node is waited for [s].

        Returns
        -------
        Future
            Its result is a `CalibrationOutcome`, whatever happens.

        Raises
        ------
        RuntimeError, ValueError
            As `scan`.
        """
        goal = _checked(
            CalibrateTable.Goal,
            points=list(points),
            force_n=float(force_n),
            search_m=float(search_m),
            flatness_m=float(flatness_m),
            most_tilt_rad=float(most_tilt_rad),
            heading_rad=float(heading_rad),
            sensor=sensor,
            file=str(file),
        )
        client, kind = self._calibrations, CalibrationOutcome
        return self._conduct.begin(AskedGoal(client, kind, _CALIBRATION, goal, wait_s, on_feedback))

    def cancel(self) -> None:
        """End the scan or calibration after drawing the tip back; its future is done when that is."""
        self._conduct.cancel()

    def pause(self) -> Future:
        """Wait with the tip free once the point under way is finished; as all below, a `Trigger.Response`."""
        return self._call("pause")

    def resume(self) -> Future:
        """Go on after a pause."""
        return self._call("resume")

    def skip(self) -> Future:
        """Leave the point under way for good; between two points the next."""
        return self._call("skip_point")

    def repeat(self) -> Future:
        """Repeat the point under way; between two points the last."""
        return self._call("repeat_point")

    def destroy(self) -> None:
        """Take everything off the node again; a scan under way goes on, and is followed no longer."""
        self._conduct.destroy()
        self._node.destroy_subscription(self._points)
        for service in self._services.values():
            self._node.destroy_client(service)
        self._scans.destroy()
        self._calibrations.destroy()

    # in the executor

    def _call(self, name: str) -> Future:
        service = self._services[name]
        if service.service_is_ready():
            return service.call_async(Trigger.Request())
        answer = Future()
        answer.set_result(Trigger.Response(success=False, message="no scan_node is there"))
        return answer

    def _on_point(self, message: PointResult) -> None:
        asked = self._conduct.asked
        if asked is not None and asked.on_point is not None:
            asked.on_point(message)


def _checked(kind: type, **values: Any) -> Any:
    """Message with its fields checked: unchecked, a value of a wrong type ends the process that sends it."""
    try:
        return kind(check_fields=True, **values)
    except AssertionError as error:
        raise ValueError(f"goal: {error}") from error
