# SPDX-License-Identifier: Apache-2.0
"""An FRF in which a transient is left does not give poles of status ok."""

import re

import numpy as np
import pytest

from tactile_resonance.frf.estimate import frf_of_record
from tactile_resonance.frf.result import FrfStatus
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.front import estimate_frf
from tactile_resonance.poles.identify import identify_frf
from tactile_resonance.poles.result import PolesStatus
from tactile_resonance.poles.structure import ModelStructure
from tactile_resonance.recording.recording import make_recording

RATE_HZ, SAMPLES, LINES = 5000.0, 2000, np.arange(4, 401)


def record(seed, periods, damping_ratio, snr_db, *, settled):
    """u, y (P, N) of a mode at 250 Hz, from rest or long after."""
    rng = np.random.default_rng(seed)
    spectrum = np.zeros(SAMPLES // 2 + 1, complex)
    spectrum[LINES] = np.exp(2j * np.pi * rng.random(LINES.size))
    played = periods + 12
    u = np.tile(np.fft.irfft(spectrum, SAMPLES), played)
    s = 2j * np.pi * np.fft.rfftfreq(2 * u.size, 1 / RATE_HZ)
    w0 = 2 * np.pi * 250
    g = 0.1 + 2 * damping_ratio * w0**2 / (s**2 + 2 * damping_ratio * w0 * s + w0**2)
    y = np.fft.irfft(np.fft.rfft(u, 2 * u.size) * g)[: u.size]
    noise = 10 ** (-snr_db / 20)
    y = y + noise * y.std() * rng.standard_normal(y.size)
    u = u + 0.1 * noise * u.std() * rng.standard_normal(u.size)
    kept = slice(-periods, None) if settled else slice(periods)
    return u.reshape(played, SAMPLES)[kept], y.reshape(played, SAMPLES)[kept]


def poles_of(seed, *arguments, settled, realisations=1):
    records = [record(seed + 1000 * m, *arguments, settled=settled) for m in range(realisations)]
    u, y = (np.stack(channel) for channel in zip(*records, strict=True))
    frf = frf_of_record(Spectrum.of(u, y), sample_rate_hz=RATE_HZ, harmonics=LINES)
    return identify_frf(frf, (200.0, 300.0), ModelStructure(2, 2))


@pytest.mark.parametrize(
    ("periods", "damping_ratio", "snr_db"),
    [(2, 0.005, 20), (2, 0.005, 80), (2, 0.02, 40), (2, 0.1, 80), (4, 0.02, 60), (8, 0.005, 40)],
)
def test_a_transient_that_the_polynomials_do_not_follow_is_told(periods, damping_ratio, snr_db):
    for seed in range(10):
        case = (seed, periods, damping_ratio, snr_db)
        poles = poles_of(*case, settled=False)
        assert poles.status is PolesStatus.MODEL_ERROR
        assert "do not follow its transient" in poles.message
        assert poles.total_covariance is not None
        settled = poles_of(*case, settled=True)
        assert settled.status is PolesStatus.OK
        assert "beside the mode" not in settled.message


@pytest.mark.parametrize("periods", [2, 4, 8])
@pytest.mark.parametrize("half_width_bins", [0.05, 0.15, 0.45])
@pytest.mark.parametrize("snr_db", [40, 60])
def test_total_ellipses_hold_modes_narrower_than_a_bin(periods, half_width_bins, snr_db):
    """From rest; damping ratios were off by three to sixteen deviations."""
    damping_ratio = half_width_bins * RATE_HZ / SAMPLES / periods / 250
    for seed in range(5):
        mode = poles_of(seed, periods, damping_ratio, snr_db, settled=False).main
        assert (np.abs(mode.estimate - [250, damping_ratio]) < 3 * mode.std).all()
        assert mode.f0_hz == pytest.approx(250, abs=0.2 * RATE_HZ / SAMPLES / periods)


def test_a_transient_that_they_follow_is_none_of_their_faults():
    for seed in range(10):
        assert poles_of(seed, 8, 0.05, 40, settled=False).status is PolesStatus.OK


@pytest.mark.parametrize("half_width_bins", [0.1, 0.3, 1.0])
@pytest.mark.parametrize(("realisations", "periods"), [(6, 1), (10, 1), (50, 1), (2, 2), (10, 2), (10, 4)])
def test_several_realisations_from_rest(realisations, periods, half_width_bins):
    """Damping ratios were off by up to sixteen deviations, with status ok."""
    damping_ratio = half_width_bins * RATE_HZ / SAMPLES / periods / 250
    for seed in range(3):
        case = (seed, periods, damping_ratio, 60)
        poles = poles_of(*case, settled=False, realisations=realisations)
        assert poles.status is PolesStatus.MODEL_ERROR
        assert "transient" in poles.message
        mode = poles.main
        assert (np.abs(mode.estimate - [250, damping_ratio]) < 3 * mode.std).all()
        if 12 * half_width_bins / periods > 1.5:  # nothing is left after twelve periods
            settled = poles_of(*case, settled=True, realisations=realisations)
            assert settled.status is PolesStatus.OK


@pytest.mark.parametrize("realisations", [1, 4])
@pytest.mark.parametrize("periods", [2, 8])
@pytest.mark.parametrize("half_width_bins", [0.1, 0.3, 8.0])
def test_the_frf_of_a_mode_narrower_than_a_bin_is_suspect(periods, realisations, half_width_bins):
    """From rest its peak is off by some 1.6 deviations over the half width in bins, at any noise."""
    damping_ratio = half_width_bins * RATE_HZ / SAMPLES / periods / 250
    for seed in range(3):
        for settled in (False, True):
            if settled and half_width_bins < 1:
                continue  # twelve periods are too few for it
            case = (periods, damping_ratio, 60)
            records = [record(seed + 1000 * m, *case, settled=settled) for m in range(realisations)]
            u, y = (np.stack(channel) for channel in zip(*records, strict=True))
            recording = make_recording(u, y, sample_rate_hz=RATE_HZ, excited_harmonics=LINES)
            frf = estimate_frf(recording)
            s, w0 = 2j * np.pi * frf.frequency_hz, 2 * np.pi * 250
            truth = 0.1 + 2 * damping_ratio * w0**2 / (s**2 + 2 * damping_ratio * w0 * s + w0**2)
            worst = np.max(np.abs(frf.g - truth) / np.sqrt(frf.variance_noise))
            if half_width_bins < 1:
                assert worst > 4
                assert frf.status is FrfStatus.SUSPECT
                assert re.search(r"stand out from the lines beside at .*\b250\b.* Hz", frf.message)
            else:
                assert worst < 4.5
                assert frf.status is FrfStatus.OK
