# SPDX-License-Identifier: Apache-2.0
"""The measurement that a scene needs at each point: its period, and what it leaves out.

Where a scene leaves the period to the plan (``samples_per_period: auto``), it is the shortest of which one
block, from rest, gives a pole with a covariance to be relied on, and away from the mains. Each band holds as
many lines as response and transient have coefficients for, and `FREE_LINES`; its residual terms follow the
modes beside it (`scene.residual_terms_of`). So the wider a band, the shorter the period.

The lines sound one after the other, from low to high, for a mode that is excited early rings within the
record: at 59 ms its f0 is more than twice as precise as with random phases. One or two blocks cannot
distinguish hum from response. From the third block on it shows in bins between the lines, so that the period
is up to `LONGER` times as long where this keeps the harmonics of the mains `LEAST_DISTANCE` from the lines.

``tools/run.sh python -m benchmarks.skip_decision`` prints precision and coverage of one block on all tissues
of the simulated bench, and what blocks of that period decide.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.force_spread import SHORTEST_S
from tactile_resonance.fields import require
from tactile_resonance.multisine import Excitation, Grid, design_multisine
from tactile_resonance.poles.structure import ModelStructure, PoleBand
from tactile_resonance.scan.decision import BlockLimits, Separate
from tactile_resonance.scan.scene import Output, ScanScene
from tactile_resonance.tones import MAINS_HZ

# Beside the band of the fit: the local polynomial method looks at neighbours, the fit does not.
MARGIN_LINES = 8
F_MIN_HZ, F_MAX_HZ = 10.0, 10_000.0
"""The sensor's whole range, to which the level of a scene refers."""
MOST_OF_RATE = 0.4
"""Of the sample rate: up to here anti-alias filters pass lines."""
ODD_RANDOM_SHARE = 3 / 8
"""Of all lines: odd ones, three of four."""
MOST_S = 3.2
"""Of vibration at a point, where the plan chooses period and blocks: eight periods of 0.4 s."""
CALIBRATED_S, CALIBRATED_MOST_S = 0.02, 0.8
"""Of a block, and of all at a point, through a calibrated sensor: `benchmark calibrate`."""
FEWEST_CALIBRATED = 5
"""Lines of a block: four parameters of a contact, three of them with priors."""
REFERENCE_S = 0.8
"""Of vibration in a reference, at least: two periods of 0.4 s (arXiv 1805.00682)."""
FREE_LINES = 12
"""Excited lines of a band beyond those that its coefficients take up: the level of the noise is from them."""
LEAST_DISTANCE = 0.15
"""Of a harmonic of the mains from an excited line, in spacings of the lines."""
LONGER = 1.15
"""A period may be this much longer than the shortest to keep that distance."""
LONGEST_S = 20.0
"""Of a period: the time of a point is a minute."""


@dataclass(frozen=True)
class Skipped:
    """Something that was left out because nothing needs it.

    Attributes
    ----------
    what, why : str
        For people.
    saved_s : float
        Measuring time saved [s]; 0 where it saves computing or disk only.
    """

    what: str
    why: str
    saved_s: float = 0.0


