# SPDX-License-Identifier: Apache-2.0
"""The figure of a calibration: responses with the model, and what it leaves of them."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from tactile_resonance.calibration.calibration_record import Load
from tactile_resonance.calibration.fit import Fitted
from tactile_resonance.report.drawing import decibel, new_figure


def draw_calibration(fitted: Fitted, title: str) -> Figure:
    """A column of each record: response and residual over frequency, residuals in their standard deviations."""
    records = fitted.records
    figure = new_figure(4.2 * len(records), 7.5)
    figure.suptitle(title)
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
        above.semilogx(frf.frequency_hz, decibel(np.abs(frf.g) ** 2), ".", ms=2, label="|G|")
        above.semilogx(frf.frequency_hz, decibel(np.abs(model) ** 2), "k-", lw=0.6, label="model")
        gap = decibel(np.abs(residual * std) ** 2)
        above.semilogx(frf.frequency_hz, gap, ".", ms=1, color="C3", label="|G - model|")
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
