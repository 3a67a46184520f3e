# SPDX-License-Identifier: Apache-2.0
"""A measurement of two bands: bins, poles and distortion of each, from one record."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_resonance.frf.distortion import nonlinear_distortion, spectra_between
from tactile_resonance.frf.measurement import MeasurementFrf
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.multisine import Grid, design_multisine
from tactile_resonance.poles.estimator import poles_of_bands
from tactile_resonance.poles.result import PolesStatus
from tactile_resonance.poles.structure import PoleBand
from tactile_resonance.record import Channel, Record
from tactile_resonance.recording.store import read_stored, write_stored

RATE_HZ, N, PERIODS = 5e3, 2000, 3
BANDS = (PoleBand(200.0, 300.0), PoleBand(600.0, 800.0, residual_terms=10))
MODES = ((250.0, 0.02), (704.0, 0.015))


def excitation(realisation=0, **given):
    asked = {
        "band_hz": ((180.0, 320.0), (580.0, 820.0)),
        "bands": BANDS,
        "realisations": 2,
        "realisation": realisation,
        **given,
    }
    return design_multisine(
        sample_rate_hz=RATE_HZ, samples_per_period=N, periods=PERIODS, seed=1, **asked
    )


def measured(made, noise_v=1e-4, square=0.0):
    """Records of a system of two modes played from rest, with a nonlinearity at its output."""
    rng = np.random.default_rng(made.realisation)
    u = np.tile(made.period(), PERIODS)
    s = 2j * np.pi * np.fft.rfftfreq(4 * u.size, 1 / RATE_HZ)
    g = 0.02 + 0j
    for f0_hz, damping in MODES:
        w0 = 2 * np.pi * f0_hz
        g = g + 100 * s / (s**2 + 2 * damping * w0 * s + w0**2)
    y = np.fft.irfft(np.fft.rfft(u, 4 * u.size) * g)[: u.size]
    y = y + square * u**2
    u, y = (x + noise_v * rng.standard_normal(x.size) for x in (u, y))
    return u.reshape(PERIODS, N), y.reshape(PERIODS, N)


def all_of(measurement, made, **how):
    u, y = measured(made, **how)
    for p in range(PERIODS):
        frf = measurement.add(
            Record(Channel(u[p]), Channel(y[p]), RATE_HZ, N, made.realisation, block_index=p),
            made,
        )
    return frf


def test_only_the_stretches_asked_for_are_excited():
    f = excitation().frequency_hz
    assert f.min() == 180
    assert f.max() == 820
    assert not np.any((f > 320) & (f < 580))
    assert f.size == 57 + 97


def test_both_modes_come_from_one_record():
    frf = all_of(MeasurementFrf(1), excitation())
    assert frf.bands == BANDS
    assert frf.bins.harmonics.size == 41
    assert [bins.harmonics.size for bins in frf.further_bins] == [81]
    poles = poles_of_bands(frf, frf.bands)
    assert [each.band_hz for each in poles.bands] == [(200.0, 300.0), (600.0, 800.0)]
    for each, band, (f0_hz, damping) in zip(poles.bands, BANDS, MODES, strict=True):
        assert each.status is PolesStatus.OK
        assert each.method == "joint maximum likelihood of poles and transient"
        assert each.structure.numerator_order == band.order + band.residual_terms - 1
        off = (each.main.estimate - [f0_hz, damping]) / each.main.std
        assert np.all(np.abs(off) < 4)
    # each as it would be alone
    alone = poles_of_bands(replace(frf, further_bins=()), BANDS[:1])
    assert poles.main.f0_hz == alone.main.f0_hz


def test_the_data_choose_the_order_of_a_band():
    bands = (replace(BANDS[0], order=0, low_hz=200.0, high_hz=800.0),)
    made = excitation(bands=bands, band_hz=(180.0, 820.0))
    poles = poles_of_bands(all_of(MeasurementFrf(1), made), bands)
    assert poles.structure.order == 4
    assert poles.f0_hz == pytest.approx([250, 704], abs=0.5)


@pytest.mark.parametrize("square", [0.0, 2e-3])
def test_even_distortion_is_told_in_each_band(square):
    wide = {"band_hz": (10.0, 2000.0), "grid": Grid.ODD_RANDOM}
    measurement = MeasurementFrf(1)
    frfs = [all_of(measurement, excitation(m, **wide), square=square) for m in range(2)]
    assert [(d.low_hz, d.high_hz) for d in frfs[-1].distortion] == [b.ends_hz for b in BANDS]
    for found in frfs[-1].distortion:
        assert found.even_above_noise == (square > 0)
        assert found.even_noise_db < -60
        assert found.input_even_db < -60
        assert not found.odd_above_noise
        if not square:
            assert found.even_db == pytest.approx(found.even_noise_db, abs=3)
    # what the whole record shows in the band
    u, y = (
        np.stack(x)
        for x in zip(
            *(measured(excitation(m, **wide), square=square) for m in range(2)), strict=True
        )
    )
    made = excitation(**wide)
    inside = made.harmonics[(made.frequency_hz >= 200) & (made.frequency_hz <= 300)]
    spectra = spectra_between(Spectrum.of(u, y), inside, made.harmonics)
    whole = nonlinear_distortion(spectra, inside, sample_rate_hz=RATE_HZ)
    assert frfs[-1].distortion[0].even_db == pytest.approx(float(whole.even.rms_level_db))
    assert frfs[-1].distortion[0].input_odd_db == pytest.approx(float(whole.odd.rms_input_level_db))
    # nothing of the kind where every line is excited
    assert all_of(MeasurementFrf(1), excitation()).distortion == ()


def test_a_transient_of_a_single_period_is_not_called_distortion():
    """From rest the linear system has -17 dB at the lines that are left out."""
    made = excitation(band_hz=(10.0, 2000.0), grid=Grid.ODD_RANDOM)
    u, y = measured(made)
    frf = MeasurementFrf(1).add(Record(Channel(u[0]), Channel(y[0]), RATE_HZ, N), made)
    for found in frf.distortion:
        assert np.isnan([found.even_db, found.odd_db, found.even_noise_db]).all()
        assert found.input_even_db < -60
        assert not found.even_above_noise


def test_bands_are_stored_with_their_excitation(tmp_path):
    for made in (excitation(), excitation(bands=())):
        write_stored(tmp_path / "e.npz", made)
        assert read_stored(tmp_path / "e.npz", type(made)).bands == made.bands
