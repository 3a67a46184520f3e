# SPDX-License-Identifier: Apache-2.0
"""Other ways from the same data to a pole, each as its users call it.

A peer takes the case and returns a function of the run's index that gives (f0_hz, damping_ratio);
it raises ImportError where its package is not installed.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from benchmarks.poles_plant import Plant
from tactile_resonance._typing import ComplexArray, FloatArray

Estimator = Callable[[int], tuple[float, float]]
NOTHING = (float("nan"), float("nan"))


@dataclass(frozen=True)
class Case:
    """Data of all runs.

    Attributes
    ----------
    plant : Plant
    frequency_hz : (F,) float
        Lines of the band.
    g : (runs, F) complex
        FRF by the local polynomial method.
    variance : (runs, F) float
        Its sample variance.
    joint : tuple
        (bins (K,), u (runs, K), y (runs, K)): all bins of the band.
    wide_hz : (W,) float
        Lines of 20-1000 Hz.
    wide_g : (few, W) complex
        FRF there, for methods that need more than a band.
    """

    plant: Plant
    frequency_hz: FloatArray
    g: ComplexArray
    variance: FloatArray
    joint: tuple[npt.NDArray, npt.NDArray, npt.NDArray]
    wide_hz: FloatArray
    wide_g: ComplexArray


def _nearest(poles_rad_s: ComplexArray) -> tuple[float, float]:
    """Of poles above the real axis the one nearest to 250 Hz."""
    above = poles_rad_s[poles_rad_s.imag > 0]
    if above.size == 0:
        return NOTHING
    pole = above[np.argmin(np.abs(np.abs(above) / (2 * np.pi) - 250))]
    return abs(pole) / (2 * np.pi), -pole.real / abs(pole)


def least_squares_peer(case: Case) -> Estimator:
    """scipy.optimize.least_squares on the same cost, from linear least squares."""
    s = 1j * case.frequency_hz / 250.0

    def residual(theta, g, std):
        b = theta[0] + theta[1] * s + theta[2] * s**2
        a = theta[3] + theta[4] * s + s**2
        e = (g - b / a) / std
        return np.concatenate([e.real, e.imag])

    def estimate(k: int) -> tuple[float, float]:
        g, std = case.g[k], np.sqrt(case.variance[k])
        design = np.stack([np.ones_like(s), s, s**2, -g, -g * s], -1)
        return _pole(residual, design, g * s**2, (g, std))

    return estimate


def joint_least_squares_peer(case: Case) -> Estimator:
    """scipy.optimize.least_squares on the joint estimator's cost, given the true noise levels."""
    bins, u, y = case.joint
    s = 1j * bins * (2.5 / case.plant.periods) / 250.0
    variance_y, variance_u = case.plant.noise
    excited = bins % case.plant.periods == 0

    def residual(theta, u_k, y_k):
        a = theta[3] + theta[4] * s + s**2
        g = (theta[0] + theta[1] * s + theta[2] * s**2) / a
        variance = variance_y + np.where(excited, variance_u * np.abs(g) ** 2, 0)
        transient = (theta[5] + theta[6] * s) / a
        e = (y_k - np.where(excited, g * u_k, 0) - transient) / np.sqrt(variance)
        return np.concatenate([e.real, e.imag])

    def estimate(k: int) -> tuple[float, float]:
        one = np.ones_like(s)
        u_k, y_k = np.where(excited, u[k], 0), y[k]
        design = np.stack([u_k, u_k * s, u_k * s**2, -y_k, -y_k * s, one, s], -1)
        return _pole(residual, design, y_k * s**2, (u_k, y_k))

    return estimate


def _pole(
    residual: Callable, design: npt.NDArray, right: npt.NDArray, data: tuple[npt.NDArray, ...]
) -> tuple[float, float]:
    """f0 [Hz] and damping ratio of least squares that begin at the linear solution of `design`."""
    start = np.linalg.lstsq(
        np.concatenate([design.real, design.imag]),
        np.concatenate([right.real, right.imag]),
        rcond=None,
    )[0]
    theta = least_squares(residual, start, args=data, method="lm", x_scale="jac").x
    w0 = np.sqrt(theta[3])
    return 250 * w0, theta[4] / (2 * w0)


def aaa_peer(case: Case) -> Estimator:
    """scipy.interpolate.AAA with three support points, on lines of both signs."""
    from scipy.interpolate import AAA

    s = 2j * np.pi * case.frequency_hz

    def estimate(k: int) -> tuple[float, float]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fit = AAA(s, case.g[k], max_terms=3, clean_up=False)
        return _nearest(fit.poles())

    return estimate


