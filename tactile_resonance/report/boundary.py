# SPDX-License-Identifier: Apache-2.0
"""The boundary that an adaptive scan was to find: in words, as JSON, beside its truth where that is known."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from tactile_resonance.fields import counted
from tactile_resonance.report.run_report import scene_of
from tactile_resonance.scan.adaptive import Adaptive, known_points
from tactile_resonance.scan.level_set import Boundary, Lines, difference_m2
from tactile_resonance.scan.run_content import RunContent
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.sensor.experiments import truth_over
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.simulation.tissue.scene import PhantomScene, read_scene

FILE = "boundary.json"
_TRUTH_CELLS = 16  # along the longer side; between them the truth is interpolated


@dataclass(frozen=True, eq=False)
class RunBoundary:
    """The boundary of a run.

    Attributes
    ----------
    boundary : Boundary
    wanted_m2 : float
        Expected area on its wrong side that was asked for.
    touches : int
    frame_id : str
        Of its coordinates.
    true_outline_m : lines (k, 2)
        What the simulated bench knew, at its nominal age of contact; none for hardware.
    off_m2 : float
        Area between boundary and truth; NaN for hardware.
    """

    boundary: Boundary
    wanted_m2: float
    touches: int
    frame_id: str
    true_outline_m: Lines = ()
    off_m2: float = math.nan

    @property
    def met(self) -> bool:
        """Whether it is known as well as it was asked for."""
        return self.boundary.wrong_area_m2 <= self.wanted_m2

    def as_json(self) -> str:
        """Content of ``boundary.json``: metres, hertz."""
        known = not math.isnan(self.off_m2)
        content = {
            **self.boundary.as_json(),
            "wanted_wrong_area_m2": self.wanted_m2,
            "met": self.met,
            "touches": self.touches,
            "frame_id": self.frame_id,
            "true_outline_m": [line.tolist() for line in self.true_outline_m] if known else None,
            "off_truth_m2": self.off_m2 if known else None,
        }
        return json.dumps(content, indent=1, allow_nan=False) + "\n"

    def sentences(self) -> list[str]:
        """What is known of it, for people."""
        found = self.boundary
        levels = " and ".join(f"{level:.2f}" for level in found.level_set.levels)
        lines = [
            f"Boundary at {levels} Hz after {counted(self.touches, 'touch', 'touches')}: "
            f"{1e6 * found.area_m2:.1f} mm2 within, "
            f"{1e6 * found.wrong_area_m2:.2g} mm2 expected on its wrong side, "
            f"{1e6 * self.wanted_m2:.3g} mm2 asked for{'' if self.met else ': not met'}."
        ]
        if not math.isnan(self.off_m2):
            lines.append(f"Off the simulation's truth by {1e6 * self.off_m2:.2g} mm2.")
        return lines


def boundary_of_run(run: RunContent) -> RunBoundary | None:
    """Boundary as far as a run has come; None where none is wanted, or too few points have a pole."""
    scene = scene_of(run)
    asked = None if scene is None else scene.adaptive
    boundary = None if asked is None else asked.boundary(run.latest)
    if scene is None or asked is None or boundary is None:
        return None
    frame_id = run.latest[0].frame_id or scene.frame_id
    found = RunBoundary(boundary, asked.most_loss, len(run.latest), frame_id)
    if not any(result.simulated for result in run.latest):
        return found
    try:
        phantoms = read_scene(read_tissues(), run.path / "scene.yaml")
    except ValueError:  # simulated without a scene of the bench
        return found
    truth = true_f0_hz(phantoms, asked, boundary.level_set.levels[0])
    surface = asked.krige(known_points(run.latest))
    assert surface is not None  # else there were no boundary
    return replace(
        found,
        true_outline_m=asked.raster.lines(boundary.level_set.depth(truth)),
        off_m2=difference_m2(surface, boundary.level_set, asked.raster, truth),
    )


def true_f0_hz(phantoms: PhantomScene, asked: Adaptive, near_hz: float) -> np.ndarray:
    """(r, c) true f0 of the mode near a frequency over the raster of a region [Hz]; NaN where nothing lies."""
    raster = asked.raster
    low, high = asked.polygon_m.min(axis=0), asked.polygon_m.max(axis=0)
    axes = [np.linspace(low[k], high[k], _TRUTH_CELLS + 1) for k in range(2)]
    at = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    felt = truth_over(SimulatedBench.from_configuration(), phantoms, at)
    sensors: list[Any] = felt.ravel().tolist()
    f0 = [math.nan if sensor is None else sensor.mode_near(near_hz).f0_hz for sensor in sensors]
    values = np.reshape(f0, felt.shape)
    method = "cubic" if np.all(np.isfinite(values)) else "linear"
    return np.asarray(RegularGridInterpolator(axes, values, method=method)(raster.xy_m))
