# SPDX-License-Identifier: Apache-2.0
"""How well the link to a robot serves: what it is, its states' rate and gaps, their age and clock."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass

import numpy as np

from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.drivers.ur_arm import UrArm
from tactile_resonance.drivers.ur_config import UrArmConfig

POLL_S = 0.0005


@dataclass(frozen=True)
class RobotIdentity:
    """Answers of the dashboard server: texts of the robot."""

    model: str
    version: str
    robot_mode: str
    safety_status: str
    remote_control: bool


@dataclass(frozen=True)
class LinkReport:
    """States received over a time without motion.

    Attributes
    ----------
    duration_s : float
        By the robot's clock.
    rate_hz : float
        Of states that were seen.
    missed : int
        States skipped, by the robot's time stamps.
    longest_gap_s : float
        Between the time stamps of two states seen one after the other.
    age_median_s, age_p99_s, age_max_s : float
        Of the newest state whenever it was asked for.
    stale : int
        How often it was older than the configuration accepts.
    clock_uncertainty_s : float
    """

    duration_s: float
    rate_hz: float
    missed: int
    longest_gap_s: float
    age_median_s: float
    age_p99_s: float
    age_max_s: float
    stale: int
    clock_uncertainty_s: float


def identify(host: str) -> RobotIdentity:
    """Ask the dashboard server. Raises `ArmError` LINK_LOST where it does not answer."""
    import dashboard_client

    client = dashboard_client.DashboardClient(host)
    try:
        client.connect()
        return RobotIdentity(
            model=client.getRobotModel(),
            version=client.polyscopeVersion(),
            robot_mode=client.robotmode(),
            safety_status=client.safetystatus(),
            remote_control=client.isInRemoteControl(),
        )
    except RuntimeError as error:
        raise ArmError(
            ArmFault.LINK_LOST, f"dashboard of {host} does not answer: {error}"
        ) from error
    finally:
        with contextlib.suppress(RuntimeError):
            client.disconnect()


def watch(config: UrArmConfig, seconds: float) -> LinkReport:
    """Connect with the control program, move nothing, and watch the states.

    Raises
    ------
    ArmError
        Where connecting fails or the link is lost; stale states are counted instead.
    """
    arm = UrArm(config)
    stamps: list[float] = []
    ages: list[float] = []
    stale = 0
    try:
        arm.connect()
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            try:
                sample = arm.state()
            except ArmError as error:
                if error.fault is not ArmFault.STALE:
                    raise
                stale += 1
                time.sleep(POLL_S)
                continue
            ages.append((arm.clock.now_ns() - sample.time_ns) * 1e-9)
            if not stamps or sample.robot_time_s != stamps[-1]:
                stamps.append(sample.robot_time_s)
            time.sleep(POLL_S)
        uncertainty_s = arm.clock_uncertainty_s
    finally:
        arm.close()
    if len(stamps) < 2:
        raise ArmError(ArmFault.STALE, f"{config.host}: no fresh states in {seconds:g} s")
    gaps = np.diff(stamps)
    duration_s = stamps[-1] - stamps[0]
    return LinkReport(
        duration_s=duration_s,
        rate_hz=len(gaps) / duration_s,
        missed=round(duration_s * config.rate_hz) - len(gaps),
        longest_gap_s=float(gaps.max()),
        age_median_s=float(np.median(ages)),
        age_p99_s=float(np.quantile(ages, 0.99)),
        age_max_s=float(max(ages)),
        stale=stale,
        clock_uncertainty_s=uncertainty_s,
    )
