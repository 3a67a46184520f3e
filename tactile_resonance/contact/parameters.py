# SPDX-License-Identifier: Apache-2.0
"""How a contact is made, and within which limits: read from ``config/contact.yaml``, checked."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

from tactile_resonance.configuration import share_path
from tactile_resonance.fields import (
    known_keys,
    numbers,
    read_dataclass,
    read_yaml,
    require,
    section,
)

REACTION_S = 0.03
"""From a touch until the arm stands: means of forces, cycles, dead time, lag and braking [s]."""

RANGES: dict[str, tuple[float, float]] = {
    "approach_speed_m_s": (1e-4, 5e-3),
    "press_speed_m_s": (1e-4, 5e-3),
    "told_speed_m_s": (1e-4, 5e-3),
    "unknown_speed_m_s": (1e-4, 5e-3),
    "known_radius_m": (0.0, 1.0),
    "travel_speed_m_s": (1e-3, 0.25),
    "retract_speed_m_s": (1e-3, 0.1),
    "acceleration_m_s2": (0.05, 2.0),
    "relief_acceleration_m_s2": (0.05, 2.0),
    "standoff_m": (5e-4, 0.05),
    "search_m": (0.0, 0.02),
    "early_m": (0.0, 0.02),
    "tare_s": (0.05, 5.0),
    "tare_std_n": (1e-6, 1.0),
    "tare_drift_n_per_s": (1e-6, 10.0),
    "tare_offset_n": (1e-3, 1000.0),
    "cell_noise_n": (1e-5, 1.0),
    "tolerance": (0.005, 0.5),
    "settle_s": (0.0, 2.0),
    "time_constant_s": (0.01, 1.0),
    "hold_time_constant_s": (0.02, 2.0),
    "caution": (0.0, 3.0),
    "beam_stiffness_n_per_m": (0.0, 1e5),
    "carried_kg": (0.0, 5.0),
    "cell_lag_s": (0.0, 0.05),
    "arm_dead_time_s": (0.0, 0.1),
    "arm_lag_s": (0.0, 0.2),
    "arm_vibration_m": (0.0, 1e-4),
    "period_s": (1e-3, 0.02),
}
"""Accepted range of each number of `ContactParameters`, ends included."""


@dataclass(frozen=True)
class ContactParameters:
    """How a contact is made.

    Attributes
    ----------
    approach_speed_m_s, press_speed_m_s : float
        Towards the surface before and after the touch [m/s].
    told_speed_m_s : float
        Towards it, at most, once another sensor has detected the touch and the force has not yet [m/s].
    unknown_speed_m_s, known_radius_m : float
        Towards it and after the touch, at least, where no contact has succeeded so near [m/s], [m]: what is
        touched may be bone (see `first_speed_m_s`).
    travel_speed_m_s, retract_speed_m_s : float
        To the standoff, and away from the tissue [m/s].
    acceleration_m_s2, relief_acceleration_m_s2 : float
        Limit of every motion but stops [m/s2]; and, where it is larger, of one in contact that takes
        force off the tissue.
    standoff_m : float
        Height above the expected surface where the approach begins [m].
    search_m, early_m : float
        How far below or above its place the surface may be found [m].
    tare_s, tare_std_n, tare_drift_n_per_s : float
        Length of the tare [s]; uncertainty [N] and drift [N/s] of the zero with which it is refused.
    tare_offset_n : float
        Largest zero of each axis [N]: bias of the cell, and weight on one under the sample; on the tool
        what is left once the payload is taken off. More is refused.
    cell_noise_n : float
        Of one force as the source states it, the shaking of a tool on it included [N rms]; with
        half as much again the tare is refused.
    tolerance : float
        Error of the force at which the contact is ready, as a share of the force.
    settle_s : float
        How long the force must have been within the tolerance [s].
    time_constant_s, hold_time_constant_s : float
        In which the rest of the way is gone, while pressing and while holding [s].
    caution : float
        Standard deviations of the estimated force by which pressing stays below the aim.
    beam_stiffness_n_per_m : float
        Of the beam between robot and ball [N/m]; 0 where the ball is held rigidly.
    carried_kg : float
        Mass beyond a tool-mounted cell, whose inertia it feels [kg]; 0 under the sample, or where
        the force source removes it.
    cell_lag_s : float
        By which the inertia that a tool-mounted cell shows is late on its time stamps [s].
    arm_dead_time_s, arm_lag_s, arm_vibration_m : float
        How the arm follows.
    period_s : float
        Of the control loop [s].
    """

    approach_speed_m_s: float = 4e-3
    press_speed_m_s: float = 5e-3
    told_speed_m_s: float = 1e-3
    unknown_speed_m_s: float = 3e-4
    known_radius_m: float = 0.01
    travel_speed_m_s: float = 0.05
    retract_speed_m_s: float = 0.02
    acceleration_m_s2: float = 0.5
    relief_acceleration_m_s2: float = 1.0
    standoff_m: float = 3e-3
    search_m: float = 2e-3
    early_m: float = 2e-3
    tare_s: float = 0.4
    tare_std_n: float = 3e-4
    tare_drift_n_per_s: float = 2e-3
    tare_offset_n: float = 2.5
    cell_noise_n: float = 1e-3
    tolerance: float = 0.05
    settle_s: float = 0.05
    time_constant_s: float = 0.03
    hold_time_constant_s: float = 0.08
    caution: float = 1.0
    beam_stiffness_n_per_m: float = 0.0
    carried_kg: float = 0.0
    cell_lag_s: float = 0.002
    arm_dead_time_s: float = 0.004
    arm_lag_s: float = 0.010
    arm_vibration_m: float = 3e-6
    period_s: float = 0.002

    def __post_init__(self) -> None:
        check_ranges(self, RANGES)
        low = self.early_m
        require(self.standoff_m > low, "standoff_m", self.standoff_m, f"above early_m = {low}")

    @property
    def beam_n_per_m(self) -> float:
        """Stiffness of the beam [N/m], infinite where there is none."""
        return self.beam_stiffness_n_per_m or math.inf

    def first_speed_m_s(self, abort_force_n: float) -> float:
        """Return the speed at which bone may be met where nothing is known of the tissue [m/s].

        While the tip goes on for `REACTION_S` a beam bends and limits the force to half of that at which the
        contact is given up; a tip without one meets the bone itself, at `unknown_speed_m_s`.
        """
        bends_m_s = abort_force_n / 2 / (self.beam_n_per_m * REACTION_S)
        return max(self.unknown_speed_m_s, bends_m_s)


@dataclass(frozen=True)
class Workspace:
    """Box for the tip in the base.

    Attributes
    ----------
    low_m, high_m : tuple of 3 floats
        Opposite corners of the box in which the tip may be, in the base [m].
    """

    low_m: tuple[float, ...] = (-1.0, -1.0, -0.2)
    high_m: tuple[float, ...] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        low, high = self.low_m, self.high_m
        good = len(low) == len(high) == 3 and all(a < b for a, b in zip(low, high, strict=True))
        require(good, "high_m", high, f"three coordinates above low_m = {low}")


LOST_SHARE = 0.2
"""Of the force asked for, below which a contact is lost: 2 mN at 1 cN."""

LIMIT_RANGES: dict[str, tuple[float, float]] = {
    "abort_force_n": (1e-3, 10.0),
    "hard_force_n": (1e-3, 20.0),
    "pull_force_n": (1e-3, 10.0),
    "lateral_force_n": (1e-3, 10.0),
    "force_rate_n_per_s": (0.01, 1000.0),
    "depth_m": (1e-5, 0.02),
    "lost_force_n": (0.0, 1.0),
    "lost_s": (0.01, 10.0),
    "near_m": (1e-3, 0.1),
    "near_speed_m_s": (1e-4, 0.02),
    "contact_speed_m_s": (1e-4, 0.02),
    "lateral_speed_m_s": (0.0, 0.02),
    "free_speed_m_s": (1e-3, 0.5),
    "angular_speed_rad_s": (0.0, 2.0),
    "tilt_rad": (1e-3, 1.6),
    "misalignment_rad": (1e-3, 0.5),
    "clearance_m": (0.0, 0.05),
    "force_age_s": (1e-3, 0.5),
    "arm_age_s": (1e-3, 0.5),
    "stuck_samples": (3, 1000),
    "travel_s": (0.1, 600.0),
    "approach_s": (0.1, 600.0),
    "press_s": (0.1, 60.0),
    "hold_s": (0.1, 3600.0),
    "retract_s": (0.1, 60.0),
    "stop_deceleration_m_s2": (0.1, 20.0),
}
"""Accepted range of each number of `Limits`, ends included."""

STRICTER_BELOW = frozenset(
    {
        *("abort_force_n", "hard_force_n", "pull_force_n", "lateral_force_n", "force_rate_n_per_s"),
        *("depth_m", "near_speed_m_s", "contact_speed_m_s", "lateral_speed_m_s", "free_speed_m_s"),
        *("angular_speed_rad_s", "tilt_rad", "misalignment_rad", "force_age_s", "arm_age_s"),
        *("stuck_samples", "search_m", "early_m", "unknown_speed_m_s", "known_radius_m"),
        *("tare_std_n", "tare_drift_n_per_s", "tare_offset_n"),
    }
)
STRICTER_ABOVE = frozenset({"near_m", "clearance_m"})
"""What protects the tissue, of either class: each admits more above its value, these two below it."""


@dataclass(frozen=True)
class Limits:
    """What must never be exceeded; they win over everything else.

    Attributes
    ----------
    abort_force_n, hard_force_n : float
        Force at which the contact is given up, and force that must never be reached [N].
    pull_force_n : float
        Force against the pressing direction at which it is given up [N]: a sensor with its sign
        flipped, or a tip that sticks.
    lateral_force_n : float
        Along the surface [N].
    force_rate_n_per_s : float
        Over 10 ms [N/s].
    depth_m : float
        Past the first touch [m].
    lost_force_n, lost_s : float
        Contact is lost where the mean force of that time is below that force; see `lost_below_n`.
    near_m : float
        Height above the expected surface below which the tip is near it [m].
    near_speed_m_s, contact_speed_m_s, lateral_speed_m_s, free_speed_m_s : float
        Speed near the surface, in contact, along the surface in contact, elsewhere [m/s].
    angular_speed_rad_s : float
        Of turns anywhere [rad/s].
    tilt_rad : float
        Between +z of the tip and the vertical [rad].
    misalignment_rad : float
        Between the tip and its goal while near the surface [rad].
    clearance_m : float
        Of the sensor's housing above the surface, at least [m].
    force_age_s, arm_age_s : float
        Age of the newest data [s].
    stuck_samples : int
        So many equal forces in a row are a stuck sensor.
    travel_s, approach_s, press_s, hold_s, retract_s : float
        Longest time in a state [s].
    stop_deceleration_m_s2 : float
        Of stops [m/s2].
    workspace : Workspace
    """

    abort_force_n: float = 0.03
    hard_force_n: float = 0.05
    pull_force_n: float = 0.008
    lateral_force_n: float = 0.015
    force_rate_n_per_s: float = 1.2
    depth_m: float = 3e-3
    lost_force_n: float = 2e-3
    lost_s: float = 0.05
    near_m: float = 5e-3
    near_speed_m_s: float = 5e-3
    contact_speed_m_s: float = 5e-3
    lateral_speed_m_s: float = 2e-3
    free_speed_m_s: float = 0.1
    angular_speed_rad_s: float = 0.3
    tilt_rad: float = 0.8
    misalignment_rad: float = 0.05
    clearance_m: float = 1e-4
    force_age_s: float = 0.010
    arm_age_s: float = 0.020
    stuck_samples: int = 10
    travel_s: float = 60.0
    approach_s: float = 20.0
    press_s: float = 10.0
    hold_s: float = 120.0
    retract_s: float = 10.0
    stop_deceleration_m_s2: float = 1.0
    workspace: Workspace = Workspace()

    def __post_init__(self) -> None:
        check_ranges(self, LIMIT_RANGES)
        least = self.abort_force_n
        require(self.hard_force_n > least, "hard_force_n", self.hard_force_n, f"above {least}")

    def lowered(self, abort_force_n: float | None, depth_m: float | None) -> Limits:
        """Return limits in which these two are lower, for one contact; None leaves one as it is.

        Raises
        ------
        ValueError
            If one would be raised.
        """
        for name, value in (("abort_force_n", abort_force_n), ("depth_m", depth_m)):
            limit = getattr(self, name)
            good = value is None or 0 < value <= limit
            require(good, name, value, f"above 0, at most the limit {limit:g}")
        return replace(
            self,
            abort_force_n=self.abort_force_n if abort_force_n is None else abort_force_n,
            depth_m=self.depth_m if depth_m is None else depth_m,
        )

    def lost_below_n(self, force_n: float) -> float:
        """Mean force [N] below which a contact that is to press with `force_n` is lost."""
        return min(self.lost_force_n, LOST_SHARE * force_n)

    def check(self, parameters: ContactParameters) -> None:
        """Raise ``ValueError`` where parameters ask for more than the limits allow."""
        for name, limit in (
            ("approach_speed_m_s", self.near_speed_m_s),
            ("press_speed_m_s", self.contact_speed_m_s),
            ("travel_speed_m_s", self.free_speed_m_s),
            ("retract_speed_m_s", self.free_speed_m_s),
        ):
            value = getattr(parameters, name)
            require(value <= limit, name, value, f"at most the limit {limit}")
        p = parameters
        way_m = p.standoff_m + p.search_m
        speed = min(p.approach_speed_m_s, p.first_speed_m_s(self.abort_force_n))
        least = way_m / speed
        need = f"{least:.3g} s or more for {1e3 * way_m:g} mm at {speed:.3g} m/s"
        require(self.approach_s >= least, "approach_s", self.approach_s, need)


def check_ranges(owner: object, ranges: dict[str, tuple[float, float]]) -> None:
    """Raise ``ValueError`` naming the first number of a dataclass that is out of its range."""
    for name, (low, high) in ranges.items():
        value = getattr(owner, name)
        require(low <= value <= high, name, value, f"{low:g} to {high:g}")


def read_contact(path: Path | None = None) -> tuple[ContactParameters, Limits]:
    """Read both; without a path, from ``config/contact.yaml``.

    Raises
    ------
    ValueError
        If the file cannot be read, or a field is unknown, out of range or beyond the limits.
    """
    path = share_path("config/contact.yaml") if path is None else Path(path)
    content, where = read_yaml(path), path.name
    known_keys(content, {"contact", "limits"}, where)
    parameters = read_dataclass(
        ContactParameters, section(content, "contact", where), f"{where}: contact"
    )
    entries = dict(section(content, "limits", where))
    box = entries.pop("workspace", None)
    limits = read_dataclass(Limits, entries, f"{where}: limits")
    if box is not None:
        at = f"{where}: limits.workspace"
        require(isinstance(box, dict), at, box, "a mapping of low_m and high_m")
        known_keys(box, {"low_m", "high_m"}, at)
        corners = [numbers(box.get(name), f"{at}.{name}", 3) for name in ("low_m", "high_m")]
        limits = replace(limits, workspace=Workspace(*corners))
    limits.check(parameters)
    return parameters, limits