@dataclass(frozen=True)
class MeasurementDesign:
    """One measurement, as the action `measure` takes it and every node behind it follows it.

    Attributes
    ----------
    bands : tuple of PoleBand
        In which poles are identified, the main one first.
    stretches_hz : tuple of (float, float)
        Lines from the one to the other are excited, ascending and apart from each other.
    grid : Grid
    level_v : float
        Root mean square of what is played [V]: the amplitude per line is that of the whole range at the
        scene's level.
    sample_rate_hz : float
    samples : int
        Of each channel in a block, one period.
    blocks : BlockLimits
        Fewest and most at a point.
    periods : int
        Most blocks of this measurement.
    lines : int
        Excited where the grid leaves none out.
    skipped : tuple of Skipped
    sweep : bool
        Over each period, in place of random phases.
    silent : bool
        Nothing is played.
    air : MeasurementDesign or None
        What a reference in air is of, where it is something else: a pole there is fitted without a calibration.
    """

    bands: tuple[PoleBand, ...]
    stretches_hz: tuple[tuple[float, float], ...]
    grid: Grid
    level_v: float
    sample_rate_hz: float
    samples: int
    blocks: BlockLimits
    periods: int
    lines: int
    skipped: tuple[Skipped, ...] = ()
    sweep: bool = False
    silent: bool = False
    air: MeasurementDesign | None = None

    @property
    def block_s(self) -> float:
        """Duration of a block [s]."""
        return self.samples / self.sample_rate_hz

    @property
    def of_reference(self) -> MeasurementDesign:
        """The same, or that for air, with as many blocks as a reference has."""
        if self.air is not None:
            return self.air.of_reference
        fewest = math.ceil(REFERENCE_S / self.block_s - 1e-9)
        return replace(self, periods=max(self.blocks.least, fewest))


def design_measurement(scene: ScanScene) -> MeasurementDesign:
    """What to play at each point of a scene.

    Raises
    ------
    ValueError
        If a band does not lie within what can be excited, or holds too few lines for its model, or the scene
        wants what the short blocks of a calibrated sensor do not hold.
    """
    use, outputs = scene.sensor, set(scene.outputs)
    top_hz = min(F_MAX_HZ, MOST_OF_RATE * use.sample_rate_hz)
    for band in use.bands:
        within = band.low_hz >= F_MIN_HZ and band.high_hz <= top_hz
        require(within, "sensor: band [Hz]", band.ends_hz, f"within {F_MIN_HZ:g} to {top_hz:g}")
    air = _design_in_air(scene) if use.calibrated else None
    whole_hz = ((F_MIN_HZ, top_hz),)
    # even distortion of a band falls outside of it: what is to show there must be excited there
    distortion = Output.DISTORTION in outputs
    share = ODD_RANDOM_SHARE if distortion else 1.0
    samples, margin = use.samples_per_period, MARGIN_LINES
    # a gate judges how the force of a block moved
    least_s = 0.0 if scene.gate is None else SHORTEST_S
    if use.calibrated:
        samples, margin = samples or math.ceil(CALIBRATED_S * use.sample_rate_hz), 0
    elif samples is None:
        samples, margin = shortest_samples(use.bands, use.sample_rate_hz, share, least_s), 0
    spacing_hz, block_s = use.sample_rate_hz / samples, samples / use.sample_rate_hz
    accepted = f"{least_s * use.sample_rate_hz:g} or more with a gate, which must know how the force moved"
    require(block_s >= least_s, "sensor.samples_per_period", samples, accepted)
    blocks = scene.blocks or _default_blocks(scene, block_s)
    narrow = not distortion and Output.FRF not in outputs
    stretches_hz = _stretches(use.bands, margin * spacing_hz, top_hz) if narrow else whole_hz
    lines = sum(lines_of(ends_hz, spacing_hz) for ends_hz in stretches_hz)
    for band in use.bands:
        fewest = ModelStructure.with_residual(band.order or 2, band.residual_terms).fewest_lines
        if use.calibrated:
            fewest = FEWEST_CALIBRATED - 1
        found = lines_of(band.ends_hz, spacing_hz, share)
        where = f"sensor: excited lines from {band.low_hz:g} to {band.high_hz:g} Hz"
        accepted = f"more than {fewest} (they are {spacing_hz:g} Hz apart)"
        require(found > fewest, where, found, accepted)
    design = MeasurementDesign(
        bands=use.bands if air is None else air.bands,
        stretches_hz=stretches_hz,
        grid=Grid.ODD_RANDOM if distortion else Grid.FULL,
        # each line at the amplitude that it has where the sensor's whole range is excited
        level_v=use.level_v * math.sqrt(lines / lines_of((F_MIN_HZ, F_MAX_HZ), spacing_hz)),
        sample_rate_hz=use.sample_rate_hz,
        samples=samples,
        blocks=blocks,
        periods=blocks.most,
        lines=lines,
        sweep=use.calibrated or (use.samples_per_period is None and not distortion),
        air=air,
    )
    skipped = []
    if narrow:
        of_whole = lines_of((F_MIN_HZ, top_hz), spacing_hz)
        named = " and ".join(f"{band.low_hz:g} to {band.high_hz:g} Hz" for band in use.bands)
        text = f"{of_whole - lines} of {of_whole} lines, neither excited nor computed"
        skipped.append(Skipped(text, f"only poles from {named} are wanted"))
    if not distortion:
        skipped.append(Skipped("even and odd distortion", "distortion is not wanted"))
    if Output.SILENT not in outputs:
        silent = design.of_reference
        silent_s = silent.periods * silent.block_s
        skipped.append(Skipped("a silent record", "silent is not wanted", silent_s))
    if Output.MAP not in outputs:
        skipped.append(Skipped("pole_map.png and map.mcap", "no map is wanted"))
    return replace(design, skipped=tuple(skipped))