def vector_fitting_peer(case: Case) -> Estimator:
    """scikit-rf vector fitting with one complex pair."""
    import skrf
    from skrf.vectorFitting import VectorFitting

    def estimate(k: int) -> tuple[float, float]:
        network = skrf.Network(f=case.frequency_hz, s=case.g[k][:, None, None], f_unit="Hz")
        fit = VectorFitting(network)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fit.vector_fit(n_poles_real=0, n_poles_cmplx=1, enforce_dc=False)
        return _nearest(np.asarray(fit.poles))

    return estimate


def lscf_peer(case: Case) -> Estimator:
    """sdypy-EMA LSCF of order 30 over 20-1000 Hz, the stable pole nearest to 250 Hz."""
    from sdypy import EMA

    line_hz = case.wide_hz[1] - case.wide_hz[0]
    grid_hz = np.arange(0, case.wide_hz[-1] + line_hz / 2, line_hz)

    def estimate(k: int) -> tuple[float, float]:
        padded = np.zeros(grid_hz.size, complex)
        padded[np.round(case.wide_hz / line_hz).astype(int)] = case.wide_g[k]
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = EMA.Model(padded[None], grid_hz, lower=20, upper=1000, pol_order_high=30)
            model.get_poles(show_progress=False)
        poles = np.asarray(model.all_poles[-1])
        return _nearest(poles[poles.real < 0])

    return estimate


def half_power_peer(case: Case) -> Estimator:
    """Peak of |G| and its width at 1/sqrt(2), by interpolation between lines."""

    def estimate(k: int) -> tuple[float, float]:
        f, size = case.frequency_hz, np.abs(case.g[k])
        peak = int(np.argmax(size))
        if not 0 < peak < f.size - 1:
            return NOTHING
        a, b, c = np.polyfit(f[peak - 1 : peak + 2] - f[peak], size[peak - 1 : peak + 2], 2)
        offset = -b / (2 * a)
        level = (c + b * offset / 2) / np.sqrt(2)
        left = np.flatnonzero(size[:peak] < level)
        right = np.flatnonzero(size[peak:] < level)
        if not left.size or not right.size:
            return NOTHING
        i, j = left[-1], peak + right[0]
        low = np.interp(level, size[i : i + 2], f[i : i + 2])
        high = np.interp(-level, -size[j - 1 : j + 1], f[j - 1 : j + 1])
        f0 = f[peak] + offset
        return f0, (high - low) / (2 * f0)

    return estimate


def circle_fit_peer(case: Case) -> Estimator:
    """Kennedy-Pancu circle through the lines near the peak, f0 and damping from the angle."""

    def estimate(k: int) -> tuple[float, float]:
        f, g = case.frequency_hz, case.g[k]
        peak = int(np.argmax(np.abs(np.gradient(g))))
        near = slice(max(peak - 4, 0), peak + 5)
        z = g[near]
        # |z|^2 = 2 a x + 2 b y + c
        design = np.stack([2 * z.real, 2 * z.imag, np.ones(z.size)], -1)
        a, b, _ = np.linalg.lstsq(design, np.abs(z) ** 2, rcond=None)[0]
        angle = np.unwrap(np.angle(z - (a + 1j * b)))
        # tan((angle - angle0) / 2) = (f0^2 - f^2) / (2 zeta f0 f)
        best = NOTHING
        least = np.inf
        for middle in np.linspace(angle.min(), angle.max(), 101)[1:-1]:
            tangent = np.tan(np.clip((angle - middle) / 2, -1.5, 1.5))
            x = np.stack([1 / f[near], -f[near]], -1)
            solution, rest, *_ = np.linalg.lstsq(x, tangent, rcond=None)
            if rest.size and rest[0] < least and np.all(solution > 0):
                f0 = np.sqrt(solution[0] / solution[1])
                least, best = rest[0], (f0, 1 / (2 * solution[1] * f0))
        return best

    return estimate


PEERS: list[tuple[str, Callable[[Case], Estimator]]] = [
    ("scipy least_squares, same cost as FRF", least_squares_peer),
    ("scipy least_squares, same cost as joint", joint_least_squares_peer),
    ("scipy AAA, 3 terms (FRF)", aaa_peer),
    ("scikit-rf vector fitting, 1 pair (FRF)", vector_fitting_peer),
    ("sdypy-EMA LSCF, order 30, 20-1000 Hz", lscf_peer),
    ("half power (FRF)", half_power_peer),
    ("circle fit (FRF)", circle_fit_peer),
]
