# SPDX-License-Identifier: Apache-2.0
"""Tests of tissue with a ball: force and depth through time, means of them for a fit, the series it finds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.fields import AboveZero, Checked, Range, require


@dataclass(frozen=True, eq=False)
class Prony:
    """``E(t) = Einf + sum_j E_j exp(-t / tau_j)``.

    A generalised Maxwell solid: a Prony series; with one term the standard linear solid.

    Attributes
    ----------
    equilibrium_pa : float
        Einf [Pa], 0 or above.
    moduli_pa, times_s : (terms,) arrays
        E_j [Pa], 0 or above, and tau_j [s], above 0.
    """

    equilibrium_pa: float
    moduli_pa: FloatArray
    times_s: FloatArray

    @property
    def instantaneous_pa(self) -> float:
        """E(0) [Pa]."""
        return float(self.equilibrium_pa + self.moduli_pa.sum())

    def relaxation_modulus(self, time_s: ArrayLike) -> FloatArray:
        """Return E(t) [Pa], of the shape of `time_s` (0 or above)."""
        time = np.asarray(time_s, dtype=float)[..., None]  # (..., 1)
        return np.asarray(self.equilibrium_pa + np.exp(-time / self.times_s) @ self.moduli_pa)

    def complex_modulus(self, s_rad_s: ArrayLike) -> ComplexArray:
        """Return ``E*(s) = Einf + sum E_j s tau_j / (1 + s tau_j)`` [Pa] at complex s [rad/s]."""
        s = np.asarray(s_rad_s, dtype=complex)[..., None] * self.times_s
        return np.asarray(self.equilibrium_pa + (s / (1 + s)) @ self.moduli_pa)

    def creep_compliance(self, time_s: ArrayLike) -> FloatArray:
        """Return the creep compliance J(t) [1/Pa], of the shape of `time_s` (0 or above).

        Exact inverse of the Prony series: ``s J(s) = 1 / E*(s)``, whose poles are the eigenvalues
        of a symmetric rank-one change of ``diag(1 / tau)``. Needs Einf above 0.
        """
        time = np.asarray(time_s, dtype=float)[..., None]
        rate, glassy = 1 / self.times_s, self.instantaneous_pa
        root = np.sqrt(self.moduli_pa * rate)
        retardation, vectors = np.linalg.eigh(np.diag(rate) - np.outer(root, root) / glassy)
        weight = (vectors.T @ root) ** 2 / glassy**2 / retardation
        return np.asarray(1 / glassy - np.expm1(-time * retardation) @ weight)


@dataclass(frozen=True)
class BallTip(Checked):
    """What presses.

    Attributes
    ----------
    radius_m : float
    poisson_ratio : float
        Of the tissue.
    stiffness_n_per_m : float
        Between robot and ball; infinite where it is held rigidly.
    """

    radius_m: AboveZero
    poisson_ratio: Annotated[float, Range(0, 0.5)] = 0.49
    stiffness_n_per_m: Annotated[float, Range(math.ulp(0.0), math.inf, "a number above 0")] = math.inf

    @property
    def factor(self) -> float:
        """Force of Hertz per modulus and ``delta^(3/2)`` [m^(1/2)]."""
        return 4 / 3 * math.sqrt(self.radius_m) / (1 - self.poisson_ratio**2)


class Protocol(str, Enum):
    """What is done with the tissue, after it was pressed until a force was reached."""

    RELAXATION = "relaxation"
    """The robot keeps its place."""
    CREEP = "creep"
    """The force is kept."""
    INDENTATION = "indentation"
    """The tip is drawn back slowly."""


@dataclass(frozen=True, eq=False)
class IndentationRecord:
    """A record of one test.

    Attributes
    ----------
    protocol : Protocol
    time_s, force_n, depth_m : (n,) arrays
        Ascending times; force along the normal, compression positive; way of the robot past the surface,
        negative above it. Of the ball, where it is held rigidly.
    ball : BallTip
    depth_std_m, force_std_n : float
        Standard deviations of the zeros of depth and force; NaN: unknown, the record has to show them. 0:
        exact.
    noise_n : float
        Standard deviation of one force; NaN: the forces show it.
    label : str
    source : str
        Of the forces: a sensor, a file.
    simulated : bool
    """

    protocol: Protocol
    time_s: FloatArray
    force_n: FloatArray
    depth_m: FloatArray
    ball: BallTip
    depth_std_m: float = np.nan
    force_std_n: float = np.nan
    noise_n: float = np.nan
    label: str = ""
    source: str = ""
    simulated: bool = False

    def __post_init__(self) -> None:
        count = self.time_s.size
        for name in ("time_s", "force_n", "depth_m"):
            values = getattr(self, name)
            good = values.shape == (count,) and count >= MOST_FEW
            accepted = f"at least {MOST_FEW} numbers, as many of each"
            require(good, name, f"shape {values.shape}", accepted)
            wrong = np.flatnonzero(~np.isfinite(values))
            got = f"{values[wrong[0]]} at sample {wrong[0]}" if wrong.size else ""
            require(not wrong.size, name, got, "finite numbers")
        back = np.flatnonzero(np.diff(self.time_s) <= 0)
        got = f"{self.time_s[back[0] + 1]:g} s after {self.time_s[back[0]]:g} s" if back.size else ""
        require(not back.size, "time_s", got, "ascending times")
        require(
            self.depth_m.max() > 0, "depth_m", float(self.depth_m.max()), "a largest one above 0"
        )


MOST_FEW = 20
"""A record has so many samples, at least."""
SMOOTH = 9
"""Samples over which force and depth are averaged to find where pressing ends."""
PRESSED_DEPTH, PRESSED_FORCE = 0.98, 0.95
"""Of the largest one, at which the tissue counts as pressed."""
BACK = 0.05
"""By which the robot may go back while it presses, and at which a record may begin, of the largest depth."""
RAMP_PARTS, BEFORE_PARTS, AFTER_PARTS = 50, 6, 4
"""Means of the ramp, of the time before the touch, and after the tip is clear."""
GROWTH = 1.06
"""From one mean of a hold to the next, longer by this factor."""
CLEAR_M = 2e-4
"""Above the surface the tip is clear of the tissue [m]: nothing clings to it any more."""


@dataclass(frozen=True)
class Means:
    """What is left of a record: means of force and depth, few enough for a fit.

    Attributes
    ----------
    time_s, depth_m, force_n, std_n : (N,) arrays
        Of the contact; std_n from the noise of the forces and their last digit.
    turn : int
        Last of them before the tip is drawn back.
    free_time_s, free_force_n, free_std_n : (M,) arrays
        Of the time before the touch, and after the tip is clear.
    begin_s, ramp_s, end_s : float
        When the tip touches, how long it presses until depth or force is nearly there, and when the hold
        ends.
    """

    time_s: FloatArray
    depth_m: FloatArray
    force_n: FloatArray
    std_n: FloatArray
    turn: int
    free_time_s: FloatArray
    free_force_n: FloatArray
    free_std_n: FloatArray
    begin_s: float
    ramp_s: float
    end_s: float

    @property
    def hold_s(self) -> float:
        """From the end of the ramp to the end of the hold [s]."""
        return self.end_s - self.begin_s - self.ramp_s


def means_of(test: IndentationRecord) -> Means:
    """Means over parts of a record that are short where it changes fast.

    Raises
    ------
    ValueError
        If the record begins in contact, no force rises, the robot goes back before the end of the hold, or
        one of relaxation or creep holds for less than its ramp.
    """
    time, force, depth = test.time_s, test.force_n, test.depth_m
    smooth = min(SMOOTH, time.size // 4)
    deep, strong = (np.convolve(v, np.ones(smooth) / smooth, "same") for v in (depth, force))
    most = deep.max()
    begun = f"{depth[0]:.3g} m at its beginning, {most:.3g} at most"
    require(depth[0] < BACK * most, "depth_m", begun, "a record that begins before the touch")
    first = int(np.argmax(depth > 0))
    last = int(np.flatnonzero(deep >= PRESSED_DEPTH * most)[-1])
    least = int(np.argmax(deep == most)) if test.protocol is not Protocol.INDENTATION else last
    pressing = deep[first : last + 1]
    back = float((np.maximum.accumulate(pressing) - pressing).max())
    accepted = (
        f"a way into the tissue that goes back by less than {BACK:.0%} before it is drawn back"
    )
    require(back < BACK * most, "depth_m", f"{back:.3g} m back", accepted)
    reached = int(np.argmax(deep >= PRESSED_DEPTH * most))
    noise = _noise_of(test)
    # of many means the largest one is more than the force by several of their deviations
    peak = strong[: last + 1].max() - LARGEST * noise / np.sqrt(smooth)
    rest_n = float(force[:first].mean()) if first else 0.0
    got = f"{strong[: last + 1].max():.3g} N at most, {rest_n:.3g} N before the touch"
    accepted = "a largest one above 0 and above that in air: compression is positive"
    require(bool(peak > max(rest_n, 0.0)), "force_n", got, accepted)
    held_n, count = float(force[reached : last + 1].mean()), last + 1 - reached
    got = f"{held_n:.2g} N where it is deepest, {rest_n:.2g} N before, with a noise of {noise:.2g} N"
    accepted = "a force above its noise: was the tissue touched, are forces in newtons?"
    require(held_n - rest_n > SURE * noise / math.sqrt(count), "force_n", got, accepted)
    felt = int(np.argmax(strong >= PRESSED_FORCE * peak))
    ramp = max(first + 1, min(reached, felt, least, last))
    if test.protocol is not Protocol.INDENTATION:
        ramp_s, hold_s = time[ramp] - time[first], time[last] - time[ramp]
        got, accepted = f"{hold_s:.3g} s", f"one as long as the ramp, {ramp_s:.3g} s, or longer"
        require(hold_s >= ramp_s, "hold", got, accepted)
    edges = [first, *_even(time, first, ramp, RAMP_PARTS)]
    shortest_s = (time[ramp] - time[first]) / RAMP_PARTS
    edges += _growing(time, ramp, last + 1, shortest_s)
    off = np.flatnonzero(depth[last:] < -CLEAR_M)
    clear = last + int(off[0]) if off.size else depth.size
    turn = len(edges) - 2
    if test.protocol is Protocol.INDENTATION:
        # between means the way is a line: a long one before the turn would begin to draw back too early
        edges[-1:] = _shrinking(time, edges[-2], last + 1, shortest_s)
        turn = len(edges) - 2
        edges += _even(time, last + 1, clear, RAMP_PARTS)
    taken = np.asarray(edges)
    time_s, depth_m, force_n = (_mean(v, taken) for v in (time, depth, force))
    rounding = _rounding_of(test, noise)
    std = np.hypot(noise / np.sqrt(np.diff(taken)), rounding)
    ends = [0, *_even(time, 0, first, BEFORE_PARTS)] if first > BEFORE_PARTS else []
    before = np.asarray(ends, int)
    after = np.asarray([], int)
    if time.size - clear > AFTER_PARTS:
        after = np.asarray([clear, *_even(time, clear, time.size, AFTER_PARTS)])
    free_s, free_n = (
        np.concatenate([_mean(v, part) for part in (before, after)]) for v in (time, force)
    )
    counts = np.concatenate([np.diff(before), np.diff(after)])
    return Means(
        time_s,
        depth_m,
        force_n,
        std,
        turn,
        free_s,
        free_n,
        np.hypot(noise / np.sqrt(counts), rounding),
        float(time[first]),
        float(time[ramp] - time[first]),
        float(time[last]),
    )


MEDIAN_OF_SQUARE = 0.4549364
"""Of a normal variable with variance 1."""
ALIKE = 20
"""Samples after which a filter's noise is new."""
SURE = 5.0
"""Deviations of its mean that the force rises by, at least, where tissue is touched."""
LARGEST = 3.5
"""Deviations of the largest of some thousand normal variables."""


