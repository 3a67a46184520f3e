# SPDX-License-Identifier: Apache-2.0
"""Multisines: which lines, how large, with random phases; for linear work with small peaks, and more power."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.fields import number, numbers, require, require_kind, whole
from tactile_resonance.poles.structure import PoleBand


class Grid(Enum):
    """Which harmonics of the band are excited.

    Notes
    -----
    Detection lines, the harmonics left out, show nonlinear distortion: see Pintelon & Schoukens,
    *System Identification: A Frequency Domain Approach*, 2nd ed. (2012), section 4.3.
    """

    CUSTOM = "custom"
    FULL = "full"
    ODD = "odd"
    ODD_RANDOM = "odd_random"


@dataclass(frozen=True)
class Excitation:
    """One realisation of a multisine, ``u(t) = sum_k a_k cos(2 pi f_k t + phi_k)``.

    Attributes
    ----------
    harmonics : (F,) int
        Excited lines as multiples of ``sample_rate_hz / samples_per_period``, ascending.
    amplitude_v : (F,) float
        Peak amplitude of each line [V].
    phase_rad : (F,) float
        Phase of each line [rad], cosine convention.
    sample_rate_hz : float
    samples_per_period : int
    periods : int
        How many periods of this realisation are played.
    realisation, realisations : int
        Index of this realisation, from 0, and how many the measurement has.
    grid : Grid
    seed : int
        Seed of the phases and of the random grid.
    random_phases : bool
        False where phases were compressed or given: such a signal is for linear work only, never for
        best-linear-approximation or distortion statistics.
    measurement_id, excitation_id : int
        What records refer to.
    label : str
        What is measured, for people.
    bands : tuple of PoleBand
        In which poles are wanted, the main one first; empty: nothing was said.
    """

    harmonics: IntArray
    amplitude_v: FloatArray
    phase_rad: FloatArray
    sample_rate_hz: float
    samples_per_period: int
    periods: int = 1
    realisation: int = 0
    realisations: int = 1
    grid: Grid = Grid.CUSTOM
    seed: int = 0
    random_phases: bool = True
    measurement_id: int = 0
    excitation_id: int = 0
    label: str = ""
    bands: tuple[PoleBand, ...] = ()

    def __post_init__(self) -> None:
        rate_hz = self.sample_rate_hz
        require(0 < rate_hz < np.inf, "sample_rate_hz", rate_hz, "a number above 0")
        for name, least in (("samples_per_period", 4), ("periods", 1), ("realisations", 1)):
            value = getattr(self, name)
            require(value >= least, name, value, f"{least} or above")
        given = self.harmonics.dtype
        require(given.kind == "i", "harmonics", f"values of type {given}", "signed integers")
        checked_harmonics(self.harmonics, self.samples_per_period)
        accepted = f"finite real numbers of shape {self.harmonics.shape}"
        for name in ("amplitude_v", "phase_rad"):
            array = getattr(self, name)
            good = array.dtype.kind == "f" and array.shape == self.harmonics.shape
            good = good and bool(np.all(np.isfinite(array)))
            require(good, name, f"{array.dtype} of shape {array.shape}", accepted)

    @property
    def frequency_hz(self) -> FloatArray:
        """(F,) excited lines [Hz]."""
        return np.asarray(self.harmonics * (self.sample_rate_hz / self.samples_per_period), float)

    @property
    def level_v(self) -> float:
        """Root mean square of the signal [V]."""
        return float(np.sqrt(np.sum(self.amplitude_v**2) / 2))

    @property
    def period_s(self) -> float:
        """Length of one period [s]."""
        return self.samples_per_period / self.sample_rate_hz

    def spectrum(self) -> ComplexArray:
        """(N // 2 + 1,) one-sided spectrum [V], ``X[k] = (1/N) sum_n u[n] exp(-j 2 pi k n / N)``."""
        spectrum = np.zeros(self.samples_per_period // 2 + 1, complex)
        spectrum[self.harmonics] = 0.5 * self.amplitude_v * np.exp(1j * self.phase_rad)
        return spectrum

    def period(self) -> FloatArray:
        """(N,) samples of one period [V]; energy on the excited lines only."""
        n = self.samples_per_period
        return np.fft.irfft(self.spectrum() * n, n)

    def crest_factor(self) -> float:
        """Peak over root mean square of the sampled period; NaN where nothing is played."""
        if self.level_v == 0:
            return float("nan")
        return float(np.max(np.abs(self.period())) / self.level_v)


def checked_harmonics(harmonics: npt.ArrayLike, samples_per_period: int) -> IntArray:
    """(F,) int harmonics, read-only; ValueError unless ascending within 1..(N - 1) // 2."""
    array = np.array(harmonics)
    good = array.ndim == 1 and array.size > 0 and array.dtype.kind in "iu"
    given = f"{array.dtype} of shape {array.shape}"
    require(good, "harmonics", given, "(F,) integers, F >= 1")
    array = array.astype(np.int64)
    last = (samples_per_period - 1) // 2
    good = array[0] >= 1 and array[-1] <= last and bool(np.all(np.diff(array) >= 1))
    require(good, "harmonics", f"{array[0]}..{array[-1]}", f"ascending, within 1..{last}")
    array.flags.writeable = False
    return array


def harmonics_on_grid(
    low: int, high: int, grid: Grid, *, seed: int = 0, block_lines: int = 4
) -> IntArray:
    """Harmonics from `low` to `high` (both included) that a grid excites.

    Parameters
    ----------
    low, high : int
        First and last harmonic of the band.
    grid : Grid
        ``ODD_RANDOM`` leaves out one of every `block_lines` consecutive odd harmonics; a last,
        incomplete block is excited whole.
    seed : int
        Decides which lines are left out. The same seed gives the same grid, whatever the phases.
    block_lines : int
        Odd lines per block, N_grid.

    Returns
    -------
    (F,) int

    Raises
    ------
    ValueError
        If the band is empty on this grid, or the grid has no rule.
    """
    require(grid is not Grid.CUSTOM, "grid", grid.value, "full, odd or odd_random, which have a rule")
    block_lines = whole(block_lines, "block_lines", 2)
    lines = np.arange(low, high + 1, dtype=np.int64)
    if grid is not Grid.FULL:
        lines = lines[lines % 2 == 1]
    if grid is Grid.ODD_RANDOM:
        blocks = lines.size // block_lines
        left_out = np.random.default_rng([seed, 0]).integers(block_lines, size=blocks)
        lines = np.delete(lines, np.arange(blocks) * block_lines + left_out)
    accepted = f"one that holds a line of the {grid.value} grid"
    require(lines.size > 0, "band", f"harmonics {low}..{high}", accepted)
    return lines


def mains_lines(
    frequency_hz: FloatArray, spacing_hz: float, mains_hz: Sequence[float], lines_beside: int = 1
) -> BoolArray:
    """(F,) which lines are the nearest to a harmonic of the mains, or one of those beside it.

    Parameters
    ----------
    frequency_hz : (F,) float
        Multiples of `spacing_hz`.
    spacing_hz : float
    mains_hz : sequence of float
    lines_beside : int
        On either side of the nearest one.

    Raises
    ------
    ValueError
        If a frequency has harmonics so near each other that no line would be left between them.
    """
    lines_beside = whole(lines_beside, "lines_beside")
    width_hz = (2 * lines_beside + 1) * spacing_hz
    found = np.zeros(np.shape(frequency_hz), bool)
    for mains in mains_hz:
        taken = f"above {width_hz:g} Hz, what {2 * lines_beside + 1} lines of {spacing_hz:g} Hz take up"
        require(width_hz < mains < np.inf, "mains_hz", mains, taken)
        harmonic = np.maximum(np.round(frequency_hz / mains), 1)
        found |= np.abs(frequency_hz - harmonic * mains) < width_hz / 2
    return found


def design_multisine(
    *,
    sample_rate_hz: float = 50e3,
    samples_per_period: int = 20000,
    band_hz: tuple[float, float] | Sequence[tuple[float, float]] = (10.0, 10e3),
    level_v: float = 1.0,
    scale_by: str = "rms",
    grid: Grid = Grid.FULL,
    block_lines: int = 4,
    mains_hz: Sequence[float] = (),
    lines_beside: int = 1,
    relative_amplitude: npt.ArrayLike | None = None,
    sweep: bool = False,
    seed: int = 0,
    realisation: int = 0,
    realisations: int = 1,
    periods: int = 1,
    measurement_id: int = 0,
    excitation_id: int = 0,
    label: str = "",
    bands: tuple[PoleBand, ...] = (),
) -> Excitation:
    """Random-phase multisine over a band.

    Phases are independent and uniform on [0, 2 pi), a new draw for every `realisation` of the same
    `seed`; the grid depends on the seed alone, so that realisations excite the same lines.

    Parameters
    ----------
    sample_rate_hz, samples_per_period
        The lines are multiples of their ratio. Defaults give 2.5 Hz (arXiv 1805.00682).
    band_hz : (low, high) or several of them
        Lines in this band, ends included, are excited; several are ascending and share no line.
    level_v : float
        Root mean square of the whole signal, or its peak [V].
    scale_by : {"rms", "peak"}
    grid, block_lines
        See `harmonics_on_grid`.
    mains_hz : sequence of float
        The lines of the grid at harmonics of these, and `lines_beside` on either side, are not excited
        (`mains_lines`): hum is then seen between the lines, and bends no response. None by default,
        for near a pole such lines hold most information (docs/poles.md).
    lines_beside : int
    relative_amplitude : (F,) array, optional
        Shape of the amplitude over the excited lines; flat when absent.
    sweep : bool
        Phases of a rising sweep over each period in place of random ones: of one realisation.
    seed, realisation, realisations, periods, measurement_id, excitation_id, label, bands
        See `Excitation`.

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted.

    References
    ----------
    Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
    section 2.6.2 (random-phase multisine).

    Examples
    --------
    Every line of 2.5 Hz from 200 to 300 Hz, 0.5 V rms:

    >>> multisine = tr.design_multisine(
    ...     sample_rate_hz=5e3, samples_per_period=2000, band_hz=(200.0, 300.0), level_v=0.5, seed=1
    ... )
    >>> multisine.frequency_hz[:3].tolist(), multisine.harmonics.size
    ([200.0, 202.5, 205.0], 41)
    >>> u = multisine.period()  # samples of one period [V]
    >>> print(u.shape, f"{u.std():.3f} V rms")
    (2000,) 0.500 V rms
    """
    rate_hz = number(sample_rate_hz, "sample_rate_hz")
    samples = whole(samples_per_period, "samples_per_period", 4)
    require(rate_hz > 0, "sample_rate_hz", rate_hz, "a number above 0")
    resolution_hz = rate_hz / samples
    stretches_hz = _stretches(band_hz, rate_hz / 2)
    require(number(level_v, "level_v") > 0, "level_v", level_v, "a voltage above 0")
    seed, realisation = whole(seed, "seed"), whole(realisation, "realisation")
    choices = ", ".join(f"{kind.name} ({kind.value!r})" for kind in Grid if kind is not Grid.CUSTOM)
    require(grid in [*Grid, *(kind.value for kind in Grid)], "grid", grid, f"Grid of {choices}")
    grid = Grid(grid)
    require(scale_by in ("rms", "peak"), "scale_by", scale_by, "'rms' or 'peak'")
    # 1e-9: a band edge that is a line stays in the band whatever the rounding of the division
    ends = np.array(stretches_hz) / resolution_hz + [-1e-9, 1e-9]
    harmonics = np.concatenate(
        [
            harmonics_on_grid(
                int(np.ceil(low)), int(np.floor(high)), grid, seed=seed, block_lines=block_lines
            )
            for low, high in ends
        ]
    )
    apart = bool(np.all(np.diff(harmonics) > 0))
    require(apart, "band_hz", band_hz, "bands that are ascending and share no line")
    frequency_hz = np.asarray(harmonics * resolution_hz, float)
    hum = mains_lines(frequency_hz, resolution_hz, numbers(mains_hz, "mains_hz"), lines_beside)
    accepted = f"what leaves a line of {frequency_hz[0]:g}..{frequency_hz[-1]:g} Hz"
    require(not hum.all(), "mains_hz", list(mains_hz), accepted)
    harmonics = harmonics[~hum]
    shape = np.ones(harmonics.size)
    if relative_amplitude is not None:
        try:
            shape = np.asarray(relative_amplitude, float)
        except (TypeError, ValueError):
            shape = np.empty(0)
        good = shape.shape == harmonics.shape and bool(np.all((shape > 0) & (shape < np.inf)))
        accepted = f"numbers above 0 of shape {harmonics.shape}"
        require(good, "relative_amplitude", f"values of shape {shape.shape}", accepted)
        shape = shape / shape.max()  # squares of what is very large or small would not be finite, or 0
    require_kind(sweep, "sweep", bool)
    require_kind(label, "label", str)
    require_kind(bands, "bands", tuple)
    for each in bands:
        require_kind(each, "bands", PoleBand)
    realisations = whole(realisations, "realisations", 1)
    accepted = "1 with sweep: its phases are the same in each"
    require(realisations == 1 or not sweep, "realisations", realisations, accepted)
    phase = np.random.default_rng([seed, 1, realisation]).uniform(0, 2 * np.pi, harmonics.size)
    if sweep:
        phase = _sweep_phases(harmonics, shape)
    unscaled = Excitation(
        harmonics=harmonics,
        amplitude_v=shape,
        phase_rad=phase,
        sample_rate_hz=rate_hz,
        samples_per_period=samples,
        periods=whole(periods, "periods", 1),
        realisation=realisation,
        realisations=realisations,
        grid=grid,
        seed=seed,
        random_phases=not sweep,
        measurement_id=whole(measurement_id, "measurement_id"),
        excitation_id=whole(excitation_id, "excitation_id"),
        label=label,
        bands=bands,
    )
    present_v = unscaled.level_v if scale_by == "rms" else float(np.max(np.abs(unscaled.period())))
    return replace(unscaled, amplitude_v=shape * (level_v / present_v))


def _sweep_phases(harmonics: IntArray, amplitude: FloatArray) -> FloatArray:
    """(F,) phases [rad] with which lines sound one after the other over a period, from low to high.

    Each has the time that its part of the power takes (Schroeder, IEEE Trans. Inf. Theory 16 (1970) 85-89).
    """
    power = amplitude**2 / np.sum(amplitude**2)
    delay = np.cumsum(power) - power / 2  # of each line, in periods: minus the slope of its phase
    cycles = np.cumsum(delay * np.diff(harmonics, prepend=harmonics[0]))
    return np.asarray(-2 * np.pi * cycles % (2 * np.pi))


# Clip level over the passes, relative to the present peak: gentle clipping late keeps what was won.
FIRST_CLIP, LAST_CLIP = 0.75, 0.99


def compress_crest_factor(excitation: Excitation, *, passes: int = 300) -> Excitation:
    """The same lines and amplitudes with phases that make the peaks small.

    Parameters
    ----------
    excitation : Excitation
        A single realisation.
    passes : int
        Clipping passes; each costs two FFTs of a period.

    Returns
    -------
    Excitation
        With ``random_phases`` False and the smallest crest factor of all passes.

    Raises
    ------
    ValueError
        If the excitation is one of several realisations: phases are then no longer random, and the
        scatter over realisations says nothing of nonlinear distortion.

    Notes
    -----
    Signal and spectrum are made to fit in turn: the signal is clipped, its spectrum keeps the new phases
    and takes back the amplitudes wanted (Van der Ouderaa, Schoukens, Renneboog, IEEE Trans. Instrum.
    Meas. 37 (1988) 145-147).
    """
    several = excitation.realisations
    accepted = "1: compressed phases are not random, so several would not show nonlinear distortion"
    require(several == 1, "realisations", several, accepted)
    passes = whole(passes, "passes", 1)
    n = excitation.samples_per_period
    lines, amplitude = excitation.harmonics, excitation.amplitude_v
    spectrum = np.zeros(n // 2 + 1, complex)
    phasor = np.exp(1j * excitation.phase_rad)
    best, smallest = phasor, np.inf
    for clip in np.linspace(FIRST_CLIP, LAST_CLIP, passes):
        spectrum[lines] = 0.5 * amplitude * phasor
        signal = np.fft.irfft(spectrum, n, norm="forward")
        peak = float(np.max(np.abs(signal)))
        if peak < smallest:
            best, smallest = phasor, peak
        np.clip(signal, -clip * peak, clip * peak, out=signal)
        clipped = np.fft.rfft(signal)[lines]
        size = np.abs(clipped)
        # a line that clipping removed keeps the phase it had
        phasor = np.where(size > 0, clipped / np.where(size > 0, size, 1.0), phasor)
    return replace(excitation, phase_rad=np.angle(best), random_phases=False)


def _stretches(band_hz: Any, most_hz: float) -> list[tuple[float, float]]:
    """Ends of each band."""
    try:
        pairs = [band_hz] if np.ndim(band_hz) == 1 else band_hz
        ends = [(number(low, "band_hz"), number(high, "band_hz")) for low, high in pairs]
    except (TypeError, ValueError):
        ends = []
    good = bool(ends) and all(0 < low <= high < most_hz for low, high in ends)
    accepted = f"(low, high) in Hz with 0 < low <= high < {most_hz:g}, or several of them"
    require(good, "band_hz", band_hz, accepted)
    return ends
