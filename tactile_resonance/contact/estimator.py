# SPDX-License-Identifier: Apache-2.0
"""What is known of a contact; its touch, and the first estimate from the samples around it.

A ball on soft tissue at the end of a spring. Hertz, ``F = C u^(3/2)``, u the depth of the ball; with a beam of
stiffness k in series the robot goes the depth ``d = u + F / k``. From the touch on `contact_filter` follows.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from tactile_resonance._typing import FloatArray

RIGID = math.inf
"""Stiffness of the beam where there is none."""


def hertz_depth(force_n: float, c: float, beam_n_per_m: float = RIGID) -> float:
    """Return the depth that the robot must go for a force [m]; 0 for no force."""
    if force_n <= 0:
        return 0.0
    return (force_n / c) ** (2 / 3) + force_n / beam_n_per_m


LN_C_MEAN, LN_C_STD = math.log(800.0), 1.5
"""ln of C [N/m^1.5] before the touch: 2 to 40 kPa under balls of 1.5 to 3 mm give 140 to 3800."""


SURFACES, STIFFNESSES = 28, 21
"""Grid of the first estimate, over the height of the touch and ln C."""

RECENT, GROUP = 40, 6
"""Of the samples before the touch was detected the last are used one by one, the others in groups."""


@dataclass(frozen=True)
class ContactEstimate:
    """What is known of the contact.

    Attributes
    ----------
    force_n, force_std_n : float
        Force now, and its standard deviation from noise [N].
    stiffness_n_per_m : float
        Slope of force over depth, the beam included [N/m].
    depth_m, depth_std_m : float
        Past the first touch [m].
    surface_m : float
        Height of the tip at first touch, on the scale of the heights given [m].
    """

    force_n: float
    force_std_n: float
    stiffness_n_per_m: float
    depth_m: float
    depth_std_m: float
    surface_m: float


class TouchDetector:
    """Tells a touch from noise: means over short and long windows against their deviation.

    Short windows see stiff tissue at once, long ones soft tissue at a fraction of the noise.
    """

    WINDOWS = (4, 12, 36)
    THRESHOLD = 5.0  # standard deviations: some 1e-7 false alarms per window

    def __init__(self, noise_n: float, tare_std_n: float) -> None:
        self._limits_n = [
            n * self.THRESHOLD * math.sqrt(noise_n**2 / n + tare_std_n**2) for n in self.WINDOWS
        ]  # of the sums
        self._sums_n = [0.0] * len(self.WINDOWS)
        self._recent: deque[float] = deque(maxlen=self.WINDOWS[-1] + 1)

    def add(self, force_n: float) -> bool:
        """Take one more force; return whether there is contact."""
        recent, sums = self._recent, self._sums_n
        recent.append(force_n)
        count, found = len(recent), False
        for k, n in enumerate(self.WINDOWS):
            sums[k] += force_n - recent[-n - 1] if count > n else force_n
            found = found or (count >= n and sums[k] > self._limits_n[k])
        return found


def touch_posterior(
    heights_m: FloatArray,
    forces_n: FloatArray,
    noise_n: float,
    beam_n_per_m: float = RIGID,
) -> tuple[FloatArray, FloatArray]:
    """Return mean (2,) and covariance (2, 2) of (height of touch, ln C) from few samples.

    On a grid: the touch anywhere on the way, C by its prior; no linearisation, since at first
    touch none holds. Older samples, where at most soft tissue was touched, are taken in groups.

    Parameters
    ----------
    heights_m, forces_n : (n,) arrays
        Oldest first; the tip has come down.
    noise_n : float
    beam_n_per_m : float
    """
    heights, forces, weights = _grouped(heights_m, forces_n)  # (p,) each
    lowest = float(heights_m.min())
    span = max(float(heights_m.max()) - lowest, 1e-6)
    # finer towards the tip, since stiff tissue was touched only just now
    edges = lowest + span * np.linspace(0, 1, SURFACES + 1) ** 2
    surface, width = (edges[1:] + edges[:-1]) / 2, np.diff(edges)  # (s,)
    ln_c = LN_C_MEAN + LN_C_STD * np.linspace(-2.5, 2.5, STIFFNESSES)  # (c,)
    depth = np.maximum(surface[:, None, None] - heights, 0)  # (s, 1, p)
    c = np.exp(ln_c)[:, None]  # (c, 1)
    root = np.broadcast_to(np.sqrt(depth), (SURFACES, STIFFNESSES, heights.size)).copy()
    if beam_n_per_m != RIGID:  # as in `contact_filter.hertz_force`
        for _ in range(4):
            excess = (c * root + beam_n_per_m) * root**2 - beam_n_per_m * depth
            root -= excess / ((3 * c * root + 2 * beam_n_per_m) * root + 1e-12)
    misfit = ((forces - c * root**3) ** 2) @ weights / noise_n**2  # (s, c)
    cost = misfit / 2 + ((ln_c - LN_C_MEAN) / LN_C_STD) ** 2 / 2
    weight = np.exp(-(cost - cost.min())) * width[:, None]
    weight /= weight.sum()
    of_surface, of_c = weight.sum(axis=1), weight.sum(axis=0)
    mean = np.array([of_surface @ surface, of_c @ ln_c])
    off_s, off_c = surface - mean[0], ln_c - mean[1]
    mixed = off_s @ weight @ off_c
    # within a cell all is equally likely
    variance_s = of_surface @ (off_s**2 + width**2 / 12)
    variance_c = of_c @ off_c**2 + (ln_c[1] - ln_c[0]) ** 2 / 12
    return mean, np.array([[variance_s, mixed], [mixed, variance_c]])


def _grouped(
    heights_m: FloatArray, forces_n: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Newest samples as they are, older ones as means of groups; with how many each stands for."""
    recent = min(len(forces_n), RECENT)
    older = (len(forces_n) - recent) // GROUP * GROUP
    begin = len(forces_n) - recent - older
    parts = [
        np.concatenate([x[begin : begin + older].reshape(-1, GROUP).mean(axis=1), x[-recent:]])
        for x in (heights_m, forces_n)
    ]
    weights = np.concatenate([np.full(older // GROUP, float(GROUP)), np.ones(recent)])
    return parts[0], parts[1], weights
