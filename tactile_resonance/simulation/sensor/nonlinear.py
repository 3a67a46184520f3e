# SPDX-License-Identifier: Apache-2.0
"""The sensor with a static nonlinearity in its drive, in steady state and from rest.

The strain dynamics S (the linear sensor without its feedthrough) are driven by
``u + a2 u^2 + a3 u^3 + g2 s^2 + g3 s^3``, s the strain voltage; ``Us = s + gamma u``.
What depends on u alone is periodic and treated exactly, as further lines. What depends on s is
found by fixed-point (Picard) iteration, over the period in steady state, and window by window when
the record starts from rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy.fft

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.fields import require
from tactile_resonance.sensor import NonlinearParameters
from tactile_resonance.simulation.sensor.response import (
    Lines,
    PoleResidueModel,
    ResponseStream,
    sample_period,
)


class WindowKernel:
    """Zero-start response of a model to a sampled input over one window, and its bookkeeping.

    Between samples the input is the cubic through the sample after and the three before, for
    which every pole is integrated exactly (exponential Adams-Moulton method of fourth order):
    ``z_n = E z_{n-1} + r sum_{q=0}^{3} w_q e_{n-q}``, ``E = exp(p h)``. It is causal, and as stable
    as the model whatever the interval.

    Parameters
    ----------
    model : PoleResidueModel
        Strictly proper.
    size : int
        Samples in the window.
    interval_s : float
        h [s].
    """

    PAST = 3  # input samples before the window that still count, latest first

    def __init__(self, model: PoleResidueModel, size: int, interval_s: float) -> None:
        poles, residues, weights = model.poles_rad_s, model.residues_rad_s, model.weights
        lags = self.PAST + 1
        step = residues[:, None] * _adams_weights(poles, interval_s)  # (K, lags)
        powers = np.exp(np.outer(poles, np.arange(size + 1)) * interval_s)  # (K, size + 1)
        # effect of one input sample on all states at the samples after it: the sample p before
        # the window start reaches them from lag q = p on, that at the start from lag 0
        effect = np.zeros((lags, poles.size, size), dtype=complex)  # (p, K, size)
        for p in range(lags):
            for q in range(p, min(lags, p + size)):
                effect[p, :, q - p :] += step[:, q, None] * powers[:, : size - (q - p)]
        output = (weights[:, None] * effect).real.sum(axis=1)  # (p, size)
        self._size = size
        self._length = scipy.fft.next_fast_len(2 * size, real=True)
        self._spectrum = scipy.fft.rfft(output[0], self._length)
        self._past_output = output[1:]  # (PAST, size)
        free = weights[:, None] * powers[:, 1:]  # (K, size)
        self._free_output = np.vstack([free.real, -free.imag])  # (2 K, size)
        self._end_power = powers[:, size]
        self._end_past = effect[1:, :, -1]  # (PAST, K)
        self._end_window = effect[0][:, ::-1]  # (K, size): input sample m counts effect[size-1-m]

    def history(self, state: ComplexArray, past: FloatArray) -> FloatArray:
        """Return the output over the window due to what was before it, shape (size,).

        Parameters
        ----------
        state : (K,) array
            Modal state at the sample before the window.
        past : (PAST,) array
            Input samples before the window, latest first.
        """
        free = np.concatenate([state.real, state.imag]) @ self._free_output
        return np.asarray(free + past @ self._past_output)

    def convolve(self, signal: FloatArray) -> FloatArray:
        """Return the output over the window due to the input (size,) within it."""
        spectrum = self._spectrum * scipy.fft.rfft(signal, self._length)
        return np.asarray(scipy.fft.irfft(spectrum, self._length)[: self._size])

    def advance(
        self, state: ComplexArray, past: FloatArray, signal: FloatArray
    ) -> tuple[ComplexArray, FloatArray]:
        """Return state and past at the end of the window."""
        end = self._end_power * state + past @ self._end_past + self._end_window @ signal
        latest_first = np.concatenate([signal[::-1], past])[: self.PAST]
        return end, latest_first


def _adams_weights(poles: ComplexArray, interval_s: float) -> ComplexArray:
    """Return ``integral_0^h exp(p (h - t)) l_q(t) dt``, shape (K, 4), q = 0 ... 3 samples back.

    l_q are the Lagrange polynomials on the nodes h, 0, -h, -2 h. By Gauss-Legendre quadrature,
    where the closed form would cancel for slow poles; for fast ones in as many pieces as needed.
    """
    points, gauss = np.polynomial.legendre.leggauss(16)
    pieces = 1 + int(np.abs(poles * interval_s).max(initial=0.0))
    edges = np.arange(pieces)[:, None]
    x = ((edges + (points + 1) / 2) / pieces).ravel()  # t / h in (0, 1)
    weight = np.tile(gauss / (2 * pieces), pieces) * interval_s
    nodes = np.array([1.0, 0.0, -1.0, -2.0])
    lagrange = np.ones((4, x.size))
    for q in range(4):
        for other in range(4):
            if other != q:
                lagrange[q] *= (x - nodes[other]) / (nodes[q] - nodes[other])
    kernel = np.exp(np.outer(poles, 1 - x) * interval_s)  # (K, x)
    return np.asarray((kernel * weight) @ lagrange.T)


# The cube of a signal reaches three times its highest line; with four times the sample rate no
# product of the drive folds back into the band of the drive.
OVERSAMPLING = 4
WINDOW = 512  # fine samples per window: short, so that the iteration contracts fast
TOLERANCE, MOST_ITERATIONS = 1e-13, 100


def effective_drive(
    lines: Lines, nonlinear: NonlinearParameters, oversampling: int = OVERSAMPLING
) -> Lines:
    """Return ``u + a2 u^2 + a3 u^3`` as lines on a grid `oversampling` times as fine, 4 or more."""
    accepted = f"{OVERSAMPLING} or above"
    require(oversampling >= OVERSAMPLING, "oversampling", oversampling, accepted)
    fine = lines.resampled(oversampling)
    a2, a3 = nonlinear.actuator_quadratic_per_v, nonlinear.actuator_cubic_per_v2
    if a2 == 0.0 and a3 == 0.0:
        return fine
    u = sample_period(fine)
    spectrum = scipy.fft.rfft(u + a2 * u**2 + a3 * u**3)
    highest = (3 if a3 else 2) * int(lines.harmonics[-1])  # below samples / 2
    phasor = spectrum[: highest + 1] * (2 / u.size)
    phasor[0] /= 2
    return Lines(np.arange(highest + 1), phasor, fine.sample_rate_hz, fine.samples_per_period)


def solve_strain(
    known_v: FloatArray,
    feedback: Callable[[FloatArray], FloatArray],
    nonlinear: NonlinearParameters,
    lines: Lines,
) -> tuple[FloatArray, FloatArray]:
    """Return the strain ``s = known + feedback(g2 s^2 + g3 s^3)`` and that term [V], by Picard's iteration.

    Raises
    ------
    ValueError
        If it does not converge: its loop gain, about ``3 g3 s^2 |S|`` at resonance, exceeds 1, as for a
        narrow-band drive of 4 V rms.
    """
    g2, g3 = nonlinear.strain_quadratic_per_v, nonlinear.strain_cubic_per_v2
    strain, scale = known_v, float(np.abs(known_v).max())
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(MOST_ITERATIONS):
            term = (g2 + g3 * strain) * strain * strain
            following = known_v + feedback(term)
            change = float(np.abs(following - strain).max())
            strain = following
            if change <= TOLERANCE * scale:
                return strain, term
            if not change < 1e3 * scale:
                break
    rms_v = np.linalg.norm(lines.phasor_v) / np.sqrt(2)
    count, highest_hz = lines.harmonics.size, lines.frequency_hz[-1]
    raise ValueError(
        f"amplitude_v: got {rms_v:.3g} V rms on {count} lines up to {highest_hz:g} Hz; accepted is a drive "
        "weak enough for the sensor's nonlinearity (its response grows beyond bounds); lower the level or "
        "spread it over more lines"
    )


def nonlinear_steady_state(
    model: PoleResidueModel,
    nonlinear: NonlinearParameters,
    lines: Lines,
    *,
    oversampling: int = OVERSAMPLING,
) -> FloatArray:
    """Return one period of the nonlinear sensor's voltage Us [V] in steady state, (samples_per_period,).

    Parameters
    ----------
    model : PoleResidueModel
        The linear sensor, feedthrough as direct term.
    nonlinear : NonlinearParameters
    lines : Lines
        The drive.
    oversampling : int
        Products of the strain above half the fine sample rate fold back: 4 or more.

    Raises
    ------
    ValueError
        As `solve_strain`.
    """
    drive = effective_drive(lines, nonlinear, oversampling)
    count = drive.samples_per_period
    frequency_hz = np.arange(count // 2 + 1) * (drive.sample_rate_hz / count)
    response = replace(model, direct=0.0).frequency_response(frequency_hz)
    response[-1] = 0.0  # half the sample rate has no phase

    def feedback(term: FloatArray) -> FloatArray:
        return np.asarray(scipy.fft.irfft(response * scipy.fft.rfft(term), count))

    linear = sample_period(drive, response[drive.harmonics])
    strain, _ = solve_strain(linear, feedback, nonlinear, lines)
    return strain[::oversampling] + model.direct * sample_period(lines)


class NonlinearStream:
    """The nonlinear sensor's response, from rest, to one excitation after another.

    Counterpart of `ResponseStream`, sample for sample the same when all coefficients are 0. The
    strain term is integrated exactly for its cubic interpolation between fine samples.

    Parameters
    ----------
    model : PoleResidueModel
        The linear sensor, feedthrough as direct term.
    nonlinear : NonlinearParameters
    delay_s : float
        As in `ResponseStream`.
    oversampling : int
        Fine samples per sample, 4 or more.
    """

    def __init__(
        self,
        model: PoleResidueModel,
        nonlinear: NonlinearParameters,
        *,
        delay_s: float = 0.0,
        oversampling: int = OVERSAMPLING,
    ) -> None:
        self._oversampling = oversampling
        self._nonlinear = nonlinear
        self._strain_model = replace(model, direct=0.0)
        self._driven = ResponseStream(self._strain_model, delay_s=delay_s)
        nothing = np.zeros(0, dtype=complex)
        self._through = ResponseStream(
            PoleResidueModel(nothing, nothing, model.direct), delay_s=delay_s
        )
        self._drive: tuple[Lines, Lines] | None = None  # lines and their effective drive
        self._state = np.zeros(model.poles_rad_s.size, dtype=complex)  # due to the strain term
        self._past = np.zeros(WindowKernel.PAST)  # last values of the strain term
        self._kernels: dict[tuple[int, float], WindowKernel] = {}

    def play(self, lines: Lines) -> FloatArray:
        """Return the response to the next period of an excitation, as `ResponseStream.play`.

        Raises
        ------
        ValueError
            If the response grows beyond bounds.
        """
        through = self._through.play(lines)
        if self._drive is None or not lines.same_signal(self._drive[0]):
            self._drive = (lines, effective_drive(lines, self._nonlinear, self._oversampling))
        driven = self._driven.play(self._drive[1])
        strain = np.empty_like(driven)
        for begin in range(0, driven.size, WINDOW):
            window = slice(begin, begin + WINDOW)
            strain[window] = self._solve_window(driven[window], lines)
        return strain[:: self._oversampling] + through

    def _solve_window(self, driven: FloatArray, lines: Lines) -> FloatArray:
        """Add the feedback of the strain term to the driven strain, and move on."""
        key = driven.size, lines.sample_rate_hz * self._oversampling
        if key not in self._kernels:
            self._kernels[key] = WindowKernel(self._strain_model, key[0], 1 / key[1])
        kernel = self._kernels[key]
        known = driven + kernel.history(self._state, self._past)
        strain, term = solve_strain(known, kernel.convolve, self._nonlinear, lines)
        self._state, self._past = kernel.advance(self._state, self._past, term)
        return strain
