# SPDX-License-Identifier: Apache-2.0
"""Signals for the tests of the FRF."""

import numpy as np
import pytest


def _multisine(harmonics, samples, rng, *, amplitude=1.0, records=()):
    """(*records, N) random-phase multisines; `amplitude` is the peak of each line."""
    harmonics = np.asarray(harmonics)
    spectrum = np.zeros((*records, samples // 2 + 1), complex)
    phase = rng.uniform(0, 2 * np.pi, (*records, harmonics.size))
    spectrum[..., harmonics] = amplitude / 2 * np.exp(1j * phase)
    return np.fft.irfft(spectrum * samples, samples, axis=-1)


def _deviation_from_one(numerator, denominator):
    """Ratio of means over runs, and how many of its standard errors it is from 1.

    Both (runs, ...): averaged within a run first, so that only runs need to be independent.
    """
    a = np.real(numerator).reshape(len(numerator), -1).mean(axis=1)
    b = np.real(denominator).reshape(len(denominator), -1).mean(axis=1)
    ratio = a.mean() / b.mean()
    error = np.std(a - ratio * b, ddof=1) / np.sqrt(len(a)) / b.mean()
    return ratio, abs(ratio - 1) / error


@pytest.fixture(scope="session")
def multisine():
    return _multisine


@pytest.fixture(scope="session")
def deviation_from_one():
    return _deviation_from_one
