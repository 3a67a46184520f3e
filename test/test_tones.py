# SPDX-License-Identifier: Apache-2.0
"""A record without drive: tones by frequency and size, noise by its density."""

import numpy as np
import pytest

from tactile_resonance.cli import main
from tactile_resonance.tones import silent_record

RATE_HZ, PERIODS, SAMPLES = 5000.0, 8, 2000


def white(rng, density):
    """(P, N) noise of this one-sided density [V/sqrt(Hz)]."""
    return density * np.sqrt(RATE_HZ / 2) * rng.standard_normal((PERIODS, SAMPLES))


def tones(*frequency_and_rms):
    t = np.arange(PERIODS * SAMPLES).reshape(PERIODS, SAMPLES) / RATE_HZ
    return sum(np.sqrt(2) * rms * np.sin(2 * np.pi * f * t + f) for f, rms in frequency_and_rms)


def test_tones_and_noise_are_those_put_in():
    rng = np.random.default_rng(1)
    hidden = (49.98, 1e-3), (149.94, 3e-4), (333.3, 1e-4)
    u, y = white(rng, 1e-6), white(rng, 2e-6) + tones(*hidden)
    found = silent_record(u, y, sample_rate_hz=RATE_HZ)
    assert found.actuator_noise == pytest.approx(1e-6, rel=0.05)
    assert found.sensor_noise == pytest.approx(2e-6, rel=0.05)
    assert len(found.tones) == 3
    for tone, (frequency_hz, rms_v) in zip(found.tones, hidden, strict=True):
        assert tone.channel == "sensor"
        assert tone.frequency_hz == pytest.approx(frequency_hz, abs=0.02)
        assert tone.rms_v == pytest.approx(rms_v, rel=0.05)
    assert [tone.mains_hz for tone in found.tones] == [(50.0,), (50.0,), ()]


@pytest.mark.parametrize("volts", [0.1, 1 / 3])
def test_rounding_is_no_tone(volts):
    """Of a channel that stands still, and beside a tone without noise: peaks of 1e-16 of it were named."""
    still, alone = np.full((PERIODS, SAMPLES), volts), tones((50.0, 0.7))
    with np.errstate(divide="raise"):
        found = silent_record(still, alone, sample_rate_hz=RATE_HZ)
    assert [(tone.channel, round(tone.frequency_hz)) for tone in found.tones] == [("sensor", 50)]


def test_noise_is_no_tone():
    """White, and that of a random walk, whose density falls by 20 dB a decade."""
    rng = np.random.default_rng(2)
    for _ in range(150):
        walk = np.cumsum(white(rng, 1e-6)).reshape(PERIODS, SAMPLES)
        assert silent_record(white(rng, 1e-6), walk, sample_rate_hz=RATE_HZ).tones == ()


def test_zeros_hold_nothing():
    nothing = np.zeros((PERIODS, SAMPLES))
    found = silent_record(nothing, nothing, sample_rate_hz=RATE_HZ)
    assert found.tones == ()
    assert found.sensor_noise == 0


def test_a_band_may_be_asked_for_and_must_hold_bins():
    rng = np.random.default_rng(3)
    u, y = white(rng, 1e-6), white(rng, 1e-6) + tones((50.0, 1e-3), (250.0, 1e-3))
    (tone,) = silent_record(u, y, sample_rate_hz=RATE_HZ, band_hz=(200.0, 300.0)).tones
    assert tone.frequency_hz == pytest.approx(250, abs=0.02)
    with pytest.raises(ValueError, match=r"band_hz: 200..201 Hz hold 4 bins"):
        silent_record(u, y, sample_rate_hz=RATE_HZ, band_hz=(200.0, 201.0))


