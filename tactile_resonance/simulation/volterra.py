# SPDX-License-Identifier: Apache-2.0
"""Response of a pole-residue model to a sampled signal over a short window of a march."""

from __future__ import annotations

import numpy as np
import scipy.fft

from tactile_resonance.simulation.modal import ComplexArray, FloatArray, PoleResidueModel


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
