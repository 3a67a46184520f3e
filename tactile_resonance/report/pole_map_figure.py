# SPDX-License-Identifier: Apache-2.0
"""The pole map as a figure: what rviz shows, for people without it."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure

from tactile_resonance.poles.result import ellipse
from tactile_resonance.report.boundary import RunBoundary
from tactile_resonance.report.drawing import PROBABILITY, SIMULATED, new_figure
from tactile_resonance.scan.level_set import PROBABILITY as LINE_PROBABILITY
from tactile_resonance.scan.level_set import Lines
from tactile_resonance.scan.pole_map import HIGH_RGB, LOW_RGB, MapSurface, PoleMap

COLOURS = LinearSegmentedColormap.from_list(
    "pole_map", [np.array(LOW_RGB) / 255, np.array(HIGH_RGB) / 255]
)
MM = 1e3
_MARKS = "osD^vP*X"


def draw_pole_map(pole_map: PoleMap, title: str, boundary: RunBoundary | None = None) -> Figure:
    """Map of f0 with ellipses and failures, its uncertainty between the points, and the poles.

    Parameters
    ----------
    pole_map : PoleMap
        With one point or more.
    title : str
    boundary : RunBoundary, optional
        Drawn with its band, and its truth where that is known.
    """
    figure = new_figure(16, 6.2, title + (f" ({SIMULATED})" if pole_map.simulated else ""))
    above, unsure, plane = figure.subplots(1, 3, width_ratios=(1.1, 1.1, 1))
    if not pole_map.estimated:
        _draw_failures(above, pole_map)
        _label(above, "no point has a pole")
        for axes in (unsure, plane):
            axes.set_axis_off()
        return figure
    f0 = pole_map.f0_hz
    colour = Normalize(f0.min(), f0.max() if np.ptp(f0) else f0.min() + 1)
    surface = pole_map.surface(80)
    if surface is not None:
        _draw_surface(above, surface, surface.f0_hz, colour)
    where = np.array([point.position_m for point in pole_map.estimated]) * MM
    dots = above.scatter(
        *where.T[:2],
        c=f0,
        cmap=COLOURS,
        norm=colour,
        s=60,
        edgecolors="white",
        linewidths=0.8,
        zorder=3,
    )
    figure.colorbar(dots, ax=above, label="natural frequency f0 [Hz]", shrink=0.9)
    scale = pole_map.ellipse_scale(PROBABILITY)
    lines = pole_map.ellipses(scale, PROBABILITY)[..., :2] * MM  # (e, segments, 2, 2)
    above.add_collection(
        LineCollection(list(lines.reshape(-1, 2, 2)), colors="black", linewidths=0.9, zorder=4)
    )
    if boundary is not None:
        _draw_boundary(above, boundary)
    _draw_failures(above, pole_map)
    _label(
        above,
        f"f0 and {100 * PROBABILITY:g} % ellipses: 1 mm along x = {1e-3 / scale.m_per_hz:.2g} Hz of f0,\n"
        f"along y = {1e-3 / scale.m_per_damping:.2g} of the damping ratio",
    )
    if surface is None:
        unsure.set_axis_off()
        why = "too few points for a surface between them"
        unsure.text(0.5, 0.5, why, ha="center", transform=unsure.transAxes)
    else:
        shown = _draw_surface(unsure, surface, surface.f0_std_hz, None)
        figure.colorbar(shown, ax=unsure, label="standard deviation of f0 [Hz]", shrink=0.9)
        unsure.plot(*where.T[:2], ".", color="white", ms=4)
        _label(unsure, "uncertainty of f0 between the points")
        unsure.set(xlim=above.get_xlim(), ylim=above.get_ylim())
    _draw_plane(plane, pole_map)
    return figure


def _draw_surface(
    axes: Axes, surface: MapSurface, values: np.ndarray, colour: Normalize | None
) -> QuadMesh:
    x, y = surface.position_m[0, :, 0] * MM, surface.position_m[:, 0, 1] * MM
    cmap = "viridis" if colour is None else COLOURS
    return axes.pcolormesh(x, y, values, cmap=cmap, norm=colour, shading="nearest", rasterized=True)


def _draw_failures(axes: Axes, pole_map: PoleMap) -> None:
    if pole_map.failures:
        where = np.array([point.position_m for point in pole_map.failures]) * MM
        axes.plot(*where.T[:2], "x", color="red", ms=9, mew=2, label="failed", zorder=5)
        axes.legend(loc="upper right")


def _draw_boundary(axes: Axes, found: RunBoundary) -> None:
    """Outline, the band that holds it, and its truth."""
    band = f"{100 * LINE_PROBABILITY:g} % band"
    styles: tuple[tuple[Lines, dict[str, Any], str], ...] = (
        (found.boundary.outline_m, {"color": "black", "lw": 2}, "boundary"),
        (found.boundary.inner_m, {"color": "black", "ls": "--", "lw": 1}, band),
        (found.boundary.outer_m, {"color": "black", "ls": "--", "lw": 1}, band),
        (found.true_outline_m, {"color": "red", "lw": 1.2}, "truth of the simulation"),
    )
    for lines, style, label in styles:
        for line in lines:
            named = label in axes.get_legend_handles_labels()[1]
            axes.plot(*(line.T * MM), **style, zorder=5, label=None if named else label)
    axes.legend(loc="upper right", fontsize="small")


def _draw_plane(axes: Axes, pole_map: PoleMap) -> None:
    """Poles by tissue class."""
    groups = pole_map.classes() or ("",)
    for k, name in enumerate(groups):
        points = [p.result for p in pole_map.estimated if p.result.tissue_class == name]
        x = np.array([p.estimate for p in points])
        axes.plot(*x.T, _MARKS[k % len(_MARKS)], color=f"C{k}", ms=4, label=name or "poles")
        loops = [
            (p.estimate[:, None] + ellipse(p.covariance, 100, PROBABILITY)).T
            for p in points
            if np.all(np.isfinite(p.covariance))
        ]
        axes.add_collection(LineCollection(loops, colors=f"C{k}", linewidths=0.8, zorder=2))
    axes.set(xlabel="f0 [Hz]", ylabel="damping ratio")
    axes.set_title(f"measured poles, {100 * PROBABILITY:g} % ellipses", fontsize="medium")
    axes.ticklabel_format(useOffset=False)
    axes.legend(loc="upper left")


def _label(axes: Axes, title: str) -> None:
    axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    axes.set_title(title, fontsize="medium")
