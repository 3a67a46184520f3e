# SPDX-License-Identifier: Apache-2.0
"""The bins of a band are those of the Fourier transform of the whole record."""

import numpy as np
import pytest

from tactile_resonance.frf.result import BandBins, band_bins, stacked_bins
from tactile_resonance.frf.spectra import Spectrum


@pytest.mark.parametrize("samples", [300, 301])
@pytest.mark.parametrize("band", [(0.0, 4.0), (10.3, 20.7), (120.0, 200.0), (40.0, 40.5)])
@pytest.mark.parametrize("periods", [1, 2, 6])
def test_equal_the_transform_of_the_whole_record(samples, band, periods):
    rng = np.random.default_rng(samples)
    harmonics = np.arange(1, (samples - 1) // 2 + 1, 2)
    u, y = rng.standard_normal((2, 3, periods, samples))
    bins = band_bins(Spectrum.of(u, y), harmonics, sample_rate_hz=float(samples), band_hz=band)
    if band[0] == 40.0:  # between odd lines: nothing is excited there
        assert bins is None
        return
    assert bins.u.shape == (3, bins.count)
    for found, x in ((bins.u, u), (bins.y, y)):
        whole = np.fft.rfft(x.reshape(3, -1)) / (periods * samples)
        expected = whole[:, bins.first_bin : bins.first_bin + bins.count]
        assert np.abs(found - expected).max() < 1e-12
    # all bins of the band and no other: without the mean, up to the last below half the rate
    low, high = bins.band_hz
    top = min(band[1], ((periods * samples - 1) // 2) / periods)
    assert max(band[0], 1 / periods) <= low + 1e-9 < max(band[0], 1e-9) + 1 / periods + 1e-9
    assert top - 1 / periods < high <= top + 1e-9
    line = bins.harmonics
    assert np.array_equal(line, harmonics[(harmonics >= band[0]) & (harmonics <= band[1])])


def test_realisations_are_stacked():
    rng = np.random.default_rng(1)

    first, second = (
        band_bins(Spectrum(samples), np.arange(1, 60), sample_rate_hz=128.0, band_hz=(10, 20))
        for samples in rng.standard_normal((2, 2, 2, 128))
    )
    both = stacked_bins([first, second])
    assert np.array_equal(both.u, np.concatenate([first.u, second.u]))
    assert np.array_equal(both.y, np.concatenate([first.y, second.y]))
    assert (both.first_bin, both.periods) == (20, 2)


def test_refusals():
    silent = Spectrum(np.zeros((2, 1, 100)))
    with pytest.raises(ValueError, match="30 to 20 Hz"):
        band_bins(silent, np.arange(1, 40), sample_rate_hz=100.0, band_hz=(30, 20))
    with pytest.raises(ValueError, match="bins to 100"):
        BandBins(
            91, np.zeros((1, 10), complex), np.zeros((1, 10), complex), np.arange(1), 50.0, 64, 3
        )
