# SPDX-License-Identifier: Apache-2.0
"""Table, file and figure of poles measured at several points on several phantoms."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from tactile_resonance.frf.result import FRF
from tactile_resonance.identification.result import Poles
from tactile_resonance.record import Origin
from tactile_resonance.report.drawing import SIMULATED, decibel, draw_ellipse, new_figure

COLUMNS = (
    *("phantom", "point", "x_m", "y_m", "force_n", "f0_hz", "f0_std_hz", "f0_true_hz"),
    *("damping_ratio", "damping_ratio_std", "damping_ratio_true", "pole_real_rad_s"),
    *("pole_imag_rad_s", "cost", "expected_cost", "status", "measurement_id", "method"),
)


@dataclass(frozen=True)
class MeasuredPoint:
    """One point of one phantom: what was estimated and what the simulation knows.

    Attributes
    ----------
    phantom : str
    point : int
        Index within the phantom.
    origin : Origin
    frf : FRF
    poles : Poles
        With exactly one mode, where the status says so.
    true_f0_hz, true_damping_ratio : float
        NaN where there is no truth.
    """

    phantom: str
    point: int
    origin: Origin
    frf: FRF
    poles: Poles
    true_f0_hz: float
    true_damping_ratio: float

    @property
    def estimate(self) -> np.ndarray:
        """(2,) f0 [Hz] and damping ratio; NaN where there is no single mode."""
        if self.poles.f0_hz.size != 1:
            return np.full(2, np.nan)
        return np.array([self.poles.f0_hz[0], self.poles.damping_ratio[0]])

    @property
    def covariance(self) -> np.ndarray:
        """(2, 2) total where known, else noise; NaN where neither."""
        for covariance in (self.poles.total_covariance, self.poles.covariance):
            if covariance is not None and len(covariance) == 1:
                return covariance[0]
        return np.full((2, 2), np.nan)

    @property
    def std(self) -> np.ndarray:
        """(2,) of f0 and damping ratio."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def truth(self) -> np.ndarray:
        """(2,) f0 and damping ratio."""
        return np.array([self.true_f0_hz, self.true_damping_ratio])

    @property
    def error_in_std(self) -> np.ndarray:
        """(2,) estimate minus truth, in standard deviations."""
        return (self.estimate - self.truth) / self.std


def by_phantom(points: Sequence[MeasuredPoint]) -> dict[str, list[MeasuredPoint]]:
    """Points of each phantom, in order of first appearance."""
    groups: dict[str, list[MeasuredPoint]] = {}
    for point in points:
        groups.setdefault(point.phantom, []).append(point)
    return groups


