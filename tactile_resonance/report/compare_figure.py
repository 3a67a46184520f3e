# SPDX-License-Identifier: Apache-2.0
"""Figure of what differs on a map: places and poles, by group."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from tactile_resonance.report.drawing import SIMULATED, draw_ellipse, new_figure
from tactile_resonance.tissue.clusters import Clusters
from tactile_resonance.tissue.differences import Differences

FloatArray = npt.NDArray[np.float64]


def draw_comparison(
    position_m: FloatArray,
    estimates: FloatArray,
    covariances: FloatArray,
    found: Differences,
    groups: Clusters,
    simulated: bool,
) -> Figure:
    """Places (n, 2) [m], poles (n, 2) of covariances (n, 2, 2), and the criterion over the number of groups."""
    figure = new_figure(15, 5)
    places, poles, criterion = figure.subplots(1, 3, width_ratios=(2, 2, 1))
    figure.suptitle("What differs" + (f", {SIMULATED}" if simulated else ""))
    of_point, differs = groups.of_point, found.differs
    for k in range(len(groups.mean)):
        own = of_point == k
        label = f"group {k + 1}: {int(own.sum())} points"
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
