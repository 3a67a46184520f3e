# SPDX-License-Identifier: Apache-2.0
"""Systems at the edges of double precision: their responses to fifty digits, and what rounding allows.

A system is a feed-through and pairs of poles with residues; the response at each line is computed by mpmath
and rounded once to double precision.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import mpmath
import numpy as np

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.poles.structure import ModelStructure

Modes = tuple[tuple[float, float, float], ...]
DIGITS = 50
FEEDTHROUGH = 0.1


@dataclass(frozen=True, eq=False)
class Cell:
    """A system, the lines on which it is seen, and the noise on them.

    Attributes
    ----------
    family, row : str
        Which map the cell is of, and the label of its row.
    modes : tuple of (f0_hz, damping_ratio, gain)
        Each ``2 gain zeta w0^2 / (s^2 + 2 zeta w0 s + w0^2)``: its peak is its gain. With a sample rate the
        same denominator in the z-domain, ``gain (1 - r)^2 / ((1 - p/z) (1 - conj(p)/z))``, r the radius of p.
    frequency_hz : (F,) float
    snr_db : float
        Rms of the response over the lines over the rms of its noise; infinite: none but rounding.
    structure : ModelStructure
    scale : float
        Factor of the response.
    single : bool
        The response is rounded to single precision.
    """

    family: str
    row: str
    modes: Modes
    frequency_hz: FloatArray
    snr_db: float
    structure: ModelStructure
    scale: float = 1.0
    single: bool = False

    @property
    def truth(self) -> FloatArray:
        """(modes, 2) natural frequencies [Hz] and damping ratios."""
        return np.array([mode[:2] for mode in self.modes])

    @property
    def unscaled(self) -> ComplexArray:
        """(F,) without noise, rounded once."""
        return _rounded(self.modes, self.frequency_hz.tobytes(), self.structure.sample_rate_hz)

    @property
    def response(self) -> ComplexArray:
        """(F,) without noise."""
        return self.unscaled * self.scale

    @property
    def column(self) -> str:
        """Label of the column."""
        return "exact" if np.isinf(self.snr_db) else f"{self.snr_db:g} dB"

    @property
    def noise(self) -> float:
        """Variance of the noise on a line, E|.|^2, in units of `scale`, without that of rounding."""
        return float(np.mean(np.abs(self.unscaled) ** 2) * 10 ** (-self.snr_db / 10))

    @cached_property
    def rounding(self) -> FloatArray:
        """(modes, 2) errors that rounding stands for: of each value of the response, of lines and poles."""
        epsilon = np.finfo(np.float32 if self.single else np.float64).eps
        of_values = self.bound(float(np.max(np.abs(self.unscaled)) ** 2 * epsilon**2))
        return of_values + np.finfo(float).eps * np.array([[f0, 1.0] for f0, _, _ in self.modes])

    def bound(self, variance: float) -> FloatArray:
        """(modes, 2) square root of the Cramer-Rao bound [Hz, -], with a variance on each line."""
        jacobian = np.concatenate(
            [self._derivatives(*mode) for mode in self.modes]
            + [np.ones((self.frequency_hz.size, 1), complex)],
            axis=1,
        )
        scale = np.linalg.norm(jacobian, axis=0)
        rows = np.concatenate([jacobian.real, jacobian.imag]) / scale
        inverse = np.linalg.pinv(rows, rcond=1e-15) / scale[:, None]
        std = np.sqrt(variance / 2) * np.linalg.norm(inverse, axis=1)
        return np.asarray(std[:-1].reshape(len(self.modes), 4)[:, :2])

    def nearest(self) -> FloatArray:
        """(modes,) distance to the nearest other mode [Hz]; infinite where there is none."""
        f0 = self.truth[:, 0]
        apart = np.abs(f0[:, None] - f0)
        np.fill_diagonal(apart, np.inf)
        return np.asarray(apart.min(axis=-1))

    def _derivatives(self, f0_hz: float, damping_ratio: float, gain: float) -> ComplexArray:
        """(F, 4) by f0, damping ratio, and the two coefficients of the mode's numerator."""
        rate_hz = self.structure.sample_rate_hz
        if rate_hz is None:
            x = 1j * self.frequency_hz / f0_hz  # s / w0
            mode = 1 / (x**2 + 2 * damping_ratio * x + 1)
            by_f0 = mode**2 * (2 * x**2 + 2 * damping_ratio * x) / f0_hz
            by_damping = -2 * x * mode**2
            height = 2 * gain * damping_ratio
        else:
            w0, under = 2 * np.pi * f0_hz, np.sqrt(1 - damping_ratio**2)
            root = w0 * (-damping_ratio + 1j * under)
            pole, x = np.exp(root / rate_hz), np.exp(-2j * np.pi * self.frequency_hz / rate_hz)  # 1 / z
            first, second = 1 / (1 - pole * x), 1 / (1 - np.conj(pole) * x)
            mode = first * second
            by_f0, by_damping = (
                mode * x * (pole * of * first + np.conj(pole * of) * second) / rate_hz
                for of in (root / f0_hz, w0 * (-1 - 1j * damping_ratio / under))
            )
            height = gain * (1 - abs(pole)) * abs(1 - pole**2)
        return height * np.stack([by_f0, by_damping, mode, x * mode], axis=-1)


