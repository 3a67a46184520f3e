# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from tactile_resonance.crest_factor import compress_crest_factor
from tactile_resonance.multisine import design_multisine


def test_peaks_shrink_and_nothing_else_changes():
    """Random phases give about 4; clipping is known to reach below 1.7 (a sine has 1.41)."""
    random = design_multisine(
        sample_rate_hz=5e3, samples_per_period=2000, band_hz=(10, 1000), seed=3
    )
    compressed = compress_crest_factor(random, passes=300)
    assert random.crest_factor() > 3
    assert compressed.crest_factor() < 1.7
    np.testing.assert_array_equal(compressed.amplitude_v, random.amplitude_v)
    np.testing.assert_array_equal(compressed.harmonics, random.harmonics)
    assert compressed.level_v == random.level_v
    assert not compressed.random_phases
    others = np.delete(np.fft.rfft(compressed.period()) / 2000, compressed.harmonics)
    assert np.max(np.abs(others)) < 1e-15


def test_more_passes_never_make_it_worse():
    random = design_multisine(sample_rate_hz=5e3, samples_per_period=2000, band_hz=(10, 1000))
    assert compress_crest_factor(random, passes=1).crest_factor() <= random.crest_factor() * 1.001


def test_refused_where_statistics_need_random_phases():
    with pytest.raises(ValueError, match="realisations: 2, compressed phases are not random"):
        compress_crest_factor(design_multisine(realisations=2))
    with pytest.raises(ValueError, match="passes"):
        compress_crest_factor(design_multisine(), passes=0)
