# SPDX-License-Identifier: Apache-2.0
"""Figure of the variance of the FRF by source, in the manner of figure 9 of arXiv 1805.00682."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from tactile_resonance.frf.variance_analysis import VarianceAnalysis
from tactile_resonance.report.drawing import decibel, new_figure


def draw_variance(
    analysis: VarianceAnalysis, in_band: VarianceAnalysis, band_hz: tuple[float, float], title: str
) -> Figure:
    """Mean FRF and the standard deviation over each source, in dB; the legend speaks of the band."""
    figure = new_figure(10, 6)
    axes = figure.subplots()
    power = np.mean(np.abs(analysis.mean) ** 2, axis=0)
    axes.semilogx(analysis.frequency_hz, decibel(power), "k-", lw=1, label="mean |G|")
    for k, source in enumerate(reversed(analysis.sources)):
        if source.variance is None:
            continue
        axes.plot(
            analysis.frequency_hz,
            decibel(source.variance),
            ".",
            ms=2,
            color=f"C{k}",
            label=f"over {source.name}: {in_band.source(source.name).rms_level_db:.1f} dB of rms |G| in "
            f"the band, {source.dof} degrees of freedom",
        )
    axes.axvspan(*band_hz, color="0.92", zorder=0, label=f"band {band_hz[0]:g}-{band_hz[1]:g} Hz")
    axes.set(xlabel="frequency [Hz]", ylabel="[dB]", title=title)
    axes.legend(fontsize="small", markerscale=4)
    axes.grid(alpha=0.3)
    return figure
