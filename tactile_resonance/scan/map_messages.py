# SPDX-License-Identifier: Apache-2.0
"""The pole map as rviz and Foxglove show it: a cloud with a named field per figure, few markers, a legend.

Messages are those of rosbags, see `scan.messages.make_message`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import counted
from tactile_resonance.recording.messages import POLES_STATUS, write_header
from tactile_resonance.scan.level_set import Boundary
from tactile_resonance.scan.messages import make_message, message_types
from tactile_resonance.scan.pole_map import EllipseScale, PoleMap, colours, shares

NO_CLASS = 255  # of the field tissue_class: none called, or unknown
NO_STATUS = 255  # of the field status: unknown, as of results of earlier versions
CLOUD, MARKERS = "sensor_msgs/msg/PointCloud2", "visualization_msgs/msg/MarkerArray"
_FIELD, _MARKER = "sensor_msgs/msg/PointField", "visualization_msgs/msg/Marker"
Message = Any  # of rosbags
POINT = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "f0_hz", "damping_ratio", "f0_std_hz")]
    + [(name, "<f4") for name in ("damping_std", "force_n", "tissue_probability")]
    + [("tissue_class", "u1"), ("status", "u1"), ("_", "V2")]
)
_STATUS = {status.value: number for status, number in POLES_STATUS.items()}
_BAR_STEPS = 32
_SURFACE_ALPHA = 0.35  # points and ellipses, of the same colours, stand out
# In sizes of the map: widths of lines, of the bar and the gap beside it, of the legend's texts.
_LINE = 0.004
_GAP = 0.05
_TEXTS = 0.6
_CHARACTER = 0.45  # width over height in rviz's texts, mean: that of figures in Liberation Sans
_WHITE = (1.0, 1.0, 1.0)
_FAILED = (1.0, 0.15, 0.1)


def cloud_message(pole_map: PoleMap, names: tuple[str, ...], header: Message) -> Message:
    """Cloud of all points with a pole; those that failed are markers.

    A point without a value would spoil the range over which rviz spreads its colours.

    Parameters
    ----------
    names : tuple of str
        Tissue classes: the field ``tissue_class`` is the index into them, `NO_CLASS` for none.
    """
    number = {name: k for k, name in enumerate(names)}
    rows = []
    for point in pole_map.estimated:
        found = point.result
        figures = found.f0_hz, found.damping_ratio, found.f0_std_hz, found.damping_ratio_std
        called = number.get(found.tissue_class, NO_CLASS)
        status = _STATUS.get(found.poles_status, NO_STATUS)
        of_contact = found.force_n, found.tissue_probability
        rows.append((*point.position_m, *figures, *of_contact, called, status, b""))
    field: Any = message_types().types[_FIELD]
    types = {"<f4": field.FLOAT32, "|u1": field.UINT8}
    fields = [
        field(name=name, offset=offset, datatype=types[kind.str], count=1)
        for name, (kind, offset, *_) in (POINT.fields or {}).items()
        if kind.str in types
    ]
    table = np.array(rows, POINT)
    return make_message(
        CLOUD,
        header=header,
        height=1,
        width=len(table),
        fields=fields,
        point_step=POINT.itemsize,
        row_step=table.nbytes,
        data=table.view(np.uint8).ravel(),
        is_dense=True,
    )


def surface_message(pole_map: PoleMap, cells: int, header: Message) -> Message:
    """The kriged surface as triangles in the colours of the legend."""
    surface = pole_map.surface(cells)
    sheet = _marker(header, "surface", 0, "TRIANGLE_LIST")
    if surface is None:
        return make_message(MARKERS, markers=[_deleted(sheet)])
    below = surface.position_m - [0.0, 0.0, _LINE * pole_map.size_m]  # where it hides no ellipse
    _lay(sheet, below, shares(surface.f0_hz, pole_map.f0_hz), _SURFACE_ALPHA)
    return make_message(MARKERS, markers=[sheet])


def marker_message(
    pole_map: PoleMap,
    scale: EllipseScale,
    probability: float,
    header: Message,
    beside: Sequence[Message] = (),
) -> Message:
    """Markers: ellipses of all points, crosses where one failed, what lies beside them: `boundary_markers`."""
    ellipses = _marker(header, "ellipses", 0, "LINE_LIST")
    crosses = _marker(header, "failures", 0, "LINE_LIST")
    if pole_map.estimated:
        ellipses.scale.x = _LINE * pole_map.size_m
        begun = pole_map.ellipses(scale, probability)[:, :, 0]  # (e, segments, 3)
        corners = _points(begun.reshape(-1, 3))  # each begins one line and ends another
        first = np.arange(len(corners)).reshape(begun.shape[:2])
        ends = np.stack([first, np.roll(first, -1, axis=1)], axis=-1)  # (e, segments, 2)
        ellipses.points = [corners[k] for k in ends.ravel().tolist()]
        own = shares([point.result.f0_hz for point in pole_map.with_ellipse], pole_map.f0_hz)
        each = 2 * begun.shape[1]
        ellipses.colors = [rgba for rgba in _colours(colours(own)) for _ in range(each)]
    if pole_map.failures:
        crosses.scale.x = 2 * _LINE * pole_map.size_m
        arms = np.array([[-1, -1, 0], [1, 1, 0], [-1, 1, 0], [1, -1, 0]])
        crossed = [p.position_m + 0.2 * pole_map.spacing_m * arms for p in pole_map.failures]
        crosses.points = _points(np.array(crossed).reshape(-1, 3))
        (crosses.color,) = _colours([_FAILED])
    markers = [ellipses, crosses, *beside]
    return make_message(MARKERS, markers=[m if m.points else _deleted(m) for m in markers])


def boundary_markers(
    pole_map: PoleMap, boundary: Boundary | None, header: Message
) -> list[Message]:
    """Outline of a boundary on a map, and the band that holds it; both empty where none is known."""
    outline, band = (_marker(header, "boundary", k, "LINE_LIST") for k in range(2))
    (band.color,) = _colours([_WHITE], 0.5)
    if boundary is not None:
        z = float(np.median(pole_map.positions_m[:, 2]))
        for marker, lines, width in (
            (outline, boundary.outline_m, 3 * _LINE),
            (band, (*boundary.inner_m, *boundary.outer_m), _LINE),
        ):
            marker.scale.x = width * pole_map.size_m
            for line in lines:
                ends = np.column_stack([line, np.full(len(line), z)])
                marker.points += _points(np.stack([ends[:-1], ends[1:]], axis=1).reshape(-1, 3))
    return [outline, band]


def legend_message(
    pole_map: PoleMap,
    scale: EllipseScale,
    probability: float,
    names: tuple[str, ...],
    header: Message,
    unplaced: int = 0,
) -> Message:
    """Right of the map and as high as it is long: colour bar, its figures, and beside them the lines.

    With the map it is little more than twice as wide as high. Each line is a marker: the distance at which
    rviz sets the lines of one text does not follow their height.

    Parameters
    ----------
    unplaced : int
        Points that failed at an unknown place: they count, and have no cross.
    """
    everything = _marker(header, "", 0, "CUBE")
    everything.action = everything.DELETEALL  # there may be fewer lines than before
    if not pole_map.estimated:
        return make_message(MARKERS, markers=[everything])
    f0, size_m = pole_map.f0_hz, pole_map.size_m
    ticks = [f"{f0.min() + share * np.ptp(f0):.2f} Hz" for share in (0.0, 0.5, 1.0)]
    lines = legend_lines(pole_map, scale, probability, names, unplaced)
    tick_width, line_width = (_CHARACTER * max(map(len, texts)) for texts in (ticks, lines))
    text_m = size_m * min(_TEXTS / line_width, 0.6 / len(lines))
    low, high = pole_map.positions_m.min(axis=0), pole_map.positions_m.max(axis=0)
    # of the bar, beside the ellipses; points in free air, far above the tissue, do not lift it
    x = float(high[0]) + 0.4 * pole_map.spacing_m + _GAP * size_m
    y = float(low[1] + high[1] - size_m) / 2
    z = float(np.median(pole_map.positions_m[:, 2]))

    bar = _marker(header, "legend", 0, "TRIANGLE_LIST")
    across, up = np.meshgrid([0.0, _GAP], np.linspace(0, 1, _BAR_STEPS + 1))
    corners = np.stack([x + size_m * across, y + size_m * up, np.full_like(up, z)], axis=-1)
    _lay(bar, corners, up)  # (steps + 1, 2)
    markers = [everything, bar]

    def write(text: str, middle_m: float, height_m: float) -> None:
        marker = _marker(header, "legend", len(markers), "TEXT_VIEW_FACING")
        marker.text, marker.scale.z = text, text_m
        marker.scale.x = 0.6 * text_m  # of spaces; rviz's own is for texts 1 m high
        (marker.pose.position,) = _points(np.array([[middle_m, height_m, z]]))
        markers.append(marker)

    # rviz hangs a text about its middle
    left_m = x + 1.5 * _GAP * size_m
    for k, text in enumerate(ticks):
        write(text, left_m + tick_width * text_m / 2, y + k * size_m / 2)
    left_m += tick_width * text_m + 0.5 * _GAP * size_m
    for k, text in enumerate(lines):
        write(text, left_m + line_width * text_m / 2, y + size_m - 1.6 * k * text_m)
    return make_message(MARKERS, markers=markers)


def legend_lines(
    pole_map: PoleMap,
    scale: EllipseScale,
    probability: float,
    names: tuple[str, ...],
    unplaced: int = 0,
) -> list[str]:
    """What is drawn, and how many points there are, by tissue class with its number in the cloud."""
    lines = [
        "colour: natural frequency f0",
        f"ellipses: {100 * probability:g} %",
        f"x: 1 mm = {1e-3 / scale.m_per_hz:.2g} Hz of f0",
        f"y: 1 mm = {1e-3 / scale.m_per_damping:.2g} of damping ratio",
        f"{counted(len(pole_map.estimated), 'point')}, {len(pole_map.failures) + unplaced} failed",
    ]
    for name in pole_map.classes():
        number = names.index(name) if name in names else NO_CLASS
        count = sum(point.result.tissue_class == name for point in pole_map.estimated)
        lines.append(f"class {number}, {name}: {count}")
    if pole_map.simulated:
        lines.append("simulated, not measured")
    return lines


def restamp(message: Message, time_ns: int) -> None:
    """Set all stamps of a message."""
    for part in getattr(message, "markers", [message]):
        write_header(part.header, time_ns, part.header.frame_id)


def _marker(header: Message, namespace: str, number: int, kind: str) -> Message:
    # locked: rviz tries again as soon as it knows the frame
    marker = make_message(_MARKER, header=header, ns=namespace, id=number, frame_locked=True)
    marker.type, marker.action = getattr(marker, kind), marker.ADD
    marker.pose.orientation.w = 1.0
    (marker.color,) = _colours([_WHITE])
    return marker


def _deleted(marker: Message) -> Message:
    """Remove instead: rviz complains of lists without points."""
    marker.action = marker.DELETE
    return marker


def _lay(marker: Message, positions_m: FloatArray, share: FloatArray, alpha: float = 1.0) -> None:
    """Triangles between positions (r, c, 3), in the colours of shares (r, c)."""
    corner = np.arange(share.size).reshape(share.shape)
    a, b = corner[:-1, :-1], corner[:-1, 1:]  # of each cell, round about it
    c, d = corner[1:, 1:], corner[1:, :-1]
    faces = np.stack([a, b, c, a, c, d], axis=-1).ravel()
    marker.scale.x = marker.scale.y = marker.scale.z = 1.0
    corners = _points(positions_m.reshape(-1, 3))
    rgba = _colours(colours(share.ravel()), alpha)
    marker.points = [corners[k] for k in faces]
    marker.colors = [rgba[k] for k in faces]


def _points(positions: FloatArray) -> list[Message]:
    """Of places (n, 3)."""
    make = message_types().types["geometry_msgs/msg/Point"]
    return [*map(make, *positions.T.tolist())]


def _colours(rgb: npt.ArrayLike, alpha: float = 1.0) -> list[Message]:
    """Of red, green and blue (n, 3)."""
    make = message_types().types["std_msgs/msg/ColorRGBA"]
    return [make(*each, alpha) for each in zip(*np.asarray(rgb, float).T.tolist(), strict=True)]
