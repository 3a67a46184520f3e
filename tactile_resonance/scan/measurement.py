# SPDX-License-Identifier: Apache-2.0
"""The measurement that a scene needs at each point, and what it leaves out."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tactile_resonance.multisine import Grid
from tactile_resonance.scan.scene import Output, ScanScene

# Beside the band of the fit: the local polynomial method looks at neighbours, the fit does not.
MARGIN_LINES = 8
DISTORTION_REALISATIONS = 2


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
class SensorRange:
    """What the acquisition offers: lines from f_min to f_max, a whole number of them per hertz spacing.

    Attributes
    ----------
    f_min_hz, f_max_hz : float
        Lowest and highest line.
    sample_rate_hz : float
    samples_per_period : int
    """

    f_min_hz: float = 10.0
    f_max_hz: float = 10_000.0
    sample_rate_hz: float = 50_000.0
    samples_per_period: int = 20_000

    @property
    def spacing_hz(self) -> float:
        """Between lines [Hz]."""
        return self.sample_rate_hz / self.samples_per_period

    @property
    def period_s(self) -> float:
        """One block [s]."""
        return self.samples_per_period / self.sample_rate_hz

    def lines(self, low_hz: float, high_hz: float) -> int:
        """How many lines lie from `low_hz` to `high_hz`."""
        return (
            math.floor(high_hz / self.spacing_hz + 1e-9)
            - math.ceil(low_hz / self.spacing_hz - 1e-9)
            + 1
        )


@dataclass(frozen=True)
class MeasurementDesign:
    """One measurement, as the action `measure` takes it.

    Attributes
    ----------
    grid : Grid
    f_min_hz, f_max_hz : float
        Excited lines.
    level_v : float
        Root mean square of what is played [V]: the amplitude per line is that of the whole range at the
        scene's level.
    periods : int
        Most blocks.
    realisations : int
        Each of as many periods.
    lines : int
        Excited.
    samples : int
        Of each channel in a block.
    block_s : float
        Duration of a block [s].
    skipped : tuple of Skipped
    silent : bool
        Nothing is played.
    """

    grid: Grid
    f_min_hz: float
    f_max_hz: float
    level_v: float
    periods: int
    realisations: int
    lines: int
    samples: int
    block_s: float
    skipped: tuple[Skipped, ...]
    silent: bool = False


def design_measurement(scene: ScanScene, offered: SensorRange | None = None) -> MeasurementDesign:
    """What to play at each point of a scene.

    Raises
    ------
    ValueError
        If the scene's band does not lie within what the acquisition offers.
    """
    offered = SensorRange() if offered is None else offered
    band = scene.sensor.band_low_hz, scene.sensor.band_high_hz
    if not offered.f_min_hz <= band[0] < band[1] <= offered.f_max_hz:
        raise ValueError(
            f"sensor.band: got {band[0]:g} to {band[1]:g} Hz; accepted is within "
            f"{offered.f_min_hz:g} to {offered.f_max_hz:g} Hz"
        )
    skipped = []
    f_min_hz, f_max_hz = offered.f_min_hz, offered.f_max_hz
    if not {Output.FRF, Output.DISTORTION} & set(scene.outputs):
        margin_hz = MARGIN_LINES * offered.spacing_hz
        f_min_hz, f_max_hz = max(f_min_hz, band[0] - margin_hz), min(f_max_hz, band[1] + margin_hz)
    lines = offered.lines(f_min_hz, f_max_hz)
    whole = offered.lines(offered.f_min_hz, offered.f_max_hz)
    if lines < whole:
        text = f"{whole - lines} of {whole} lines, neither excited nor computed"
        skipped.append(Skipped(text, f"only poles from {band[0]:g} to {band[1]:g} Hz are wanted"))
    distortion = Output.DISTORTION in scene.outputs
    realisations = DISTORTION_REALISATIONS if distortion else 1
    if not distortion:
        # a second realisation of random phases distinguishes distortion from noise
        saved = (DISTORTION_REALISATIONS - 1) * scene.blocks.most * offered.period_s
        why = "distortion is not wanted"
        skipped.append(Skipped("a second realisation at every point", why, saved))
    if Output.RELAXATION not in scene.outputs:
        skipped.append(Skipped("relaxation after contact", "relaxation is not wanted"))
    if Output.SILENT not in scene.outputs:
        saved = scene.blocks.least * offered.period_s
        skipped.append(Skipped("a silent record", "silent is not wanted", saved))
    if Output.MAP not in scene.outputs:
        skipped.append(Skipped("the map", "no map is wanted"))
    return MeasurementDesign(
        grid=Grid.ODD_RANDOM if distortion else Grid.FULL,
        f_min_hz=f_min_hz,
        f_max_hz=f_max_hz,
        level_v=scene.sensor.level_v * math.sqrt(lines / whole),
        periods=scene.blocks.most,
        realisations=realisations,
        lines=lines,
        samples=offered.samples_per_period,
        block_s=offered.period_s,
        skipped=tuple(skipped),
    )
