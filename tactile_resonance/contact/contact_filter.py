# SPDX-License-Identifier: Apache-2.0
"""Force, stiffness and place of the surface from force and height: an extended Kalman filter, and its start.

The state is (height of the first touch, its speed, ln C, d ln C / dt) of a ball on soft tissue at the end of
a spring. Hertz, ``F = C u^(3/2)``, u the depth of the ball; with a beam of stiffness k in series the robot
goes the depth ``d = u + F / k``. C falls as the tissue relaxes, and the surface moves. What the model lacks
(layers, friction, the beam's swing) goes into the random walks of C and of its rate, so that the estimated
force follows the measured one.

How freely the surface moves is learnt from the innovations. White acceleration drives it. Innovations of a
filter that is right are white (Mehra, IEEE Trans. Automatic Control 17, 1972), so the intensity of the
acceleration rises while their running mean is further from 0 than white ones leave it, and falls elsewhere.
Until a motion is detected it stays so low that still tissue is followed as if it could not move. A motion that
goes to and fro is pulled back towards its middle: then speed is foreseen where white acceleration would only
follow it.

It begins with an estimate on a grid from the samples around the touch.

The control loop runs the filter for every force, so that is compiled. numba looks at the date of this file
alone: whatever is compiled for the filter is in here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import float64, from_dtype, njit
from numba.types import UniTuple

from tactile_resonance._typing import FloatArray

RIGID = math.inf
"""Stiffness of the beam where there is none."""


def hertz_depth(force_n: float, c: float, beam_n_per_m: float = RIGID) -> float:
    """Return the depth that the robot must go for a force [m]; 0 for no force."""
    if force_n <= 0:
        return 0.0
    return (force_n / c) ** (2 / 3) + force_n / beam_n_per_m


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


LN_C_MEAN, LN_C_STD = math.log(800.0), 1.5
"""ln of C [N/m^1.5] before the touch: 2 to 40 kPa under balls of 1.5 to 3 mm give 140 to 3800."""


SURFACES, STIFFNESSES = 28, 21
"""Grid of the first estimate, over the height of the touch and ln C."""

RECENT, GROUP = 40, 6
"""Of the samples before the touch was detected the last are used one by one, the others in groups."""


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


RATE_MEAN_PER_S, RATE_STD_PER_S = -0.4, 0.5
"""d ln C / dt at first touch: brain and liver lose 0.2 to 1.2 of their stiffness per second."""

WALK_PER_SQRT_S = 0.05
"""Random walk of ln C [1/sqrt(s)]; that of its rate is five times as large per second."""

SPEED_LASTS_S = 1.0
"""Time constant in which an unseen speed of the surface dies away [s]."""

LEAST, MOST = math.log(1e-11), math.log(2e-4)
"""ln of the intensity [m2/s3]: tissue that is still; a heart's motion of 1 mm at 2 Hz."""

FIRST, LEAST_MOVING = math.log(2e-5), math.log(4e-6)
"""The same when a motion is detected, and at least after it."""

MEAN_OF, SLOW_OF, SQUARES_OF = 12.0, 48.0, 100.0
"""Innovations are averaged over so many forces, and over so many; squares of the first mean over so many."""

LARGEST = 5.0
"""A larger innovation, in deviations, counts as this: one bad force is no motion."""

OF_MEAN, OF_SLOW = math.sqrt(2 * MEAN_OF - 1), math.sqrt(2 * SLOW_OF - 1)
"""Deviation of one white innovation over those of both means."""

DETECTED, SLOWLY, EXCEEDED, MOST_SQUARE = 36.0, 14.0, 4.0, 25.0
"""Square of the running mean, in its deviations: a motion; one where the slow mean is as large; one that is
followed too slowly; counted at most."""

STILL_S = 5.0
"""So long without need of more than the least intensity the surface counts as still again [s]."""

RISE_PER_S, FALL_PER_S, QUIET_FALL_PER_S = 10.0, 3.0, 20.0
"""Of ln of the intensity: for what the square exceeds; always; more where squares are less than white ones'."""

SPEED_STD_M_S = 1e-3
"""Of the speed when a motion is detected."""

LEARN_S, LEAST_LEARN_S, MIDDLE_S = 2.0, 0.8, 0.6
"""Sizes of a motion and of its speed are means over so long, of use after the second; its middle is one over
the third, short enough to leave creep out."""

