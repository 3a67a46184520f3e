# SPDX-License-Identifier: Apache-2.0
"""Whole periods of both channels, checked; reading them from .npz, .mat and .csv files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import IntArray
from tactile_resonance.array_files import read_arrays
from tactile_resonance.fields import cut, number, require, whole

MIN_RATE_HZ, MAX_RATE_HZ = 1e-6, 1e12
_FIELDS = ("sample_rate_hz", "samples_per_period", "excited_harmonics", "time_s")


@dataclass(frozen=True)
class Recording:
    """Periodic record of both channels.

    Attributes
    ----------
    u, y : (M, P, N) float
        Actuator and sensor [V]: M realisations of P consecutive periods of N samples.
    sample_rate_hz : float
    excited_harmonics : (F,) int or None
        Multiples of ``sample_rate_hz / N``; None where the record does not say.
    notes : tuple of str
        What a reader should know: what was left out of the record, and why.
    """

    u: npt.NDArray[np.floating]
    y: npt.NDArray[np.floating]
    sample_rate_hz: float
    excited_harmonics: IntArray | None = None
    notes: tuple[str, ...] = ()

    @property
    def resolution_hz(self) -> float:
        """Distance of the lines [Hz]."""
        return self.sample_rate_hz / self.u.shape[-1]

    def require_repeated(self) -> None:
        """Raise ``ValueError`` where one period is all there is."""
        realisations, periods, samples = self.u.shape
        if realisations < 2 and periods < 2:
            raise ValueError(
                f"periods: {periods} period of {realisations} realisation, {samples} samples; expected at "
                "least 2 periods (samples_per_period, --samples-per-period, is their length) or 2 "
                "realisations: one alone has no covariance"
            )

    def require_driven(self) -> None:
        """Raise ``ValueError`` where no response can be estimated.

        From one period alone, where a channel is constant over a realisation: nothing was driven, where a
        realisation is a copy of the first, or where the actuator repeats after another number of samples than a
        period has.
        """
        self.require_repeated()
        for name, samples in (("u", self.u), ("y", self.y)):
            flat = np.ptp(samples, axis=(1, 2)) == 0
            if np.any(flat):
                raise ValueError(
                    f"{name}: constant ({samples[np.argmax(flat)].flat[0]:g} V), expected a channel that "
                    "moves; of a record without drive: analyze --silent"
                )
        for m, n in combinations(range(len(self.y)), 2):
            if np.array_equal(self.y[m], self.y[n]):
                raise ValueError(
                    f"y: realisation {n + 1} is a copy of realisation {m + 1}, expected another record with "
                    "phases of its own, or the record once"
                )
        repeats_after = _repeats_after(self.u[0])
        if repeats_after:
            raise ValueError(
                f"samples_per_period: {self.u.shape[-1]}, but u repeats after {repeats_after} samples: "
                "expected that number, or a multiple of it"
            )

    @property
    def copied(self) -> bool:
        """Whether all periods of the sensor are the same to the last bit: there is no noise to estimate."""
        return self.y.shape[1] > 1 and bool(np.all(self.y == self.y[:, :1]))


def make_recording(
    u: npt.ArrayLike,
    y: npt.ArrayLike,
    *,
    sample_rate_hz: float,
    samples_per_period: int | None = None,
    periods: int | None = None,
    segments: Sequence[tuple[int, int]] | None = None,
    excited_harmonics: npt.ArrayLike | None = None,
    u_name: str = "u",
    y_name: str = "y",
) -> Recording:
    """Check what was read and give it the axes of a `Recording`.

    Parameters
    ----------
    u, y : (samples,), (P, N) or (M, P, N)
    sample_rate_hz : float
    samples_per_period : int, optional
        Of channels that are not cut into periods; without it and `periods` each realisation is one period.
    periods : int, optional
        How many periods to use, from the first. Where `samples_per_period` is not known: into how many
        periods a one-dimensional channel divides.
    segments : [(start, stop)], optional
        Samples cut out of one-dimensional channels, one realisation each.
    excited_harmonics : (F,) int, optional
    u_name, y_name : str
        What the fields are called, for messages.

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted.

    Examples
    --------
    >>> import numpy as np
    >>> u, y = np.random.default_rng(0).standard_normal((2, 8000))  # your samples [V]
    >>> recording = tr.make_recording(u, y, sample_rate_hz=5e3, samples_per_period=2000)
    >>> recording.u.shape, recording.resolution_hz
    ((1, 4, 2000), 2.5)
    """
    rate_hz = number(sample_rate_hz, "sample_rate_hz")
    accepted = f"a positive frequency, {MIN_RATE_HZ:g} to {MAX_RATE_HZ:g} Hz"
    require(MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ, "sample_rate_hz", sample_rate_hz, accepted)
    if samples_per_period is not None:
        samples_per_period = whole(samples_per_period, "samples_per_period", 4)
    if periods is not None:
        periods = whole(periods, "periods", 1)
    channels = [_as_samples(x, name) for x, name in ((u, u_name), (y, y_name))]
    if channels[0].shape != channels[1].shape:
        raise ValueError(
            f"{y_name}: shape {channels[1].shape}, expected that of {u_name}, {channels[0].shape}"
        )
    if segments is not None:
        channels = [
            _cut(x, segments, name) for x, name in zip(channels, (u_name, y_name), strict=False)
        ]
    n = _period_length(channels[0].shape, samples_per_period, periods, u_name)
    channels = [x.reshape(x.shape[0] if x.ndim == 3 else 1, -1, n) for x in channels]  # (M, P, N)
    if periods is not None:
        if periods > channels[0].shape[1]:
            raise ValueError(
                f"periods: {periods}, accepted is 1..{channels[0].shape[1]}, the periods recorded"
            )
        channels = [x[:, :periods] for x in channels]
    for x, name in zip(channels, (u_name, y_name), strict=False):
        _check_samples(x, name)
    return Recording(channels[0], channels[1], rate_hz, _harmonics(excited_harmonics, n))


LARGEST_BETWEEN_V = 1e-70, 1e70
"""Of a channel: fourth powers of voltages must neither overflow nor vanish."""

# Part of the actuator's power that differs from period to period, from which another period is looked for, and
# how much less must differ after that.
DIFFERS, BETTER = 1e-4, 10.0
# The same, of which a period is no whole one. A multisine with a tone beside it repeats best after several.
UNLIKE = 0.5


def _repeats_after(u: npt.NDArray[np.floating]) -> int:
    """Samples after which a record (P, N) repeats much better than after N; 0 where it does not."""
    periods, n = u.shape
    x = u.astype(float).ravel()
    x -= x.mean()
    power = np.cumsum(x * x)
    if periods < 2 or not power[-1] > 0 or not np.isfinite(power[-1]):
        return 0
    differs = np.sum((x[n:] - x[:-n]) ** 2) / (power[-1] - power[n - 1] + power[-1 - n])
    if not differs > DIFFERS:
        return 0
    size = x.size
    spectrum = np.fft.rfft(x, 2 * size)
    most = max(size // 2, 3 * n // 2)  # beyond, little of the record is compared
    product = np.fft.irfft(spectrum.real**2 + spectrum.imag**2)[:most]  # over lags
    lags = np.arange(1, product.size)
    after, before = power[-1] - power[lags - 1], power[size - lags - 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        alike = np.nan_to_num(product[1:] / np.sqrt(after * before))
    low = np.flatnonzero(alike < 0.5)  # beyond it a lag is no mere smoothness
    alike[: low[0] if low.size else None] = 0.0
    best = alike.max()
    if 1 - best > differs / BETTER:
        return 0
    near = np.flatnonzero(alike > best - differs / BETTER)
    first = near[: np.argmax(np.append(np.diff(near), 2) > 1) + 1]  # around the smallest of its multiples
    lag = int(lags[first[np.argmax(alike[first])]])
    if n % lag == 0 or (lag % n == 0 and differs < UNLIKE):
        return 0
    return lag


def _as_samples(values: npt.ArrayLike, name: str) -> npt.NDArray[np.floating]:
    if isinstance(values, np.ma.MaskedArray) and values.dtype.kind in "iuf":
        values = np.ma.filled(values.astype(float), np.nan)  # samples that are masked are missing
    try:
        array = np.asarray(values)
    except ValueError:  # rows of different length
        array = np.empty(0, object)
    if array.dtype.kind not in "iuf":
        raise ValueError(
            f"{name}: values of type {array.dtype}, expected an array of real numbers [V]"
        )
    array = np.squeeze(array) if array.ndim == 2 and 1 in array.shape else array
    if array.ndim not in (1, 2, 3) or array.size == 0:
        raise ValueError(
            f"{name}: shape {array.shape}, accepted are (samples,), (periods, samples per period) and "
            "(realisations, periods, samples per period)"
        )
    return array if array.dtype.kind == "f" else array.astype(float)


def _cut(
    samples: npt.NDArray[np.floating], segments: Sequence[tuple[int, int]], name: str
) -> npt.NDArray[np.floating]:
    """(M, 1, length) one segment a realisation."""
    if samples.ndim != 1:
        raise ValueError(f"segments: {name} has shape {samples.shape}, expected (samples,)")
    try:
        pairs = [(whole(start, "segments"), whole(stop, "segments")) for start, stop in segments]
    except (TypeError, ValueError):
        pairs = []
    require(bool(pairs), "segments", segments, "a list of (start, stop) in samples")
    for start, stop in pairs:
        if not start < stop <= samples.size:
            raise ValueError(
                f"segments: {start}:{stop}, expected 0 <= START < STOP <= {samples.size}"
            )
    lengths = {stop - start for start, stop in pairs}
    if len(lengths) != 1:
        raise ValueError(f"segments: lengths {sorted(lengths)}, expected one length for all")
    for (start, stop), (following, end) in pairwise(sorted(pairs)):
        if following < stop:  # the noise of both would be taken for independent
            raise ValueError(
                f"segments: {start}:{stop} and {following}:{end} share samples, expected each sample once"
            )
    return np.stack([samples[start:stop] for start, stop in pairs])[:, None]


def _period_length(
    shape: tuple[int, ...], samples_per_period: int | None, periods: int | None, name: str
) -> int:
    cut_in_periods = len(shape) > 1 and shape[-2] > 1
    if samples_per_period is None:
        if cut_in_periods or periods is None:
            return shape[-1]
        if shape[-1] % periods:
            raise ValueError(f"periods: {periods}, expected a divisor of {shape[-1]} samples")
        return shape[-1] // periods
    if cut_in_periods and shape[-1] != samples_per_period:
        raise ValueError(
            f"samples_per_period: {samples_per_period}, but {name} has shape {shape}: expected "
            f"{shape[-1]}, or the samples of a period along the last axis"
        )
    if shape[-1] % samples_per_period:
        raise ValueError(
            f"{name}: {shape[-1]} samples, expected a multiple of the period of "
            f"{samples_per_period} samples"
        )
    return samples_per_period


def _check_samples(samples: npt.NDArray[np.floating], name: str) -> None:
    """Every sample finite, also its powers."""
    bad = samples.size - int(np.count_nonzero(np.isfinite(samples)))
    if bad:
        raise ValueError(f"{name}: {bad} samples are NaN or infinite, expected finite voltages")
    largest, (low, high) = float(max(samples.max(), -samples.min())), LARGEST_BETWEEN_V
    if not (largest == 0 or low <= largest <= high):
        raise ValueError(f"{name}: up to {largest:g} V, expected 0 or {low:g} to {high:g} V")


def _harmonics(values: npt.ArrayLike | None, n: int) -> IntArray | None:
    if values is None:
        return None
    array = np.asarray(values).ravel()
    last = (n - 1) // 2
    wrong = array
    if array.dtype.kind in "iuf":
        wrong = array[~((np.mod(array, 1) == 0) & (array >= 1) & (array <= last))]
    if wrong.size or not array.size:
        more = "..." if wrong.size > 5 else ""
        raise ValueError(
            f"excited_harmonics: {wrong[:5]}{more}, expected whole numbers from 1 to {last}"
        )
    return np.unique(array.astype(np.int64))


def read_recording(
    path: Path,
    *,
    u: str = "u",
    y: str = "y",
    sample_rate_hz: float | None = None,
    samples_per_period: int | None = None,
    periods: int | None = None,
    segments: Sequence[tuple[int, int]] | None = None,
    excited_harmonics: npt.ArrayLike | None = None,
) -> Recording:
    """Read both channels and what belongs to them.

    Parameters
    ----------
    path : Path
        ``.npz`` and ``.mat`` (up to version 7) hold the fields `u`, `y`, ``sample_rate_hz``,
        ``samples_per_period`` and optionally ``excited_harmonics``; ``.csv`` has a header line that names
        its columns, among them `u`, `y` and optionally ``time_s``.
    u, y : str
        Names of the actuator and sensor field.
    sample_rate_hz, samples_per_period, excited_harmonics
        Win over what the file says.
    periods, segments
        See `make_recording`.

    Raises
    ------
    ValueError
        If the file is no record or a field is missing or wrong; one line that says what is accepted.
    OSError
        If the file cannot be opened.
    """
    fields, names = read_arrays(path, {u, y, *_FIELDS})
    for option, name in (("u", u), ("y", y)):
        present = isinstance(name, str) and name in fields
        held = cut(", ".join(sorted(names))) or "nothing"  # names may be damaged too
        if not present and name in names:
            raise ValueError(f"{option}: no numbers under {name!r} in {path.name}, expected an array of them")
        require(present, option, name, f"an array of numbers in {path.name}, which holds {held}")
    for name in sorted({*_FIELDS}.intersection(names) - fields.keys()):
        raise ValueError(f"{name}: no numbers in {path.name}, expected numbers, or no such field")
    if sample_rate_hz is None:
        sample_rate_hz = _sample_rate(fields, path, np.shape(fields[u]))
    if samples_per_period is None and "samples_per_period" in fields:
        samples_per_period = whole(np.squeeze(fields["samples_per_period"]), "samples_per_period", 4)
    if excited_harmonics is None:
        excited_harmonics = fields.get("excited_harmonics")
    return make_recording(
        fields[u],
        fields[y],
        sample_rate_hz=sample_rate_hz,
        samples_per_period=samples_per_period,
        periods=periods,
        segments=segments,
        excited_harmonics=excited_harmonics,
        u_name=u,
        y_name=y,
    )


def _sample_rate(fields: Mapping[str, np.ndarray], path: Path, shape: tuple[int, ...]) -> float:
    """Of a channel of that shape; times may be those of all of it, or of its last axes."""
    rate_hz = None
    if "sample_rate_hz" in fields:
        rate_hz = number(np.squeeze(fields["sample_rate_hz"]), "sample_rate_hz")
    if "time_s" in fields:
        time_s = np.ravel(fields["time_s"])
        sizes = np.cumprod(shape[::-1], dtype=int).tolist() or [1]
        if time_s.size not in sizes:
            raise ValueError(f"time_s: {time_s.size} values, expected one for each of {sizes[-1]} samples")
        step = np.diff(time_s)
        alike = step.size > 0 and bool(np.all(np.abs(step - step.mean()) < 0.01 * step.mean()))
        if rate_hz is None and not alike:
            steps = f"steps of {step.min():.6g} to {step.max():.6g} s" if step.size else "one sample"
            raise ValueError(f"time_s: {steps}, expected steps that are alike within 1 %")
        if rate_hz is None:
            return float(1 / step.mean())
        if alike and abs(rate_hz * step.mean() - 1) > 0.01:
            raise ValueError(
                f"sample_rate_hz: {rate_hz:g} in {path.name}, where steps of time_s are {step.mean():.6g} s: "
                "expected the same rate of both, or the right one given"
            )
    if rate_hz is not None:
        return rate_hz
    raise ValueError(f"sample_rate_hz: missing in {path.name}, expected there or given")
