# SPDX-License-Identifier: Apache-2.0
"""Hum and other tones: what it costs not to excite their lines."""

from functools import cached_property

import numpy as np
import pytest

from benchmarks.poles_plant import HARMONICS, SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, Plant
from tactile_resonance.multisine import mains_lines

SPACING_HZ = SAMPLE_RATE_HZ / SAMPLES_PER_PERIOD


class WithoutMains(Plant):
    """Some lines are not excited; the others are as large as before."""

    mains_hz, lines_beside = 50.0, 1

    @cached_property
    def phasor(self):
        whole = Plant(self.damping_ratio, self.snr_db, self.periods, self.seed).phasor
        hum = mains_lines(HARMONICS * SPACING_HZ, SPACING_HZ, (self.mains_hz,), self.lines_beside)
        return np.where(hum, 0, whole)

    @cached_property
    def noise(self):
        return Plant(self.damping_ratio, self.snr_db, self.periods, self.seed).noise


@pytest.mark.parametrize(
    ("mains_hz", "beside", "damping_ratio", "dearer"),
    [
        (50.0, 1, 0.005, 5.54),
        (50.0, 1, 0.02, 1.59),
        (50.0, 1, 0.1, 1.20),
        (50.0, 0, 0.005, 2.03),
        (50.0, 0, 0.02, 1.13),
        (50.0, 0, 0.1, 1.07),
        (60.0, 1, 0.005, 1.03),
        (60.0, 1, 0.02, 1.06),
        (60.0, 1, 0.1, 1.11),
    ],
)
def test_what_lines_left_out_cost_by_the_cramer_rao_bound(mains_hz, beside, damping_ratio, dearer):
    """The figures of docs/poles.md: deviation of f0 of a mode at 250 Hz, 8 periods."""
    left = WithoutMains(damping_ratio, 40.0, 8)
    left.__dict__.update(mains_hz=mains_hz, lines_beside=beside)
    whole = Plant(damping_ratio, 40.0, 8)
    ratio = np.sqrt(left.bound()[0, 0] / whole.bound()[0, 0])
    assert ratio == pytest.approx(dearer, abs=0.006)
