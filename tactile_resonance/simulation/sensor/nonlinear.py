# SPDX-License-Identifier: Apache-2.0
"""The sensor with a static nonlinearity in its drive, from rest.

The strain dynamics S (the linear sensor without its feedthrough) are driven by
``u + a2 u^2 + a3 u^3 + g2 s^2 + g3 s^3``, s the strain voltage; ``Us = s + gamma u``.
What depends on u alone is periodic and treated exactly, as further lines. What depends on s, e, is between
samples the cubic through the sample after and the three before, for which every pole is integrated exactly
(exponential Adams-Moulton method of fourth order): ``z_n = E z_{n-1} + r sum_{q=0}^{3} w_q e_{n-q}``,
``E = exp(p h)``. It is as stable as the model whatever the interval h.

Each sample takes the one before, so that is compiled. numba looks at the date of this file alone: whatever is
compiled for it is in here.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.fft
from numba import complex128, float64, njit

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.fields import require
from tactile_resonance.sensor import NonlinearParameters
from tactile_resonance.simulation.sensor.response import (
    Lines,
    PoleResidueModel,
    ResponseStream,
    sample_period,
)

# The cube of a signal reaches three times its highest line; with four times the sample rate no
# product of the drive folds back into the band of the drive.
OVERSAMPLING = 4
NODES = np.array([1.0, 0.0, -1.0, -2.0])
"""Samples of the cubic, in intervals from the one before."""
MOST_ITERATIONS, TOLERANCE = 50, 1e-15
"""Of the newest sample, of which its own term is a small part."""
BEYOND = 1e3
"""Times the strain of the linear sensor: a response that grows without bounds."""


def _adams_weights(poles: ComplexArray, interval_s: float) -> ComplexArray:
    """Return ``integral_0^h exp(p (h - t)) l_q(t) dt``, shape (4, K), q = 0 ... 3 samples back.

    l_q are the Lagrange polynomials on `NODES`. By Gauss-Legendre quadrature, where the closed form would
    cancel for slow poles; for fast ones in as many pieces as needed.
    """
    points, gauss = np.polynomial.legendre.leggauss(16)
    pieces = 1 + int(np.abs(poles * interval_s).max(initial=0.0))
    edges = np.arange(pieces)[:, None]
    x = ((edges + (points + 1) / 2) / pieces).ravel()  # t / h in (0, 1)
    weight = np.tile(gauss / (2 * pieces), pieces) * interval_s
    lagrange = np.linalg.solve(np.vander(NODES).T, np.vander(x, NODES.size).T)  # (4, x)
    return np.asarray((lagrange * weight) @ np.exp(np.outer(1 - x, poles) * interval_s))


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


@njit(
    (
        *(float64[::1], complex128[::1], complex128[::1], complex128[:, ::1]),
        *(float64[::1], float64, float64),
    ),
    cache=True,
)
def _march(strain, state, decay, step, past, g2, g3):
    """Make the strain [V] of what it is driven to, in place; moves `state` (K,) and `past` (3,) on."""
    direct = step[0].real.sum()
    for n in range(strain.size):
        known, term, e1, e2, e3 = strain[n], 0.0, past[0], past[1], past[2]
        for k in range(state.size):
            state[k] = decay[k] * state[k] + e1 * step[1, k] + e2 * step[2, k] + e3 * step[3, k]
            known += state[k].real
        s = known
        for _ in range(MOST_ITERATIONS):
            before, term = s, (g2 + g3 * s) * s * s
            s = known + direct * term
            if not abs(s - before) > TOLERANCE * abs(s):
                break
        for k in range(state.size):
            state[k] += term * step[0, k]
        past[0], past[1], past[2], strain[n] = term, e1, e2, s


class NonlinearStream:
    """The nonlinear sensor's response, from rest, to one excitation after another.

    Counterpart of `ResponseStream`, sample for sample the same when all coefficients are 0.

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
        self._oversampling, self._nonlinear = oversampling, nonlinear
        self._model = replace(model, direct=0.0)
        self._driven = ResponseStream(self._model, delay_s=delay_s)
        nothing = np.zeros(0, dtype=complex)
        through = PoleResidueModel(nothing, nothing, model.direct)
        self._through = ResponseStream(through, delay_s=delay_s)
        self._drive: tuple[Lines, Lines] | None = None  # lines and their effective drive
        # due to the strain term, each pole as often as it counts; last values of that term
        self._state, self._past = np.zeros(model.poles_rad_s.size, dtype=complex), np.zeros(3)

    def play(self, lines: Lines) -> FloatArray:
        """Return the response to the next period of an excitation, as `ResponseStream.play`.

        Raises
        ------
        ValueError
            If it grows beyond bounds: the loop gain, about ``3 g3 s^2 |S|`` at resonance, exceeds 1, as for a
            narrow-band drive of 4 V rms.
        """
        through, model, nonlinear = self._through.play(lines), self._model, self._nonlinear
        if self._drive is None or not lines.same_signal(self._drive[0]):
            self._drive = (lines, effective_drive(lines, nonlinear, self._oversampling))
        drive = self._drive[1]
        strain, interval_s = self._driven.play(drive), 1 / drive.sample_rate_hz
        most_v = BEYOND * float(np.abs(strain).max())
        step = model.weights * model.residues_rad_s * _adams_weights(model.poles_rad_s, interval_s)
        _march(
            *(strain, self._state, np.exp(model.poles_rad_s * interval_s), step, self._past),
            *(nonlinear.strain_quadratic_per_v, nonlinear.strain_cubic_per_v2),
        )
        if not np.abs(strain).max() <= most_v:
            rms_v = np.linalg.norm(lines.phasor_v) / np.sqrt(2)
            count, highest_hz = lines.harmonics.size, lines.frequency_hz[-1]
            raise ValueError(
                f"amplitude_v: got {rms_v:.3g} V rms on {count} lines up to {highest_hz:g} Hz; accepted is a "
                "drive weak enough for the sensor's nonlinearity (its response grows beyond bounds); lower the "
                "level or spread it over more lines"
            )
        return strain[:: self._oversampling] + through
