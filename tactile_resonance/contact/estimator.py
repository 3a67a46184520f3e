# SPDX-License-Identifier: Apache-2.0
"""Force, stiffness and place of the surface from force and height: an extended Kalman filter.

The state is (height of the first touch, its speed, ln C, d ln C / dt) of a ball on soft tissue at the end of
a spring. Hertz, ``F = C u^(3/2)``, u the depth of the ball; with a beam of stiffness k in series the robot
goes the depth ``d = u + F / k``. C falls as the tissue relaxes, and the surface moves as `moving_surface`
says. What the model lacks (layers, friction, the beam's swing) goes into the random walks of C and of its
rate, so that the estimated force follows the measured one.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.moving_surface import SPEED_STD_M_S, MovingSurface

RIGID = math.inf
"""Stiffness of the beam where there is none."""


def hertz_force(
    depth_m: float, c: float, beam_n_per_m: float = RIGID
) -> tuple[float, float, float]:
    """Return force [N], its slope over depth [N/m] and over ln C [N]; zeros out of contact.

    Parameters
    ----------
    depth_m : float
        How far the robot has come past the first touch [m].
    c : float
        C [N/m^1.5], above 0.
    beam_n_per_m : float
        Stiffness of the beam in series [N/m].
    """
    if depth_m <= 0:
        return 0.0, 0.0, 0.0
    root = math.sqrt(depth_m)  # of u
    share = 1.0
    if beam_n_per_m != RIGID:
        # C y^3 + k y^2 = k d for the root y of u: a cubic in 1 / y without square, whose one positive
        # solution is that of the cosine of a third of an angle (Viete), or of the hyperbolic one
        bent = 1.5 * math.sqrt(3.0) * c * root / beam_n_per_m
        third = math.cos(math.acos(bent) / 3) if bent < 1 else math.cosh(math.acosh(bent) / 3)
        root *= 0.5 * math.sqrt(3.0) / third
        share = beam_n_per_m / (1.5 * c * root + beam_n_per_m)
    tissue = 1.5 * c * root
    pressed = c * root**3
    return pressed, tissue * share, pressed * share


def hertz_depth(force_n: float, c: float, beam_n_per_m: float = RIGID) -> float:
    """Return the depth that the robot must go for a force [m]; 0 for no force."""
    if force_n <= 0:
        return 0.0
    return (force_n / c) ** (2 / 3) + force_n / beam_n_per_m


RATE_MEAN_PER_S, RATE_STD_PER_S = -0.4, 0.5
"""d ln C / dt at first touch: brain and liver lose 0.2 to 1.2 of their stiffness per second."""

LN_C_MEAN, LN_C_STD = math.log(800.0), 1.5
"""ln of C [N/m^1.5] before the touch: 2 to 40 kPa under balls of 1.5 to 3 mm give 140 to 3800."""


SPEED_LASTS_S = 1.0
"""Time constant in which an unseen speed of the surface dies away [s]."""

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


class ContactFilter:
    """The extended Kalman filter, from the touch on.

    Parameters
    ----------
    heights_m, forces_n : sequences of float
        The last samples, oldest first, the touch among them.
    noise_n : float
        Standard deviation of one force [N].
    beam_n_per_m : float
        Stiffness of the beam in series [N/m]; `RIGID` without.
    vibration_m : float
        Unseen vibration of the tip [m] rms: at stiff tissue it adds to the noise.
    walk_per_sqrt_s : float
        Random walk of ln C [1/sqrt(s)]; that of its rate is five times as large per second.
    inflation : float
        By which means of forces scatter more than white noise lets them.

    Attributes
    ----------
    surface_m, surface_speed_m_s : float
        Height of the tip at first touch [m], and its rate [m/s].
    c : float
        C [N/m^1.5].
    c_rate_per_s : float
        Relative change of C [1/s].
    """

    def __init__(
        self,
        heights_m: Sequence[float],
        forces_n: Sequence[float],
        *,
        noise_n: float,
        beam_n_per_m: float = RIGID,
        vibration_m: float = 3e-6,
        walk_per_sqrt_s: float = 0.05,
        inflation: float = 1.0,
    ) -> None:
        self._inflation = inflation
        self._noise_n, self._vibration_m = noise_n, vibration_m
        self._beam, self._walk = beam_n_per_m, walk_per_sqrt_s
        mean, covariance = touch_posterior(
            np.asarray(heights_m, float), np.asarray(forces_n, float), noise_n, beam_n_per_m
        )
        self.surface_m, self._ln_c = float(mean[0]), float(mean[1])
        self.c = math.exp(self._ln_c)
        self.surface_speed_m_s, self.c_rate_per_s = 0.0, RATE_MEAN_PER_S
        self._motion, self._passed_s = MovingSurface(), 0.0
        # covariance of (surface, speed, ln C, rate): its upper triangle, row by row
        (p00, p02), (_, p22) = covariance.tolist()
        self._p = (p00, 0.0, p02, 0.0, 0.0, 0.0, 0.0, p22, 0.0, RATE_STD_PER_S**2)

    @property
    def moving(self) -> bool:
        """Whether the surface is seen to move."""
        return self._motion.moving

    @property
    def surprise(self) -> float:
        """How much more force comes than the model expects, in deviations of a mean of some forces."""
        return self._motion.surprise

    def predict(self, dt_s: float) -> None:
        """Let time pass."""
        motion = self._motion
        self._passed_s = dt_s
        # rate and speed die out, as relaxation does; what they add is bounded, however long nothing came
        adds_s = -math.expm1(-dt_s)
        keep = 1.0 - adds_s
        way_s = -SPEED_LASTS_S * math.expm1(-dt_s / SPEED_LASTS_S)
        stay = 1.0 - way_s / SPEED_LASTS_S
        self._ln_c += self.c_rate_per_s * adds_s
        self.c = math.exp(self._ln_c)
        self.c_rate_per_s *= keep
        self.surface_m += self.surface_speed_m_s * way_s
        self.surface_speed_m_s = stay * self.surface_speed_m_s + motion.acceleration_m_s2 * way_s
        # F P F' + Q, F = [[1, way, 0, 0], [0, stay, 0, 0], [0, 0, 1, adds], [0, 0, 0, keep]]
        p00, p01, p02, p03, p11, p12, p13, p22, p23, p33 = self._p
        walk, drive = self._walk**2 * dt_s, motion.intensity_m2_s3 * dt_s
        across, slow, mixed = p01 + way_s * p11, p03 + way_s * p13, p23 + adds_s * p33
        self._p = (
            p00 + way_s * (p01 + across) + drive * dt_s * dt_s / 3,
            stay * across + drive * dt_s / 2,
            p02 + way_s * p12 + adds_s * slow,
            keep * slow,
            stay * stay * p11 + drive,
            stay * (p12 + adds_s * p13),
            stay * keep * p13,
            p22 + adds_s * (p23 + mixed) + walk,
            keep * mixed,
            keep * keep * p33 + 25 * walk,
        )

    def update(self, height_m: float, force_n: float) -> float:
        """Take one force measured at a height of the tip; return its innovation in deviations."""
        depth = self.surface_m - height_m
        expected, slope, per_ln_c = hertz_force(depth, self.c, self._beam)
        p00, p01, p02, p03, p11, p12, p13, p22, p23, p33 = self._p
        # P h with h = (slope, 0, per_ln_c, 0)
        ph0 = p00 * slope + p02 * per_ln_c
        ph1 = p01 * slope + p12 * per_ln_c
        ph2 = p02 * slope + p22 * per_ln_c
        ph3 = p03 * slope + p23 * per_ln_c
        noise = self._noise_n**2 + (slope * self._vibration_m) ** 2
        spread = slope * ph0 + per_ln_c * ph2 + noise
        error = force_n - expected
        step = error / spread
        # a step of ln C beyond 1 is beyond what the linearisation stands for
        if abs(ph2 * step) > 1.0:
            step /= abs(ph2 * step)
        self.surface_m += ph0 * step
        self.surface_speed_m_s += ph1 * step
        self._ln_c += ph2 * step
        self.c = math.exp(self._ln_c)
        self.c_rate_per_s += ph3 * step
        gain0, gain1, gain2, gain3 = ph0 / spread, ph1 / spread, ph2 / spread, ph3 / spread
        innovation, motion = error / math.sqrt(spread), self._motion
        # the speed is not known when a motion is detected
        seen = motion.judge(innovation / self._inflation, self._passed_s)
        unknown = SPEED_STD_M_S**2 if seen else 0.0
        self._p = (
            p00 - gain0 * ph0,
            p01 - gain0 * ph1,
            p02 - gain0 * ph2,
            p03 - gain0 * ph3,
            p11 - gain1 * ph1 + unknown,
            p12 - gain1 * ph2,
            p13 - gain1 * ph3,
            p22 - gain2 * ph2,
            p23 - gain2 * ph3,
            p33 - gain3 * ph3,
        )
        if motion.moving:
            motion.learn(height_m, force_n, slope, self.surface_speed_m_s, self._passed_s)
        return innovation

    def force_at(self, height_m: float) -> float:
        """Return the force at a height of the tip [N]."""
        return hertz_force(self.surface_m - height_m, self.c, self._beam)[0]

    def estimate(self, height_m: float) -> ContactEstimate:
        """Return what holds at a height of the tip."""
        depth = self.surface_m - height_m
        expected, slope, per_ln_c = hertz_force(depth, self.c, self._beam)
        return ContactEstimate(
            force_n=expected,
            force_std_n=self._force_std(slope, per_ln_c),
            stiffness_n_per_m=slope,
            depth_m=depth,
            depth_std_m=math.sqrt(max(0.0, self._p[0])),
            surface_m=self.surface_m,
        )

    def depth_for(self, force_n: float) -> float:
        """Return the depth of the tip for a force [m]."""
        return hertz_depth(force_n, self.c, self._beam)

    def slope_at(self, depth_m: float) -> tuple[float, float]:
        """Return the stiffness at a depth [N/m], and the standard deviation of the force there [N]."""
        _, slope, per_ln_c = hertz_force(depth_m, self.c, self._beam)
        return slope, self._force_std(slope, per_ln_c)

    def _force_std(self, slope: float, per_ln_c: float) -> float:
        """Return the standard deviation of a force with these slopes [N]."""
        p00, p02, p22 = self._p[0], self._p[2], self._p[7]
        variance = slope**2 * p00 + per_ln_c**2 * p22 + 2 * slope * per_ln_c * p02
        return math.sqrt(max(0.0, variance))


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
    if beam_n_per_m != RIGID:  # as in `hertz_force`
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
