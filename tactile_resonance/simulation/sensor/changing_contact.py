# SPDX-License-Identifier: Apache-2.0
"""A contact that changes while it is measured.

`ContactHistory`: by creep under a held force, or as depths are given over time (`indent`: a whole test).
`ContactSoFar`: part by part, as a plant reports it.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.fields import require
from tactile_resonance.sensor import SensorParameters
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.sensor.bimorph import CoupledBimorph, couple
from tactile_resonance.simulation.tissue.hertz import (
    HertzContact,
    HertzParameters,
    Tissue,
    contact_of_radius,
    hertz_contact,
)
from tactile_resonance.simulation.tissue.indenter import Indenter

AT_ONCE_S = 1e-9  # in which the first depth is reached: glassy, as no Prony term is that fast


@dataclass(frozen=True, eq=False)
class Indentation:
    """Time [s], depth [m], force [N] and contact radius [m] of a test, (T,) arrays each."""

    time_s: FloatArray
    depth_m: FloatArray
    force_n: FloatArray
    contact_radius_m: FloatArray


def indent(
    tissue: Tissue,
    time_s: ArrayLike,
    depth_m: ArrayLike,
    *,
    tip_radius_m: float,
    poisson_ratio: float,
    adhesion_j_per_m2: float = 0.0,
) -> Indentation:
    """Return what a rigid sphere feels on its way in, while it is held, and out again.

    Parameters
    ----------
    tissue : Tissue
        At rest before the first time, at which the first depth is put on at once.
    time_s : (T,) array
        Strictly ascending times [s].
    depth_m : (T,) array
        Depth of the lowest point below the undisturbed surface [m]; straight in between.
    tip_radius_m, poisson_ratio, adhesion_j_per_m2 : float
        As in `Indenter`.

    Raises
    ------
    ValueError
        If times do not ascend, or shapes differ.
    """
    time, depth = np.asarray(time_s, dtype=float), np.asarray(depth_m, dtype=float)
    shapes = time.ndim == 1 and time.size > 0 and depth.shape == time.shape
    require(shapes, "depth_m", depth.shape, f"the shape of time_s, {time.shape}, one axis")
    require(bool(np.all(np.diff(time) > 0)), "time_s", time, "strictly ascending times")
    require(bool(np.all(np.isfinite(depth))), "depth_m", depth, "finite numbers")
    tip = Indenter(
        tissue,
        tip_radius_m=tip_radius_m,
        poisson_ratio=poisson_ratio,
        adhesion_j_per_m2=adhesion_j_per_m2,
    )
    steps = np.diff(time, prepend=time[0] - 1.0)
    steps[0] = AT_ONCE_S
    rows = []
    for x, dt in zip(depth.tolist(), steps.tolist(), strict=True):
        force = tip.step(x, dt)
        rows.append((force, tip.contact_radius_m))
    force_n, radius_m = np.array(rows).T
    return Indentation(time, depth, force_n, radius_m)


@dataclass(frozen=True, eq=False)
class ContactHistory:
    """Contact radius, force and indentation over time, linear between the times given.

    A small vibration sees the contact radius alone: while a tip is held at one depth the force
    relaxes and the poles stay; while the force is held the contact grows and they move.

    Attributes
    ----------
    tissue : Tissue
    parameters : HertzParameters
    time_s : (T,) array
        Ascending [s]; before the first and after the last the contact stays as it is there.
    contact_radius_m : (T,) array
        Above 0 throughout.
    force_n, indentation_m : (T,) arrays
    """

    tissue: Tissue
    parameters: HertzParameters
    time_s: FloatArray
    contact_radius_m: FloatArray
    force_n: FloatArray
    indentation_m: FloatArray

    def __post_init__(self) -> None:
        time = self.time_s
        good = time.ndim == 1 and time.size > 0 and bool(np.all(np.diff(time) > 0))
        require(good, "time_s", time, "ascending times, one axis")
        for name in ("contact_radius_m", "force_n", "indentation_m"):
            values = getattr(self, name)
            good = values.shape == time.shape and bool(np.all(np.isfinite(values)))
            require(good, name, values, f"{time.size} finite numbers, one for each time")
        radius = self.contact_radius_m
        require(bool(np.all(radius > 0)), "contact_radius_m", radius.min(), "contact throughout")

    @classmethod
    def under_force(
        cls,
        tissue: Tissue,
        tip_radius_m: float,
        parameters: HertzParameters,
        *,
        force_n: float | None = None,
        since_s: float = 1.0,
        duration_s: float,
        steps: int = 200,
    ) -> ContactHistory:
        """Return the creep under a held force, from `since_s` after it was put on."""
        require(duration_s > 0, "duration_s", duration_s, "a number above 0")
        # evenly in the logarithm of the time held, as creep goes
        held = np.geomspace(since_s, since_s + duration_s, steps + 1)
        contacts = [
            hertz_contact(tissue, tip_radius_m, parameters, force_n=force_n, hold_time_s=float(t))
            for t in held
        ]
        return cls(
            tissue,
            parameters,
            held - since_s,
            np.array([c.contact_radius_m for c in contacts]),
            np.array([c.force_n for c in contacts]),
            np.array([c.indentation_m for c in contacts]),
        )

    @classmethod
    def of_depth(
        cls,
        tissue: Tissue,
        tip_radius_m: float,
        parameters: HertzParameters,
        time_s: ArrayLike,
        depth_m: ArrayLike,
        *,
        start_s: float = 0.0,
    ) -> ContactHistory:
        """Return the contact of a ball moved to given depths; what was before `start_s` is cut off.

        Times are counted from `start_s`, the first at or after it.
        """
        test = indent(
            tissue,
            time_s,
            depth_m,
            tip_radius_m=tip_radius_m,
            poisson_ratio=parameters.poisson_ratio,
        )
        time = test.time_s
        keep = time >= start_s
        require(bool(keep.any()), "start_s", start_s, f"up to {time[-1]:g}, the last time")
        return cls(
            tissue,
            parameters,
            time[keep] - time[keep][0],
            test.contact_radius_m[keep],
            test.force_n[keep],
            test.depth_m[keep],
        )

    def contact_at(self, time_s: float) -> HertzContact:
        """Return the contact at one time."""
        radius, force, depth = (
            float(np.interp(time_s, self.time_s, values))
            for values in (self.contact_radius_m, self.force_n, self.indentation_m)
        )
        return contact_of_radius(
            self.tissue, radius, self.parameters, force_n=force, indentation_m=depth
        )

    def coupled_at(self, sensor: SensorParameters, time_s: float) -> CoupledBimorph:
        """Return the linear sensor on the contact of one time."""
        return couple(sensor, self.contact_at(time_s))


def pole_trajectory(
    sensor: SensorParameters,
    history: ContactHistory,
    time_s: ArrayLike,
    *,
    near_hz: float = 250.0,
) -> ComplexArray:
    """Return the pole of one resonance at times (T,) [s], shape (T,) [rad/s].

    The resonance is that whose natural frequency is nearest to `near_hz` at the first time, and
    then the nearest to itself.
    """
    poles: list[complex] = []
    for t in np.atleast_1d(np.asarray(time_s, dtype=float)):
        coupled = history.coupled_at(sensor, float(t))
        if poles:
            found = min((m.pole_rad_s for m in coupled.modes), key=lambda p: abs(p - poles[-1]))
        else:
            found = coupled.mode_near(near_hz).pole_rad_s
        poles.append(found)
    return np.array(poles)


@dataclass(frozen=True)
class BenchTip:
    """What the tip is in contact with.

    Attributes
    ----------
    tissue : Tissue or None
        None: air.
    force_n : float
    since_s : float
        How long the force has been held [s].
    contact_radius_m, depth_m : float
        As a plant has them [m]; NaN: those of Hertz under the force after `since_s`.
    """

    tissue: Tissue | None
    force_n: float
    since_s: float
    contact_radius_m: float = math.nan
    depth_m: float = math.nan

    def coupled(self, bench: SimulatedBench) -> CoupledBimorph:
        """The linear sensor on it."""
        if self.tissue is None or math.isnan(self.contact_radius_m):
            return bench.coupled(
                self.tissue, force_n=self.force_n or None, hold_time_s=self.since_s
            )
        contact = contact_of_radius(
            self.tissue,
            self.contact_radius_m,
            bench.contact,
            force_n=self.force_n,
            indentation_m=self.depth_m,
        )
        return couple(bench.sensor, contact)


LEAST_RADIUS_M = 1e-6
"""A contact that is lost stays one of this radius: its stiffness is below a hundredth of that at 1 cN."""


ContactState = tuple[float, float, float]
"""Mean force [N], contact radius and depth [m] along the normal over a part of time; 0 out of contact."""


class ContactSoFar:
    """Contact over time, constant in each part; beyond the last part it stays.

    A small vibration sees the contact radius alone, whatever force and motion brought it about.

    Parameters
    ----------
    bench : SimulatedBench
    start : BenchTip
        On tissue, at time 0.

    Attributes
    ----------
    parts : list of CoupledBimorph
        The linear sensor on each part so far.
    """

    def __init__(self, bench: SimulatedBench, start: BenchTip) -> None:
        self._bench, self._tip = bench, start
        self._start = start.coupled(bench)
        self._ends_s: list[float] = []
        self.parts: list[CoupledBimorph] = []

    def extend(self, length_s: float, states: Iterable[ContactState | None]) -> None:
        """Take in what followed: equal parts over `length_s`; None: the plant stood still."""
        states = list(states)
        require(length_s > 0, "length_s", length_s, "a number above 0")
        begin = self._ends_s[-1] if self._ends_s else 0.0
        for number, state in enumerate(states, 1):
            last = self.parts[-1] if self.parts else self._start
            self.parts.append(last if state is None else self._coupled(state))
            self._ends_s.append(begin + length_s * number / len(states))

    def coupled_at(self, time_s: float) -> CoupledBimorph:
        """Return the linear sensor on the contact of one time [s]."""
        if not self.parts:
            return self._start
        return self.parts[min(bisect_right(self._ends_s, time_s), len(self.parts) - 1)]

    def _coupled(self, state: ContactState) -> CoupledBimorph:
        force_n, radius_m, depth_m = state
        radius_m = max(radius_m, LEAST_RADIUS_M)
        tip = replace(self._tip, force_n=force_n, contact_radius_m=radius_m, depth_m=depth_m)
        return tip.coupled(self._bench)


def parts_of(length_s: float, longest_s: float) -> int:
    """Fewest equal parts of a length that are no longer than `longest_s`."""
    return max(1, math.ceil(length_s / longest_s - 1e-9))
