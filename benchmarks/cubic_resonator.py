# SPDX-License-Identifier: Apache-2.0
"""A resonator whose stiffness grows with the square of the deflection: another linear system for each input.

``x'' + 2 zeta w0 x' + w0^2 (x + k x^3) = w0^2 u``, from rest, by the classical Runge-Kutta method of
fourth order; between samples the input is that of the multisine, exactly.
"""

from __future__ import annotations

import numpy as np

from tactile_resonance._typing import FloatArray

SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD = 4000.0, 1600
HARMONICS = np.arange(4, 401)  # 10 to 1000 Hz
BAND_HZ = (200.0, 300.0)
F0_HZ, DAMPING_RATIO = 250.0, 0.02
STEPS = 4  # of the method in a sample: without k the response is exact to 4e-5
_STEP_S = 1 / SAMPLE_RATE_HZ / STEPS


def linear_mode() -> tuple[float, float]:
    """f0 [Hz] and damping ratio without k, as the method makes them: a pole p becomes ``ln R(p h) / h``.

    R is the stability function of the method, the first five terms of the exponential series.
    """
    w0 = 2 * np.pi * F0_HZ
    z = w0 * (-DAMPING_RATIO + 1j * np.sqrt(1 - DAMPING_RATIO**2)) * _STEP_S
    pole = np.log(1 + z * (1 + z / 2 * (1 + z / 3 * (1 + z / 4)))) / _STEP_S
    return float(abs(pole) / (2 * np.pi)), float(-pole.real / abs(pole))


def records(
    rng: np.random.Generator, count: int, periods: int, cubic: float, snr_db: float
) -> tuple[FloatArray, FloatArray]:
    """Input of 1 V rms and output with noise, each with phases of its own.

    Parameters
    ----------
    cubic : float
        k [1/V^2].
    snr_db : float
        Output over its noise, of samples.

    Returns
    -------
    u, y : (count, periods, samples) float
    """
    fine = 2 * STEPS * SAMPLES_PER_PERIOD
    spectrum = np.zeros((count, fine // 2 + 1), complex)
    spectrum[:, HARMONICS] = np.exp(2j * np.pi * rng.random((count, HARMONICS.size)))
    period = np.fft.irfft(spectrum, fine) * fine / np.sqrt(2 * HARMONICS.size)
    u = np.repeat(period[:, None, :: 2 * STEPS], periods, axis=1)
    y = _respond(period.T, periods, cubic).T.reshape(u.shape)
    noise = 10 ** (-snr_db / 20) * y.std() * rng.standard_normal(y.shape)
    return u, y + noise


def _respond(u: FloatArray, periods: int, cubic: float) -> FloatArray:
    """(samples, count) of one period at half steps (2 STEPS samples, count), repeated."""
    w0, h = 2 * np.pi * F0_HZ, _STEP_S
    x, v = np.zeros(u.shape[1]), np.zeros(u.shape[1])

    def force(x: FloatArray, v: FloatArray, u: FloatArray) -> FloatArray:
        return w0**2 * (u - x * (1 + cubic * x * x)) - 2 * DAMPING_RATIO * w0 * v

    out = np.empty((periods * SAMPLES_PER_PERIOD, u.shape[1]))
    for n in range(periods * SAMPLES_PER_PERIOD * STEPS):
        if n % STEPS == 0:
            out[n // STEPS] = x
        first, half, last = (u[(2 * n + k) % u.shape[0]] for k in range(3))
        a1 = force(x, v, first)
        v2 = v + h / 2 * a1
        a2 = force(x + h / 2 * v, v2, half)
        v3 = v + h / 2 * a2
        a3 = force(x + h / 2 * v2, v3, half)
        v4 = v + h * a3
        a4 = force(x + h * v3, v4, last)
        x = x + h / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return out
