# SPDX-License-Identifier: Apache-2.0
"""Touches for the boundary of a hidden inclusion: chosen one after the other, against grids; simulated."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from tqdm import tqdm

from tactile_resonance._typing import FloatArray
from tactile_resonance.configuration import share_path
from tactile_resonance.scan.adaptive import Adaptive
from tactile_resonance.scan.clearance import NEAR_M
from tactile_resonance.scan.kriging import KrigedSurface, krige
from tactile_resonance.scan.level_set import LevelSet, difference_m2
from tactile_resonance.scan.plan import CONTACT_S, NEAR_CONTACT_S, TRAVEL_M_S
from tactile_resonance.scan.points import grid
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.sensor.experiments import truth_over
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.simulation.tissue.scene import PhantomScene, Sphere, read_scene

PHANTOMS, QUICK_PHANTOMS = 50, 6
RADIUS_M = (0.006, 0.012)
"""Of the ball; as in the inclusion scene it lies 0.2 mm under the surface."""
DEEP_M = 0.0002
SIDE_M, SPACING_M, SMALLEST_M, START, MOST = 0.02, 0.001, 0.006, 9, 80
GRIDS = tuple(range(4, 15))
WANTED_M2 = 1e-6
LEVEL_HZ = 255.91
"""Between the classes of the inclusion scene."""
NOISE_HZ = 0.02
"""Standard deviation of f0 that the demo asks of its points."""
MEASURE_S = 0.8
"""Two blocks, as the demo's points take."""
SQUARE = SIDE_M / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
ASKED = Adaptive(
    *(SQUARE, LevelSet(low=LEVEL_HZ), MOST, SMALLEST_M),
    *(START, SPACING_M, WANTED_M2),
)


@dataclass(frozen=True)
class Phantom:
    """What is felt of a ball: f0 falls with the distance from its middle."""

    centre_m: FloatArray
    over_distance: CubicSpline

    def f0_hz(self, xy_m: FloatArray) -> FloatArray:
        """(...) at (..., 2) positions."""
        return np.asarray(self.over_distance(np.linalg.norm(xy_m - self.centre_m, axis=-1)))


@dataclass(frozen=True, eq=False)
class Touches:
    """What each number of touches led to, on one phantom.

    Attributes
    ----------
    counts, seconds, wrong_m2, expected_m2 : (n,) float
        Touches, the time they take, area off the truth, and what was expected of it.
    """

    counts: FloatArray
    seconds: FloatArray
    wrong_m2: FloatArray
    expected_m2: FloatArray

    def when(self, area_m2: FloatArray) -> tuple[float, float]:
        """Touches and time from which on an area is at most the wanted one for the first time; NaN: never."""
        (met,) = np.nonzero(area_m2 <= WANTED_M2)
        return (self.counts[met[0]], self.seconds[met[0]]) if met.size else (np.nan, np.nan)


def rows(quick: bool) -> dict[str, list[Touches]]:
    """Of grids and of chosen touches, what each led to on every phantom."""
    scene = read_scene(read_tissues(), share_path("config/scenes/inclusion_scan.yaml"))
    bench = SimulatedBench.from_configuration()
    found: dict[str, list[Touches]] = {"grid": [], "adaptive": []}
    for seed in tqdm(range(QUICK_PHANTOMS if quick else PHANTOMS), unit="phantom", leave=False):
        rng = np.random.default_rng(seed)
        phantom = _phantom(scene, bench, rng)
        found["grid"].append(_on_grids(phantom, rng))
        found["adaptive"].append(_chosen(phantom, rng))
    return found


def table(found: dict[str, list[Touches]]) -> list[str]:
    """Markdown: touches and time until the boundary is known to 1 mm2, in truth and as expected."""
    lines = [
        f"| touches | to {1e6 * WANTED_M2:g} mm2 off the truth: touches, time | until "
        f"{1e6 * WANTED_M2:g} mm2 are expected: touches, time | off the truth then |",
        "|---|---|---|---|",
    ]
    for name, of_phantoms in found.items():
        true = np.array([each.when(each.wrong_m2) for each in of_phantoms])
        stated = np.array([each.when(each.expected_m2) for each in of_phantoms])
        off = [_at(each, count) for each, count in zip(of_phantoms, stated[:, 0], strict=True)]
        lines.append(
            f"| {name} | {_median(true[:, 0]):.0f}, {_median(true[:, 1]):.0f} s | "
            f"{_median(stated[:, 0]):.0f}, {_median(stated[:, 1]):.0f} s | {1e6 * _median(off):.2f} mm2 |"
        )
    by_grid, by_choice = (
        np.array([each.when(each.wrong_m2) for each in found[name]])
        for name in ("grid", "adaptive")
    )
    fewer, faster = (_median(by_grid[:, k]) / _median(by_choice[:, k]) for k in range(2))
    lines += ["", f"{fewer:.1f} times fewer touches, {faster:.1f} times less time (medians)."]
    return lines


