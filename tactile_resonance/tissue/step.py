# SPDX-License-Identifier: Apache-2.0
"""The smallest step of concentration that a set-up separates."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import special

from tactile_resonance._typing import FloatArray
from tactile_resonance.tissue.spread import TissueSpread

_PERCENT = re.compile(r"(\d+(?:\.\d+)?)\s*%")
# A correlation beyond is not relied on: what is left across it is rounding and chance.
_LEAST_EIGENVALUE = 1e-4


@dataclass(frozen=True)
class SmallestStep:
    """Between two tissues whose names hold their concentrations.

    Attributes
    ----------
    first, second : str
    from_percent, to_percent : float
    one_block, limit : dict of str to float
        Step that is separated [%, as the concentrations], by what scatters the points: noise alone, then with
        one source of spread after the other. After one block, and of any number of blocks, without noise.
    """

    first: str
    second: str
    from_percent: float
    to_percent: float
    one_block: dict[str, float]
    limit: dict[str, float]


def percent_of(name: str) -> float | None:
    """Concentration in a name such as ``gelatine 12 %``; None where there is none."""
    found = _PERCENT.search(name)
    return float(found[1]) if found else None


def smallest_steps(
    spreads: Sequence[TissueSpread], probability: float = 0.99
) -> tuple[SmallestStep, ...]:
    """Of each two tissues of neighbouring concentrations; empty where names hold fewer than two.

    The two are separated when either is called wrongly with `1 - probability`: poles 2 z standard deviations
    apart, z the normal quantile. Poles are taken as linear in the concentration between the two, and the
    covariance as the mean of theirs. Sources that are not determined count as none.
    """
    named = [(percent_of(spread.name), spread) for spread in spreads]
    known = [(percent, spread) for percent, spread in named if percent is not None]
    known.sort(key=lambda each: each[0])
    needed = 2 * float(special.ndtri(probability))
    return tuple(
        SmallestStep(
            low.name,
            high.name,
            a,
            b,
            *(_steps(low, high, needed * (b - a), noisy) for noisy in (True, False)),
        )
        for (a, low), (b, high) in pairwise(known)
        if a < b
    )


def _steps(low: TissueSpread, high: TissueSpread, step: float, noisy: bool) -> dict[str, float]:
    """By what scatters, from inside to outside; `step` is that of one standard deviation between the two."""
    parts = {"noise": (low.block + high.block) / 2 * noisy, "force": (low.force + high.force) / 2}
    for first, second in zip(low.sources[::-1], high.sources[::-1], strict=True):
        parts[first.name] = np.nan_to_num([first.covariance, second.covariance]).mean(axis=0)
    total, steps, apart = np.zeros((2, 2)), {}, high.mean - low.mean
    for name, part in parts.items():
        total = total + part
        steps[name] = step / _distance(apart, total) if np.diag(total).all() else 0.0
    return steps


def _distance(apart: FloatArray, covariance: FloatArray) -> float:
    """Mahalanobis distance."""
    unit = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    along = vectors.T @ (apart / unit)
    return float(np.sqrt(np.sum(along**2 / np.maximum(values, _LEAST_EIGENVALUE))))
