# SPDX-License-Identifier: Apache-2.0
"""How well the link to a robot serves: what it is, its states' rate and gaps, their age and clock."""

from __future__ import annotations

import contextlib
import time

import numpy as np

from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.drivers.ur_arm import UrArm
from tactile_resonance.drivers.ur_config import UrArmConfig

POLL_S = 0.0005


def identify(host: str) -> str:
    """What the dashboard server answers, in lines. Raises `ArmError` LINK_LOST where it does not."""
    import dashboard_client

    client = dashboard_client.DashboardClient(host)
    try:
        client.connect()
        return (
            f"{client.getRobotModel()}, PolyScope {client.polyscopeVersion()}; {client.robotmode()}; "
            f"{client.safetystatus()}\n"
            f"remote control: {'yes' if client.isInRemoteControl() else 'NO'}"
        )
    except RuntimeError as error:
        raise ArmError(
            ArmFault.LINK_LOST, f"dashboard of {host} does not answer: {error}"
        ) from error
    finally:
        with contextlib.suppress(RuntimeError):
            client.disconnect()


def watch(config: UrArmConfig, seconds: float) -> tuple[str, bool]:
    """Connect with the control program, move nothing, and watch the states.

    Returns
    -------
    lines : str
        Rate and gaps by the robot's time stamps, age of the newest state whenever it was asked for, and how
        well the robot's clock is known.
    fit : bool
        Whether no state was older than the configuration accepts.

    Raises
    ------
    ArmError
        Where connecting fails or the link is lost; stale states are counted instead.
    """
    arm = UrArm(config)
    stamps: list[float] = []
    counts: list[int] = []  # of all states until then: a look may find several
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
                counts.append(arm.received)
            time.sleep(POLL_S)
        uncertainty_s = arm.clock_uncertainty_s
    finally:
        arm.close()
    if len(stamps) < 2:
        raise ArmError(ArmFault.STALE, f"{config.host}: no fresh states in {seconds:g} s")
    duration_s, came = stamps[-1] - stamps[0], counts[-1] - counts[0]
    # of a look at most: all others that it found were a period apart
    gaps = np.diff(stamps) - (np.diff(counts) - 1) / config.rate_hz
    missed = round(duration_s * config.rate_hz) - came
    median_ms, most_ms, largest_ms = 1e3 * np.quantile(ages, [0.5, 0.99, 1.0])
    lines = (
        f"states: {came / duration_s:.1f} Hz over {duration_s:.1f} s, {missed} missed",
        f"longest gap: at most {gaps.max() * 1e3:.0f} ms",
        f"age: median {median_ms:.1f}, 99 % {most_ms:.1f}, largest {largest_ms:.1f} ms; limit "
        f"{config.max_state_age_s * 1e3:.0f} ms, beyond it {stale} times",
        f"clock of the robot: known to {uncertainty_s * 1e3:.2f} ms (1 sigma)",
    )
    return "\n".join(lines), stale == 0