@lru_cache(maxsize=8)
def _rounded(modes: Modes, frequency_hz: bytes, rate_hz: float | None) -> ComplexArray:
    """(F,) sum of modes and feed-through at lines, to `DIGITS` digits, rounded once."""
    with mpmath.workdps(DIGITS):
        values = []
        two_pi = 2 * mpmath.pi
        of_modes = []
        for f0, zeta, gain in modes:
            w0, z = two_pi * mpmath.mpf(f0), mpmath.mpf(zeta)
            pole = mpmath.mpf(0)
            if rate_hz is not None:
                pole = mpmath.exp(w0 * mpmath.mpc(-z, mpmath.sqrt(1 - z**2)) / rate_hz)
            of_modes.append((mpmath.mpf(f0), z, gain, pole))
        for line in np.frombuffer(frequency_hz):
            total, f = mpmath.mpc(FEEDTHROUGH), mpmath.mpf(float(line))
            for f0, z, gain, pole in of_modes:
                if rate_hz is None:
                    x = mpmath.mpc(0, f / f0)  # s / w0
                    total += 2 * gain * z / (x**2 + 2 * z * x + 1)
                else:
                    q = mpmath.expjpi(-2 * f / rate_hz)  # 1 / z
                    height = gain * (1 - abs(pole)) * abs(1 - pole**2)
                    total += height / ((1 - pole * q) * (1 - mpmath.conj(pole) * q))
            values.append(complex(total))
    return np.array(values)


BARE = ModelStructure(2, 2)
SNR_DB = (0.0, 10.0, 20.0, 40.0, 80.0, 140.0, np.inf)
SCAN_HZ = np.arange(200.0, 300.1, 2.5)


def cells(largest_order: int = 40) -> list[Cell]:
    """All of all maps, of models up to an order."""
    made = [*_one_mode(), *_extremes(), *_ends(), *_two_modes(), *_orders(largest_order)]
    return [replace(cell, snr_db=snr_db) for cell in made for snr_db in SNR_DB]


