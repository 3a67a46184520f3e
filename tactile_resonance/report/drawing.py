# SPDX-License-Identifier: Apache-2.0
"""Figures by matplotlib: how all are made and saved, and those of records, of tissue and of mechanical tests.

Distortion, variance and relaxation are drawn in the manner of figures 5 to 7 and 9 of arXiv 1805.00682.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tactile_resonance._typing import FloatArray
from tactile_resonance.calibration.records import Load
from tactile_resonance.fields import counted
from tactile_resonance.files import write_whole
from tactile_resonance.frf.distortion import decibel
from tactile_resonance.mechanics.indentation import Protocol
from tactile_resonance.poles.result import ellipse
from tactile_resonance.record import SIMULATED

if TYPE_CHECKING:  # what is drawn by one command needs libraries that others do without
    from tactile_resonance.analysis import Analysis
    from tactile_resonance.calibration.fit import Fitted
    from tactile_resonance.frf.distortion import DetectionLines, Distortion
    from tactile_resonance.frf.variance_analysis import NestedMeans
    from tactile_resonance.scan.tissue_tests import TissueTest
    from tactile_resonance.tissue.comparison import Clusters, Differences
    from tactile_resonance.tissue.spread import ReferencePoints, SmallestStep, TissueSpread
    from tactile_resonance.tissue.trial import ReliabilityBin

PROBABILITY = 0.95
"""With which an ellipse holds the truth."""
PAPER_STEP_PERCENT = 2.0
"""Gelatines that the paper's sensor separates and surgeons' fingers do not (arXiv 1805.00682)."""


def new_figure(width_in: float, height_in: float, title: str | None = None) -> Figure:
    """Figure that never opens a window."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    if title is not None:
        figure.suptitle(title)
    return figure


def figure_bytes(figure: Figure, suffix: str) -> bytes:
    """Content of the file; the suffix decides the format."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=suffix.lstrip(".").lower() or "png", dpi=150)
    return buffer.getvalue()


def save_figure(figure: Figure, path: Path) -> None:
    """Write the figure, whole or not at all."""
    write_whole(path, figure_bytes(figure, path.suffix))


def _draw_ellipse(
    axes: Axes,
    centre: npt.ArrayLike,
    covariance: FloatArray,
    **style: Any,
) -> None:
    """The ellipse of a covariance (2, 2) about a centre (2,)."""
    axes.plot(*(np.asarray(centre)[:, None] + ellipse(covariance, 100, PROBABILITY)), **style)


def draw_analysis(analysis: Analysis, title: str) -> Figure:
    """FRF with its standard deviation, the band with the model, the pole with its ellipse."""
    frf, poles = analysis.frf, analysis.poles
    simulated = f" ({SIMULATED})" if SIMULATED in analysis.warnings else ""
    figure = new_figure(12, 7.5, title + simulated)
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
                _draw_ellipse(
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
        for label, part in (("real", residual.real), ("imaginary", residual.imag)):
            own = np.sqrt(2) * part  # half of the variance is of either
            below.semilogx(frf.frequency_hz, own, ".", ms=1, label=label)
        mean = np.mean(np.abs(residual) ** 2)
        below.set_title(f"mean square {mean:.2f} of noise", fontsize="small")
        low, high = below.get_ylim()
        below.set(xlabel="frequency [Hz]", ylim=(min(low, -6), max(high, 6)))
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
        _dots(axes, lines.frequency_hz, lines.power, _parity_label(name, lines), 1.5, color=colour)
        if name == "even" and not np.all(np.isnan(lines.noise_power)):
            _dots(axes, lines.frequency_hz, lines.noise_power, "noise", 1.5, color="0.6")
    axes.legend(fontsize="small", markerscale=4, loc="lower left")
    axes.grid(alpha=0.3)


def _parity_label(name: str, lines: DetectionLines) -> str:
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
        axes.text(0.5, 0.5, "no two concentrations in the names", transform=axes.transAxes, ha="center")
        return
    ordered = ("noise", "force", "repetition", "position", "preparation")
    names = sorted({name for step in steps for name in step.one_block}, key=ordered.index)
    for k, step in enumerate(steps):
        of = f"{step.from_percent:g} to {step.to_percent:g} %"
        x = np.arange(len(names)) + 0.12 * (k - (len(steps) - 1) / 2)
        for values, marker, which in (
            (step.one_block, "o", "one block"),
            (step.limit, "_", "limit"),
        ):
            y = [values.get(name) or np.nan for name in names]
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
        measured = spread.noise + spread.force
        _draw_ellipse(axes, spread.mean, spread.covariance + measured, color=f"C{k}", lw=1)
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
        _draw_ellipse(
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
        _draw_test(over_time, over_depth, one, f"C{k % 10}", creep)
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


def _draw_test(over_time: Axes, over_depth: Axes, one: TissueTest, colour: str, creep: bool) -> None:
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
