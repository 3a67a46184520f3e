# SPDX-License-Identifier: Apache-2.0
"""A mode at 250 Hz, damping 2 %, in the forms that users hand over."""

import numpy as np

from tactile_resonance.frf.result import FRF
from tactile_resonance.poles.estimator import identify_poles_from_records
from tactile_resonance.poles.structure import ModelStructure

BARE = ModelStructure(2, 2)
LINES_HZ = np.linspace(200, 300, 41)
S, W0 = 2j * np.pi * LINES_HZ, 2 * np.pi * 250
G = 0.1 + 0.04 * W0**2 / (S**2 + 0.04 * W0 * S + W0**2)


def circular(rng, shape, variance):
    parts = rng.standard_normal((*shape, 2)).view(complex)[..., 0]
    return parts * np.sqrt(np.asarray(variance) / 2)


NOISY = G + circular(np.random.default_rng(0), (41,), 1e-6)


def frf(**changes):
    fields = {"variance_noise": np.full(41, 1e-6), "noise_dof": 7, **changes}
    return FRF(**{"frequency_hz": LINES_HZ, "g": NOISY, **fields})


def spectra(**changes):
    """Arguments of `identify_spectra`."""
    covariance = np.zeros((2, 2, 41), complex)
    covariance[0, 0] = covariance[1, 1] = 1e-6
    u = np.exp(2j * np.pi * np.random.default_rng(1).random(41))
    good = {"frequency_hz": LINES_HZ, "spectra": np.stack([NOISY * u, u]), "dof": 7}
    return {**good, "covariance": covariance, "structure": BARE, **changes}


RATE_HZ, SAMPLES, PERIODS, HARMONICS = 5000.0, 2000, 3, np.arange(4, 401)


def record(noise=1e-3):
    """Three periods, settled."""
    rng = np.random.default_rng(2)
    spectrum = np.zeros(SAMPLES // 2 + 1, complex)
    spectrum[HARMONICS] = np.exp(2j * np.pi * rng.random(HARMONICS.size))
    s = 2j * np.pi * np.arange(spectrum.size) * RATE_HZ / SAMPLES
    g = 0.1 + 0.04 * W0**2 / (s**2 + 0.04 * W0 * s + W0**2)
    scale = SAMPLES / np.sqrt(2 * HARMONICS.size)
    u, y = (scale * np.fft.irfft(x, SAMPLES) for x in (spectrum, g * spectrum))
    shape = (PERIODS, SAMPLES)
    return (
        u + noise / 10 * rng.standard_normal(shape),
        y + noise * rng.standard_normal(shape),
    )


def from_record(**changes):
    u, y = record()
    good = {"u": u, "y": y, "sample_rate_hz": RATE_HZ, "harmonics": HARMONICS}
    return identify_poles_from_records(
        **{**good, "band_hz": (200.0, 300.0), "structure": BARE, **changes}
    )
