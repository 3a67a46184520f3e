# SPDX-License-Identifier: Apache-2.0
"""What realisations of the phases have in common on excited lines, and what they differ by.

An error of the model is an error of the response: turned by the phase of the input it is the same in
every realisation. Noise and stochastic nonlinear distortion differ (Pintelon & Schoukens, *System
Identification: A Frequency Domain Approach*, 2nd ed. (2012), section 4.3). So of M residuals on a
line one combination may hold model error, and the M - 1 others give the variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.noise_level import (
    log_linear,
    model_variance,
    two_channels,
)

# Degrees of freedom that a variance known from a piece of the band alone should have, and the fewest.
PIECE_DOF = 24
FEWEST_PIECE_DOF = 8
# Pieces that are wanted before their degrees of freedom are.
WANTED_PIECES = 5


@dataclass(frozen=True, eq=False)
class Scatter:
    """Weighted residuals of M realisations apart.

    Attributes
    ----------
    common : (batch, K) complex
        Turned by the phase of the input; of the variance of one residual. 0 on lines without input.
    differing : (batch, M, K) complex
        The rest, turned too; M - 1 degrees of freedom a line.
    """

    common: ComplexArray
    differing: ComplexArray

    @classmethod
    def of(cls, residual: ComplexArray, u: ComplexArray) -> Scatter:
        """Of weighted residuals (batch, M, K), turned by the phases of inputs (batch, M, K)."""
        size = np.abs(u)
        with np.errstate(divide="ignore", invalid="ignore"):
            whole = np.sqrt(np.sum(size**2, axis=1, keepdims=True))
            direction = np.where(whole > 0, size / whole, 0.0)
        common = np.einsum("bmk,bmk->bk", direction, residual)
        return cls(common, residual - direction * common[:, None])

    @property
    def common_cost(self) -> FloatArray:
        """(batch,)."""
        return np.asarray(np.sum(self.common.real**2 + self.common.imag**2, axis=-1))

    @property
    def line_cost(self) -> FloatArray:
        """(batch, K) of what differs."""
        return np.asarray(np.sum(self.differing.real**2 + self.differing.imag**2, axis=1))

    @property
    def differing_cost(self) -> FloatArray:
        """(batch,)."""
        return np.asarray(self.line_cost.sum(axis=-1))


@dataclass(frozen=True, eq=False)
class Pieces:
    """Neighbouring lines whose variances are averaged before they are compared with each other.

    Attributes
    ----------
    lines : int
        In each, the last one longer.
    starts, counts : (pieces,) int
    of_line : (K,) int
    dof : int
        Complex degrees of freedom of the variance of a piece.
    """

    lines: int
    starts: IntArray
    counts: IntArray
    of_line: IntArray
    dof: int

    @classmethod
    def of(cls, lines: int, dof: int) -> Pieces:
        """Of lines with a sample variance of `dof` degrees of freedom each."""
        size = min(-(-PIECE_DOF // dof), max(1, lines // WANTED_PIECES))
        size = max(size, -(-FEWEST_PIECE_DOF // dof))
        pieces = max(1, lines // size)
        starts = np.arange(pieces) * size
        counts = np.diff(np.append(starts, lines))
        return cls(
            size, starts, counts, np.minimum(np.arange(lines) // size, pieces - 1), size * dof
        )

    def means(self, values: FloatArray) -> FloatArray:
        """(batch, pieces) of (batch, K)."""
        return np.asarray(np.add.reduceat(values, self.starts, axis=-1) / self.counts)


def smooth_variance(
    sample: FloatArray, gain: FloatArray, pieces: Pieces
) -> tuple[FloatArray, IntArray]:
    """Variance on each line from sample variances, and its kind as index into `KINDS`.

    Flat on both channels unless a test says otherwise, then sloped, then piece by piece.

    Parameters
    ----------
    sample : (batch, K) float
    gain : (batch, K) float
        ``|G|^2``.
    pieces : Pieces
    """
    kind = model_variance(pieces.means(sample), pieces.dof, pieces.means(gain)).kind
    variance = two_channels(sample, gain)
    sloped, each = kind == 1, kind == 2
    if sloped.any():  # with noise of both channels, whose sum follows the resonance
        curve = log_linear(sample[sloped])
        more = two_channels(sample[sloped] / curve, gain[sloped])
        variance[sloped] = curve * more
    if each.any():
        variance[each] = pieces.means(sample[each])[:, pieces.of_line]
    return variance, kind
