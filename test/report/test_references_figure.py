# SPDX-License-Identifier: Apache-2.0
"""Figure of references: where points of a tissue are said to be."""

from dataclasses import replace

import numpy as np
from scipy import stats
from tissue.reference_points import NOISE, SOURCES, drawn

from tactile_resonance.report.drawing import draw_poles, new_figure
from tactile_resonance.tissue.spread import spreads_of


def test_ellipses_hold_what_force_adds_to_each_point():
    """Of points that scatter mostly by their force the ellipse reaches as far as their deviation says."""
    points = drawn(np.random.default_rng(1), [(1,) * 4] * 100, SOURCES, 400 * NOISE)
    points = replace(points, measured=points.measured / 200)
    spreads = spreads_of(points)
    axes = new_figure(5, 5).subplots()
    draw_poles(axes, points, spreads)
    dots, line = (np.asarray(each.get_xydata()) for each in axes.lines)
    assert len(dots) == 400
    middle = (line.max(axis=0) + line.min(axis=0)) / 2
    reach = np.sqrt(stats.chi2.ppf(0.95, 2))
    std = (line.max(axis=0) - line.min(axis=0)) / 2 / reach
    np.testing.assert_allclose(middle, spreads[0].mean, rtol=1e-3)
    np.testing.assert_allclose(std, np.std(dots, axis=0), rtol=0.15)
