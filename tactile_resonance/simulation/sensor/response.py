# SPDX-License-Identifier: Apache-2.0
"""Exact time response of a linear system to a sequence of periodic excitations.

Over a stretch of one excitation the response is its steady state, synthesised by an inverse FFT,
plus free decays of the poles: ``z_k(t) = z_ss,k(t) + (z_k(0) - z_ss,k(0)) exp(p_k t)``. Nothing is
discretised, so nothing warps, and a record can be produced period by period.

Where the contact changes slowly, it is over an interval h that of the interval's middle, which takes over the
state of the one before. With the contact at rest this is exact. Otherwise the part of the response that a
pole p makes is off by at most ``|p'| h^2 / 12`` of itself, and on the mean over an interval by nothing: it
lags behind its steady state by ``|p'| / Re(p)^2``, as it has to.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.fields import require
from tactile_resonance.simulation.sensor.bimorph import CoupledBimorph
from tactile_resonance.simulation.sensor.linear import Lines, PoleResidueModel, sample_period

# A decay this far below the response is not computed: below the rounding of the sum it enters.
NEGLIGIBLE = 1e-18
MAX_DELAY_S = 1.0


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


@dataclass(frozen=True, eq=False)
class _Plan:
    """What one excitation needs once: its steady-state period and the state at its time zero."""

    lines: Lines
    period: FloatArray  # (samples_per_period,)
    state: ComplexArray  # (K,)


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
        self._model = model
        require(negligible_v >= 0, "negligible_v", negligible_v, "0 or above")
        self._delay_s = delay_s
        self._negligible_v = negligible_v
        self._sample_rate_hz: float | None = None
        self._plan: _Plan | None = None
        self._phase = 0  # samples of the current period already played
        # state minus steady state: it only decays, so it loses no digits over many periods
        self._deviation = np.zeros(model.poles_rad_s.size, dtype=complex)
        self._late = np.zeros(0)  # computed, but not due yet because of the delay

    @property
    def state(self) -> ComplexArray:
        """Modal state ``z`` at the end of what was played (not delayed), shape (K,)."""
        if self._plan is None:
            return self._deviation.copy()
        if self._phase == 0:
            return self._plan.state + self._deviation
        now_s = self._phase / self._plan.lines.sample_rate_hz
        return steady_state(self._model, self._plan.lines, now_s) + self._deviation

    def continued(self, model: PoleResidueModel, state: ComplexArray) -> ResponseStream:
        """Return a stream of another model that goes on from here, in a given state (K,)."""
        other = ResponseStream(model, delay_s=self._delay_s, negligible_v=self._negligible_v)
        other._sample_rate_hz, other._phase = self._sample_rate_hz, self._phase
        other._late = self._late.copy()
        if self._plan is not None:
            lines = self._plan.lines
            other._plan = other._make_plan(lines)
            now_s = self._phase / lines.sample_rate_hz
            state = state - steady_state(model, lines, now_s)
        other._deviation = state
        return other

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
        plan = self._take_up(lines)
        played = np.arange(self._phase, self._phase + samples)
        steady = plan.period.take(played, mode="wrap")
        self._phase = (self._phase + samples) % lines.samples_per_period
        scale = NEGLIGIBLE * float(np.abs(plan.state).max(initial=0.0))
        return self._advance(steady, scale)

    def skip(self, lines: Lines, periods: int) -> None:
        """Advance whole periods of an excitation; only the last one is synthesised."""
        require(periods >= 0, "periods", periods, "0 or above")
        for _ in range(periods - 1):
            self._take_up(lines)
            self._deviation = self._deviation * self._decay(lines.samples_per_period)
        if periods > 0:
            self.play(lines)  # samples that are late belong to what follows

    def _take_up(self, lines: Lines) -> _Plan:
        """Return the plan of an excitation; a new one starts here, from the present state."""
        self._set_rate(lines.sample_rate_hz)
        if self._plan is None or not lines.same_signal(self._plan.lines):
            state = self.state
            self._plan, self._phase = self._make_plan(lines), 0
            self._deviation = state - self._plan.state
        return self._plan

    def _make_plan(self, lines: Lines) -> _Plan:
        _, part_s = self._delay_steps()
        gain = self._model.frequency_response(lines.frequency_hz)
        period = sample_period(lines, gain, shift_s=part_s)
        return _Plan(lines, period, steady_state(self._model, lines))

    def _advance(self, steady: FloatArray, floor: float) -> FloatArray:
        """Add the decay of the deviation to a steady response, move on, apply the delay."""
        whole, part_s = self._delay_steps()
        decay = free_decay(
            self._model,
            self._deviation,
            steady.size,
            self._interval_s,
            part_s,
            max(floor, self._negligible_v),
        )
        response = steady + decay
        self._deviation = self._deviation * self._decay(steady.size)
        if whole == 0:
            return response
        late = self._late if self._late.size else np.zeros(whole)
        joined = np.concatenate([late, response])
        self._late = joined[steady.size :]
        return joined[: steady.size]

    def _decay(self, samples: int) -> ComplexArray:
        assert self._sample_rate_hz is not None
        return np.asarray(np.exp(self._model.poles_rad_s * (samples / self._sample_rate_hz)))

    @property
    def _interval_s(self) -> float:
        assert self._sample_rate_hz is not None
        return 1 / self._sample_rate_hz

    def _delay_steps(self) -> tuple[int, float]:
        """Split the delay: output n is the response at ``(n - whole) interval + part``."""
        # a delay of a whole number of intervals, up to rounding, is exactly that
        whole = int(np.ceil(self._delay_s / self._interval_s - 1e-9))
        return whole, max(0.0, whole * self._interval_s - self._delay_s)

    def _set_rate(self, sample_rate_hz: float) -> None:
        if self._sample_rate_hz is None:
            self._sample_rate_hz = float(sample_rate_hz)
        same = sample_rate_hz == self._sample_rate_hz
        accepted = f"{self._sample_rate_hz:g}, that of what was played before"
        require(same, "sample_rate_hz", sample_rate_hz, accepted)


INTERVAL_S = 0.04


class VaryingStream:
    """Counterpart of `ResponseStream` for a sensor that is another at every time.

    Parameters
    ----------
    coupled_at : callable
        The linear sensor at a time [s] since the start.
    delay_s, negligible_v : float
        As in `ResponseStream`.
    """

    def __init__(
        self,
        coupled_at: Callable[[float], CoupledBimorph],
        *,
        delay_s: float = 0.0,
        negligible_v: float = 0.0,
    ) -> None:
        self._coupled_at = coupled_at
        self._coupled = coupled_at(0.0)
        self._stream = ResponseStream(
            self._coupled.modal, delay_s=delay_s, negligible_v=negligible_v
        )
        self._time = 0.0

    def play(self, lines: Lines) -> FloatArray:
        """Return the response to the next period of an excitation, as `ResponseStream.play`."""
        samples, rate_hz = lines.samples_per_period, lines.sample_rate_hz
        count = max(1, int(np.ceil(samples / rate_hz / INTERVAL_S - 1e-9)))
        ends = np.linspace(0, samples, count + 1).astype(int)
        start, parts = self._time, []
        for begin, end in pairwise(ends):
            middle_s = start + float(begin + end) / 2 / rate_hz
            contact = self._coupled_at(middle_s)
            state = self._coupled.carry_state(self._stream.state, contact)
            self._coupled, self._stream = contact, self._stream.continued(contact.modal, state)
            parts.append(self._stream.play(lines, int(end - begin)))
        self._time = start + samples / rate_hz
        return np.concatenate(parts)
