# SPDX-License-Identifier: Apache-2.0
"""The period of a measurement: as short as the model allows, and away from the mains.

Where a scene leaves it to the plan (``samples_per_period: auto``), the period is the shortest of which one
block, from rest, gives a pole with a covariance to be relied on. Each band holds as many lines as response
and transient have coefficients for, and `FREE_LINES`; its residual terms follow modes that lie at `NEIGHBOUR`
times its lower end or below up to `LEFT_OF_NEIGHBOURS` of their response. So the wider a band, the shorter
the period.

The lines sound one after the other, from low to high, for a mode that is excited early rings within the
record: at 59 ms its f0 is more than twice as precise as with random phases. One or two blocks cannot
distinguish hum from response. From the third block on it shows in bins between the lines, so that the period
is up to `LONGER` times as long where this keeps the harmonics of the mains `LEAST_DISTANCE` from the lines.

``tools/run.sh python -m benchmarks.skip_decision`` prints precision and coverage of one block on all tissues
of the simulated bench, and what blocks of that period decide.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import FloatArray
from tactile_resonance.poles.structure import ModelStructure, PoleBand
from tactile_resonance.tones import MAINS_HZ

FREE_LINES = 12
"""Excited lines of a band beyond those that its coefficients take up: the level of the noise is from them."""
LEAST_DISTANCE = 0.15
"""Of a harmonic of the mains from an excited line, in spacings of the lines."""
LONGER = 1.15
"""A period may be this much longer than the shortest to keep that distance."""
NEIGHBOUR = 0.5
"""Of the lower end of a band: other modes are expected from there downwards."""
LEFT_OF_NEIGHBOURS = 1e-6
"""Of the response of such a mode, what residual terms may leave."""
LONGEST_S = 20.0
"""Of a period: the time of a point is a minute."""


def lines_of(ends_hz: tuple[float, float], spacing_hz: float, share: float = 1.0) -> int:
    """How many lines from the one end to the other are excited, of which this share is."""
    low, high = (hz / spacing_hz for hz in ends_hz)
    return int(share * (math.floor(high + 1e-9) - math.ceil(low - 1e-9) + 1))


def residual_terms_of(ends_hz: tuple[float, float]) -> int:
    """Residual terms that a band needs for modes beside it.

    A polynomial of r terms follows the response of a pole beside a band up to ``rho^-r`` of it, rho the sum of
    the half axes of the ellipse through the pole whose foci are the band's ends, over half the band's width
    (Bernstein; Trefethen, Approximation Theory and Approximation Practice (2013), theorem 8.2).
    """
    low_hz, high_hz = ends_hz
    away = (low_hz + high_hz - 2 * NEIGHBOUR * low_hz) / (high_hz - low_hz)
    return math.ceil(-math.log(LEFT_OF_NEIGHBOURS) / math.acosh(away))


def lines_wanted(band: PoleBand) -> int:
    """Lines of a band from which one period alone gives poles with a covariance to be relied on.

    Those that the coefficients of response and transient take up, and `FREE_LINES`, from which the level of the
    noise is estimated.
    """
    structure = ModelStructure.with_residual(band.order or 2, band.residual_terms)
    coefficients = structure.parameters + structure.transient_terms
    return math.ceil(coefficients / 2) + FREE_LINES


def shortest_samples(
    bands: Sequence[PoleBand], sample_rate_hz: float, share: float = 1.0, least_s: float = 0.0
) -> int:
    """Samples of the shortest period with enough lines in each band, and away from the mains where that can be.

    Parameters
    ----------
    bands : sequence of PoleBand
    sample_rate_hz : float
    share : float
        Of the lines that are excited.
    least_s : float
        Of the period.

    Raises
    ------
    ValueError
        If a band is so narrow that the period would be longer than `LONGEST_S`.
    """
    for band in bands:
        width_hz = band.high_hz - band.low_hz
        least_hz = lines_wanted(band) / share / LONGEST_S
        if width_hz < least_hz:
            raise ValueError(
                f"sensor: got the band {band.low_hz:g} to {band.high_hz:g} Hz with samples_per_period auto; "
                f"accepted is {least_hz:.2g} Hz wide or more, for a period of {LONGEST_S:g} s at most"
            )
    fewest = max(
        int((lines_wanted(band) / share - 1) * sample_rate_hz / (band.high_hz - band.low_hz))
        for band in bands
    )
    fewest = max(fewest, math.ceil(least_s * sample_rate_hz))
    while not _enough(bands, sample_rate_hz / fewest, share):
        fewest += 1
    tried = [
        samples
        for samples in range(fewest, int(LONGER * fewest) + 1)
        if _enough(bands, sample_rate_hz / samples, share)
    ]
    distances = mains_distances(mains_in(bands), sample_rate_hz / np.array(tried))
    far = np.flatnonzero(distances >= LEAST_DISTANCE)
    return tried[int(far[0] if far.size else np.argmax(distances))]


def _enough(bands: Sequence[PoleBand], spacing_hz: float, share: float) -> bool:
    """Whether each band holds as many lines as it needs."""
    return all(lines_of(band.ends_hz, spacing_hz, share) >= lines_wanted(band) for band in bands)


def mains_distances(hum_hz: FloatArray, spacing_hz: npt.ArrayLike) -> FloatArray:
    """(...) how near one of these frequencies (h,) comes to a multiple of each spacing (...) [Hz].

    In units of the spacing: 0 is on a line, 0.5 in the middle between two, and where there are no frequencies.
    """
    at = hum_hz / np.asarray(spacing_hz, float)[..., None]
    return np.asarray(np.abs(at - np.round(at)).min(axis=-1, initial=0.5))


def mains_in(bands: Sequence[PoleBand]) -> FloatArray:
    """Harmonics of the mains within bands, ascending [Hz]."""
    top_hz = max(band.high_hz for band in bands)
    hum_hz = np.unique(np.concatenate([np.arange(hz, top_hz + 1, hz) for hz in MAINS_HZ]))
    inside = [(hum_hz >= band.low_hz) & (hum_hz <= band.high_hz) for band in bands]
    return np.asarray(hum_hz[np.any(inside, axis=0)])
