# SPDX-License-Identifier: Apache-2.0
"""Figures over frequency: a recording that was analysed, a calibration, distortion, variance by source.

Distortion and variance are drawn in the manner of figures 5, 6 and 9 of arXiv 1805.00682.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tactile_resonance._typing import FloatArray
from tactile_resonance.analysis import Analysis
from tactile_resonance.calibration.fit import Fitted
from tactile_resonance.calibration.records import Load
from tactile_resonance.frf.distortion import DetectionLines, Distortion, decibel
from tactile_resonance.frf.variance_analysis import NestedMeans
from tactile_resonance.report.drawing import draw_ellipse, new_figure


def draw_analysis(analysis: Analysis, title: str) -> Figure:
    """FRF with its standard deviation, the band with the model, the pole with its ellipse."""
    frf, poles = analysis.frf, analysis.poles
    figure = new_figure(12, 7.5, title)
    axes = figure.subplot_mosaic([["whole", "whole", "poles"], ["band", "phase", "poles"]])

    whole = axes["whole"]
    _dots(whole, frf.frequency_hz, np.abs(frf.g) ** 2, "|G|", 2)
    if frf.variance is not None:
        _dots(whole, frf.frequency_hz, frf.variance, "its standard deviation", 2)
    whole.axvspan(*poles.band_hz, color="0.9", label="band of the fit")
    whole.set(xlabel="frequency [Hz]", ylabel="[dB]")
    whole.legend(loc="best", fontsize="small")

    inside = frf.band(*poles.band_hz)
    band, phase = axes["band"], axes["phase"]
    _dots(band, inside.frequency_hz, np.abs(inside.g) ** 2, "|G|", 3)
    phase.plot(inside.frequency_hz, np.degrees(np.unwrap(np.angle(inside.g))), ".", ms=3)
    if poles.fit is not None:
        fine = np.linspace(*poles.band_hz, 1000)
        model = poles.fit.response(fine)
        band.plot(fine, decibel(np.abs(model) ** 2), "k-", lw=1, label="model")
        left = inside.g - poles.fit.response(inside.frequency_hz)
        _dots(band, inside.frequency_hz, np.abs(left) ** 2, "|G - model|", 3, color="C3")
        phase.plot(fine, np.degrees(np.unwrap(np.angle(model))), "k-", lw=1)
    if inside.variance is not None:
        _dots(band, inside.frequency_hz, inside.variance, "std of G", 2, color="C1")
    band.set(xlabel="frequency [Hz]", ylabel="[dB]")
    band.legend(loc="best", fontsize="small")
    phase.set(xlabel="frequency [Hz]", ylabel="phase [degrees]")

    pole_axes = axes["poles"]
    for k, (f0_hz, damping_ratio) in enumerate(zip(poles.f0_hz, poles.damping_ratio, strict=False)):
        pole_axes.plot(f0_hz, damping_ratio, "k+", ms=10)
        for covariance, colour, name in (
            (poles.total_covariance, "C1", "95 %, total"),
            (poles.covariance, "C0", "95 %, noise"),
        ):
            if covariance is not None:
                draw_ellipse(
                    pole_axes, (f0_hz, damping_ratio), covariance[k], color=colour, label=name
                )
    pole_axes.set(
        xlabel="f0 [Hz]", ylabel="damping ratio", title=f"pole, status: {poles.status.value}"
    )
    pole_axes.ticklabel_format(useOffset=False)
    pole_axes.locator_params(axis="x", nbins=3)  # six digits each
    if pole_axes.get_legend_handles_labels()[0]:
        pole_axes.legend(loc="best", fontsize="small")
    return figure


def draw_calibration(fitted: Fitted, title: str) -> Figure:
    """A column of each record: response and residual over frequency, residuals in their standard deviations."""
    records = fitted.records
    figure = new_figure(4.2 * len(records), 7.5, title)
    axes = figure.subplots(2, len(records), squeeze=False, sharex=True)
    for column, (record, residual) in enumerate(zip(records, fitted.residuals, strict=True)):
        frf, std = record.frf, np.sqrt(record.variance)
        above, below = axes[:, column]
        value = {
            Load.MASS: f" {1e6 * record.value:.4g} mg",
            Load.SPRING: f" {record.value:.4g} N/m",
        }
        above.set_title(record.name + value.get(record.load, ""), fontsize="medium")
        model = frf.g + residual * std
        _dots(above, frf.frequency_hz, np.abs(frf.g) ** 2, "|G|", 2)
        above.semilogx(frf.frequency_hz, decibel(np.abs(model) ** 2), "k-", lw=0.6, label="model")
        _dots(above, frf.frequency_hz, np.abs(residual * std) ** 2, "|G - model|", 1, color="C3")
        above.semilogx(frf.frequency_hz, decibel(std**2), "C1-", lw=0.8, label="std of G")
        below.semilogx(frf.frequency_hz, residual.real, ".", ms=1, label="real")
        below.semilogx(frf.frequency_hz, residual.imag, ".", ms=1, label="imaginary")
        mean = np.mean(np.abs(residual) ** 2)
        below.set_title(f"mean square {mean:.2f} of noise", fontsize="small")
        below.set(xlabel="frequency [Hz]", ylim=(-6, 6))
    axes[0, 0].set_ylabel("[dB]")
    axes[1, 0].set_ylabel("residual [standard deviations]")
    for row in axes:
        row[0].legend(fontsize="small", markerscale=4, loc="lower left")
    return figure


def draw_distortion(cases: Mapping[str, Distortion], title: str) -> Figure:
    """One panel a case: linear output, even and odd distortion of the output, noise, over frequency."""
    columns = min(2, len(cases))
    rows = -(-len(cases) // columns)
    figure = new_figure(7.5 * columns, 4.5 * rows, title)
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
    noise = [float(np.max(cases[level].odd.rms_noise_level_db)) for level in levels]
    if not np.any(np.isnan(noise)):
        axes.plot(levels, noise, "k.--", label="noise at odd lines")
    axes.set(
        xlabel="drive level [V rms]",
        ylabel="against the linear output in the band [dB]",
        title=title,
    )
    axes.legend()
    axes.grid(alpha=0.3)
    return figure


def _dots(
    axes: Axes, frequency_hz: FloatArray, power: FloatArray, label: str, size: float, **style: Any
) -> None:
    """A power over frequency, in dB."""
    axes.plot(frequency_hz, decibel(power), ".", ms=size, label=label, **style)


def _draw_case(axes: Axes, distortion: Distortion) -> None:
    power = np.mean(np.abs(distortion.output) ** 2, axis=-2)
    axes.set_xscale("log")
    _dots(axes, distortion.frequency_hz, power, "linear output", 1.5, color="k")
    for name, colour in (("odd", "C3"), ("even", "C0")):
        lines = getattr(distortion, name)
        if lines.harmonics.size == 0:
            continue
        _dots(axes, lines.frequency_hz, lines.power, _label(name, lines), 1.5, color=colour)
        if name == "even" and not np.all(np.isnan(lines.noise_power)):
            _dots(axes, lines.frequency_hz, lines.noise_power, "noise", 1.5, color="0.6")
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


def draw_variance(
    found: NestedMeans, frequency_hz: FloatArray, band_hz: tuple[float, float], title: str
) -> Figure:
    """Mean FRF and the standard deviation over each source, in dB; the legend speaks of the band."""
    figure = new_figure(10, 6)
    axes = figure.subplots()
    inside = (frequency_hz >= band_hz[0]) & (frequency_hz <= band_hz[1])
    power = np.mean(np.abs(found.mean) ** 2, axis=0)
    axes.semilogx(frequency_hz, decibel(power), "k-", lw=1, label="mean |G|")
    for k, source in enumerate(reversed(found.levels)):
        if source.variance is None:
            continue
        level_db = found.rms_level_db(source, inside)
        label = f"over {source.name}: {level_db:.1f} dB of rms |G| in the band, {source.dof} degrees of freedom"
        _dots(axes, frequency_hz, source.variance, label, 2, color=f"C{k}")
    axes.axvspan(*band_hz, color="0.92", zorder=0, label=f"band {band_hz[0]:g}-{band_hz[1]:g} Hz")
    axes.set(xlabel="frequency [Hz]", ylabel="[dB]", title=title)
    axes.legend(fontsize="small", markerscale=4)
    axes.grid(alpha=0.3)
    return figure
