# SPDX-License-Identifier: Apache-2.0
"""Hum and other tones in the bins of the joint estimator, or lines of an FRF: found, named, taken out.

A tone is a sinusoid that the excitation did not make. On an excited line it looks like response and
bends the poles, between lines it looks like noise. One at a time, the bin or line that departs most from a fit
is tested: whether it does so as noise would make it. The test of an outlier of a regression: by how much the
cost falls without it (Cook & Weisberg, *Residuals and Influence in Regression* (1982), section 2.2). What it
is compared with are medians of bins around of the same kind, so that coloured noise, distortion and an error of
the model, which all spread over many bins, are no outliers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import scipy  # its parts are loaded where they are used first: scipy.optimize takes a node 0.15 s
from scipy import special
from scipy.ndimage import median_filter

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.frf.result import FRF
from tactile_resonance.poles.compiled import entry, inner
from tactile_resonance.poles.joint import JointPlan
from tactile_resonance.poles.result import PolesBatch, PolesStatus
from tactile_resonance.tones import ROUNDING, Tone, level_around

FALSE_ALARM = 1e-4
"""Probability that noise of a record has a bin taken for a tone."""
MOST_TONES = 8
"""In a band; where there are more bins that stand out, something else is wrong."""
WINDOW = 33
"""Bins, or lines, around one that give the level there."""
MEDIAN_LOSS = 2.5
"""Times the variance of a mean that a median of exponential powers counts as having: 2.1, and its tails."""
CERTAIN_LEVERAGE = 0.99
"""A bin that the fit follows to this part cannot be tested."""
ALIKE_LINES = 9
"""Lines over which the variance counts as constant: that of one alone is too uncertain to divide by."""
NEAR_BINS = 0.75
"""So near a tone bins are left out; further away what leaks is taken off."""
BINS_OF_A_TONE = 3
"""On either side of its peak, from which it is estimated."""
PEAK_PASSES = 1e-4
"""Probability that a narrow peak of noise or distortion passes for a tone, where it is the largest."""
LINES_AROUND = 3
MOST_RETURNS = 8
"""How often a tone is estimated anew from a fit without it."""


@dataclass(frozen=True, eq=False)
class _Taken:
    """A tone and what is done about it.

    Attributes
    ----------
    channel : str
    at : float
        Where it lies, in bins.
    phasor : (M,) complex
        In each record [V]; half its amplitude.
    bins : frozenset of int
        Left out.
    """

    channel: str
    at: float
    phasor: ComplexArray
    bins: frozenset[int]

    def leak(self, plan: JointPlan) -> ComplexArray:
        """(M, K) what it adds to the bins of a band."""
        return self.phasor[:, None] * _spectrum_of(self.at, plan)

    def on_line_of(self, plan: JointPlan) -> bool:
        """Whether a harmonic of the period is left out for it, excited or not."""
        return any(n % plan.periods == 0 for n in self.bins)

    def named(self, plan: JointPlan) -> Tone:
        """For people."""
        rms_v = float(np.sqrt(2 * np.mean(np.abs(self.phasor) ** 2)))
        return Tone(self.at * plan.resolution_hz, rms_v, self.channel, plan.resolution_hz)


@lru_cache(maxsize=16)
def _leaving_out(plan: JointPlan, bins: tuple[int, ...]) -> JointPlan:
    """The plan without some bins; the latest ones are kept, for a tone is in many records."""
    return replace(plan, left_out=bins)


@dataclass(frozen=True, eq=False)
class _Fitted:
    """A fit without the tones taken; the data that it saw, (M, K) without what leaks out of these.

    And what it makes of all bins of the band, those left out too.
    """

    plan: JointPlan
    batch: PolesBatch
    u: ComplexArray
    y: ComplexArray

    @classmethod
    def without(
        cls, plan: JointPlan, u: ComplexArray, y: ComplexArray, taken: list[_Taken]
    ) -> _Fitted:
        if taken:
            bins = frozenset().union(*(tone.bins for tone in taken))
            plan = _leaving_out(plan, tuple(sorted(bins)))
        shape = np.shape(y)
        rest = {"actuator": np.atleast_2d(u), "sensor": np.atleast_2d(y)}
        for tone in taken:
            rest[tone.channel] = rest[tone.channel] - tone.leak(plan)
        u, y = rest["actuator"], rest["sensor"]
        return cls(plan, plan.from_bins(u.reshape(shape), y.reshape(shape)), u, y)

    @cached_property
    def _denominator(self) -> ComplexArray:
        """(K,)."""
        return np.asarray(self.plan.denominator_basis.values @ self.batch.fit.denominator)

    @cached_property
    def g(self) -> ComplexArray:
        """(K,) response."""
        return np.asarray(self.plan.numerator_on_bins @ self.batch.fit.numerator / self._denominator)

    @cached_property
    def _output(self) -> tuple[ComplexArray, BoolArray]:
        """(M, K), and on which bins (K,) the input is part of it."""
        plan, basis = self.plan, self.plan.transient_on_bins
        decay = self.batch.fit.transient.reshape(-1, basis.shape[1])  # (M, c)
        transient = decay @ basis.T / self._denominator
        # between harmonics the input is noise of the voltmeter, unless the output follows it
        error, through = self.y - transient, self.g * self.u
        less = np.linalg.norm((error - through)[:, plan.others_at])
        follows = plan.driven | bool(less < np.linalg.norm(error[:, plan.others_at]))
        return np.where(follows, through, 0) + transient, follows

    @cached_property
    def variance(self) -> FloatArray:
        """(K,) of the output less that of the model."""
        variance_y, variance_u = self.batch.noise_variance
        return np.asarray(variance_y + np.where(self._output[1], variance_u * np.abs(self.g) ** 2, 0))

    def errors(self) -> ComplexArray:
        """(M, K) output less that of the model."""
        return np.asarray(self.y - self._output[0])

    def without_each(self) -> FloatArray:
        """(K,) what the cost falls by without a bin, in units of its variance, see `_mean_of`.

        0 where a bin is not used.
        """
        plan, weight = self.plan, np.zeros(self.plan.bins.size)
        weight[plan.order] = 1 / np.sqrt(self.variance[plan.order])
        u = np.where(plan.driven, self.u, 0)
        bases = (plan.denominator_basis.values, plan.numerator_on_bins, plan.transient_on_bins)
        scale, error = weight / self._denominator, self.errors() * weight
        return _mean_of(falls_without_each(bases, self._output[0], u, scale, error), plan)


def _mean_of(power: FloatArray, plan: JointPlan) -> FloatArray:
    """(K,) mean over records of powers (M, K), each in units of its own level and at the mean of these.

    Of records that are not equally noisy the plain mean would be that of the noisiest alone, which exceeds its
    surroundings more often than a mean of M does.
    """
    if len(power) == 1:
        return power[0]
    at = plan.others_at if plan.others_at.size else plan.order
    level = np.median(power[:, at], axis=1)
    if not level.all():  # an exact input
        return np.asarray(power.mean(axis=0))
    return np.asarray(level.mean() * np.mean(power / level[:, None], axis=0))


def has_tones(plan: JointPlan, u: ComplexArray, y: ComplexArray, batch: PolesBatch) -> bool:
    """Whether a bin of u, y (K,) or (M, K) stands out from their fit, shape (), as one with a tone does."""
    return _most_striking(_Fitted(plan, batch, np.atleast_2d(u), np.atleast_2d(y))) is not None


def noise_without_one_tone(
    plan: JointPlan, u: ComplexArray, y: ComplexArray, batch: PolesBatch
) -> float:
    """Variance of the noise of y that is left once what stands out most is taken off as a tone.

    Of bins and a fit as `has_tones` takes them. Infinite where no bin stands out, or too few lines are left.
    """
    found = _most_striking(_Fitted(plan, batch, np.atleast_2d(u), np.atleast_2d(y)))
    if found is None:
        return np.inf
    try:
        return float(_taken_too(plan, u, y, [], *found)[1].batch.noise_variance[0])
    except ValueError:  # too few lines are left
        return np.inf


def poles_without_tones(
    plan: JointPlan, u: ComplexArray, y: ComplexArray, batch: PolesBatch
) -> tuple[PolesBatch, tuple[Tone, ...]]:
    """Poles of one point, bins with a tone left out and what leaks out of them taken off.

    A tone on the only line that shows a narrow mode cannot be distinguished from response. Of bins u, y (K,)
    or (M, K) of a plan that leaves out none, and its fit, shape (). Tones are by frequency; none where so
    many bins, or neighbouring excited lines, stand out that something other than tones is wrong, or where the
    fit without them finds no minimum.
    """
    taken: list[_Taken] = []
    whole = fitted = _Fitted(plan, batch, np.atleast_2d(u), np.atleast_2d(y))
    try:
        while (found := _most_striking(fitted)) is not None:
            taken, fitted = _taken_too(plan, u, y, taken, *found)
            if len(taken) > MOST_TONES:
                return whole.batch, ()
        # a large tone bends the fit, and then others that are none stand out too
        for tone in sorted(taken, key=lambda tone: np.sum(np.abs(tone.phasor) ** 2)):
            fewer = [other for other in taken if other is not tone]
            if fewer and _most_striking(again := _Fitted.without(plan, u, y, fewer)) is None:
                taken, fitted = fewer, again
        sure = [tone for tone in taken if _stands_alone(fitted, tone)]
        if fitted.batch.has_status(PolesStatus.MODEL_ERROR):
            # what the model leaves out, or distortion, may be that large on a single line
            sure = [tone for tone in sure if not tone.on_line_of(fitted.plan)]
        if len(sure) < len(taken):
            taken, fitted = sure, _Fitted.without(plan, u, y, sure)
    except ValueError:  # too few lines are left
        return whole.batch, ()
    lost = fitted.batch.has_status(PolesStatus.NOT_CONVERGED) and not whole.batch.has_status(
        PolesStatus.NOT_CONVERGED
    )
    if lost or (taken and _lines_in_a_row(fitted.plan)):
        return whole.batch, ()
    named = (tone.named(fitted.plan) for tone in sorted(taken, key=lambda tone: tone.at))
    return fitted.batch, tuple(named)


def _taken_too(
    plan: JointPlan, u: ComplexArray, y: ComplexArray, taken: list[_Taken], k: int, channel: str
) -> tuple[list[_Taken], _Fitted]:
    """With the tone at bin k, estimated from fits that leave it out."""
    for tone in taken:
        if any(abs(k - n) == 1 for n in tone.bins):  # it is not steady
            wider = replace(tone, bins=tone.bins | {k})
            now = [wider if other is tone else other for other in taken]
            return now, _Fitted.without(plan, u, y, now)
    tone = _Taken(channel, float(k), np.zeros(len(np.atleast_2d(y)), complex), frozenset({k}))
    fitted = _Fitted.without(plan, u, y, [*taken, tone])
    for _ in range(MOST_RETURNS):
        here = fitted.plan
        rest = fitted.u if channel == "actuator" else fitted.errors()
        unknown = here.bins[here.driven] if channel == "actuator" else here.bins[here.excited_at]
        at, phasor = _tone_near(here, rest + tone.leak(here), k, unknown)
        near = here.bins[np.abs(here.bins - at) <= NEAR_BINS]
        moved = abs(at - tone.at)
        tone = _Taken(channel, at, phasor, tone.bins | {int(n) for n in near})
        fitted = _Fitted.without(plan, u, y, [*taken, tone])
        if moved < 0.01:
            break
    return [*taken, tone], fitted


def _lines_in_a_row(plan: JointPlan) -> bool:
    """Whether neighbouring excited lines are left out, and not what lies between them: no tone does that."""
    gone = np.flatnonzero(np.isin(plan.bins[plan.driven], plan.left_out))
    if plan.periods == 1:  # two are one tone between them
        return bool(np.any(gone[2:] - gone[:-2] == 2))
    return bool(np.any(np.diff(gone) == 1))


@lru_cache(maxsize=16)
def _kinds(plan: JointPlan) -> list[BoolArray]:
    """(K,) each, as `least_chance` takes them: excited lines, other even and odd harmonics, bins between.

    Other harmonics only where there are any.
    """
    on_line, odd = plan.bins % plan.periods == 0, plan.bins // plan.periods % 2 == 1
    excited, others = np.zeros((2, odd.size), bool)
    excited[plan.excited_at] = others[plan.others_at] = True
    silent = others & on_line
    return [excited, *filter(np.any, (silent & ~odd, silent & odd)), others & ~on_line]


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def _most_striking(fitted: _Fitted) -> tuple[int, str] | None:
    """Bin and channel of what stands out most, if noise would not make it."""
    plan = fitted.plan
    if not (np.isfinite(fitted.variance).all() and np.isfinite(fitted.g).all()):
        return None
    rounding_y, rounding_u = (
        ROUNDING * np.mean(np.abs(x[:, plan.driven]) ** 2) for x in (fitted.y, fitted.u)
    )
    kinds = _kinds(plan)
    input_power = _mean_of(np.abs(fitted.u) ** 2, plan)
    falls, least = fitted.without_each(), rounding_y / fitted.variance
    if not plan.level_known:  # noise of the input may make more at a resonance
        least = np.maximum(least, 1.4 * median_filter(falls, 5))
    other = [np.zeros_like(kinds[0]), *kinds[1:]]
    found = {
        "sensor": least_chance(falls, kinds, len(fitted.y), least),
        "actuator": least_chance(input_power, other, len(fitted.u), rounding_u),
    }
    tests = plan.excited_at.size + 2 * plan.others_at.size
    channel = min(found, key=lambda name: found[name][0])
    chance, k = found[channel]
    return (int(plan.bins[k]), channel) if chance * tests < FALSE_ALARM else None


def _spectrum_of(at: float, plan: JointPlan) -> ComplexArray:
    """(K,) what a phasor of 1 at a bin that need not be whole adds to the bins of a band."""
    samples = plan.samples_per_period * plan.periods
    away = at - plan.bins
    on = np.abs(away) < 1e-9
    safe = np.where(on, 0.5, away)
    ratio = np.expm1(2j * np.pi * safe) / (samples * np.expm1(2j * np.pi * safe / samples))
    return np.where(on, 1.0, ratio)


def _tone_near(
    plan: JointPlan, errors: ComplexArray, k: int, unknown: IntArray
) -> tuple[float, ComplexArray]:
    """Where a tone near bin k lies, in bins, and its phasors (M,) in errors (M, K), by least squares.

    From bins other than the `unknown` ones, unless there are none.
    """
    near = np.abs(plan.bins - k) <= BINS_OF_A_TONE
    near &= ~np.isin(plan.bins, unknown) | (plan.periods == 1)
    values = errors[:, near]

    def fit(at: float) -> tuple[float, ComplexArray]:
        shape = _spectrum_of(at, plan)[near]
        phasor = values @ shape.conj() / np.sum(np.abs(shape) ** 2)
        return float(np.sum(np.abs(values - phasor[:, None] * shape) ** 2)), phasor

    found = scipy.optimize.minimize_scalar(
        lambda at: fit(at)[0], bounds=(k - 0.7, k + 0.7), method="bounded", options={"xatol": 1e-4}
    )
    return float(found.x), fit(float(found.x))[1]


def _stands_alone(fitted: _Fitted, tone: _Taken) -> bool:
    """Whether little is left around a tone once it is taken off: of a peak of noise or distortion much is.

    Around are bins between lines, the nearest four and more, and lines where the tone is on one.
    """
    plan, variance = fitted.plan, fitted.variance
    power = np.sum(np.abs(tone.phasor) ** 2)
    rest = fitted.u if tone.channel == "actuator" else fitted.errors()
    away = np.abs(plan.bins - tone.at)
    kinds = [(plan.others_at, 4), (plan.others_at, 4 * BINS_OF_A_TONE)]
    if tone.channel == "sensor" and tone.on_line_of(plan):
        kinds.append((plan.excited_at, 2 * LINES_AROUND))
    for at, count in kinds:
        near = at[np.argsort(away[at])[:count]]
        if near.size < 2:
            continue
        left = np.abs(rest[:, near]) ** 2
        # as large as at the tone, were they noise of the model's variance
        left = left / variance[near] * np.interp(tone.at, plan.bins, variance)
        ratio = power / np.sum(np.mean(left, axis=1))
        if special.fdtrc(2 * len(left), 2 * left.size, ratio) > PEAK_PASSES:
            return False
    return True


def poles_of_lines_without_tones(
    fit: Callable[[FRF], PolesBatch], frf: FRF
) -> tuple[PolesBatch, tuple[Tone, ...]]:
    """Poles from an FRF, lines with a tone left out; see `poles_without_tones` for records.

    Parameters
    ----------
    fit : callable
        Poles from lines, of which those that are not finite are left out.
    frf : FRF
        With (F,) arrays, the lines of the band.
    """
    whole = batch = fit(frf)
    rest, found = frf, list[int]()
    while (line := _most_striking_line(batch, rest)) is not None:
        found.append(line)
        g = rest.g.copy()
        g[line] = np.nan
        rest = replace(rest, g=g)
        batch = fit(rest)
        if len(found) > MOST_TONES or 1 in np.diff(np.sort(found)):
            return whole, ()  # neighbours stand out, or too many: that is no tone
    if batch.has_status(PolesStatus.MODEL_ERROR) or batch.has_status(PolesStatus.NOT_CONVERGED):
        return whole, ()  # distortion, or what the model leaves out, may be that large on a line
    spacing_hz = float(np.diff(frf.frequency_hz).min()) if found else 0.0
    tones = []
    for line in sorted(found):
        frequency_hz = frf.frequency_hz[line]
        rms_v = np.nan
        if frf.actuator_amplitude is not None:
            error = frf.g[line] - batch.fit.response(frequency_hz[None])[0]
            rms_v = np.sqrt(2) * np.abs(error) * frf.actuator_amplitude[line]
        tones.append(Tone(float(frequency_hz), float(rms_v), "sensor", spacing_hz))
    return batch, tuple(tones)


@np.errstate(all="ignore")
def _most_striking_line(batch: PolesBatch, frf: FRF) -> int | None:
    """The line that stands out most, if noise would not make it."""
    fit, used = batch.fit, np.isfinite(frf.g)
    variance = np.ones(used.size) if frf.variance is None else frf.variance
    used &= np.isfinite(variance) & (variance > 0)
    x = fit.variable.of_frequency(frf.frequency_hz)
    p, q = (basis.at(x, 0)[0] for basis in (fit.denominator_basis, fit.numerator_basis))
    turned = np.exp(-2j * np.pi * frf.frequency_hz * fit.delay_s) / (p @ fit.denominator)
    response = (q @ fit.numerator) * turned
    if not np.isfinite(response).all() or used.sum() <= batch.structure.fewest_lines:
        return None
    smooth = median_filter(np.where(used, variance, np.median(variance[used])), ALIKE_LINES)
    by_line = str(batch.variance_model) == "per line"
    weight = used / np.sqrt(np.where(used, variance, 1.0) if by_line else smooth)
    scale = weight * turned
    error = np.asarray(np.where(used, frf.g - response, 0) * weight, complex)[None]
    bases = p, q, np.empty((used.size, 0), complex)
    none = np.zeros_like(used)
    least = ROUNDING * np.mean(np.abs(response[used]) ** 2) * weight**2
    power = falls_without_each(bases, response[None], np.ones_like(error), scale, error)[0]
    dof = frf.dof if by_line and frf.dof else np.inf
    chance, line = least_chance(power, [used, none, none], 1, np.where(used, least, 1.0), dof)
    return line if chance * used.sum() < FALSE_ALARM else None


def falls_without_each(
    bases: tuple[ComplexArray, ComplexArray, ComplexArray],
    output: ComplexArray,
    u: ComplexArray,
    scale: ComplexArray,
    error: ComplexArray,
) -> FloatArray:
    """(M, K) what the cost falls by without a bin, in units of its variance.

    0 where the fit goes through a bin whatever is there. Of bases (K, terms) of A, B and C, output of the model
    and input (M, K), a `scale` (K,) that derivatives of the error are weighted with, over A, 0 on bins not
    used, and weighted errors (M, K), E|error|^2 = 1 of noise.
    """
    falls = np.empty(error.shape)
    _falls_without_each(*bases, output, u, scale, error, falls)
    return falls


@entry
def _falls_without_each(of_a, of_b, of_c, output, u, scale, error, falls):
    """Put what `falls_without_each` gives into the last."""
    (records, bins), a, b, c = output.shape, of_a.shape[1] - 1, of_b.shape[1], of_c.shape[1]
    # real and imaginary parts of derivatives by the C of each record, and by what records share
    own, shared = np.empty((c, 2, bins)), np.empty((a + b, records, 2, bins))
    for k in range(bins):
        for i in range(c):
            value = scale[k] * of_c[k, i]
            own[i, 0, k], own[i, 1, k] = value.real, value.imag
        for i in range(a + b):
            of = -scale[k] * of_a[k, i] if i < a else scale[k] * of_b[k, i - a]
            for m in range(records):
                value = of * (output[m, k] if i < a else u[m, k])
                shared[i, m, 0, k], shared[i, m, 1, k] = value.real, value.imag
    for i in range(c):
        _make_orthonormal(own[i].reshape(-1), own[:i].reshape(i, -1))
    for i in range(a + b):
        for m in range(records):
            _take_off(shared[i, m].reshape(-1), own.reshape(c, -1))
        _make_orthonormal(shared[i].reshape(-1), shared[:i].reshape(i, -1))
    for m in range(records):
        for k in range(bins):
            # I - H, 2 x 2: what of an error there the fit has left
            p, r, both = 1.0, 1.0, 0.0
            for i in range(c + a + b):
                of_bin = own[i, :, k] if i < c else shared[i - c, m, :, k]
                re, im = of_bin[0], of_bin[1]
                p, r, both = p - re * re, r - im * im, both - re * im
            falls[m, k] = 0.0
            if (p + r) / 2 - np.hypot((p - r) / 2, both) > 1 - CERTAIN_LEVERAGE:  # least eigenvalue
                re, im = error[m, k].real, error[m, k].imag
                falls[m, k] = (r * re * re - 2 * both * re * im + p * im * im) / (p * r - both * both)


@inner
def _take_off(column, basis):
    """What a column has along each of the orthonormal rows of a basis; twice, for what rounding leaves."""
    for _ in range(2):
        for i in range(basis.shape[0]):
            of, along = basis[i], 0.0
            for k in range(column.size):
                along += of[k] * column[k]
            for k in range(column.size):
                column[k] -= along * of[k]


@inner
def _make_orthonormal(column, basis):
    """Make a column orthogonal to the rows of a basis, and its length 1; 0 where nothing is left."""
    _take_off(column, basis)
    square = 0.0
    for k in range(column.size):
        square += column[k] * column[k]
    scale = 1 / np.sqrt(square) if square > 0 else 0.0
    for k in range(column.size):
        column[k] *= scale


def least_chance(
    power: FloatArray,
    kinds: list[BoolArray],
    records: int,
    least: FloatArray | float,
    most_dof: float = np.inf,
) -> tuple[float, int]:
    """Least probability that noise makes a power as large as that of a bin, and which bin; from those around.

    Of powers (K,) that are means over records, divided by what has `most_dof` complex degrees of freedom;
    rounding has a level `least`. The kinds (K,) are first excited lines, then kinds of other harmonics, last
    the bins between, with noise alone. Harmonics may hold distortion: they are compared with the larger level
    of their own kind and of the noise. Other harmonics that are few of their kind are compared with the
    excited ones; without excited ones they are not tested. NaN where a power or level is.
    """
    found = [(1.0, 0)]
    levels = [level_around(power, kind, records, WINDOW) for kind in kinds]
    between, between_around = levels[-1]
    for k, (kind, (own, around)) in enumerate(zip(kinds, levels, strict=True)):
        if not around and 0 < k < len(kinds) - 1:
            own, around = levels[0]
            if not around:
                continue
        level = np.maximum(own, between)
        # the larger of two levels makes fewer false alarms than either
        around = between_around or around
        if around:
            dof = min(records * around / MEDIAN_LOSS, most_dof)
            ratio = np.where(kind, power / np.maximum(level, least), 0.0)
            at = int(np.argmax(ratio))
            found.append((float(special.fdtrc(2 * records, 2 * dof, ratio[at])), at))
    return found[int(np.argmin([chance for chance, _ in found]))]
