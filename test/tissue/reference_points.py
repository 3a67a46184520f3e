# SPDX-License-Identifier: Apache-2.0
"""Reference points drawn from known spreads."""

from dataclasses import fields

import numpy as np

from tactile_resonance.tissue.spread import ReferencePoints

NOISE = np.array([[0.02**2, 0.5 * 0.02 * 1e-4], [0.5 * 0.02 * 1e-4, 1e-4**2]])


def covariance(f0_std_hz, damping_std, correlation):
    std = np.array([f0_std_hz, damping_std])
    return np.outer(std, std) * [[1, correlation], [correlation, 1]]


SOURCES = {
    "preparation": covariance(0.4, 4e-4, 0.9),
    "position": covariance(0.2, 3e-4, 0.8),
    "repetition": covariance(0.05, 1e-4, 0.2),
}


def drawn(rng, sizes, sources=SOURCES, noise=NOISE, mean=(254.0, 0.0336), tissue="gel"):
    """Points of `sizes` = positions of each preparation, each a tuple of repetitions."""
    rows = []
    for i, positions in enumerate(sizes):
        casting = mean + rng.multivariate_normal(np.zeros(2), sources["preparation"])
        for j, repetitions in enumerate(positions):
            place = casting + rng.multivariate_normal(np.zeros(2), sources["position"])
            for _ in range(repetitions):
                each = sources["repetition"] + noise
                rows.append((i, j, place + rng.multivariate_normal(np.zeros(2), each)))
    n = len(rows)
    preparation = np.array([f"{tissue}{i}" for i, _, _ in rows])
    return ReferencePoints(
        np.array([x for _, _, x in rows]),
        np.broadcast_to(noise, (n, 2, 2)).copy(),
        np.broadcast_to(noise / 2, (n, 2, 2)).copy(),
        np.full(n, 2.0),
        np.full(n, tissue),
        preparation,
        np.array([f"{j}" for _, j, _ in rows]),
        preparation,
    )


def joined(*parts):
    names = [item.name for item in fields(ReferencePoints)]
    return ReferencePoints(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))