SLOWEST_RAD_S, FASTEST_RAD_S = 5.0, 20.0
"""To and fro at these rates is foreseen; slower motion is followed well without."""

STATE = np.dtype(
    [
        # height of the first touch, its rate, ln C and its rate; upper triangle of their covariance
        *[(name, float) for name in ("surface_m", "speed_m_s", "ln_c", "rate_per_s")],
        *[(f"p{n}", float) for n in ("00", "01", "02", "03", "11", "12", "13", "22", "23", "33")],
        # whether the surface is seen to move, and how it would go on to and fro
        *[(name, float) for name in ("moving", "acceleration_m_s2", "ln_intensity")],
        # of the innovations: running means, and mean square of the first; how long all was quiet
        *[(name, float) for name in ("mean", "slow", "square", "quiet_s")],
        # of a motion: for how long it is learnt, its middle, mean squares of its size and of its speed
        *[(n, float) for n in ("learnt_s", "middle_m", "middle_n", "way_m2", "speed_m2_s2")],
        # what stays: see `ContactFilter`
        *[(name, float) for name in ("noise_n", "vibration_m", "beam_n_per_m")],
    ]
)


@njit(UniTuple(float64, 3)(float64, float64, float64), cache=True)
def hertz_force(depth_m, c, beam_n_per_m):
    """Return force [N], its slope over depth [N/m] and over ln C [N]; zeros out of contact.

    Parameters
    ----------
    depth_m : float
        How far the robot has come past the first touch [m].
    c : float
        C [N/m^1.5], above 0.
    beam_n_per_m : float
        Stiffness of the beam in series [N/m]; `RIGID` without.
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
    pressed = c * math.pow(root, 3.0)
    return pressed, tissue * share, pressed * share


@njit
def _judge(s, innovation, dt_s):
    """Take an innovation, in deviations; return whether it is the one that shows a motion."""
    within = min(LARGEST, max(-LARGEST, innovation))
    s.mean += (within - s.mean) / MEAN_OF
    s.slow += (within - s.slow) / SLOW_OF
    square, slowly = s.mean * OF_MEAN, s.slow * OF_SLOW
    square, slowly = square * square, slowly * slowly
    if not s.moving:
        seen = square > DETECTED or min(square, slowly) > SLOWLY
        if seen:
            s.moving, s.ln_intensity, s.quiet_s = 1.0, FIRST, 0.0
        return seen
    s.square += (square - s.square) / SQUARES_OF
    rate = RISE_PER_S * max(0.0, min(square, MOST_SQUARE) - EXCEEDED) - FALL_PER_S
    rate -= QUIET_FALL_PER_S * max(0.0, 1.0 - s.square)
    s.ln_intensity = min(MOST, max(LEAST_MOVING, s.ln_intensity + rate * dt_s))
    s.quiet_s = s.quiet_s + dt_s if s.ln_intensity == LEAST_MOVING else 0.0
    if s.quiet_s > STILL_S:
        s.moving, s.ln_intensity = 0.0, LEAST
        s.acceleration_m_s2 = s.learnt_s = 0.0
    return False


@njit
def _learn(s, height_m, force_n, slope_n_per_m, dt_s):
    """Take where the tip is, and what it presses.

    What the surface does is what the tip does, but for the force that is more or less than its mean: so
    it does not depend on how deep the tip is thought to be. Of a sine, its size and that of its speed
    tell the rate.
    """
    s.learnt_s += dt_s
    share = dt_s / min(s.learnt_s, LEARN_S)
    near = dt_s / min(s.learnt_s, MIDDLE_S)
    s.middle_n += near * (force_n - s.middle_n)
    place_m = height_m
    if slope_n_per_m > 0:
        place_m += (force_n - s.middle_n) / slope_n_per_m
    s.middle_m += near * (place_m - s.middle_m)
    off_m = place_m - s.middle_m
    s.way_m2 += share * (off_m * off_m - s.way_m2)
    s.speed_m2_s2 += share * (s.speed_m_s * s.speed_m_s - s.speed_m2_s2)
    s.acceleration_m_s2 = 0.0
    if s.learnt_s > LEAST_LEARN_S and s.way_m2 > 0:
        pull_per_s2 = s.speed_m2_s2 / s.way_m2
        if SLOWEST_RAD_S * SLOWEST_RAD_S < pull_per_s2 < FASTEST_RAD_S * FASTEST_RAD_S:
            s.acceleration_m_s2 = -pull_per_s2 * off_m


@njit(UniTuple(float64, 7)(from_dtype(STATE)[::1], float64, float64, float64), cache=True)
def _follow(states, dt_s, height_m, force_n):
    """Let time pass and take one force; see `ContactFilter.follow`, and for what is returned its attributes."""
    s = states[0]
    # rate and speed die out, as relaxation does; what they add is bounded, however long nothing came
    adds_s = -math.expm1(-dt_s)
    keep = 1.0 - adds_s
    way_s = -SPEED_LASTS_S * math.expm1(-dt_s / SPEED_LASTS_S)
    stay = 1.0 - way_s / SPEED_LASTS_S
    ln_c, rate = s.ln_c + s.rate_per_s * adds_s, s.rate_per_s * keep
    surface, speed = (
        s.surface_m + s.speed_m_s * way_s,
        stay * s.speed_m_s + s.acceleration_m_s2 * way_s,
    )
    # F P F' + Q, F = [[1, way, 0, 0], [0, stay, 0, 0], [0, 0, 1, adds], [0, 0, 0, keep]]
    walk, drive = WALK_PER_SQRT_S * WALK_PER_SQRT_S * dt_s, math.exp(s.ln_intensity) * dt_s
    across, slow, mixed = s.p01 + way_s * s.p11, s.p03 + way_s * s.p13, s.p23 + adds_s * s.p33
    p00 = s.p00 + way_s * (s.p01 + across) + drive * dt_s * dt_s / 3
    p01 = stay * across + drive * dt_s / 2
    p02 = s.p02 + way_s * s.p12 + adds_s * slow
    p03 = keep * slow
    p11 = stay * stay * s.p11 + drive
    p12 = stay * (s.p12 + adds_s * s.p13)
    p13 = stay * keep * s.p13
    p22 = s.p22 + adds_s * (s.p23 + mixed) + walk
    p23 = keep * mixed
    p33 = keep * keep * s.p33 + 25 * walk

    expected, slope, per_ln_c = hertz_force(surface - height_m, math.exp(ln_c), s.beam_n_per_m)
    # P h with h = (slope, 0, per_ln_c, 0)
    ph0 = p00 * slope + p02 * per_ln_c
    ph1 = p01 * slope + p12 * per_ln_c
    ph2 = p02 * slope + p22 * per_ln_c
    ph3 = p03 * slope + p23 * per_ln_c
    shaken = slope * s.vibration_m
    spread = slope * ph0 + per_ln_c * ph2 + (s.noise_n * s.noise_n + shaken * shaken)
    error = force_n - expected
    step = error / spread
    # a step of ln C beyond 1 is beyond what the linearisation stands for
    if abs(ph2 * step) > 1.0:
        step /= abs(ph2 * step)
    s.surface_m, s.speed_m_s = surface + ph0 * step, speed + ph1 * step
    s.ln_c, s.rate_per_s = ln_c + ph2 * step, rate + ph3 * step
    innovation = error / math.sqrt(spread)
    seen = _judge(s, innovation, dt_s)
    gain0, gain1, gain2, gain3 = ph0 / spread, ph1 / spread, ph2 / spread, ph3 / spread
    s.p00, s.p01, s.p02 = p00 - gain0 * ph0, p01 - gain0 * ph1, p02 - gain0 * ph2
    s.p03, s.p12, s.p13 = p03 - gain0 * ph3, p12 - gain1 * ph2, p13 - gain1 * ph3
    # the speed is not known when a motion is detected
    s.p11 = p11 - gain1 * ph1 + (SPEED_STD_M_S * SPEED_STD_M_S if seen else 0.0)
    s.p22, s.p23, s.p33 = p22 - gain2 * ph2, p23 - gain2 * ph3, p33 - gain3 * ph3
    if s.moving:
        _learn(s, height_m, force_n, slope, dt_s)
    surprise = s.mean * OF_MEAN
    return s.surface_m, s.speed_m_s, math.exp(s.ln_c), s.rate_per_s, s.moving, surprise, innovation


class ContactFilter:
    """The filter, from the touch on.

    Parameters
    ----------
    heights_m, forces_n : sequences of float
        The last samples, oldest first, the touch among them.
    noise_n : float
        Standard deviation of one force [N]; where neighbouring ones are alike, that of white noise whose means
        scatter as much.
    beam_n_per_m : float
        Stiffness of the beam in series [N/m]; `RIGID` without.
    vibration_m : float
        Unseen vibration of the tip [m] rms: at stiff tissue it adds to the noise.

    Attributes
    ----------
    surface_m, surface_speed_m_s : float
        Height of the tip at first touch [m], and its rate [m/s].
    c : float
        C [N/m^1.5].
    c_rate_per_s : float
        Relative change of C [1/s].
    moving : bool
        Whether the surface is seen to move.
    surprise : float
        How much more force comes than the model expects, in deviations of a mean of some forces.
    state : array of `STATE`, of length 1
    """

    def __init__(
        self,
        heights_m: Sequence[float],
        forces_n: Sequence[float],
        *,
        noise_n: float,
        beam_n_per_m: float = RIGID,
        vibration_m: float = 3e-6,
    ) -> None:
        mean, covariance = touch_posterior(
            np.asarray(heights_m, float), np.asarray(forces_n, float), noise_n, beam_n_per_m
        )
        self.surface_m, ln_c = mean.tolist()
        self.surface_speed_m_s, self.c, self.c_rate_per_s = 0.0, math.exp(ln_c), RATE_MEAN_PER_S
        self.moving, self.surprise = False, 0.0
        self._beam_n_per_m = beam_n_per_m
        (p00, p02), (_, p22) = covariance.tolist()
        self.state = np.zeros(1, STATE)
        for name, value in {
            **{"surface_m": self.surface_m, "ln_c": ln_c, "rate_per_s": RATE_MEAN_PER_S},
            **{"p00": p00, "p02": p02, "p22": p22, "p33": RATE_STD_PER_S**2},
            **{"ln_intensity": LEAST, "square": 1.0},
            **{"noise_n": noise_n, "vibration_m": vibration_m, "beam_n_per_m": beam_n_per_m},
        }.items():
            self.state[name] = value

    def follow(self, dt_s: float, height_m: float, force_n: float) -> float:
        """Let time pass and take one force, measured at a height; return its innovation in deviations."""
        surface_m, speed_m_s, c, rate_per_s, moving, surprise, innovation = _follow(
            self.state, dt_s, height_m, force_n
        )
        self.surface_m, self.surface_speed_m_s = surface_m, speed_m_s
        self.c, self.c_rate_per_s = c, rate_per_s
        self.moving, self.surprise = moving > 0.0, surprise
        return innovation

    def force_at(self, height_m: float) -> float:
        """Return the force at a height of the tip [N]."""
        return hertz_force(self.surface_m - height_m, self.c, self._beam_n_per_m)[0]

    def estimate(self, height_m: float) -> ContactEstimate:
        """Return what holds at a height of the tip."""
        depth = self.surface_m - height_m
        expected, slope, per_ln_c = hertz_force(depth, self.c, self._beam_n_per_m)
        return ContactEstimate(
            force_n=expected,
            force_std_n=self._force_std(slope, per_ln_c),
            stiffness_n_per_m=slope,
            depth_m=depth,
            depth_std_m=math.sqrt(max(0.0, float(self.state["p00"][0]))),
            surface_m=self.surface_m,
        )

    def depth_for(self, force_n: float) -> float:
        """Return the depth of the tip for a force [m]."""
        return hertz_depth(force_n, self.c, self._beam_n_per_m)

    def stiffness_at(self, depth_m: float) -> float:
        """Return the stiffness at a depth [N/m]."""
        return hertz_force(depth_m, self.c, self._beam_n_per_m)[1]

    def slope_at(self, depth_m: float) -> tuple[float, float]:
        """Return the stiffness at a depth [N/m], and the standard deviation of the force there [N]."""
        _, slope, per_ln_c = hertz_force(depth_m, self.c, self._beam_n_per_m)
        return slope, self._force_std(slope, per_ln_c)

    def _force_std(self, slope: float, per_ln_c: float) -> float:
        """Return the standard deviation of a force with these slopes [N]."""
        p00, p02, p22 = (float(self.state[name][0]) for name in ("p00", "p02", "p22"))
        variance = slope**2 * p00 + per_ln_c**2 * p22 + 2 * slope * per_ln_c * p02
        return math.sqrt(max(0.0, variance))
