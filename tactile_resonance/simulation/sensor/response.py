# SPDX-License-Identifier: Apache-2.0
"""Linear systems as sums over their poles, and their exact time response to periodic excitations.

A system is ``G(s) = direct + sum r_k / (s - p_k)``: every state is one number that decays by itself, so any
instant is reached without the instants before it. The polynomial form of the same system is useless in
floating point at this order.

Over a stretch of one excitation the response is its steady state, synthesised by an inverse FFT,
plus free decays of the poles: ``z_k(t) = z_ss,k(t) + (z_k(0) - z_ss,k(0)) exp(p_k t)``. Nothing is
discretised, so nothing warps, and a record can be produced period by period.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.fields import require
from tactile_resonance.multisine import Excitation

# A decay this far below the response is not computed: below the rounding of the sum it enters.
NEGLIGIBLE = 1e-18
MAX_DELAY_S = 1.0


@dataclass(frozen=True)
class PoleResidueModel:
    """A real, stable, strictly diagonalisable single-input single-output system.

    Attributes
    ----------
    poles_rad_s : (K,) array
        Poles with imaginary part 0 or above [rad/s]; conjugates are implied.
    residues_rad_s : (K,) array
        Their residues [V/V rad/s].
    direct : float
        Direct term [V/V].

    Notes
    -----
    State ``z_k' = p_k z_k + r_k u``; output ``direct u + sum weight_k Re z_k``, weight 2 for a
    complex pole (it stands for the pair), 1 for a real one.
    """

    poles_rad_s: ComplexArray
    residues_rad_s: ComplexArray
    direct: float

    @property
    def weights(self) -> FloatArray:
        """How often each listed pole counts, shape (K,): 2 for a complex pole, 1 for a real one."""
        return np.where(self.poles_rad_s.imag > 0, 2.0, 1.0)

    def frequency_response(self, frequency_hz: ArrayLike) -> ComplexArray:
        """Return G(j 2 pi f), of the shape of `frequency_hz`."""
        upper, lower = self.resolvents(frequency_hz)
        weighted = self.residues_rad_s * self.weights / 2
        return np.asarray(self.direct + upper @ weighted + lower @ np.conj(weighted))

    def resolvents(self, frequency_hz: ArrayLike) -> tuple[ComplexArray, ComplexArray]:
        """Return ``1 / (s - p)`` and ``1 / (s - conj p)`` at s = j 2 pi f, both (..., K)."""
        s = 2j * np.pi * np.asarray(frequency_hz, dtype=float)[..., None]  # (..., 1)
        return 1 / (s - self.poles_rad_s), 1 / (s - np.conj(self.poles_rad_s))


@dataclass(frozen=True, eq=False)
class Lines:
    """An excitation: harmonics (F,), ascending, complex peak amplitudes (F,) [V], and the sampling.

    ``u(t) = Re sum_k phasor_v[k] exp(j 2 pi f_k t)``; the lines lie from 0 to below half the sample rate.
    """

    harmonics: IntArray
    phasor_v: ComplexArray
    sample_rate_hz: float
    samples_per_period: int

    @classmethod
    def of(cls, excitation: Excitation | Lines) -> Lines:
        """Lines of an excitation; what are lines already stays as it is."""
        if isinstance(excitation, Lines):
            return excitation
        return cls(
            excitation.harmonics,
            excitation.amplitude_v * np.exp(1j * excitation.phase_rad),
            excitation.sample_rate_hz,
            excitation.samples_per_period,
        )

    @property
    def period_s(self) -> float:
        """Length of one period [s]."""
        return self.samples_per_period / self.sample_rate_hz

    @property
    def frequency_hz(self) -> FloatArray:
        """Frequencies of the lines [Hz], shape (F,)."""
        return np.asarray(self.harmonics * (self.sample_rate_hz / self.samples_per_period), float)

    def same_signal(self, other: Lines | None) -> bool:
        """Whether another excitation is this one, sample for sample."""
        if other is None or other is self:
            return other is self
        return (
            self.sample_rate_hz == other.sample_rate_hz
            and self.samples_per_period == other.samples_per_period
            and np.array_equal(self.harmonics, other.harmonics)
            and np.array_equal(self.phasor_v, other.phasor_v)
        )

    def resampled(self, factor: int) -> Lines:
        """Return the same signal sampled `factor` times as fast."""
        return Lines(
            self.harmonics,
            self.phasor_v,
            self.sample_rate_hz * factor,
            self.samples_per_period * factor,
        )

    def shifted(self, time_s: float) -> ComplexArray:
        """Return the phasors of ``u(t + time_s)``, shape (F,)."""
        return self.phasor_v * np.exp(2j * np.pi * self.frequency_hz * time_s)


def sample_period(lines: Lines, gain: ArrayLike = 1.0, *, shift_s: float = 0.0) -> FloatArray:
    """Return one period of ``Re sum gain_k phasor_k exp(j 2 pi f_k (t + shift))``, exactly.

    Parameters
    ----------
    lines : Lines
    gain : complex or (F,) array
        Response at the lines [V/V].
    shift_s : float
        Time of the first sample [s].

    Returns
    -------
    (samples_per_period,) array
    """
    count = lines.samples_per_period
    spectrum = np.zeros(count // 2 + 1, dtype=complex)
    phasor = lines.phasor_v if shift_s == 0.0 else lines.shifted(shift_s)
    spectrum[lines.harmonics] = np.asarray(gain, complex) * phasor * (count / 2)
    if lines.harmonics[0] == 0:
        spectrum[0] *= 2
    return np.asarray(scipy.fft.irfft(spectrum, count))


def steady_state(model: PoleResidueModel, lines: Lines, time_s: float = 0.0) -> ComplexArray:
    """Return the periodic steady state ``z_ss(time)`` of every pole, shape (K,)."""
    phasor = lines.phasor_v if time_s == 0.0 else lines.shifted(time_s)
    upper, lower = model.resolvents(lines.frequency_hz)  # (F, K) each
    # a real cosine is half its phasor and half the conjugate at the negative frequency
    forced = phasor @ upper + np.conj(phasor @ lower)  # (K,)
    return np.asarray(model.residues_rad_s * forced / 2)


def free_decay(
    model: PoleResidueModel,
    start: ComplexArray,
    samples: int,
    interval_s: float,
    offset_s: float = 0.0,
    floor: float = 0.0,
) -> FloatArray:
    """Return ``sum weight Re(start exp(p (offset + n interval)))`` for n = 0 ... samples - 1.

    Factored into coarse and fine time steps: one small matrix product in place of
    poles x samples exponentials. Terms below `floor` (or negligible against the largest) are left
    out.
    """
    out = np.zeros(samples)
    start = model.weights * start * np.exp(model.poles_rad_s * offset_s)  # (K,)
    size = np.abs(start)
    floor = max(floor, NEGLIGIBLE * float(size.max(initial=0.0)))
    keep = size > floor
    if samples == 0 or not np.any(keep):
        return out
    poles, start = model.poles_rad_s[keep], start[keep]
    # samples until the last term has fallen to the floor
    lasting = np.log(size[keep] / floor) / (-poles.real * interval_s)
    used = int(min(samples, np.ceil(lasting.max()) + 1))
    fine = max(1, int(np.sqrt(used)))
    coarse = -(-used // fine)
    step = np.exp(np.outer(poles, np.arange(fine)) * interval_s)  # (K, fine)
    jump = np.exp(np.outer(np.arange(coarse), poles) * (fine * interval_s)) * start  # (coarse, K)
    jump[np.abs(jump) < floor] = 0.0
    product = np.hstack([jump.real, -jump.imag]) @ np.vstack([step.real, step.imag])
    out[:used] = product.ravel()[:used]
    return out


class ResponseStream:
    """The response of a linear system, from rest, to one excitation after another.

    Each call of `play` continues where the last one ended, so a record may be made in pieces of any
    length. Silence is an excitation whose lines are 0.

    Parameters
    ----------
    model : PoleResidueModel
    delay_s : float
        The output is sampled this much late: output sample n is the response at ``t_n - delay``,
        0 before the start.
    negligible_v : float
        A pole's free decay is left out where it stays below this [V]; 0: where it would be lost in
        rounding. The steady state is always whole.
    """

    def __init__(
        self, model: PoleResidueModel, *, delay_s: float = 0.0, negligible_v: float = 0.0
    ) -> None:
        require(bool(0 <= delay_s <= MAX_DELAY_S), "delay_s", delay_s, f"0 to {MAX_DELAY_S} s")
        require(negligible_v >= 0, "negligible_v", negligible_v, "0 or above")
        self._model = model
        self._delay_s = delay_s
        self._negligible_v = negligible_v
        self._lines: Lines | None = None  # played at present
        self._phase = 0  # samples of the current period already played
        # state minus steady state: it only decays, so it loses no digits over many periods
        self._deviation = np.zeros(model.poles_rad_s.size, dtype=complex)
        self._late = np.zeros(0)  # computed, but not due yet because of the delay

    @property
    def state(self) -> ComplexArray:
        """Modal state ``z`` at the end of what was played (not delayed), shape (K,)."""
        if self._lines is None:
            return self._deviation.copy()
        if self._phase == 0:
            return self._steady + self._deviation
        now_s = self._phase / self._lines.sample_rate_hz
        return steady_state(self._model, self._lines, now_s) + self._deviation

    def become(self, model: PoleResidueModel, state: ComplexArray) -> None:
        """Go on from here as another model, in a given state (K,)."""
        self._model, self._deviation = model, state
        if (lines := self._lines) is not None:
            self._prepare(lines)
            now_s = self._phase / lines.sample_rate_hz
            self._deviation = state - steady_state(model, lines, now_s)

    def play(self, lines: Lines, samples: int | None = None) -> FloatArray:
        """Return the response to the next samples of an excitation, one period by default.

        The same excitation played again goes on where it stopped, even within a period; another
        one starts at its own time zero.

        Parameters
        ----------
        lines : Lines
        samples : int, optional
            Number of samples of the excitation, at most one period.

        Returns
        -------
        (samples,) array
        """
        samples = lines.samples_per_period if samples is None else samples
        accepted = f"1 to samples_per_period = {lines.samples_per_period}"
        require(1 <= samples <= lines.samples_per_period, "samples", samples, accepted)
        self._take_up(lines)
        rate_hz = lines.sample_rate_hz
        played = np.arange(self._phase, self._phase + samples)
        self._phase = (self._phase + samples) % lines.samples_per_period
        floor = max(NEGLIGIBLE * float(np.abs(self._steady).max(initial=0.0)), self._negligible_v)
        response = self._period.take(played, mode="wrap") + free_decay(
            self._model, self._deviation, samples, 1 / rate_hz, self._part_s, floor
        )
        self._deviation = self._deviation * np.exp(self._model.poles_rad_s * (samples / rate_hz))
        if self._late_samples == 0:
            return response
        late = self._late if self._late.size else np.zeros(self._late_samples)
        joined = np.concatenate([late, response])
        self._late = joined[samples:]
        return joined[:samples]

    def _take_up(self, lines: Lines) -> None:
        """Begin an excitation here, from the present state, unless it is played already."""
        if not lines.same_signal(self._lines):
            if self._lines is not None:
                rate_hz = self._lines.sample_rate_hz
                accepted = f"{rate_hz:g}, that of what was played before"
                require(lines.sample_rate_hz == rate_hz, "sample_rate_hz", lines.sample_rate_hz, accepted)
            state = self.state
            self._prepare(lines)
            self._phase, self._deviation = 0, state - self._steady

    def _prepare(self, lines: Lines) -> None:
        """Work out what an excitation needs once."""
        self._lines = lines
        interval_s = 1 / lines.sample_rate_hz
        # a delay of a whole number of intervals, up to rounding, is exactly that
        late = int(np.ceil(self._delay_s / interval_s - 1e-9))
        # output n is the response at (n - late) interval + part
        self._late_samples, self._part_s = late, max(0.0, late * interval_s - self._delay_s)
        gain = self._model.frequency_response(lines.frequency_hz)
        self._period = sample_period(lines, gain, shift_s=self._part_s)
        self._steady = steady_state(self._model, lines)  # at time zero of the excitation