def _noise_of(test: IndentationRecord) -> float:
    """Standard deviation of one force: what neighbours differ by (von Neumann 1941).

    Of means over some samples, where there are many: those of a filter are alike. Not less than the rounding of
    the last digit, below which neighbours are equal.
    """
    noise, force = test.noise_n, test.force_n
    if np.isnan(noise):
        count = ALIKE if force.size > 50 * ALIKE else 1
        means = force[: force.size // count * count].reshape(-1, count).mean(1)
        noise = float(np.sqrt(count * np.median(np.diff(means) ** 2) / 2 / MEDIAN_OF_SQUARE))
    return max(noise, 1e-9 * float(np.abs(test.force_n).max()))


def _rounding_of(test: IndentationRecord, noise: float) -> float:
    """Standard deviation of the rounding of the last digit where noise is less: no mean averages it."""
    steps = np.diff(np.unique(test.force_n))
    steps = steps[steps > 1e-9 * np.abs(test.force_n).max()]
    digit = float(steps.min(initial=np.inf))
    return digit / math.sqrt(12) if noise < digit / 2 < math.inf else 0.0


def _mean(values: FloatArray, edges: IntArray) -> FloatArray:
    """(len(edges) - 1,) means between samples."""
    if edges.size < 2:
        return np.zeros(0)
    sums = np.add.reduceat(values[: edges[-1]], edges[:-1])
    return sums / np.diff(edges)


def _even(time: FloatArray, begin: int, end: int, parts: int) -> list[int]:
    """Ends of parts of equal duration, one sample or more in each, of samples from `begin` to before `end`."""
    if end <= begin:
        return []
    wanted = np.linspace(time[begin], time[end - 1], parts + 1)[1:-1]
    found = np.unique(np.searchsorted(time[begin:end], wanted)) + begin
    return [int(i) for i in found if begin < i < end] + [end]


def _growing(time: FloatArray, begin: int, end: int, shortest_s: float) -> list[int]:
    """Ends of parts that grow with the time since `begin`."""
    if end <= begin + 1:
        return [end] if end > begin else []
    since = time[begin:end] - time[begin]
    parts = np.log1p(since * (GROWTH - 1) / shortest_s) / np.log(GROWTH)
    found = np.flatnonzero(np.diff(np.floor(parts)) > 0) + begin + 1
    return [*(int(i) for i in found), end]


def _shrinking(time: FloatArray, begin: int, end: int, shortest_s: float) -> list[int]:
    """Ends of parts that grow with the time before the last sample."""
    count = time.size
    back = _growing(-time[::-1], count - end, count - begin, shortest_s)
    return [*(count - i for i in reversed(back[:-1])), end]
