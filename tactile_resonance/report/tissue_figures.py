# SPDX-License-Identifier: Apache-2.0
"""Figures of tissue: references (classes, spread, reliability, smallest step), compared points, tests.

Relaxation is drawn as in figure 7 of arXiv 1805.00682.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import counted
from tactile_resonance.mechanics.indentation import Protocol
from tactile_resonance.report.drawing import SIMULATED, draw_ellipse, new_figure
from tactile_resonance.scan.tissue_tests import TissueTest
from tactile_resonance.tissue.comparison import Clusters, Differences
from tactile_resonance.tissue.spread import ReferencePoints, SmallestStep, TissueSpread
from tactile_resonance.tissue.trial import ReliabilityBin

PAPER_STEP_PERCENT = 2.0
"""Gelatines that the paper's sensor separates and surgeons' fingers do not (arXiv 1805.00682)."""


def draw_references(
    points: ReferencePoints,
    spreads: Sequence[TissueSpread],
    bins: Sequence[ReliabilityBin],
    steps: Sequence[SmallestStep],
    simulated: bool,
) -> Figure:
    """All four panels."""
    figure = new_figure(13, 9, "References" + (f", {SIMULATED}" if simulated else ""))
    (poles, sources), (calls, step) = figure.subplots(2, 2)
    draw_poles(poles, points, spreads)
    _draw_sources(sources, spreads)
    draw_reliability(calls, bins)
    draw_steps(step, steps)
    return figure


def draw_reliability(axes: Axes, bins: Sequence[ReliabilityBin]) -> None:
    """How often calls were right, over the stated probability."""
    axes.plot([0, 1], [0, 1], color="0.6", lw=1, label="as stated")
    axes.set(
        xlabel="stated probability", ylabel="part that is right", title="Calls", xlim=(0.3, 1.01)
    )
    axes.set_ylim(-0.02, 1.05)
    if not bins:
        axes.text(0.5, 0.5, "not tried", transform=axes.transAxes, ha="center")
        return
    stated, right = ([getattr(each, name) for each in bins] for name in ("stated", "right"))
    middle = np.array([(each.low + each.high) / 2 for each in bins])
    half = np.array([(each.high - each.low) / 2 for each in bins])
    axes.errorbar(
        stated, middle, half, fmt="none", color="C0", alpha=0.35, lw=7, label="expected in 95 %"
    )
    axes.plot(stated, right, "ko", ms=4, label="found")
    for each in bins:
        axes.annotate(
            f"{each.points}",
            (each.stated, each.right),
            textcoords="offset points",
            xytext=(8, -10),
            fontsize=7,
        )
    axes.legend(loc="upper left", fontsize="small", title="figures: points")
    axes.grid(alpha=0.3)


def draw_steps(axes: Axes, steps: Sequence[SmallestStep]) -> None:
    """Steps by what scatters, after one block and without noise, against those of paper and finger."""
    axes.set(ylabel="smallest step [% w/w]", title="Separated at 99 %")
    if not steps:
        axes.text(0.5, 0.5, "names hold no concentrations", transform=axes.transAxes, ha="center")
        return
    names = list(steps[0].one_block)
    for k, step in enumerate(steps):
        of = f"{step.from_percent:g} to {step.to_percent:g} %"
        x = np.arange(len(names)) + 0.12 * (k - (len(steps) - 1) / 2)
        for values, marker, which in (
            (step.one_block, "o", "one block"),
            (step.limit, "_", "limit"),
        ):
            y = [values[name] or np.nan for name in names]
            axes.plot(x, y, marker, color=f"C{k}", ms=7, label=f"{of}, {which}")
    axes.axhline(PAPER_STEP_PERCENT, color="k", lw=1)
    told = f" the paper's sensor separates {PAPER_STEP_PERCENT:g} %, a surgeon's finger does not"
    axes.text(-0.5, PAPER_STEP_PERCENT, told, va="bottom", fontsize=8)
    axes.set_xticks(range(len(names)), [names[0], *(f"+ {name}" for name in names[1:])], fontsize=8)
    axes.set(yscale="log", xlim=(-0.5, len(names) - 0.5))
    axes.set_ylim(top=max(axes.get_ylim()[1], 3 * PAPER_STEP_PERCENT))
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(0, 0.6), ncols=2)
    axes.grid(alpha=0.3, which="both", axis="y")


def draw_poles(axes: Axes, points: ReferencePoints, spreads: Sequence[TissueSpread]) -> None:
    """Points, and an ellipse for each tissue."""
    for k, spread in enumerate(spreads):
        own = points.of(spread.name)
        axes.plot(*own.estimate.T, ".", ms=3, color=f"C{k}", label=spread.name)
        draw_ellipse(axes, spread.mean, spread.covariance + spread.noise, color=f"C{k}", lw=1)
    axes.set(
        xlabel="f0 [Hz]", ylabel="damping ratio", title="Poles, and where 95 % are, if Gaussian"
    )
    axes.legend(fontsize="small")
    axes.grid(alpha=0.3)


def _draw_sources(axes: Axes, spreads: Sequence[TissueSpread]) -> None:
    """Standard deviations of f0, each tissue a group of bars."""
    names = ["noise", "force", *(source.name for source in reversed(spreads[0].sources))]
    for k, name in enumerate(names):
        covariances = [
            getattr(s, name)
            if k < 2
            else next(source.covariance for source in s.sources if source.name == name)
            for s in spreads
        ]
        std = [np.sqrt(each[0, 0]) for each in covariances]
        x = np.arange(len(spreads)) + 0.16 * (k - (len(names) - 1) / 2)
        axes.bar(x, np.where(np.array(std) > 0, std, np.nan), 0.15, label=name)
    axes.set_xticks(range(len(spreads)), [s.name for s in spreads], fontsize=8)
    axes.set(yscale="log", ylabel="standard deviation of f0 [Hz]", title="Spread by source")
    axes.set_ylim(top=3 * axes.get_ylim()[1])
    axes.legend(fontsize="small", ncols=len(names), loc="upper center")
    axes.grid(alpha=0.3, axis="y")


def draw_comparison(
    position_m: FloatArray,
    estimates: FloatArray,
    covariances: FloatArray,
    found: Differences,
    groups: Clusters,
    simulated: bool,
) -> Figure:
    """Places (n, 2) [m], poles (n, 2) of covariances (n, 2, 2), and the criterion over the number of groups."""
    figure = new_figure(15, 5, "What differs" + (f", {SIMULATED}" if simulated else ""))
    places, poles, criterion = figure.subplots(1, 3, width_ratios=(2, 2, 1))
    of_point, differs = groups.of_point, found.differs
    for k in range(len(groups.mean)):
        own = of_point == k
        label = f"group {k + 1}: {counted(int(own.sum()), 'point')}"
        places.plot(*(1e3 * position_m[own].T), "o", color=f"C{k}", ms=5, label=label)
        poles.plot(*estimates[own].T, ".", color=f"C{k}")
        draw_ellipse(
            poles,
            groups.mean[k],
            groups.covariance[k] + covariances[own].mean(axis=0)
            if own.any()
            else groups.covariance[k],
            color=f"C{k}",
            lw=1,
        )
    ring = {"ms": 11, "mfc": "none", "mec": "k", "ls": "none", "marker": "o"}
    places.plot(*(1e3 * position_m[differs].T), **ring, label="differs from the rest")
    poles.plot(*estimates[differs].T, **ring)
    poles.plot(*found.rest, "k+", ms=14, label="the rest")
    places.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal", title="Places")
    places.margins(0.15)
    figure.legend(*places.get_legend_handles_labels(), loc="outside lower center", ncols=7)
    poles.set(xlabel="f0 [Hz]", ylabel="damping ratio", title="Poles; ellipses hold 95 %")
    poles.legend(fontsize="small")
    bic = groups.bic - groups.bic.min()
    criterion.plot(np.arange(1, len(bic) + 1), bic, "k.-")
    criterion.set(xlabel="groups", title="Information criterion")
    criterion.set_xticks(range(1, len(bic) + 1))
    for axes in (places, poles, criterion):
        axes.grid(alpha=0.3)
    return figure


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
    any_simulated = any(one.test.simulated for one in shown)
    figure = new_figure(13, 5.5, f"{title} ({SIMULATED})" if any_simulated else title)
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
