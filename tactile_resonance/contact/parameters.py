# SPDX-License-Identifier: Apache-2.0
"""How a contact is made, within which limits, and what may be asked; read from ``config/contact.yaml``."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from tactile_resonance.configuration import share_path
from tactile_resonance.contact.goal import ContactGoal
from tactile_resonance.contact.vectors import rotated
from tactile_resonance.fields import build, read_file, require


def within(default: float, low: float, high: float, description: str) -> Any:
    """Field of a dataclass with a default, a range and a description, in SI units."""
    return field(default=default, metadata={"range": (low, high, description)})


def ranges_of(kind: Any) -> dict[str, tuple[float, float, str]]:
    """Range and description of each field that was made by `within`, of a dataclass or one of its objects."""
    return {each.name: each.metadata["range"] for each in fields(kind) if "range" in each.metadata}


def check_ranges(owner: Any) -> None:
    """Raise ``ValueError`` naming the first number of a dataclass that is out of its range."""
    for name, (low, high, _) in ranges_of(owner).items():
        value = getattr(owner, name)
        require(low <= value <= high, name, value, f"{low:g} to {high:g}")


EARLY_SHARE = 0.8
"""Of a standoff that a goal lowers, how far above its place the surface may be at most."""

REACTION_S = 0.03
"""From a touch until the arm stands: means of forces, cycles, dead time, lag and braking [s]."""


@dataclass(frozen=True)
class ContactParameters:
    """How a contact is made; each field states its range and its meaning."""

    approach_speed_m_s: float = within(
        4e-3, 1e-4, 5e-3, "Towards the surface before the touch [m/s]."
    )
    press_speed_m_s: float = within(5e-3, 1e-4, 5e-3, "Towards the surface after the touch [m/s].")
    told_speed_m_s: float = within(
        *(1e-3, 1e-4, 5e-3),
        "Towards it, at most, once another sensor has detected the touch and the force has not "
        "yet [m/s].",
    )
    unknown_speed_m_s: float = within(
        *(3e-4, 1e-4, 5e-3),
        "Towards it and after the touch, at least, where no contact has succeeded within "
        "known_radius_m [m/s]: what is touched may be bone.",
    )
    known_radius_m: float = within(
        0.01, 0.0, 1.0, "So near to a contact that has succeeded the tissue is known [m]."
    )
    travel_speed_m_s: float = within(0.05, 1e-3, 0.25, "To the standoff [m/s].")
    retract_speed_m_s: float = within(0.02, 1e-3, 0.1, "Away from the tissue [m/s].")
    acceleration_m_s2: float = within(0.5, 0.05, 2.0, "Limit of every motion but stops [m/s2].")
    relief_acceleration_m_s2: float = within(
        *(1.0, 0.05, 2.0),
        "Where it is larger, limit of a motion in contact that takes force off the tissue [m/s2].",
    )
    standoff_m: float = within(
        3e-3, 5e-4, 0.05, "Height above the expected surface where the approach begins [m]."
    )
    search_m: float = within(
        2e-3, 0.0, 0.02, "How far below its place the surface may be found [m]."
    )
    early_m: float = within(
        2e-3, 0.0, 0.02, "How far above its place the surface may be found [m]."
    )
    tare_s: float = within(0.4, 0.05, 5.0, "Length of the tare [s].")
    tare_std_n: float = within(
        3e-4, 1e-6, 1.0, "Uncertainty of the zero with which the tare is refused [N]."
    )
    tare_drift_n_per_s: float = within(
        2e-3, 1e-6, 10.0, "Drift of the zero with which the tare is refused [N/s]."
    )
    tare_offset_n: float = within(
        *(2.5, 1e-3, 1000.0),
        "Largest zero of each axis [N]: bias of the cell, and weight on one under the sample; "
        "on the tool what is left once the payload is taken off. More is refused.",
    )
    zero_std_n: float = within(
        *(1e-4, 0.0, 1.0),
        "With a cell under the sample: a zero that contacts before and the way to the standoff leave no "
        "more uncertain than this is used without a rest for the tare [N]; 0: the tip always rests.",
    )
    zero_walk_n_per_sqrt_s: float = within(
        *(5e-5, 0.0, 1.0), "By which the zero walks at random from contact to contact [N/sqrt(s)]."
    )
    cell_noise_n: float = within(
        *(1e-3, 1e-5, 1.0),
        "Of one force as the source states it, the shaking of a tool on it included [N rms]; "
        "with half as much again the tare is refused.",
    )
    tolerance: float = within(
        *(0.05, 0.005, 0.5),
        "Error of the force at which the contact is ready, as a share of the force.",
    )
    settle_s: float = within(
        0.05, 0.0, 2.0, "How long the force must have been within the tolerance [s]."
    )
    time_constant_s: float = within(
        0.03, 0.01, 1.0, "In which the rest of the way is gone while pressing [s]."
    )
    hold_time_constant_s: float = within(
        0.08, 0.02, 2.0, "In which the rest of the way is gone while holding [s]."
    )
    caution: float = within(
        *(1.0, 0.0, 3.0),
        "Standard deviations of the estimated force by which pressing stays below the aim.",
    )
    beam_stiffness_n_per_m: float = within(
        0.0, 0.0, 1e5, "Of the beam between robot and ball [N/m]; 0 where the ball is held rigidly."
    )
    carried_kg: float = within(
        *(0.0, 0.0, 5.0),
        "Mass beyond a tool-mounted cell, whose inertia it feels [kg]; none under the sample.",
    )
    cell_lag_s: float = within(
        *(0.002, 0.0, 0.05),
        "By which the inertia that a tool-mounted cell shows is late on its time stamps [s].",
    )
    arm_dead_time_s: float = within(
        0.004, 0.0, 0.1, "After a command the arm begins to follow [s]."
    )
    arm_lag_s: float = within(0.010, 0.0, 0.2, "Time constant with which the arm follows [s].")
    arm_vibration_m: float = within(3e-6, 0.0, 1e-4, "By which the arm shakes about its place [m].")
    period_s: float = within(0.002, 1e-3, 0.02, "Of the control loop [s].")

    def __post_init__(self) -> None:
        check_ranges(self)
        low = self.early_m
        require(self.standoff_m > low, "standoff_m", self.standoff_m, f"above early_m = {low}")

    def lowered(self, standoff_m: float, press_speed_m_s: float) -> ContactParameters:
        """Return these with no higher standoff and no faster way into the tissue.

        With a lower standoff the surface may be found as much less early.

        Raises
        ------
        ValueError
            If it is out of its range.
        """
        standoff_m = min(self.standoff_m, standoff_m)
        early_m = min(self.early_m, EARLY_SHARE * standoff_m)
        return replace(
            self,
            standoff_m=standoff_m,
            early_m=early_m,
            approach_speed_m_s=min(self.approach_speed_m_s, press_speed_m_s),
            press_speed_m_s=min(self.press_speed_m_s, press_speed_m_s),
        )

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

    low_m: tuple[float, float, float] = (-1.0, -1.0, -0.2)
    high_m: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        low, high = self.low_m, self.high_m
        good = len(low) == len(high) == 3 and all(a < b for a, b in zip(low, high, strict=True))
        require(good, "high_m", high, f"three coordinates above low_m = {low}")


LOST_SHARE = 0.2
"""Of the force asked for, below which a contact is lost: 2 mN at 1 cN."""

STRICTER_BELOW = frozenset(
    {
        *("abort_force_n", "hard_force_n", "pull_force_n", "lateral_force_n", "force_rate_n_per_s"),
        *("depth_m", "near_speed_m_s", "contact_speed_m_s", "lateral_speed_m_s", "free_speed_m_s"),
        *("angular_speed_rad_s", "tilt_rad", "misalignment_rad", "force_age_s", "arm_age_s"),
        *("stuck_samples", "search_m", "early_m", "unknown_speed_m_s", "known_radius_m"),
        *("tare_std_n", "tare_drift_n_per_s", "tare_offset_n", "cell_noise_n", "carried_kg"),
    }
)
STRICTER_ABOVE = frozenset({"near_m", "clearance_m"})
"""What protects the tissue, of either class: each admits more above its value, these two below it."""


@dataclass(frozen=True)
class Limits:
    """What must never be exceeded; they win over everything else. See `ContactParameters`."""

    abort_force_n: float = within(0.03, 1e-3, 10.0, "Force at which the contact is given up [N].")
    hard_force_n: float = within(0.05, 1e-3, 20.0, "Force that must never be reached [N].")
    pull_force_n: float = within(
        *(0.008, 1e-3, 10.0),
        "Force against the pressing direction, mean of three, at which the contact is given up [N]: "
        "a sensor with its sign flipped, or a tip that sticks.",
    )
    lateral_force_n: float = within(0.015, 1e-3, 10.0, "Along the surface [N].")
    force_rate_n_per_s: float = within(1.2, 0.01, 1000.0, "Over 10 ms [N/s].")
    depth_m: float = within(3e-3, 1e-5, 0.02, "Past the first touch [m].")
    lost_force_n: float = within(
        *(2e-3, 0.0, 1.0),
        "Contact is lost where the mean force over lost_s is below this [N]; of a small force "
        "asked for, below a fifth of it.",
    )
    lost_s: float = within(0.05, 0.01, 10.0, "Over which that mean is taken [s].")
    near_m: float = within(
        5e-3, 1e-3, 0.1, "Height above the expected surface below which the tip is near it [m]."
    )
    near_speed_m_s: float = within(5e-3, 1e-4, 0.02, "Speed near the surface [m/s].")
    contact_speed_m_s: float = within(5e-3, 1e-4, 0.02, "Speed in contact [m/s].")
    lateral_speed_m_s: float = within(2e-3, 0.0, 0.02, "Speed along the surface in contact [m/s].")
    free_speed_m_s: float = within(0.1, 1e-3, 0.5, "Speed elsewhere [m/s].")
    angular_speed_rad_s: float = within(0.3, 0.0, 2.0, "Of turns anywhere [rad/s].")
    tilt_rad: float = within(0.8, 1e-3, 1.6, "Between +z of the tip and that of the base [rad].")
    misalignment_rad: float = within(
        0.05, 1e-3, 0.5, "Between the tip and its goal, near the surface and in contact [rad]."
    )
    clearance_m: float = within(
        1e-4, 0.0, 0.05, "Of the sensor's housing above the surface, at least [m]."
    )
    force_age_s: float = within(0.010, 1e-3, 0.5, "Age of the newest force [s].")
    arm_age_s: float = within(0.020, 1e-3, 0.5, "Age of the newest state of the arm [s].")
    stuck_samples: int = within(10, 3, 1000, "So many equal forces in a row are a stuck sensor.")
    travel_s: float = within(60.0, 0.1, 600.0, "Longest time of the way to the standoff [s].")
    approach_s: float = within(20.0, 0.1, 600.0, "Longest time of an approach [s].")
    press_s: float = within(
        10.0, 0.1, 60.0, "Longest time from the touch until the force is held [s]."
    )
    hold_s: float = within(120.0, 0.1, 3600.0, "Longest time for which the force is held [s].")
    retract_s: float = within(10.0, 0.1, 60.0, "Longest time of the way back [s].")
    stop_deceleration_m_s2: float = within(1.0, 0.1, 20.0, "Of stops [m/s2].")
    workspace: Workspace = Workspace()

    def __post_init__(self) -> None:
        check_ranges(self)
        least = self.abort_force_n
        require(self.hard_force_n > least, "hard_force_n", self.hard_force_n, f"above {least}")

    def lowered(self, abort_force_n: float | None, depth_m: float | None) -> Limits:
        """Return limits in which these two are lower, for one contact; None leaves one as it is.

        Raises
        ------
        ValueError
            If one would be raised.
        """
        asked: dict[str, Any] = {"abort_force_n": abort_force_n, "depth_m": depth_m}
        lower = {name: value for name, value in asked.items() if value is not None}
        for name, value in lower.items():
            limit = getattr(self, name)
            require(0 < value <= limit, name, value, f"above 0, at most the limit {limit:g}")
        return replace(self, **lower)

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


FORCE_SHARE = 2 / 3
"""Of the abort force that may be asked for."""


def check_goal(goal: ContactGoal, parameters: ContactParameters, limits: Limits) -> None:
    """Raise ``ValueError`` where a goal lies beyond the limits."""
    good = bool(np.isfinite(goal.touch.vector).all())
    require(good, "touch", goal.touch.vector.tolist(), "six finite numbers")
    most = FORCE_SHARE * limits.abort_force_n
    good = goal.force_n <= most * (1 + 1e-9)  # two thirds are no round number
    require(good, "force_n", goal.force_n, f"up to {most:g}, two thirds of abort_force_n")
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


@dataclass(frozen=True)
class _ContactFile:
    contact: ContactParameters
    limits: Limits


def read_contact(path: Path | None = None) -> tuple[ContactParameters, Limits]:
    """Read both; without a path, from ``config/contact.yaml``.

    Raises
    ------
    ValueError
        If the file cannot be read, or a field is unknown, out of range or beyond the limits.
    """
    path = share_path("config/contact.yaml") if path is None else Path(path)
    both = read_file(_ContactFile, path)
    build(both.limits.check, f"{path.name}:", both.contact)
    return both.contact, both.limits
