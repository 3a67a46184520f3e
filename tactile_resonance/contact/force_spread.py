# SPDX-License-Identifier: Apache-2.0
"""How much the force of a contact moved while it was measured, beside the noise of its sensor.

Tissue moves with breath and heartbeat, at up to a few hertz; a force sensor makes noise up to its own rate.
They are distinguished by time scale: what means over 10 ms differ by from one to the next is noise (mean square
successive difference; von Neumann, Ann. Math. Stat. 12 (1941) 367), what means over 20 ms differ by beyond
their share of it is the force.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SHORT_S = 0.02
"""Of the short means [s]."""

LEAST_SHORT = 8
"""Fewer of them say nothing about a spread."""

SHORTEST_S = LEAST_SHORT * SHORT_S
"""Of an interval whose spread can be known [s]."""

LEAST_KNOWN = 0.8
"""Of the blocks of a measurement, in time, whose spread must be known."""


@dataclass(frozen=True)
class ForceSpread:
    """How a force moved over an interval; NaN where not known.

    Attributes
    ----------
    rms_n : float
        Root mean square about the mean [N], the sensor's noise taken off, and with it what is as quick: 3 %
        of a motion of 5 Hz, 12 % of one of 10 Hz. 0: noise explains all of it. Noise of 1 mN at 1 kHz
        leaves an uncertainty of about 0.1 mN after 0.4 s where the force does not move.
    min_n, max_n : float
        Smallest and largest mean over 20 ms [N], with their noise.
    """

    rms_n: float = math.nan
    min_n: float = math.nan
    max_n: float = math.nan


def spread_of(
    time_s: NDArray[np.floating], force_n: NDArray[np.floating], length_s: float
) -> ForceSpread:
    """Spread of the forces heard in an interval.

    Parameters
    ----------
    time_s : (n,) array
        Ascending, from the beginning of the interval.
    force_n : (n,) array
        NaN where there is none.
    length_s : float
        Of the interval.
    """
    parts = round(length_s / SHORT_S)
    heard = np.isfinite(force_n)
    if parts < LEAST_SHORT or heard.sum() < 2 * parts:
        return ForceSpread()
    halves = 2 * parts
    at = (time_s[heard] * (halves / length_s)).astype(int).clip(0, halves - 1)
    counts = np.bincount(at, minlength=halves)
    known = 2 * counts > np.median(counts)  # at the edge of a gap few are left
    reference_n = force_n[heard][0]
    sums = np.bincount(at, force_n[heard] - reference_n, halves)
    means = np.divide(sums, counts, out=np.full(halves, math.nan), where=known)  # over 10 ms
    here = means.reshape(parts, 2).mean(axis=1)  # over 20 ms
    here = here[np.isfinite(here)]
    if here.size < LEAST_SHORT:
        return ForceSpread()
    noise = float(np.nanmean(np.diff(means) ** 2)) / 2 / 2  # variance of a mean over 20 ms
    # an n-th of the noise went with the mean
    variance = float(here.var()) - (1 - 1 / here.size) * noise
    return ForceSpread(
        math.sqrt(max(variance, 0.0)),
        float(reference_n + here.min()),
        float(reference_n + here.max()),
    )


def joined_spread(blocks: Sequence[tuple[float, ForceSpread, float]]) -> ForceSpread:
    """Spread over all blocks of a measurement, that between their means included.

    Parameters
    ----------
    blocks : sequence of (mean force [N], its spread, length [s])
        Not known where more than a fifth of their time is not.
    """
    known = [block for block in blocks if math.isfinite(block[0] + block[1].rms_n)]
    length_s = sum(block[2] for block in known)
    if not known or length_s < LEAST_KNOWN * sum(block[2] for block in blocks):
        return ForceSpread()
    mean_n = sum(force * seconds for force, _, seconds in known) / length_s
    variance = sum(
        seconds * (spread.rms_n**2 + (force - mean_n) ** 2) for force, spread, seconds in known
    )
    return ForceSpread(
        math.sqrt(variance / length_s),
        min(spread.min_n for _, spread, _ in known),
        max(spread.max_n for _, spread, _ in known),
    )
