# SPDX-License-Identifier: Apache-2.0
"""Whether a contact may begin at all: a goal against limits, a force source against the force asked for."""

from __future__ import annotations

import math

import numpy as np

from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.goal import ContactGoal
from tactile_resonance.contact.interfaces import ForceInfo
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.vectors import rotated
from tactile_resonance.fields import require

FORCE_SHARE = 2 / 3
"""Of the abort force that may be asked for."""


def check_goal(
    goal: ContactGoal,
    parameters: ContactParameters,
    limits: Limits,
    tip: TipGeometry | None = None,
) -> None:
    """Raise ``ValueError`` where a goal lies beyond the limits.

    Parameters
    ----------
    goal : ContactGoal
    parameters : ContactParameters
    limits : Limits
    tip : TipGeometry, optional
        Its housing must stay clear of the surface as deep as the limits allow, the tip as far off its
        orientation as they allow.
    """
    good = bool(np.isfinite(goal.touch.vector).all())
    require(good, "touch", goal.touch.vector.tolist(), "six finite numbers")
    most = FORCE_SHARE * limits.abort_force_n
    good = goal.aim.force_n <= most * (1 + 1e-9)  # two thirds are no round number
    require(good, "force_n", goal.aim.force_n, f"up to {most:g}, two thirds of abort_force_n")
    if math.isfinite(goal.hold_s):
        slow, fastest = goal.unload_speed_m_s, parameters.retract_speed_m_s
        unload_s = limits.depth_m / slow if slow > 0 else 0.0
        most = limits.hold_s - unload_s
        accepted = f"up to {most:g}, limits.hold_s less {unload_s:g} s to draw back"
        require(0 <= goal.hold_s <= most, "hold_s", goal.hold_s, accepted)
        accepted = f"up to {fastest:g}, retract_speed_m_s"
        require(0 <= slow <= fastest, "unload_speed_m_s", slow, accepted)
    box, normal = limits.workspace, np.array(rotated(goal.touch.turn, (0.0, 0.0, 1.0)))
    for name, height in (
        ("standoff", parameters.standoff_m),
        ("deepest place", -parameters.search_m - limits.depth_m),
    ):
        place = goal.touch.position_m + height * normal
        if (place < box.low_m).any() or (place > box.high_m).any():
            ends = f"{box.low_m} to {box.high_m}"
            raise ValueError(f"touch: its {name} {place} lies outside the workspace {ends}")
    if normal[2] < math.cos(limits.tilt_rad):
        raise ValueError(f"touch: tilted by more than tilt_rad = {limits.tilt_rad}")
    if tip is not None:
        height = tip.worst_height(limits.depth_m, limits.misalignment_rad)
        if height < limits.clearance_m:
            raise ValueError(
                f"depth_m: at {1e3 * limits.depth_m:g} mm, the tip off by misalignment_rad = "
                f"{limits.misalignment_rad:g}, the housing is {1e3 * height:.2f} mm above the surface; "
                f"accepted is clearance_m = {1e3 * limits.clearance_m:g} mm or more: less depth, or a "
                "larger beam_tilt_rad"
            )


REFERENCE_RATE_HZ = 500.0
"""The control loop's. White noise of another rate is compared by its density."""
NOISE_SHARE = 0.10
"""Noise of one sample at the reference rate, per force asked for: 1 mN rms at 1 cN."""
RESOLUTION_SHARE = 0.03
"""Smallest step, per force asked for: 0.3 mN at 1 cN."""
SLOWEST_HZ = 200.0
"""Two samples within the 10 ms after which force data are too old."""
RANGE_FACTOR = 5.0
"""Range, per force asked for: the hard stop of contact control must be measurable."""


def require_fit(info: ForceInfo, force_n: float) -> None:
    """Refuse a source that cannot serve a force.

    The limits are those with which the contact controller was simulated: with three times the noise the
    95 % quantile of its overshoot goes from 10 to 33 % (docs/force_sensors.md).

    Parameters
    ----------
    info : ForceInfo
    force_n : float
        Contact force asked for [N].

    Raises
    ------
    ValueError
        With every reason and its figures.
    """
    if not 0 < force_n < float("inf"):
        raise ValueError(f"force_n: {force_n!r}, expected a force above 0")
    noise_n = info.noise_rms_n * (REFERENCE_RATE_HZ / info.rate_hz) ** 0.5
    most_noise_n, most_step_n = NOISE_SHARE * force_n, RESOLUTION_SHARE * force_n
    slack = 1 + 1e-9
    judged = (
        (
            noise_n <= most_noise_n * slack,
            f"its noise is {noise_n * 1e3:.3g} mN rms (at {REFERENCE_RATE_HZ:g} Hz), at most "
            f"{most_noise_n * 1e3:.3g} mN serve",
        ),
        (
            info.resolution_n <= most_step_n * slack,
            f"its smallest step is {info.resolution_n * 1e3:.3g} mN, at most "
            f"{most_step_n * 1e3:.3g} mN serve",
        ),
        (
            info.rate_hz >= SLOWEST_HZ,
            f"it gives {info.rate_hz:g} Hz, at least {SLOWEST_HZ:g} Hz serve",
        ),
        (
            info.range_n >= RANGE_FACTOR * force_n,
            f"its range is {info.range_n * 1e3:.4g} mN, at least "
            f"{RANGE_FACTOR * force_n * 1e3:.3g} mN serve",
        ),
    )
    reasons = "; ".join(text for good, text in judged if not good)
    if reasons:
        raise ValueError(f"force source {info.name} cannot control {force_n * 1e3:.3g} mN: {reasons}")
