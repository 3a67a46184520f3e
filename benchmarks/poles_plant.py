# SPDX-License-Identifier: Apache-2.0
"""A plant with exact spectra, and the Cramer-Rao bound of its poles: what estimators are judged by.

Second-order mode on a feed-through, ``G = 0.1 + 2 zeta w0^2 / (s^2 + 2 zeta w0 s + w0^2)``, excited
from rest by a random-phase multisine of lines 10 Hz - 10 kHz (2.5 Hz apart) at 50 kHz, white noise
on the output and 20 dB less on the input. Bins are made directly: the DFT of the record is known in
closed form, and that of white noise is white. Nothing here uses the estimators.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import ComplexArray, FloatArray

SAMPLE_RATE_HZ = 50e3
SAMPLES_PER_PERIOD = 20000
HARMONICS = np.arange(4, 4001)
BAND_HZ = (200.0, 300.0)
F0_HZ = 250.0
INPUT_NOISE_DB = 20.0


@dataclass(frozen=True)
class Plant:
    """One cell of the grid: damping ratio, signal-to-noise ratio, periods.

    Attributes
    ----------
    damping_ratio : float
    snr_db : float
        Rms of the clean output over rms of its noise, both over 0-25 kHz.
    periods : int
    seed : int
        Of the phases.
    """

    damping_ratio: float
    snr_db: float
    periods: int
    seed: int = 1

    @cached_property
    def phasor(self) -> ComplexArray:
        """(lines,) excitation of 1 V rms; u = sum 2 Re phasor exp(j w t)."""
        rng = np.random.default_rng(self.seed)
        turns = rng.uniform(0, 2 * np.pi, HARMONICS.size)
        return np.exp(1j * turns) / np.sqrt(2 * HARMONICS.size)

    @property
    def theta(self) -> FloatArray:
        """[f0, damping, b0 / w0^2, b1 / w0, b2, Re c, Im c]: c the free decay from rest."""
        zeta = self.damping_ratio
        system = np.array([F0_HZ, zeta, 0.1 + 2 * zeta, 0.2 * zeta, 0.1])
        pole, residue = pole_and_residue(system)
        s = 2j * np.pi * HARMONICS * (SAMPLE_RATE_HZ / SAMPLES_PER_PERIOD)
        state = np.sum(self.phasor / (s - pole) + self.phasor.conj() / (-s - pole))
        decay = -residue * state
        return np.append(system, [decay.real, decay.imag])

    @cached_property
    def noise(self) -> tuple[float, float]:
        """Variance of the noise on a bin of Y and of U, E|.|^2."""
        s = 2j * np.pi * HARMONICS * (SAMPLE_RATE_HZ / SAMPLES_PER_PERIOD)
        power = 2 * np.sum(np.abs(response(self.theta, s) * self.phasor) ** 2)
        samples = SAMPLES_PER_PERIOD * self.periods
        variance_y = power / 10 ** (self.snr_db / 10) / samples
        return variance_y, 1.0 / 10 ** ((self.snr_db + INPUT_NOISE_DB) / 10) / samples

    def bins(self, low_hz: float = BAND_HZ[0], high_hz: float = BAND_HZ[1]) -> npt.NDArray:
        """(K,) bins of the whole record's DFT within a band."""
        resolution = SAMPLE_RATE_HZ / SAMPLES_PER_PERIOD / self.periods
        return np.arange(round(low_hz / resolution), round(high_hz / resolution) + 1)

    def input(self, bins: npt.NDArray) -> ComplexArray:
        """(K,) exact U on bins."""
        u = np.zeros(bins.size, complex)
        excited = bins % self.periods == 0
        u[excited] = self.phasor[bins[excited] // self.periods - HARMONICS[0]]
        return u

    def output(self, bins: npt.NDArray, theta: npt.NDArray | None = None) -> ComplexArray:
        """(K,) exact Y on bins, transient included."""
        theta = self.theta if theta is None else theta
        samples = SAMPLES_PER_PERIOD * self.periods
        w = 2 * np.pi * bins / samples  # rad per sample
        pole, _ = pole_and_residue(theta[:5])
        y = response(theta, 1j * w * SAMPLE_RATE_HZ) * self.input(bins)
        for p, c in ((pole, theta[5] + 1j * theta[6]), (pole.conj(), theta[5] - 1j * theta[6])):
            p = p / SAMPLE_RATE_HZ
            y = y - c * np.expm1(p * samples) / -np.expm1(p - 1j * w) / samples
        return y

    def noisy(
        self, rng: np.random.Generator, runs: int, bins: npt.NDArray
    ) -> tuple[npt.NDArray, npt.NDArray]:
        """U and Y (runs, K) with independent circular noise."""
        variance_y, variance_u = self.noise

        def noise(variance: float) -> ComplexArray:
            parts = rng.standard_normal((runs, bins.size, 2)) * np.sqrt(variance / 2)
            return parts.view(complex)[..., 0]

        return self.input(bins) + noise(variance_u), self.output(bins) + noise(variance_y)

    def bound(self, transient: bool = True) -> FloatArray:
        """(2, 2) Cramer-Rao bound of (f0, damping) from the bins of the band.

        With `transient` the initial state is unknown and all bins are used; without, the record is
        in steady state and known to be. Unknown noise levels change neither: their score is
        uncorrelated with those of the other parameters. The unknown true input is eliminated.
        """
        jacobian, variance = self.derivatives()
        if not transient:
            jacobian = jacobian[:, :5] * (self.bins() % self.periods == 0)[:, None]
        return _inverse_information(jacobian, variance)

    def derivatives(self) -> tuple[ComplexArray, FloatArray]:
        """(K, 7) derivative of Y by theta on the bins of the band, and (K,) variance of ``Y - G U``."""
        bins, theta = self.bins(), self.theta
        columns = []
        for k in range(theta.size):
            step = 1e-6 * (abs(theta[k]) if k < 5 else np.hypot(*theta[5:]))
            up, down = theta.copy(), theta.copy()
            up[k] += step
            down[k] -= step
            columns.append((self.output(bins, up) - self.output(bins, down)) / (2 * step))
        variance_y, variance_u = self.noise
        excited = bins % self.periods == 0
        s = 2j * np.pi * bins * (SAMPLE_RATE_HZ / SAMPLES_PER_PERIOD / self.periods)
        gain = np.where(excited, np.abs(response(theta, s)) ** 2, 0)
        return np.stack(columns, axis=-1), variance_y + gain * variance_u


def bound_of_realisations(plants: list[Plant], distortion: float = 0.0) -> FloatArray:
    """(2, 2) Cramer-Rao bound of (f0, damping) from records of one plant, other phases in each.

    Every initial state is unknown. Unknown levels change nothing, see `Plant.bound`.

    Parameters
    ----------
    plants : list of Plant
        Which differ in their seeds.
    distortion : float
        Variance of an independent error of Y on excited bins.
    """
    rows, variances = [], []
    for m, plant in enumerate(plants):
        of_one, variance = plant.derivatives()
        row = np.zeros((of_one.shape[0], 5 + 2 * len(plants)), complex)
        row[:, :5] = of_one[:, :5]
        row[:, 5 + 2 * m : 7 + 2 * m] = of_one[:, 5:]
        rows.append(row)
        variances.append(variance + distortion * (plant.bins() % plant.periods == 0))
    return _inverse_information(np.concatenate(rows), np.concatenate(variances))


def _inverse_information(jacobian: ComplexArray, variance: FloatArray) -> FloatArray:
    """(2, 2) block of the first two parameters."""
    scale = np.sqrt(np.sum(np.abs(jacobian) ** 2 / variance[:, None], axis=0))
    scaled = jacobian / np.sqrt(variance)[:, None] / scale
    information = 2 * np.real(scaled.conj().T @ scaled)
    return (np.linalg.inv(information) / np.outer(scale, scale))[:2, :2]


def pole_and_residue(system: npt.NDArray) -> tuple[complex, complex]:
    """Pole above the real axis, and the residue of G there."""
    f0, zeta, b0, b1, b2 = system
    w0 = 2 * np.pi * f0
    pole = w0 * (-zeta + 1j * np.sqrt(1 - zeta**2))
    return pole, (b2 * pole**2 + b1 * w0 * pole + b0 * w0**2) / (pole - np.conj(pole))


def response(theta: npt.NDArray, s: npt.NDArray) -> ComplexArray:
    """(F,) G at s."""
    f0, zeta, b0, b1, b2 = theta[:5]
    w0 = 2 * np.pi * f0
    return (b2 * s**2 + b1 * w0 * s + b0 * w0**2) / (s**2 + 2 * zeta * w0 * s + w0**2)


def judge(
    errors: npt.NDArray, covariance: npt.NDArray, bound: npt.NDArray
) -> tuple[npt.NDArray, float]:
    """MSE over bound of (f0, damping), and how often the 95 % ellipse holds the truth.

    Parameters
    ----------
    errors : (runs, 2) float
    covariance : (runs, 2, 2) float
    bound : (2, 2) float
    """
    ratio = np.mean(errors**2, axis=0) / np.diag(bound)
    solved = np.linalg.solve(covariance, errors[..., None])[..., 0]
    distance = np.sum(errors * solved, axis=-1)
    return ratio, float(np.mean(distance < -2 * np.log(0.05)))
