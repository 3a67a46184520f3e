# SPDX-License-Identifier: Apache-2.0
"""A mode that jumps within a record, as where the tip slips: told, and never stated as a drift that is sure."""

import re

import numpy as np
import pytest
from poles.mode_at_250_hz import HARMONICS, RATE_HZ, SAMPLES
from poles.test_drift import record as drifting_record
from poles.test_drift import repeated
from scipy import stats

from tactile_resonance.poles.result import PolesStatus
from tactile_resonance.poles.structure import ModelStructure

DEFAULT = ModelStructure()


def of_parts(periods, parts, rng, rest):
    """(P, N) of input and sensor: an oscillator whose stiffness steps, under the same force and damper.

    Each part is (first sample, f0_hz, damping ratio). In each the steady answer, exact from the spectrum of the
    period, and the free decay that joins position and velocity to those of the part before.
    """
    spectrum = np.zeros(SAMPLES // 2 + 1, complex)
    spectrum[HARMONICS] = np.exp(2j * np.pi * rng.random(HARMONICS.size))
    spectrum *= SAMPLES / np.sqrt(2 * HARMONICS.size)
    s = 2j * np.pi * np.arange(spectrum.size) * RATE_HZ / SAMPLES
    u = np.tile(np.fft.irfft(spectrum, SAMPLES), periods)
    _, f0_hz, damping = parts[0]
    force, y, state = 2 * damping * (2 * np.pi * f0_hz) ** 2, 0.1 * u, np.zeros(2)
    for k, (first, f0_hz, damping) in enumerate(parts):
        w = 2 * np.pi * f0_hz
        last = parts[k + 1][0] if k + 1 < len(parts) else u.size
        at = np.arange(first, last + 1)
        answer = force * spectrum / (s**2 + 2 * damping * w * s + w**2)
        steady = np.array([np.fft.irfft(of, SAMPLES)[at % SAMPLES] for of in (answer, s * answer)])
        x, v = np.zeros(2) if k == 0 and not rest else state - steady[:, 0]
        p = w * (-damping + 1j * np.sqrt(1 - damping**2))
        free = (x + 1j * (p.real * x - v) / p.imag) * np.exp(p * (at - first) / RATE_HZ)
        y[first:last] += steady[0, :-1] + free.real[:-1]
        state = steady[:, -1] + [free[-1].real, (p * free[-1]).real]
    return u.reshape(periods, SAMPLES), y.reshape(periods, SAMPLES)


def poles_of(u, y, snr_db, rng):
    noise = np.std(y) * 10 ** (-snr_db / 20)
    return next(repeated((u, y), noise, DEFAULT, runs=1, first=rng))


def a_jump(seed):
    """A record, the two f0 [Hz] in it, and the sample after which the second begins."""
    rng = np.random.default_rng([11, seed])
    periods, damping = int(rng.integers(2, 9)), 10 ** rng.uniform(-2.3, -1.3)
    f0_hz, half_widths = rng.uniform(235, 265), 10 ** rng.uniform(-1, 0.7) * rng.choice([-1, 1])
    later_hz = f0_hz + half_widths * damping * f0_hz
    if abs(later_hz - 250) > 45:
        later_hz = f0_hz - half_widths * damping * f0_hz
    first = int(rng.uniform(0.02, 0.98) * periods * SAMPLES)
    parts = [(0, f0_hz, damping), (first, later_hz, damping * f0_hz / later_hz)]
    u, y = of_parts(periods, parts, rng, rest=bool(rng.integers(2)))
    return poles_of(u, y, rng.uniform(20, 60), rng), (f0_hz, later_hz), first


def test_what_is_ok_is_one_of_the_two_poles():
    """Of jumps by .1 to 5 half widths anywhere. Before: 21 of 24 were ok, 17 of these neither."""
    named = 0
    for seed in range(24):
        poles, both_hz, _ = a_jump(seed)
        named += "jumps about" in poles.message
        if poles.status is PolesStatus.OK:
            off_hz = poles.main.estimate[0] - both_hz
            assert np.min(np.abs(off_hz)) < stats.norm.isf(5e-5) * poles.main.std[0]
    # of seven in ten, no more than that once in a thousand
    assert named > stats.binom.ppf(1e-3, 24, 0.7)


@pytest.mark.parametrize("half_widths", [0.3, -1.0])
def test_the_sentence_says_what_jumped_and_when(half_widths):
    for seed in range(5):
        rng = np.random.default_rng([12, seed])
        at_s, change_hz = rng.uniform(0.4, 1.2), half_widths * 0.02 * 250
        parts = [(0, 250.0, 0.02), (round(at_s * RATE_HZ), 250 + change_hz, 0.02)]
        poles = poles_of(*of_parts(4, parts, rng, rest=True), 40.0, rng)
        assert poles.status is PolesStatus.MODEL_ERROR
        found = re.search(r"jumps about (\S+) s after .* f0 by about (\S+) Hz", poles.message)
        assert float(found[1]) == pytest.approx(at_s, abs=0.06)
        assert float(found[2]) == pytest.approx(change_hz, rel=0.2)


def test_modes_that_creep_do_not_jump():
    """Exponentially, from a tenth of the record on; by up to two half widths."""
    rng = np.random.default_rng(13)
    for seed in range(16):
        periods, damping, part = int(rng.integers(2, 9)), 10 ** rng.uniform(-2, -1.3), rng.uniform(0.1, 1)

        def shape(time_s, part=part):
            curve = -np.exp(-(time_s - time_s[0]) / (part * (time_s[-1] - time_s[0])))
            return (curve - curve.mean()) / np.polyfit(time_s, curve, 1)[0]

        per_s = 10 ** rng.uniform(-1.3, 0) * damping * 250 / (periods * SAMPLES / RATE_HZ)
        u, y = drifting_record(periods, per_s, 0.0, damping=damping, shape=shape, seed=seed)
        poles = poles_of(u, y, rng.uniform(20, 60), rng)
        assert "jumps" not in poles.message


def test_a_jump_of_the_damping_is_no_tone():
    """A narrow mode. Beside what polynomials leave, 2 of 10 were taken for a tone, ok with another damping."""
    for seed in range(10):
        rng = np.random.default_rng([14, seed])
        first = int(rng.uniform(0.3, 0.7) * 7 * SAMPLES)
        parts = [(0, 243.0, 0.0057), (first, 243.0, 0.0031)]
        poles = poles_of(*of_parts(7, parts, rng, rest=False), 50.0, rng)
        assert poles.status is PolesStatus.MODEL_ERROR
        assert "jumps about" in poles.message
