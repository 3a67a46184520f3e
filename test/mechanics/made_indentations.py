# SPDX-License-Identifier: Apache-2.0
"""Records of a ball on a solid that is known, with noise, a place of the surface and a drifting zero."""

import numpy as np

from tactile_resonance.mechanics.course import course_of
from tactile_resonance.mechanics.indentation import BallTip, IndentationRecord, Protocol

RADIUS_M = 2.5e-3


def force_over(ball, time_s, depth_m, series, turn=None):
    turn = len(time_s) - 1 if turn is None else turn
    sets = [series.equilibrium_pa], [series.moduli_pa], [series.times_s]
    course = course_of(ball, np.asarray(time_s), np.asarray(depth_m), turn, *sets)
    return course.force_n[0], course.indentation_m[0]


def relaxation(
    series,
    rng,
    *,
    stiffness_n_per_m=np.inf,
    ramp_s=0.2,
    hold_s=30.0,
    noise_n=2e-4,
    force_n=0.015,
    rate_hz=500.0,
):
    """0.3 s above the surface, ramp, hold, half a second in air again."""
    ball = BallTip(RADIUS_M, stiffness_n_per_m=stiffness_n_per_m)
    pressed = (force_n / ball.factor / series.relaxation_modulus(ramp_s / 2)) ** (2 / 3)
    depth_m = pressed + force_n / stiffness_n_per_m
    time = np.arange(0.0, ramp_s + hold_s, 1 / rate_hz)
    depth = depth_m * np.minimum(time / ramp_s, 1.0)
    sparse = np.unique(np.geomspace(3 * ramp_s * rate_hz, time.size - 1, 300).astype(int))
    nodes = np.concatenate([np.arange(sparse[0]), sparse])
    force = np.interp(time, time[nodes], force_over(ball, time[nodes], depth[nodes], series)[0])
    before, after = np.arange(-0.3, 0.0, 1 / rate_hz), time[-1] + np.arange(0.5, 1.0, 1 / rate_hz)
    times = np.concatenate([before, time, after])
    forces = np.concatenate([0 * before, force, 0 * after])
    depths = np.concatenate([before * depth_m / ramp_s, depth, np.full(after.size, -2e-3)])
    zero = 1e-4 * rng.standard_normal() + 5e-6 * rng.standard_normal() * times
    forces = forces + zero + noise_n * rng.standard_normal(times.size)
    depths = depths + 2e-5 * rng.standard_normal()
    return IndentationRecord(Protocol.RELAXATION, times, forces, depths, ball, simulated=True)
