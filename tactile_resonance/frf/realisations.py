# SPDX-License-Identifier: Apache-2.0
"""Whether the records of several realisations are of one system, in steady state.

The mean of the responses of records that contradict each other is the response of none of them: one was
recorded with the polarity or the gain changed, without the sensor, or beside the wrong actuator signal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import special

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray
from tactile_resonance.frf.spectra import power

# By chance once in so many sets of records.
FALSE_ALARM = 1e-4
# Lines above the so-many-th largest count alike: a tone is large on one.
LINES_ALIKE = 5
# Resonators that are slightly nonlinear differ by less.
MOST_PHASE_RAD = np.pi / 4
MOST_GAIN = 1.25
DEVIATIONS = 5.0
# Squared coherence from which a ratio of powers is one of gains, and that of two that are alike.
FOR_GAIN, ALIKE = 0.8, 0.5
ABOVE_NOISE = 10.0
"""What realisations differ by, over the power of the noise, from which noise is no reason for it."""
# Lines over which neighbours are compared: a transient is at the modes.
WINDOWS = (8, 32, 128)


@dataclass(frozen=True, eq=False)
class Agreement:
    """How realisations compare with each other.

    Attributes
    ----------
    gain : (batch, M, M) complex
        ``gain[m, n]``: response of m in units of that of n; 1 where they agree.
    opposed : (batch, M, M) bool
        Coherent, but of another phase.
    unequal : (batch, M, M) bool
        Coherent, but of another gain.
    apart : (batch, M) bool
        Without coherence with any other realisation, two of which are coherent.
    unlike : (batch,) bool
        None coherent with any other, and noise is no reason for it.
    """

    gain: ComplexArray
    opposed: BoolArray
    unequal: BoolArray
    apart: BoolArray
    unlike: BoolArray

    @classmethod
    def of(
        cls, response: ComplexArray, u: ComplexArray, differ: FloatArray | None = None
    ) -> Agreement:
        """Of responses.

        Parameters
        ----------
        response : (batch, M, F) complex
            Of each realisation; lines without input, NaN, count as none.
        u : (batch or 1, M, F) complex
            Inputs: a line that is hardly driven shows noise.
        differ : (batch,) float, optional
            Power of what realisations differ by over that of the noise, where that is known.

        Notes
        -----
        Noise and stochastic distortion of two realisations are independent, so that they lower the
        coherence ``|H_mn|^2 / (H_mm H_nn)``, ``H_mn = sum G_m conj G_n``, but turn no phase.
        """
        drive = np.sqrt(power(u).mean(axis=1, keepdims=True))
        response = np.where(np.isfinite(response), response * drive, 0)
        size = power(response).sum(axis=1)  # (batch, F)
        few = min(LINES_ALIKE, size.shape[-1])
        weight = 1 / np.maximum(size + np.partition(size, -few, axis=-1)[:, [-few]], np.finfo(float).tiny)
        share = weight * size
        lines = np.sum(share, axis=-1) ** 2 / np.maximum(np.sum(share**2, axis=-1), np.finfo(float).tiny)
        lines = np.maximum(lines, 2.0)[:, None, None]
        h = (response * weight[:, None]) @ response.conj().swapaxes(1, 2)  # (batch, M, M)
        diagonal = np.einsum("bmm->bm", h).real
        diagonal = np.where(diagonal > 0, diagonal, np.nan)
        coherence = power(h) / (diagonal[:, :, None] * diagonal[:, None, :])
        records = response.shape[1]
        pairs = max(records * (records - 1) // 2, 1)
        coherent = coherence > 1 - (FALSE_ALARM / pairs) ** (1 / (lines - 1))
        with np.errstate(divide="ignore", invalid="ignore"):
            deviation = np.sqrt((1 - np.minimum(coherence, 1)) / (2 * lines * coherence))
            gain = h / np.abs(h) * np.sqrt(diagonal[:, :, None] / diagonal[:, None, :])
        opposed = coherent & (np.abs(np.angle(h)) > MOST_PHASE_RAD + DEVIATIONS * deviation)
        high = coherent & (coherence > FOR_GAIN)
        unequal = high & (np.abs(np.log(np.abs(gain))) > np.log(MOST_GAIN) + DEVIATIONS * deviation)
        unlike = np.zeros(len(h), bool)
        if differ is not None:
            others = ~np.eye(records, dtype=bool)
            mean = np.mean(coherence, axis=(1, 2), where=others)
            spread = (1 - ALIKE) * np.sqrt(2 * ALIKE / (lines[:, 0, 0] * max(records - 1, 1)))
            low = (mean < ALIKE - 3 * spread) & ~(coherent & others).any(axis=(1, 2))
            unlike = low & (differ > ABOVE_NOISE)
        return cls(gain, opposed, unequal, _apart(h, coherence, coherent, lines), unlike)

    @property
    def contradiction(self) -> BoolArray:
        """(batch,) whether the records are not of one system."""
        return np.asarray(self._pairs.any(axis=(1, 2)) | self.apart.any(axis=-1) | self.unlike)

    @property
    def of_no_system(self) -> BoolArray:
        """(batch,) whether the mean of the responses says nothing."""
        return np.asarray(self.opposed.any(axis=(1, 2)) | self.unlike)

    def remarks(self) -> npt.NDArray[np.object_]:
        """(batch,) what contradicts, for people; empty where nothing does."""
        wrong = self.contradiction
        remarks = np.full(wrong.size, "", object)
        for k in np.flatnonzero(wrong):
            remarks[k] = self._remark(int(k))
        return remarks

    @property
    def _pairs(self) -> BoolArray:
        return self.opposed | self.unequal

    def _remark(self, k: int) -> str:
        if self.unlike[k]:
            return (
                "the responses of the realisations have nothing in common, which noise does not explain: "
                "actuator and sensor are of different records, or distortion is larger than the response"
            )
        pairs, apart = self._pairs[k], np.flatnonzero(self.apart[k])
        records = np.arange(len(pairs))
        if apart.size:
            names = " and ".join(str(m + 1) for m in apart)
            return f"the response of realisation {names} has nothing in common with those of the others"
        for m in records if records.size > 2 else ():
            rest = records[records != m]
            if not pairs[np.ix_(rest, rest)].any():
                return _difference(int(m), self.gain[k, m, rest].mean(), "the others")
        m, n = np.argwhere(pairs)[0].tolist()
        return _difference(n, self.gain[k, n, m], f"realisation {m + 1}")


def _apart(
    h: ComplexArray, coherence: FloatArray, coherent: BoolArray, lines: FloatArray
) -> BoolArray:
    """(batch, M) see `Agreement`: with neither of the two that are most alike, beyond what noise may hide."""
    batch, records, _ = h.shape
    others = coherent & ~np.eye(records, dtype=bool)
    alike = np.where(others, coherence, 0.0).reshape(batch, records**2)
    rows, place = np.arange(batch), alike.argmax(axis=-1)
    two = np.stack(np.divmod(place, records), axis=-1)  # (batch, 2)
    common = np.abs(h[rows, two[:, 0], two[:, 1]])[:, None]
    size = np.einsum("bmm->bm", h).real
    lacks = np.ones((batch, records), bool)
    for n in two.T:
        noise = np.sqrt(size * size[rows, n][:, None] / lines[..., 0])
        lacks &= common - np.abs(h[rows, :, n]) > DEVIATIONS * noise
    return lacks & ~others.any(axis=-1) & (alike[rows, place] > ALIKE)[:, None]


def _difference(m: int, gain: complex, others: str) -> str:
    turned = abs(np.degrees(np.angle(gain)))
    return (
        f"realisation {m + 1} is not of the same system as {others}: {abs(gain):.2f} times the gain, phase off "
        f"by {turned:.0f} degrees"
    )


def transient_lines(each: ComplexArray, g: ComplexArray) -> slice | None:
    """Lines on which neighbours of ``Y_m - G U_m`` are more alike than chance makes them; None: nowhere.

    Noise and stochastic distortion are independent from line to line, the spectrum of a transient is
    smooth. Products of neighbours have mean 0 and bring their own variance then, so that lines and
    realisations may differ in noise.

    Parameters
    ----------
    each : (..., M, 2, F) complex
        Spectra [Y; U] of the realisations.
    g : (..., F) complex
        Mean response.
    """
    error = each[..., 0, :] - g[..., None, :] * each[..., 1, :]  # (..., M, F)
    records, size = error.shape[-2], power(error)
    product = np.real(error[..., 1:] * error[..., :-1].conj()).sum(axis=-2)  # (..., F - 1)
    # of M errors that add up to zero M - 1 are free
    variance = (size[..., 1:] * size[..., :-1]).sum(axis=-2) * records / (2 * (records - 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        alike = np.nan_to_num(product / np.sqrt(variance))
    count = alike.shape[-1]
    sums = np.cumsum(np.insert(alike, 0, 0.0, axis=-1), axis=-1)  # (..., F)
    found, tests = [], 0
    for window in {min(window, count) for window in (*WINDOWS, count) if count}:
        of_window = (sums[..., window:] - sums[..., :-window]).reshape(-1, count - window + 1)
        score, start = of_window.max(), int(of_window.max(axis=0).argmax())
        found.append((score / np.sqrt(window), slice(start, start + window + 1)))
        tests += of_window.size
    score, where = max(found, key=lambda of: of[0], default=(0.0, slice(0)))
    return where if score > -special.ndtri(FALSE_ALARM / max(tests, 1)) else None
