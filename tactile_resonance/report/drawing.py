# SPDX-License-Identifier: Apache-2.0
"""What the figures share: ellipses, saving, the mark on simulated results."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tactile_resonance._typing import FloatArray
from tactile_resonance.files import write_whole
from tactile_resonance.poles.result import ellipse

SIMULATED = "simulated, not measured"
PROBABILITY = 0.95
"""With which an ellipse holds the truth."""


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


def draw_ellipse(
    axes: Axes,
    centre: npt.ArrayLike,
    covariance: FloatArray,
    **style: Any,
) -> None:
    """The ellipse of a covariance (2, 2) about a centre (2,)."""
    axes.plot(*(np.asarray(centre)[:, None] + ellipse(covariance, 100, PROBABILITY)), **style)