def _design_in_air(scene: ScanScene) -> MeasurementDesign:
    """Of a calibrated sensor, as without a calibration; ValueError where its blocks hold too little."""
    use = scene.sensor
    wanted = [output.value for output in scene.outputs if output in (Output.DISTORTION, Output.FRF)]
    accepted = "none of distortion, frf with sensor.calibrated: only lines of the band are excited"
    require(not wanted, "outputs", wanted, accepted)
    further = [list(band.ends_hz) for band in use.further_bands]
    accepted = "none with sensor.calibrated: its transient is known of one band alone"
    require(not further, "sensor.further_bands", further, accepted)
    accepted = "none with sensor.calibrated, whose blocks are too short for it"
    require(scene.gate is None, "gate", scene.gate, accepted)
    plain = replace(use, calibrated=False, samples_per_period=None)
    return design_measurement(replace(scene, sensor=plain, blocks=None))


def excitation_of(design: MeasurementDesign, seed: int) -> Excitation:
    """What excitation_node plays for a design, where its parameters leave no line out."""
    return design_multisine(
        sample_rate_hz=design.sample_rate_hz,
        samples_per_period=design.samples,
        band_hz=design.stretches_hz,
        level_v=design.level_v,
        grid=design.grid,
        sweep=design.sweep,
        seed=seed,
        periods=design.periods,
        bands=design.bands,
    )


def _stretches(
    bands: Sequence[PoleBand], margin_hz: float, top_hz: float
) -> tuple[tuple[float, float], ...]:
    """Bands with a margin on either side; those that touch become one."""
    found: list[tuple[float, float]] = []
    for low_hz, high_hz in sorted(band.ends_hz for band in bands):
        low_hz, high_hz = max(F_MIN_HZ, low_hz - margin_hz), min(top_hz, high_hz + margin_hz)
        if found and low_hz <= found[-1][1]:
            low_hz = found.pop()[0]
        found.append((low_hz, high_hz))
    return tuple(found)


def _default_blocks(scene: ScanScene, block_s: float) -> BlockLimits:
    """Of a scene that says nothing; where the plan chooses the period, as many as take as long."""
    usual = BlockLimits()
    # of two classes one block may tell; a precision is estimated too well by chance from the first
    least = 1 if isinstance(scene.precision, Separate) else usual.least
    if scene.sensor.calibrated:
        return BlockLimits(least, max(least, math.ceil(CALIBRATED_MOST_S / block_s)))
    if scene.sensor.samples_per_period is not None:
        return usual
    return BlockLimits(least, max(usual.most, math.ceil(MOST_S / block_s - 1e-9)))


def lines_of(ends_hz: tuple[float, float], spacing_hz: float, share: float = 1.0) -> int:
    """How many lines from the one end to the other are excited, of which this share is."""
    low, high = (hz / spacing_hz for hz in ends_hz)
    return int(share * (math.floor(high + 1e-9) - math.ceil(low - 1e-9) + 1))