def _median(values: npt.ArrayLike) -> float:
    """NaN, what never came, as the largest."""
    return float(np.median(np.nan_to_num(np.asarray(values, float), nan=np.inf)))


def _at(of_phantom: Touches, count: float) -> float:
    """Area off the truth after so many touches; the last one where that is NaN."""
    k = np.searchsorted(of_phantom.counts, count) if np.isfinite(count) else -1
    return float(of_phantom.wrong_m2[k])


def _phantom(scene: PhantomScene, bench: SimulatedBench, rng: np.random.Generator) -> Phantom:
    """A ball of random size, felt within the region."""
    radius_m = float(rng.uniform(*RADIUS_M))
    (ball,) = scene.buried
    shape = Sphere((0.0, 0.0, -radius_m - DEEP_M), radius_m)
    alone = replace(scene, buried=(replace(ball, shape=shape),))
    distance = np.linspace(0.0, 0.024, 49)  # on the disc of gelatine
    felt = truth_over(bench, alone, np.stack([distance, 0 * distance], axis=-1))
    profile = CubicSpline(distance, [each.mode_near(LEVEL_HZ).f0_hz for each in felt])
    reach_m = float(profile.solve(LEVEL_HZ, extrapolate=False)[0])
    most_m = SIDE_M / 2 - reach_m - SPACING_M
    return Phantom(rng.uniform(-most_m, most_m, 2), profile)


def _chosen(phantom: Phantom, rng: np.random.Generator) -> Touches:
    """Touches one after the other, until as little is expected to be wrong as is wanted."""
    places = ASKED.places_m()
    touched, f0, found = ASKED.first(places), [], []
    place: int | None = touched[0]
    while place is not None:
        f0 += _measured(phantom, places[touched[len(f0) :]], rng).tolist()
        known = (places[touched], np.array(f0), np.full(len(f0), NOISE_HZ))
        surface = ASKED.krige(known)
        assert surface is not None
        found.append((len(f0), _seconds(places[touched]), *_areas(phantom, surface)))
        way_m = np.linalg.norm(places - places[touched[-1]], axis=1)
        place = ASKED.next(places, touched, known, _each_s(way_m))
        if place is not None:
            touched.append(place)
    return Touches(*np.array(found, float).T)


def _on_grids(phantom: Phantom, rng: np.random.Generator) -> Touches:
    found = []
    for side in GRIDS:
        spacing = (SIDE_M / (side - 1),) * 2
        at = grid((0.0, 0.0), (SIDE_M, SIDE_M), spacing, "serpentine")
        surface = krige(at, _measured(phantom, at, rng), np.full(len(at), NOISE_HZ))
        found.append((len(at), _seconds(at), *_areas(phantom, surface)))
    return Touches(*np.array(found, float).T)


def _measured(phantom: Phantom, xy_m: FloatArray, rng: np.random.Generator) -> FloatArray:
    return phantom.f0_hz(xy_m) + NOISE_HZ * rng.standard_normal(len(xy_m))


def _areas(phantom: Phantom, surface: KrigedSurface) -> tuple[float, float]:
    """Off the truth, and as expected [m^2]."""
    raster = ASKED.raster
    off_m2 = difference_m2(surface, ASKED.wanted, raster, phantom.f0_hz(raster.xy_m))
    return off_m2, ASKED.loss(surface)


def _seconds(path_m: FloatArray) -> float:
    """That touches along a path take, as plans reckon them."""
    ways_m = np.linalg.norm(np.diff(path_m, axis=0), axis=1)
    return CONTACT_S + MEASURE_S + float(np.sum(_each_s(ways_m)))


def _each_s(way_m: FloatArray) -> FloatArray:
    """Of touches and the ways to them."""
    contact_s = np.where(way_m <= NEAR_M, NEAR_CONTACT_S, CONTACT_S)
    return np.asarray(way_m / TRAVEL_M_S + contact_s + MEASURE_S)
