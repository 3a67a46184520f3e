# SPDX-License-Identifier: Apache-2.0
"""The bins that a stream keeps are those of the Fourier transform of the whole record."""

import numpy as np
import pytest

from tactile_resonance.frf.band_bins import BandBins
from tactile_resonance.frf.band_bins_stream import BandBinsStream


@pytest.mark.parametrize("samples", [300, 301])
@pytest.mark.parametrize("band", [(0.0, 4.0), (10.3, 20.7), (120.0, 200.0), (40.0, 40.5)])
def test_equal_the_transform_of_the_whole_record(samples, band):
    rng = np.random.default_rng(samples)
    harmonics = np.arange(1, (samples - 1) // 2 + 1, 2)
    record = rng.standard_normal((2, 6, samples))
    stream = BandBinsStream(
        harmonics, samples, sample_rate_hz=float(samples), band_hz=band, max_periods=6
    )
    assert stream.bins() is None
    for periods in range(1, 7):
        stream.add_period(*record[:, periods - 1])
        bins = stream.bins()
        if band[0] == 40.0:  # between odd lines: nothing is excited there
            assert bins is None
            continue
        whole = record[:, :periods].reshape(2, -1)
        expected = np.fft.rfft(whole)[:, bins.first_bin : bins.first_bin + bins.count]
        assert bins.u.shape == (1, bins.count)
        assert np.abs(bins.u - expected[0] / whole.shape[1]).max() < 1e-12
        assert np.abs(bins.y - expected[1] / whole.shape[1]).max() < 1e-12
        # all bins of the band and no other: without the mean, up to the last line below Nyquist
        low, high = bins.band_hz
        top = min(band[1], (samples - 1) // 2)
        assert max(band[0], 1 / periods) <= low + 1e-9 < max(band[0], 1e-9) + 1 / periods + 1e-9
        assert top - 1 / periods < high + 1e-9
        assert high <= top + 1e-9
        line = bins.harmonics
        assert np.array_equal(line, harmonics[(harmonics >= band[0]) & (harmonics <= band[1])])


def test_another_realisation_begins_anew():
    rng = np.random.default_rng(1)
    u, y = rng.standard_normal((2, 3, 128))
    stream = BandBinsStream(
        np.arange(1, 60), 128, sample_rate_hz=128.0, band_hz=(10, 20), max_periods=2
    )
    stream.add_period(u[0], y[0])
    stream.clear()
    for k in (1, 2):
        stream.add_period(u[k], y[k])
    bins = stream.bins()
    assert bins.periods == 2
    expected = np.fft.rfft(u[1:].ravel())[20:41] / 256
    assert np.abs(bins.u - expected).max() < 1e-13


def test_what_cannot_be_sent_is_refused():
    for band, message in (((30, 20), "30 to 20 Hz"), ((0, 20000), "at most 20000")):
        with pytest.raises(ValueError, match=message):
            BandBinsStream(
                np.arange(1, 9000), 20000, sample_rate_hz=50e3, band_hz=band, max_periods=8
            )
    with pytest.raises(ValueError, match="bins to 100"):
        BandBins(
            91, np.zeros((1, 10), complex), np.zeros((1, 10), complex), np.arange(1), 50.0, 64, 3
        )
