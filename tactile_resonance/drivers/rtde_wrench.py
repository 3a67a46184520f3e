# SPDX-License-Identifier: Apache-2.0
"""The robot's own force/torque sensor, as its state brings it."""

from __future__ import annotations

import math
from dataclasses import replace

from tactile_resonance.contact.cell_checks import CellChecks
from tactile_resonance.contact.interfaces import (
    ArmError,
    ForceError,
    ForceFault,
    ForceInfo,
    NodeArm,
)
from tactile_resonance.contact.samples import ArmSample, CellSample
from tactile_resonance.contact.vectors import rotated_back, turn_from_vector
from tactile_resonance.drivers.force_config import ForceConfig


class RtdeWrench:
    """Wrenches of the robot's sensor in the frame `tip` (a `contact.interfaces.Cell`).

    The controller has taken the payload off and moved the wrench to the tool centre point, which is the
    tip: so the mounting is the identity, and the payload is set at the robot.

    Parameters
    ----------
    config : ForceConfig
    arm : NodeArm
        Silence is judged on its clock.
    """

    def __init__(self, config: ForceConfig, arm: NodeArm) -> None:
        mounting = config.mounting
        if mounting.frame.vector.any() or mounting.payload is not None:
            raise ValueError("frame, payload: expected zeros and none, the controller knows both")
        self._config, self._arm, self._clock = config, arm, arm.clock
        self._checks = CellChecks(config.info, config.range_nm, config.limits)
        self._robot_time_s = -math.inf
        self._new_s = 0.0

    @property
    def info(self) -> ForceInfo:
        """What the sensor can do; the uncertainty of its clock is NaN while the arm is not connected."""
        try:
            std_s = self._arm.clock_uncertainty_s
        except ArmError:
            std_s = float("nan")
        return replace(self._config.info, clock_uncertainty_s=std_s)

    def start(self) -> None:
        """Begin anew; the arm is connected by its owner. Raises `ForceError`."""
        self._checks.restart()
        state = self._state()
        self._robot_time_s, self._new_s = state.robot_time_s, self._now_s()

    def read(self) -> list[CellSample]:
        """The newest wrench where there is a new one. Raises `ForceError`."""
        state = self._state()
        now_s = self._now_s()
        if state.robot_time_s == self._robot_time_s:
            if now_s - self._new_s > self._config.limits.silent_s:
                text = f"{self.info.name}: no new state for {(now_s - self._new_s) * 1e3:.0f} ms"
                raise ForceError(ForceFault.SILENT, text)
            return []
        self._robot_time_s, self._new_s = state.robot_time_s, now_s
        assert state.tool_wrench is not None
        turn, (x, y, z, tx, ty, tz) = turn_from_vector(state.rotation_rad), state.tool_wrench
        wrench = *rotated_back(turn, (x, y, z)), *rotated_back(turn, (tx, ty, tz))
        overload = self._checks.check(wrench)
        stamp_ns = state.time_ns - round(self._config.latency_s * 1e9)
        return [CellSample(stamp_ns, wrench, overload)]

    def close(self) -> None:
        """Nothing is to be let go: the arm belongs to someone else."""

    def _now_s(self) -> float:
        return self._clock.now_ns() * 1e-9

    def _state(self) -> ArmSample:
        try:
            state = self._arm.recent()
        except ArmError as error:
            raise ForceError(ForceFault.LINK_LOST, f"{self._config.info.name}: {error}") from error
        if state.tool_wrench is None:
            text = f"{self._config.info.name}: the arm brings no wrench"
            raise ForceError(ForceFault.REFUSED, text)
        return state