def lines_wanted(band: PoleBand) -> int:
    """Lines of a band from which one period alone gives poles with a covariance to be relied on.

    Those that the coefficients of response and transient take up, and `FREE_LINES`, from which the level of the
    noise is estimated.
    """
    structure = ModelStructure.with_residual(band.order or 2, band.residual_terms)
    coefficients = structure.parameters + structure.transient_terms
    return math.ceil(coefficients / 2) + FREE_LINES


def shortest_samples(
    bands: Sequence[PoleBand], sample_rate_hz: float, share: float = 1.0, least_s: float = 0.0
) -> int:
    """Samples of the shortest period with enough lines in each band, and away from the mains where that can be.

    Parameters
    ----------
    bands : sequence of PoleBand
    sample_rate_hz : float
    share : float
        Of the lines that are excited.
    least_s : float
        Of the period.

    Raises
    ------
    ValueError
        If a band is so narrow that the period would be longer than `LONGEST_S`.
    """
    for band in bands:
        width_hz = band.high_hz - band.low_hz
        least_hz = lines_wanted(band) / share / LONGEST_S
        accepted = f"{least_hz:.2g} Hz wide or more with samples_per_period auto, {LONGEST_S:g} s at most"
        require(width_hz >= least_hz, "sensor: band [Hz]", band.ends_hz, accepted)
    fewest = max(
        int((lines_wanted(band) / share - 1) * sample_rate_hz / (band.high_hz - band.low_hz))
        for band in bands
    )
    fewest = max(fewest, math.ceil(least_s * sample_rate_hz))
    while not _enough(bands, sample_rate_hz / fewest, share):
        fewest += 1
    tried = [
        samples
        for samples in range(fewest, int(LONGER * fewest) + 1)
        if _enough(bands, sample_rate_hz / samples, share)
    ]
    distances = mains_distances(mains_in(bands), sample_rate_hz / np.array(tried))
    far = np.flatnonzero(distances >= LEAST_DISTANCE)
    return tried[int(far[0] if far.size else np.argmax(distances))]


def _enough(bands: Sequence[PoleBand], spacing_hz: float, share: float) -> bool:
    """Whether each band holds as many lines as it needs."""
    return all(lines_of(band.ends_hz, spacing_hz, share) >= lines_wanted(band) for band in bands)


def mains_sentence(design: MeasurementDesign) -> str:
    """Which harmonics of the mains cannot be distinguished from the response at excited lines."""
    hum_hz = mains_in(design.bands)
    spacing_hz = design.sample_rate_hz / design.samples
    near = [hz for hz in hum_hz if mains_distances(np.array([hz]), spacing_hz) < LEAST_DISTANCE]
    distance = f"{LEAST_DISTANCE:g} of the spacing of lines"
    if not near:
        return f"harmonics of 50 and 60 Hz in the bands are {distance} or more from the next line"
    names = ", ".join(f"{hz:g}" for hz in near)
    return f"hum at {names} Hz would count as response: it is within {distance} from the next line"


def mains_distances(hum_hz: FloatArray, spacing_hz: npt.ArrayLike) -> FloatArray:
    """(...) how near one of these frequencies (h,) comes to a multiple of each spacing (...) [Hz].

    In units of the spacing: 0 is on a line, 0.5 in the middle between two, and where there are no frequencies.
    """
    at = hum_hz / np.asarray(spacing_hz, float)[..., None]
    return np.asarray(np.abs(at - np.round(at)).min(axis=-1, initial=0.5))


def mains_in(bands: Sequence[PoleBand]) -> FloatArray:
    """Harmonics of the mains within bands, ascending [Hz]."""
    top_hz = max(band.high_hz for band in bands)
    hum_hz = np.unique(np.concatenate([np.arange(hz, top_hz + 1, hz) for hz in MAINS_HZ]))
    inside = [(hum_hz >= band.low_hz) & (hum_hz <= band.high_hz) for band in bands]
    return np.asarray(hum_hz[np.any(inside, axis=0)])