def test_a_short_record_says_from_where_on_it_shows_tones():
    """50 Hz are the tenth bin of 0.2 s: among the first sixteen, in which none is looked for."""
    rng = np.random.default_rng(5)
    short = slice(0, int(0.2 * RATE_HZ))
    u, y = white(rng, 1e-6), white(rng, 1e-6) + tones((50.0, 1e-3))
    u, y = (x.reshape(1, -1)[:, short] for x in (u, y))
    found = silent_record(u, y, sample_rate_hz=RATE_HZ)
    assert found.tones == ()
    assert found.band_hz == pytest.approx((80.0, RATE_HZ / 2))
    assert "no tones from 80 to" in found.text()
    given = silent_record(u, y, sample_rate_hz=RATE_HZ, band_hz=(200.0, 300.0))
    assert given.band_hz == (200.0, 300.0)
    with pytest.raises(ValueError, match=r"40..60 Hz hold 0 bins above the 80 Hz from which a record of"):
        silent_record(u, y, sample_rate_hz=RATE_HZ, band_hz=(40.0, 60.0))


def test_analyze_prints_what_a_silent_record_holds(tmp_path, capsys):
    rng = np.random.default_rng(4)
    u, y = white(rng, 1e-6), white(rng, 2e-6) + tones((249.9, 1e-4))
    path = tmp_path / "silent.npz"
    np.savez(path, u=u, y=y, sample_rate_hz=RATE_HZ, samples_per_period=SAMPLES)
    assert main(["analyze", str(path), "--silent"]) == 0
    out = capsys.readouterr().out
    lowest_hz = 16 * RATE_HZ / (PERIODS * SAMPLES)
    assert f"sensor: noise 2e-06 V/sqrt(Hz), median from {lowest_hz:g} to 2500 Hz" in out
    assert "tone at 249.9 Hz: fits hum of 50 Hz, 0.0001 V rms in the sensor" in out
    for options in (["--json", tmp_path / "a.json"], ["--order", 4], ["--distortion"]):
        assert main(["analyze", str(path), "--silent", *map(str, options)]) != 0
        error = capsys.readouterr().err
        assert f"{options[0]}: got" in error
        assert "accepted is one without --silent" in error


def test_a_silent_record_needs_no_period(tmp_path, capsys):
    """Nor does its length have to be a multiple of anything."""
    u, y = np.random.default_rng(1).standard_normal((2, 20011))
    path = tmp_path / "silent.npz"
    np.savez(path, u=u, y=y, sample_rate_hz=RATE_HZ)
    assert main(["analyze", str(path), "--silent"]) == 0
    assert capsys.readouterr().out.startswith("actuator: noise ")


def test_a_driven_record_that_names_no_lines_is_refused_but_not_one_with_hum(tmp_path, capsys):
    """Harmonics of the mains up to 2.45 kHz lie on the lines of this period."""
    rng, path = np.random.default_rng(6), tmp_path / "record.npz"
    hum = tones(*((50.0 * k, 1e-3 / k) for k in range(1, 50)))
    multisine = tones(*((k * RATE_HZ / SAMPLES, 1e-3) for k in range(60, 161)))
    for u, status in ((hum, 0), (multisine, 1), (hum + multisine, 1)):
        fields = {"sample_rate_hz": RATE_HZ, "samples_per_period": SAMPLES}
        np.savez(path, u=u + white(rng, 1e-6), y=white(rng, 1e-6), **fields)
        assert main(["analyze", str(path), "--silent"]) == status
    assert capsys.readouterr().err.count("expected a record taken without drive") == 2


def test_a_driven_record_is_refused_as_silent(tmp_path, capsys):
    """But not one of the same lines at level 0, as scans store their silent records."""
    rng = np.random.default_rng(5)
    path, harmonics = tmp_path / "record.npz", np.arange(80, 121)
    multisine = tones(*((k * RATE_HZ / SAMPLES, 1e-3) for k in harmonics))
    for level, status in ((0.0, 0), (1.0, 1)):
        u, y = white(rng, 1e-6) + level * multisine, white(rng, 1e-6)
        fields = {"sample_rate_hz": RATE_HZ, "samples_per_period": SAMPLES, "excited_harmonics": harmonics}
        np.savez(path, u=u, y=y, **fields)
        assert main(["analyze", str(path), "--silent"]) == status
    # 1 mV against noise in 0.3125 Hz: 65 dB, and 1.6 from the mean to the median of noise power
    assert "record: the actuator has 67 dB more power at the excited lines" in capsys.readouterr().err
