# SPDX-License-Identifier: Apache-2.0
"""Figures of nonlinear distortion, in the manner of figures 5 and 6 of arXiv 1805.00682."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tactile_resonance.frf.distortion import DetectionLines, Distortion
from tactile_resonance.report.drawing import decibel, new_figure


def draw_distortion(cases: Mapping[str, Distortion], title: str) -> Figure:
    """One panel a case: linear output, even and odd distortion of the output, noise, over frequency."""
    columns = min(2, len(cases))
    rows = -(-len(cases) // columns)
    figure = new_figure(7.5 * columns, 4.5 * rows)
    figure.suptitle(title)
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes, (name, distortion) in zip(panels.flat, cases.items(), strict=False):
        _draw_case(axes, distortion)
        axes.set_title(name)
    for axes in panels[-1]:
        axes.set_xlabel("frequency [Hz]")
    for axes in panels[:, 0]:
        axes.set_ylabel("output per line [dB, 1 V]")
    return figure


def draw_distortion_levels(cases: Mapping[float, Distortion], title: str) -> Figure:
    """Rms level of even and odd distortion against the linear output, over the drive level [V rms]."""
    figure = new_figure(7, 5)
    axes = figure.subplots()
    levels = sorted(cases)
    for name, marker in (("even", "o-"), ("odd", "s-")):
        lines = [getattr(cases[level], name) for level in levels]
        axes.plot(levels, [float(np.max(x.rms_level_db)) for x in lines], marker, label=name)
    noise = [cases[level].odd.rms_noise_level_db for level in levels]
    known = [float(np.max(x)) for x in noise if x is not None]
    if len(known) == len(levels):
        axes.plot(levels, known, "k.--", label="noise at odd lines")
    axes.set(
        xlabel="drive level [V rms]",
        ylabel="against the linear output in the band [dB]",
        title=title,
    )
    axes.legend()
    axes.grid(alpha=0.3)
    return figure


def _draw_case(axes: Axes, distortion: Distortion) -> None:
    power = np.mean(np.abs(distortion.output) ** 2, axis=-2)
    style: dict[str, Any] = {"marker": ".", "ms": 1.5, "ls": "none"}
    axes.semilogx(
        distortion.frequency_hz, decibel(power), color="k", label="linear output", **style
    )
    for name, colour in (("odd", "C3"), ("even", "C0")):
        lines = getattr(distortion, name)
        if lines.harmonics.size == 0:
            continue
        axes.plot(
            lines.frequency_hz,
            decibel(lines.power),
            color=colour,
            label=_label(name, lines),
            **style,
        )
        if lines.noise_power is not None and name == "even":
            axes.plot(
                lines.frequency_hz, decibel(lines.noise_power), color="0.6", label="noise", **style
            )
    axes.legend(fontsize="small", markerscale=4, loc="lower left")
    axes.grid(alpha=0.3)


def _label(name: str, lines: DetectionLines) -> str:
    """Level of a parity, and whether it is more than noise: noise must not pass for distortion."""
    level = f"{float(np.max(lines.rms_level_db)):.1f} dB"
    if lines.above_noise is None:
        return f"{name} lines, {level}, noise unknown"
    if not np.any(lines.above_noise):
        return f"{name} lines, {level}, no more than noise"
    return f"{name} distortion, {level}"