def as_csv(points: Sequence[MeasuredPoint]) -> str:
    """One line a point; numbers with all their digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for p in points:
        x_m, y_m = (p.origin.contact.position_m or (np.nan, np.nan, np.nan))[:2]
        pole = p.poles.poles_rad_s[0] if p.poles.f0_hz.size == 1 else complex(np.nan, np.nan)
        numbers = [
            *(x_m, y_m, p.origin.contact.force_n),
            *(p.estimate[0], p.std[0], p.true_f0_hz),
            *(p.estimate[1], p.std[1], p.true_damping_ratio),
            *(pole.real, pole.imag, p.poles.cost, p.poles.expected_cost),
        ]
        writer.writerow(
            [p.phantom, p.point, *(repr(float(x)) for x in numbers)]
            + [p.poles.status.value, p.origin.measurement_id, p.poles.method]
        )
    return text.getvalue()


def as_table(points: Sequence[MeasuredPoint]) -> str:
    """Per phantom: mean over its points, stated and observed spread, truth, error.

    The stated standard deviation is that of one point (root mean square over the points), the spread that
    of the estimates over the points; the error is that of the mean, in standard deviations of the mean, and
    the worst that of any one point.
    """
    head = (
        "phantom          points  quantity             mean      stated std   spread       "
        "truth          error/std   worst point"
    )
    lines = [head, "-" * len(head)]
    for name, group in by_phantom(points).items():
        estimates = np.array([p.estimate for p in group])  # (n, 2)
        stds = np.sqrt(np.mean([p.std**2 for p in group], axis=0))
        mean = estimates.mean(axis=0)
        spread = estimates.std(axis=0, ddof=1) if len(group) > 1 else np.full(2, np.nan)
        truth = group[0].truth
        error = (mean - truth) / (stds / np.sqrt(len(group)))
        worst = np.max(np.abs([p.error_in_std for p in group]), axis=0)
        for k, (quantity, digits) in enumerate((("f0 [Hz]", 4), ("damping ratio", 6))):
            lead = f"{name:<16} {len(group):>6}" if k == 0 else " " * 23
            lines.append(
                f"{lead}  {quantity:<14} {mean[k]:>11.{digits}f}  {stds[k]:>11.2g}  "
                f"{'-' if len(group) == 1 else f'{spread[k]:.2g}':>9}  {truth[k]:>12.{digits}f}  "
                f"{error[k]:>11.2f}  {worst[k]:>11.2f}"
            )
    methods = sorted({p.poles.method for p in points})
    lines.append(f"method: {', '.join(methods)}")
    return "\n".join(lines)


def draw_phantoms(points: Sequence[MeasuredPoint], band_hz: tuple[float, float]) -> Figure:
    """In the manner of figure 8 of arXiv 1805.00682: FRFs, zoom on the mode, poles with 95 % ellipses."""
    groups = by_phantom(points)
    figure = new_figure(17, 9)
    mark = f" ({SIMULATED})" if any(p.origin.simulated for p in points) else ""
    figure.suptitle(f"Frequency response and poles of {len(groups)} phantoms{mark}")
    grid = figure.add_gridspec(2 * len(groups), 3, width_ratios=(1, 0.9, 0.5))
    whole = figure.add_subplot(grid[: len(groups), 0])
    zoom = figure.add_subplot(grid[len(groups) :, 0])
    plane = figure.add_subplot(grid[:, 1])
    for k, (name, group) in enumerate(groups.items()):
        colour = f"C{k}"
        frf = group[0].frf
        level = decibel(np.abs(frf.g) ** 2)
        whole.semilogx(frf.frequency_hz, level, color=colour, lw=0.8, label=name)
        inside = frf.band(*band_hz)
        zoom.plot(
            inside.frequency_hz, decibel(np.abs(inside.g) ** 2), ".-", ms=3, lw=0.8, color=colour
        )
        from_the_highest = len(groups) - 1 - k
        close = figure.add_subplot(grid[2 * from_the_highest : 2 * from_the_highest + 2, 2])
        close.set_title(f"{name}, magnified", fontsize="small", color=colour)
        close.tick_params(labelsize="x-small")
        close.xaxis.set_major_locator(MaxNLocator(4))
        close.ticklabel_format(useOffset=False)
        for axes in (plane, close):
            _draw_poles(axes, group, colour)
    plane.plot([], [], "k+", ms=10, label="truth of the simulation")
    whole.set(xlabel="frequency [Hz]", ylabel="|U_sensor / U_actuator| [dB]", title="whole band")
    zoom.set(xlabel="frequency [Hz]", ylabel="[dB]", title="band of the fit")
    plane.set(xlabel="f0 [Hz]", ylabel="damping ratio", title="poles with 95 % ellipses")
    whole.legend(fontsize="small")
    plane.legend(loc="upper left")
    return figure


def _draw_poles(axes: Axes, group: Sequence[MeasuredPoint], colour: str) -> None:
    for p in group:
        axes.plot(*p.estimate, ".", ms=3, color=colour)
        if np.all(np.isfinite(p.covariance)):
            draw_ellipse(axes, p.estimate, p.covariance, color=colour, lw=0.7)
    axes.plot(*group[0].truth, "k+", ms=10)
