# SPDX-License-Identifier: Apache-2.0
"""The pole map as rviz shows it: a cloud with a named field per figure, few markers, a legend."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from tactile_resonance.nodes.conversions import POLES_STATUS
from tactile_resonance.scan.colour_scale import colours, shares
from tactile_resonance.scan.pole_map import EllipseScale, MapSurface, PoleMap

FloatArray = npt.NDArray[np.float64]
NO_CLASS = 255  # of the field tissue_class: none called, or unknown
_TYPES = {"<f4": PointField.FLOAT32, "|u1": PointField.UINT8}
POINT = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "f0_hz", "damping_ratio", "f0_std_hz")]
    + [(name, "<f4") for name in ("damping_std", "force_n", "tissue_probability")]
    + [("tissue_class", "u1"), ("status", "u1"), ("_", "V2")]
)
SURFACE_POINT = np.dtype([(name, "<f4") for name in ("x", "y", "z", "f0_hz", "f0_std_hz")])
_BAR_STEPS = 32
_WHITE = (1.0, 1.0, 1.0)
_FAILED = (1.0, 0.15, 0.1)


def cloud_message(pole_map: PoleMap, names: tuple[str, ...], header: Header) -> PointCloud2:
    """Cloud of all points with a pole; those that failed are markers.

    A point without a value would spoil the range over which rviz spreads its colours.

    Parameters
    ----------
    names : tuple of str
        Tissue classes: the field ``tissue_class`` is the index into them, `NO_CLASS` for none.
    """
    points = pole_map.estimated
    table = np.zeros(len(points), POINT)
    for row, p in zip(table, points, strict=True):
        row["x"], row["y"], row["z"] = p.position_m
        row["f0_hz"], row["damping_ratio"] = p.estimate
        row["f0_std_hz"], row["damping_std"] = p.std
        row["force_n"], row["tissue_probability"] = p.force_n, p.tissue_probability
        known = p.tissue_class in names
        row["tissue_class"] = names.index(p.tissue_class) if known else NO_CLASS
        row["status"] = POLES_STATUS[p.status]
    return _cloud(table, header)


def surface_message(surface: MapSurface | None, header: Header) -> PointCloud2:
    """Cloud of the kriged surface; empty where there is none."""
    if surface is None:
        return _cloud(np.zeros(0, SURFACE_POINT), header)
    table = np.zeros(surface.f0_hz.size, SURFACE_POINT)
    for k, name in enumerate("xyz"):
        table[name] = surface.position_m[..., k].ravel()
    table["f0_hz"], table["f0_std_hz"] = surface.f0_hz.ravel(), surface.f0_std_hz.ravel()
    return _cloud(table, header)


def marker_message(
    pole_map: PoleMap, scale: EllipseScale, probability: float, header: Header
) -> MarkerArray:
    """Two markers: the ellipses of all points, crosses where a point failed."""
    ellipses = _marker(header, "ellipses", 0, Marker.LINE_LIST)
    width_m = _line_width(pole_map)
    ellipses.scale.x = width_m
    lines = pole_map.ellipses(scale, probability)  # (e, segments, 2, 3)
    ellipses.points = _points(lines.reshape(-1, 3))
    if len(lines):
        own = shares([point.estimate[0] for point in pole_map.with_ellipse], pole_map.f0_hz)
        repeated = np.repeat(colours(own), lines[0].size // 3, axis=0)
        ellipses.colors = [_colour(rgb) for rgb in repeated]
    crosses = _marker(header, "failures", 0, Marker.LINE_LIST)
    crosses.scale.x = 2 * width_m
    arm_m = 0.2 * _spacing(pole_map)
    arms = arm_m * np.array([[-1, -1, 0], [1, 1, 0], [-1, 1, 0], [1, -1, 0]])
    ends = [point.position_m + arms for point in pole_map.failures]
    crosses.points = _points(np.array(ends).reshape(-1, 3))
    crosses.color = _colour(_FAILED)
    markers = [m if m.points else _deleted(m) for m in (ellipses, crosses)]
    return MarkerArray(markers=markers)


def legend_message(
    pole_map: PoleMap,
    scale: EllipseScale,
    probability: float,
    names: tuple[str, ...],
    header: Header,
) -> MarkerArray:
    """Colour bar with its ends and middle, the scale of the ellipses, counts, beside the map."""
    if not pole_map.estimated:
        everything = _marker(header, "", 0, Marker.CUBE)
        everything.action = Marker.DELETEALL
        return MarkerArray(markers=[everything])
    low, high = pole_map.positions_m.min(axis=0), pole_map.positions_m.max(axis=0)
    size_m = max(float(np.max(high - low)), 4 * _spacing(pole_map))
    corner = np.array(
        [high[0] + 0.12 * size_m, (low[1] + high[1] - size_m) / 2, (low[2] + high[2]) / 2]
    )
    text_m = 0.05 * size_m
    bar = _marker(header, "legend", 0, Marker.TRIANGLE_LIST)
    bar.scale.x = bar.scale.y = bar.scale.z = 1.0
    corners, rgb = _bar(corner, 0.06 * size_m, size_m)
    bar.points, bar.colors = _points(corners), [_colour(c) for c in rgb]
    f0 = pole_map.f0_hz
    markers = [bar]

    def write(text: str, right: float, up: float) -> None:
        marker = _marker(header, "legend", len(markers), Marker.TEXT_VIEW_FACING)
        marker.text, marker.scale.z, marker.color = text, text_m, _colour(_WHITE)
        at = corner + [right * size_m, up * size_m, 0.0]
        marker.pose.position = Point(x=float(at[0]), y=float(at[1]), z=float(at[2]))
        markers.append(marker)

    for share in (0.0, 0.5, 1.0):
        write(f"{f0.min() + share * np.ptp(f0):.2f} Hz", 0.17, share)
    write("natural frequency f0", 0.12, 1.09)
    text = legend_text(pole_map, scale, probability, names)
    # a text hangs about its middle
    write(text, 0.12, -0.06 - 0.03 * (text.count("\n") + 1))
    return MarkerArray(markers=markers)


def legend_text(
    pole_map: PoleMap, scale: EllipseScale, probability: float, names: tuple[str, ...]
) -> str:
    """What the lines mean, and how many points there are, by tissue class with its number in the cloud."""
    lines = [
        f"ellipses: {100 * probability:g} %",
        f"x: 1 mm = {1e-3 / scale.m_per_hz:.2g} Hz of f0",
        f"y: 1 mm = {1e-3 / scale.m_per_damping:.2g} of damping ratio",
        f"{len(pole_map.estimated)} points, {len(pole_map.failures)} failed",
    ]
    for name in pole_map.classes():
        number = names.index(name) if name in names else NO_CLASS
        count = sum(point.tissue_class == name for point in pole_map.estimated)
        lines.append(f"class {number}, {name}: {count}")
    if pole_map.simulated:
        lines.append("simulated, not measured")
    return "\n".join(lines)


def header_message(frame_id: str, stamp: Time) -> Header:
    """Header of everything that shows one state of the map."""
    return Header(frame_id=frame_id, stamp=stamp)


def _cloud(table: np.ndarray, header: Header) -> PointCloud2:
    fields = [
        PointField(name=name, offset=offset, datatype=_TYPES[kind.str], count=1)
        for name, (kind, offset, *_) in (table.dtype.fields or {}).items()
        if kind.str in _TYPES
    ]
    return PointCloud2(
        header=header,
        height=1,
        width=len(table),
        fields=fields,
        is_bigendian=False,
        point_step=table.dtype.itemsize,
        row_step=table.nbytes,
        data=table.tobytes(),
        is_dense=True,
    )


def _marker(header: Header, namespace: str, number: int, kind: int) -> Marker:
    marker = Marker(header=header, ns=namespace, id=number, type=kind, action=Marker.ADD)
    marker.pose.orientation.w = 1.0
    marker.color = _colour(_WHITE)
    return marker


def _deleted(marker: Marker) -> Marker:
    """Remove instead: rviz complains of lists without points."""
    marker.action = Marker.DELETE
    return marker


def _bar(corner: FloatArray, width_m: float, height_m: float) -> tuple[FloatArray, FloatArray]:
    """Corners (6 steps, 3) and colours of the triangles of an upright bar."""
    edges = np.linspace(0, 1, _BAR_STEPS + 1)
    corners, rgb = [], []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        square = [(0, low), (1, low), (1, high), (0, low), (1, high), (0, high)]
        corners += [corner + [x * width_m, y * height_m, 0.0] for x, y in square]
        rgb += list(colours([y for _, y in square]))
    return np.array(corners), np.array(rgb)


def _spacing(pole_map: PoleMap) -> float:
    return pole_map.spacing_m if np.isfinite(pole_map.spacing_m) else 0.005


def _line_width(pole_map: PoleMap) -> float:
    return 0.03 * _spacing(pole_map)


def _points(positions: FloatArray) -> list[Point]:
    return [Point(x=x, y=y, z=z) for x, y, z in positions.tolist()]


def _colour(rgb: npt.ArrayLike) -> ColorRGBA:
    r, g, b = (float(v) for v in np.asarray(rgb))
    return ColorRGBA(r=r, g=g, b=b, a=1.0)
