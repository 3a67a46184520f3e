# SPDX-License-Identifier: Apache-2.0
"""The colours of a map: the same in rviz, its legend and the figure.

rviz mixes two colours linearly over the range of a field; these two, blue and yellow, grow steadily
lighter on the way, also for those who do not tell red from green.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

LOW_RGB = (64, 105, 255)
HIGH_RGB = (255, 210, 50)


def shares(values: npt.ArrayLike, over: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """(...) place of each value between the least of `over`, 0, and the largest, 1; 0 if these are equal.

    Values beyond them have the place of the nearer one.
    """
    low, span = np.min(over), np.ptp(over)
    v = np.asarray(values, float)
    return np.zeros_like(v) if span == 0 else np.clip((v - low) / span, 0.0, 1.0)


def colours(share: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """(..., 3) red, green, blue from 0 to 1 for shares (...) from 0 to 1."""
    low, high = np.array(LOW_RGB) / 255, np.array(HIGH_RGB) / 255
    return np.asarray(low + np.asarray(share, float)[..., None] * (high - low))
