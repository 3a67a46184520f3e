# SPDX-License-Identifier: Apache-2.0
"""From the goal of a measurement and the node's parameters to the excitations asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from rclpy.node import Node

from tactile_resonance.action import Measure
from tactile_resonance.drivers.acquisition import DeviceInfo
from tactile_resonance.multisine import Excitation, Grid, compress_crest_factor, design_multisine
from tactile_resonance.nodes.parameters import Fixed, Parameter
from tactile_resonance.poles.structure import PoleBand
from tactile_resonance.recording.messages import GRIDS, each_from_message, key_of
from tactile_resonance.sensor import MAX_LEVEL_V

ASKED = ("sample_rate_hz", "samples_per_period", "level_v", "periods", "realisations")
"""Parameters that a goal may state too, by the names that `design_multisine` has for them."""
NO_RECORDS = "record_folder: "
"""A measurement whose message begins so failed because records cannot be written."""
MOST_REALISATIONS = 1000  # each is designed, with all its lines, before the first is played

PARAMETERS = (
    Parameter("sample_rate_hz", 50e3, "Sample rate of both channels [Hz].", 1.0, 1e7),
    Parameter("samples_per_period", 20000, "Samples of one period.", 4, 10**8),
    Parameter("f_min_hz", 10.0, "Lowest excited line [Hz].", 1e-3, 1e7),
    Parameter("f_max_hz", 10e3, "Highest excited line [Hz].", 1e-3, 1e7),
    Parameter("level_v", 1.0, "Root mean square of the drive [V].", 1e-6, 1e3),
    Fixed(
        "max_level_v",
        MAX_LEVEL_V,
        "The sensor's limit: a level above is refused [V rms].",
        1e-6,
        1e3,
    ),
    Parameter(
        "grid",
        "full",
        "Which harmonics are excited.",
        choices=tuple(grid.value for grid in GRIDS if grid is not Grid.CUSTOM),
    ),
    Parameter(
        "mains_hz",
        0.0,
        "Lines at the harmonics of this mains frequency are not excited; 0 excites all [Hz].",
        0.0,
        1e3,
    ),
    Parameter(
        "mains_lines_beside", 1, "So many lines on either side of them are not excited too.", 0, 100
    ),
    Parameter("periods", 8, "Periods of each realisation.", 1, 10**6),
    Parameter(
        "realisations", 1, "Realisations of the phases in each measurement.", 1, MOST_REALISATIONS
    ),
    Parameter(
        "seed",
        1,
        "Seed of the phases of the first measurement; each further one takes the next.",
        1,
        2**62,
    ),
    Parameter(
        "compression_passes",
        0,
        "Passes that make the peaks small; 0 leaves the phases random. For linear work only.",
        0,
        10**5,
    ),
)


def design(node: Node, goal: Measure.Goal, measurements: int) -> list[Excitation]:
    """All realisations of a goal; zero in the goal means the node's parameter.

    The measurement id is the goal's, so 0 where it names none; excitation ids are 0.

    Parameters
    ----------
    node : Node
        Has declared `PARAMETERS`.
    goal : Measure.Goal
    measurements : int
        How many came before: the seed moves on.

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted.
    """
    given = {each.name: node.get_parameter(each.name).value for each in PARAMETERS}
    asked = {name: getattr(goal, name) or given[name] for name in ASKED}
    if goal.silent and goal.level_v:
        raise ValueError(f"level_v: {goal.level_v:g}, a silent measurement plays nothing: 0")
    counts = len(goal.excited_low_hz), len(goal.excited_high_hz)
    if counts[0] != counts[1]:
        raise ValueError(
            f"excited_low_hz, excited_high_hz: {counts} values, as many of each are accepted"
        )
    stretches_hz = list(zip(goal.excited_low_hz, goal.excited_high_hz, strict=True))
    if stretches_hz and (goal.f_min_hz or goal.f_max_hz):
        raise ValueError(
            f"f_min_hz, f_max_hz: {goal.f_min_hz:g}, {goal.f_max_hz:g}, 0 are accepted beside excited_low_hz"
        )
    level, max_level = asked["level_v"], given["max_level_v"]
    if not level <= max_level:
        raise ValueError(f"level_v: {level:g}, the sensor bears at most {max_level:g} V rms")
    grid = key_of(GRIDS, goal.grid, "grid") if goal.grid else Grid(given["grid"])
    realisations = asked["realisations"]
    if realisations > MOST_REALISATIONS:
        raise ValueError(f"realisations: {realisations}, accepted is up to {MOST_REALISATIONS}")
    ends_hz = goal.f_min_hz or given["f_min_hz"], goal.f_max_hz or given["f_max_hz"]
    excitations = [
        design_multisine(
            **asked,
            band_hz=stretches_hz or ends_hz,
            grid=grid,
            mains_hz=(given["mains_hz"],) if given["mains_hz"] else (),
            lines_beside=given["mains_lines_beside"],
            sweep=goal.sweep,
            seed=goal.seed or given["seed"] + measurements,
            realisation=realisation,
            measurement_id=goal.measurement_id,
            label=goal.label,
            bands=each_from_message(PoleBand, goal.bands),
        )
        for realisation in range(realisations)
    ]
    if goal.silent:
        return [replace(each, amplitude_v=np.zeros(each.harmonics.size)) for each in excitations]
    if (passes := given["compression_passes"]) and not goal.sweep:
        return [compress_crest_factor(each, passes=passes) for each in excitations]
    return excitations


def check_output(excitations: Sequence[Excitation], info: DeviceInfo) -> None:
    """ValueError if a peak is more than the device can put out."""
    for excitation in excitations:
        peak_v = float(np.max(np.abs(excitation.period())))
        if peak_v > info.output_peak_v:
            raise ValueError(
                f"level_v: peak {peak_v:.3g} V, {info.name} puts out at most "
                f"{info.output_peak_v:.3g} V"
            )
