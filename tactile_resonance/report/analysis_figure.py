# SPDX-License-Identifier: Apache-2.0
"""The figure of one analysed recording."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from tactile_resonance.analysis import Analysis
from tactile_resonance.report.drawing import decibel, draw_ellipse, new_figure


def draw_analysis(analysis: Analysis, title: str) -> Figure:
    """FRF with its standard deviation, the band with the model, the pole with its ellipse."""
    frf, poles = analysis.frf, analysis.poles
    figure = new_figure(12, 7.5)
    figure.suptitle(title)
    axes = figure.subplot_mosaic([["whole", "whole", "poles"], ["band", "phase", "poles"]])

    whole = axes["whole"]
    whole.plot(frf.frequency_hz, decibel(np.abs(frf.g) ** 2), ".", ms=2, label="|G|")
    if frf.variance is not None:
        whole.plot(
            frf.frequency_hz, decibel(frf.variance), ".", ms=2, label="its standard deviation"
        )
    whole.axvspan(*poles.band_hz, color="0.9", label="band of the fit")
    whole.set(xlabel="frequency [Hz]", ylabel="[dB]")
    whole.legend(loc="best", fontsize="small")

    inside = frf.band(*poles.band_hz)
    band, phase = axes["band"], axes["phase"]
    band.plot(inside.frequency_hz, decibel(np.abs(inside.g) ** 2), ".", ms=3, label="|G|")
    phase.plot(inside.frequency_hz, np.degrees(np.unwrap(np.angle(inside.g))), ".", ms=3)
    if poles.fit is not None:
        fine = np.linspace(*poles.band_hz, 1000)
        model = poles.fit.response(fine)
        band.plot(fine, decibel(np.abs(model) ** 2), "k-", lw=1, label="model")
        left = inside.g - poles.fit.response(inside.frequency_hz)
        band.plot(
            inside.frequency_hz,
            decibel(np.abs(left) ** 2),
            ".",
            ms=3,
            color="C3",
            label="|G - model|",
        )
        phase.plot(fine, np.degrees(np.unwrap(np.angle(model))), "k-", lw=1)
    if inside.variance is not None:
        band.plot(
            inside.frequency_hz, decibel(inside.variance), ".", ms=2, color="C1", label="std of G"
        )
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
    if pole_axes.get_legend_handles_labels()[0]:
        pole_axes.legend(loc="best", fontsize="small")
    return figure
