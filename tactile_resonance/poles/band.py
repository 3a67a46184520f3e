# SPDX-License-Identifier: Apache-2.0
"""Which band to look at when nobody said."""

from __future__ import annotations

import numpy as np

from tactile_resonance.frf.result import FRF

# Half width of the band in units of the resonance's own half width: wide enough to see the mode die
# out.
HALF_WIDTHS = 5.0
FEWEST_LINES_EACH_SIDE = 20
# Lines that are so many times as far apart as those beside them belong to two stretches, between which nothing
# was excited.
GAP = 10.0


def strongest_resonance_band(frf: FRF) -> tuple[float, float]:
    """Band around the line where the response moves fastest along its arc, within one stretch of lines.

    Parameters
    ----------
    frf : FRF
        With (F,) arrays, F at least 10.

    Returns
    -------
    (low_hz, high_hz)

    Notes
    -----
    Kennedy & Pancu (J. Aeronaut. Sci. 14 (1947) 603-625): near a resonance G runs through a circle,
    and ``|dG/df|``, proportional to ``1 / ((f - f0)^2 + (damping f0)^2)``, is largest at the
    resonance whatever the other modes add. It is averaged over five lines against noise.
    """
    f = frf.frequency_hz
    if f.size < 10:
        raise ValueError(
            f"band: {f.size} excited lines, at least 10 are needed to find a resonance"
        )
    speed = np.abs(np.diff(frf.g) / np.diff(f))
    speed = np.convolve(speed, np.ones(5) / 5, mode="same")
    speed[:2] = speed[-2:] = 0.0  # fewer than five lines were averaged there
    centre = int(np.argmax(speed))
    above = speed > speed[centre] / 2
    left = centre - int(np.argmin(above[centre::-1])) if not above[: centre + 1].all() else 0
    right = centre + int(np.argmin(above[centre:])) if not above[centre:].all() else f.size - 2
    half = max(int(HALF_WIDTHS * (right - left) / 2), FEWEST_LINES_EACH_SIDE)
    spacing = np.diff(f)
    gaps = 1 + np.flatnonzero(spacing[1:-1] > GAP * np.maximum(spacing[:-2], spacing[2:]))
    first = max((int(gap) + 1 for gap in gaps if gap < centre), default=0)
    last = min((int(gap) for gap in gaps if gap >= centre), default=f.size - 1)
    return float(f[max(centre - half, first)]), float(f[min(centre + half + 1, last)])