def _one_mode() -> list[Cell]:
    def around(zeta: float) -> FloatArray:
        return 250.0 * np.linspace(max(1 - 8 * zeta, 0.05), 1 + 8 * zeta, 61)

    ratios = (1e-8, 1e-6, 1e-4, 1e-2, 0.1, 0.3, 0.7, 0.95)
    one = [
        Cell(family, f"{zeta:g}", ((250.0, zeta, 1.0),), around(zeta), 0.0, structure)
        for family, structure in (
            ("damping ratio, bare second order", BARE),
            ("damping ratio, six residual terms", ModelStructure()),
        )
        for zeta in ratios
    ]
    family = "damping ratio, values in single precision"
    one += [replace(cell, family=family, single=True) for cell in one[2 : len(ratios)]]
    return one + [
        Cell("damping ratio, on lines of 2.5 Hz", f"{zeta:g}", ((251.3, zeta, 1.0),), SCAN_HZ, 0.0,
             ModelStructure())
        for zeta in (1e-5, 1e-4, 1e-3, 5e-3, 0.02, 0.1, 0.3)
    ]  # fmt: skip


def _extremes() -> list[Cell]:
    scales = (1e-300, 1e-150, 1e-30, 1e-12, 1e12, 1e30, 1e150, 1e300)
    return [
        Cell("scale of the response", f"{scale:g}", ((250.0, 0.02, 1.0),), SCAN_HZ, 0.0, BARE, scale)
        for scale in scales
    ] + [
        Cell("natural frequency [Hz]", f"{f0:g}", ((f0, 0.02, 1.0),), f0 * np.linspace(0.8, 1.2, 41), 0.0,
             ModelStructure())
        for f0 in (1e-9, 1e-3, 1.0, 1e3, 1e6, 1e9, 1e15)
    ]  # fmt: skip


def _ends() -> list[Cell]:
    sampled = ModelStructure(2, 2, domain="z", sample_rate_hz=1000.0)
    return [
        *(
            Cell("near 0 Hz: f0 over the spacing of the lines", f"{f0:g}", ((f0, 0.05, 1.0),),
                 np.arange(1.0, 61.0), 0.0, BARE)
            for f0 in (0.5, 1.0, 2.0, 5.0)
        ),
        *(
            Cell("beyond the band: f0 over its upper end", f"{f0:g}", ((f0, 0.05, 1.0),),
                 np.linspace(0, 1, 81)[20:], 0.0, BARE)
            for f0 in (1.0, 1.01, 1.1, 1.5)
        ),
        *(
            Cell("z-domain: f0 over half the sample rate", f"{over:g}", ((500 * over, 0.005, 1.0),),
                 500 * over * np.linspace(0.96, min(1.04, 0.9999 / over), 81), 0.0, sampled)
            for over in (0.5, 0.9, 0.97, 0.99)
        ),
    ]  # fmt: skip


def _two_modes() -> list[Cell]:
    order = ModelStructure(4, 4)
    return [
        Cell("two modes: distance over the half width", f"{apart:g}",
             ((250.0, 0.01, 1.0), (250.0 * (1 + 0.01 * apart), 0.01, 1.3)),
             np.linspace(220, 290, 121), 0.0, order)
        for apart in (3.0, 1.0, 0.3, 0.1, 0.01, 1e-4)
    ] + [
        Cell("second mode nearly cancelled by a zero: its gain", f"{gain:g}",
             ((240.0, 0.02, 1.0), (262.0, 0.02, gain)), np.linspace(200, 300, 81), 0.0, order)
        for gain in (0.1, 1e-2, 1e-4, 1e-6, 1e-10)
    ]  # fmt: skip


def _orders(largest: int) -> list[Cell]:
    made = []
    for order in (4, 8, 12, 20, 30, 40):
        if order > largest:
            break
        decades = 10 * 10 ** (np.arange(order // 2) / 3)
        even = 100 + 20.0 * np.arange(order // 2)
        for family, f0s, lines in (
            ("order, modes over decades", decades, np.geomspace(5, 2 * decades[-1], 24 * order)),
            ("order, modes side by side", even, np.linspace(80, even[-1] + 20, 24 * order)),
        ):
            modes = tuple((float(f0), 0.02, 1.0) for f0 in f0s)
            made.append(Cell(family, str(order), modes, lines, 0.0, ModelStructure(order, order)))
    return sorted(made, key=lambda cell: cell.family)
