# SPDX-License-Identifier: Apache-2.0
"""The Python in docs/first_connection.md does what the page says, on records of known content."""

import re
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.cli import main
from tactile_resonance.multisine import design_multisine
from tactile_resonance.record import Channel, Origin, Record
from tactile_resonance.recording.store import RecordStore

PAGE = Path(__file__).resolve().parent.parent / "docs" / "first_connection.md"
RATE_HZ, SAMPLES, PERIODS = 50e3, 5000, 8


@pytest.fixture
def record(tmp_path, monkeypatch):
    """Write a measurement into checks/NAME: the sensor is the actuator times `response`."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(3)

    def write(name, key, response, level_v=0.1, drive=1.0, hum_v=0.0, noise_v=1e-5, limit_v=9.0):
        excitation = design_multisine(
            sample_rate_hz=RATE_HZ,
            samples_per_period=SAMPLES,
            level_v=level_v,
            periods=PERIODS,
            measurement_id=key,
            excitation_id=key,
        )
        spectrum = excitation.spectrum() * SAMPLES
        f_hz = np.fft.rfftfreq(SAMPLES, 1 / RATE_HZ)
        u = drive * np.fft.irfft(spectrum, SAMPLES)
        y = drive * np.fft.irfft(spectrum * response(f_hz), SAMPLES)
        store = RecordStore(Path("checks") / name)
        store.begin([excitation])
        store.add_excitation(excitation)
        for block in range(PERIODS):
            t = (np.arange(SAMPLES) + block * SAMPLES) / RATE_HZ
            sensor = y + hum_v * np.sqrt(2) * np.sin(2 * np.pi * 50 * t + 1)
            u_noise, y_noise = noise_v * rng.standard_normal((2, SAMPLES))
            counts = np.rint((sensor + y_noise) / 1e-6).astype(np.int32)
            saturated = bool(np.max(np.abs(sensor)) > limit_v)
            store.add_record(
                Record(
                    Channel(u + u_noise),
                    Channel(counts, 1e-6, saturated=saturated),
                    RATE_HZ,
                    SAMPLES,
                    block_index=block,
                    origin=Origin(measurement_id=key, excitation_id=key),
                )
            )

    return write


def run(number, capsys):
    """Output of the page's piece of Python with this number."""
    pieces = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(pieces) == 2
    exec(compile(pieces[number], f"{PAGE.name}, piece {number}", "exec"), {})
    return capsys.readouterr().out


def test_loopback_finds_the_delay(record, capsys):
    delay_s = 137e-9
    record("loopback", 1, lambda f: 1.002 * np.exp(-2j * np.pi * f * delay_s))
    text = run(0, capsys)
    delay_ns, std_ns, gain, left = map(float, re.findall(r"-?\d+\.?\d*(?:e-\d+)?", text))
    assert abs(delay_ns - 137) < 5 * std_ns + 0.1
    assert std_ns < 10
    assert gain == pytest.approx(1.002, abs=1e-4)
    assert left < 0.1


def test_noise_and_hum_have_their_size(record, capsys):
    # the switch is open: nothing of the drive arrives
    record("noise", 1, np.zeros_like, drive=0.0, hum_v=3e-3, noise_v=1e-4)
    command = re.search(r"tactile_resonance (analyze checks/noise .*)", PAGE.read_text("utf-8"))
    assert main(command[1].split()) == 0
    text = capsys.readouterr().out
    found = re.findall(r"tone at ([\d.]+) Hz: fits hum of 50 Hz, ([\d.]+) V rms in the (\w+)", text)
    assert found == [("50.0", "0.003", "sensor")]
    # white noise of 0.1 mV over 25 kHz
    assert "actuator: noise 6.3e-07 V/sqrt(Hz)" in text


def test_ramp_tells_the_level_that_is_too_high(record, capsys):
    for key, level_v in enumerate((0.1, 0.2, 0.5), start=1):
        # the response of the last one is off by 5 %, and a channel is at its limit
        gain = 0.5 if level_v < 0.5 else 0.525
        limit_v = 0.7
        record("ramp", key, lambda f, g=gain: g + 0 * f, level_v=level_v, limit_v=limit_v)
    lines = run(1, capsys).strip().split("\n")
    assert len(lines) == 3
    changes = [float(re.search(r"change ([\d.]+)%", line)[1]) for line in lines]
    assert changes[0] == 0
    assert changes[1] < 1
    assert changes[2] == pytest.approx(5, abs=0.5)
    assert ["saturated True" in line for line in lines] == [False, False, True]
