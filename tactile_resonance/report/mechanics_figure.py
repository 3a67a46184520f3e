# SPDX-License-Identifier: Apache-2.0
"""Figure of mechanical tests with their fits; relaxation as in figure 7 of arXiv 1805.00682."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tactile_resonance.mechanics.indentation import Protocol
from tactile_resonance.report.drawing import SIMULATED, new_figure
from tactile_resonance.scan.tissue_tests import TissueTest


def draw_tests(tests: Sequence[TissueTest], title: str) -> Figure:
    """Force (of creep alone: depth) over time from the touch, and force over depth: means with the model.

    Parameters
    ----------
    tests : sequence of TissueTest
        Those without a fit are left out.
    title : str

    Raises
    ------
    ValueError
        If none has a fit.
    """
    shown = [one for one in tests if one.fit is not None]
    if not shown:
        raise ValueError("tests: none could be fitted; accepted is at least one, to be drawn")
    figure = new_figure(13, 5.5)
    any_simulated = any(one.test.simulated for one in shown)
    figure.suptitle(f"{title} ({SIMULATED})" if any_simulated else title)
    over_time, over_depth = figure.subplots(1, 2)
    creep = all(one.test.protocol is Protocol.CREEP for one in shown)
    for k, one in enumerate(shown):
        _draw(over_time, over_depth, one, f"C{k % 10}", creep)
    over_time.set(
        xlabel="time from the touch [s]",
        ylabel="depth of the ball [mm]" if creep else "force / its largest [%]",
        title="model" if creep else "means of the force (points), model (line)",
        xscale="log",
    )
    over_depth.set(
        xlabel="depth of the ball [mm]",
        ylabel="force [mN]",
        title="over depth: means (points), model (line)",
    )
    for axes in (over_time, over_depth):
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    return figure


def _draw(over_time: Axes, over_depth: Axes, one: TissueTest, colour: str, creep: bool) -> None:
    fit, test = one.fit, one.test
    assert fit is not None
    share = 100 / fit.peak_force_n
    label = f"{test.label}, {test.protocol.value}"
    if test.protocol is Protocol.RELAXATION:
        label += f": {100 * fit.relaxed_share:.0f} % lost in {fit.hold_s:.0f} s"
    after = fit.time_s > 0
    time_s, depth_mm = fit.time_s[after], 1e3 * np.maximum(fit.indentation_m, 0.0)
    if creep:
        over_time.plot(time_s, depth_mm[after], color=colour, label=label)
    else:
        over_time.plot(time_s, share * fit.measured_n[after], ".", ms=3, color=colour, alpha=0.5)
        over_time.plot(time_s, share * fit.force_n[after], color=colour, label=label)
    over_depth.plot(depth_mm, 1e3 * fit.measured_n, ".", ms=3, color=colour, alpha=0.5)
    over_depth.plot(depth_mm, 1e3 * fit.force_n, color=colour, label=label)
