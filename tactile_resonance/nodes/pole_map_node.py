# SPDX-License-Identifier: Apache-2.0
"""Results of points, or poles -> map for rviz."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rclpy.parameter import Parameter as RosParameter
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from tactile_resonance import msg
from tactile_resonance.configuration import shared_file
from tactile_resonance.fields import build, counted, numbers, require
from tactile_resonance.nodes.frames import BROADCAST_TF, TipBroadcaster
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.parameters import Fixed, Parameter, pose_of, values
from tactile_resonance.nodes.running import LATCHED, POINT_RESULTS, POLES
from tactile_resonance.recording.messages import poles_from_message
from tactile_resonance.scan.level_set import Boundary, LevelSet
from tactile_resonance.scan.map_messages import (
    boundary_markers,
    cloud_message,
    legend_message,
    marker_message,
    restamp,
    surface_message,
)
from tactile_resonance.scan.messages import header_message, to_cdr
from tactile_resonance.scan.point_outcome import with_poles
from tactile_resonance.scan.point_result import PointOutcome, PointResult, from_message
from tactile_resonance.scan.pole_map import EllipseScale, GrowingMap, MapPoint, PoleMap, counts
from tactile_resonance.scan.scene import read_scan_scene
from tactile_resonance.tissue.classify import TissueClass
from tactile_resonance.tissue.nominal_contact import NominalContact
from tactile_resonance.tissue.references import read_classes

PARAMETERS = (
    Fixed(
        "source",
        "point_result",
        "What is on the map: the points of tissue that a scan accepts (point_result), or the latest poles "
        "of every place, whoever measured them and whatever for (poles).",
        choices=("point_result", "poles"),
    ),
    Fixed(
        "frame_id",
        "",
        "Frame of the map; poles in another one than this and base_frame are left out. Empty: that of the "
        "first poles.",
    ),
    Fixed("base_frame", "base", "Frame of the robot's base."),
    Fixed(
        "table_in_base",
        [0.0] * 6,
        "Pose of frame_id in base_frame, position [m] and rotation vector [rad], that of scan_node: where "
        "frame_id is given, poles in base_frame are shown in it.",
    ),
    Fixed("tip_frame", "tip", "Frame of the tip that is broadcast."),
    BROADCAST_TF,
    Fixed(
        "classes_file",
        "",
        "YAML file with tissue_classes and their nominal_contact, a scene for example; empty: no tissue is "
        "called.",
    ),
    Fixed(
        "unknown_level",
        0.01,
        "A pole farther from every class than this share of its members is unknown.",
        1e-9,
        0.5,
    ),
    Parameter(
        "ellipse_probability",
        0.95,
        "How often an ellipse holds the true pole.",
        0.1,
        0.9999,
    ),
    Parameter(
        "ellipse_m_per_hz",
        0.0,
        "Length of 1 Hz of f0 in an ellipse [m]; 0: as fits the map.",
        0.0,
        1e3,
    ),
    Parameter(
        "ellipse_m_per_damping",
        0.0,
        "Length of 1 of the damping ratio in an ellipse [m]; 0: as fits the map.",
        0.0,
        1e6,
    ),
    Fixed(
        "band",
        1,
        "Of measurements in several bands the one that is mapped, in the order of the scene; tissue is "
        "called from the first only.",
        1,
        100,
    ),
    Fixed(
        "boundary_f0_hz",
        [0.0, 0.0],
        "The boundary of what lies between two frequencies [Hz] is drawn, with the band that holds it (95 %); "
        "0: none on that side, both: no boundary.",
    ),
    Fixed(
        "adaptive_scene",
        "",
        "Scene with adaptive positions whose boundary is drawn as its scan finds it; empty: boundary_f0_hz.",
    ),
    Parameter("surface_cells", 40, "Cells along the longer side of the surface.", 4, 200),
)

# Poles may come faster than anybody looks.
PUBLISH_PERIOD_S = 0.2
BUSY_SHARE = 0.1
"""Of its time that the node draws at most: messages of 10 000 points take seconds."""
# rviz drops a cloud whose frame it does not know yet, and the markers of what is switched off.
REPEAT_PERIOD_S = 1.5


class PoleMapNode(ManagedNode):
    """Keeps the latest result or poles of every place, and shows them to whoever looks.

    `pole_map` (PointCloud2), `pole_map/markers` (95 % ellipses, failures, a boundary), `pole_map/legend` and
    `pole_map/surface` are latched; each is made when there is something new and somebody subscribed, at the
    latest when somebody does, and repeated while somebody is.
    """

    # diagnostics ask for them from the beginning
    _grown = GrowingMap()
    _unplaced = GrowingMap()  # points that failed before they had poles, at an unknown place
    _left_out = 0

    def __init__(self) -> None:
        super().__init__("pole_map_node", PARAMETERS)

    def configure(self) -> None:
        """Topics, classes and an empty map."""
        (self._frame_id, classes_file) = values(self, "frame_id", "classes_file")
        (base_frame, table) = values(self, "base_frame", "table_in_base")
        self._table = pose_of(table, "table_in_base")
        # poles in it are shown in frame_id
        self._moved_frame = base_frame if self._frame_id not in ("", base_frame) else None
        self._classes: tuple[TissueClass, ...] = ()
        self._nominal: NominalContact | None = None
        if classes_file:
            self._classes, self._nominal = read_classes(Path(classes_file))
        low, high = numbers(list(values(self, "boundary_f0_hz")[0]), "boundary_f0_hz", 2)
        ends = low or -math.inf, high or math.inf
        wanted = build(LevelSet, "boundary_f0_hz", *ends) if low or high else None
        (scene,) = values(self, "adaptive_scene")
        self._boundary_of = _boundary_of(wanted, scene)
        self._grown, self._unplaced = GrowingMap(), GrowingMap()
        self._left_out = 0
        kinds = {"": PointCloud2} | dict.fromkeys(("/markers", "/legend", "/surface"), MarkerArray)
        self._old: set[str] = set()  # outputs that show less than is known
        self._shown: dict[str, Any] = {}  # messages of rosbags
        self._pause = self.steady_timer(PUBLISH_PERIOD_S, self._on_pause_over)
        self._pause.cancel()
        self.resources.callback(self.destroy_timer, self._pause)
        self._publishers_of = {
            name: self.publish_on(kind, f"pole_map{name}", LATCHED, lambda _: self._show())
            for name, kind in kinds.items()
        }
        # heard from the configuration on: what came before comes right after it, and only then
        (source,) = values(self, "source")
        kind, callback, qos = {
            "point_result": (msg.PointResult, self._on_result, POINT_RESULTS),
            "poles": (msg.Poles, self._on_poles, POLES),
        }[source]
        self.listen(kind, source, callback, qos, always=True)
        self.add_post_set_parameters_callback(self._on_parameters)
        self.resources.callback(self.remove_post_set_parameters_callback, self._on_parameters)
        TipBroadcaster(self, *values(self, "tip_frame"))
        self.serve_trigger("pole_map/clear", self._clear)
        # the frame may be known from now on only
        self.every(REPEAT_PERIOD_S, lambda: self._show(repeat=True))

    def activate(self) -> None:
        """Soon show what was heard since the configuration."""
        self._pause.reset()

    def details(self) -> Mapping[str, str]:
        """For the diagnostics."""
        return {
            "points": str(len(self._grown.map.estimated)),
            "failures": str(len(self._grown.map.failures) + len(self._unplaced)),
            "left out": str(self._left_out),
        }

    def _on_poles(self, message: msg.Poles) -> None:
        point = self._point(message)
        if point is not None:
            self._grown.add(point)
            self._renew()

    def _on_result(self, message: msg.PointResult) -> None:
        """The latest result of a point of tissue that is not discarded replaces what was there before."""
        try:
            result = from_message(message)
        except ValueError as error:
            self._leave_out(f"result of measurement {message.measurement_id}: {error}")
            return
        if not counts(result):
            return
        self._grown.clear(result)
        self._unplaced.clear(result)
        if result.outcome is PointOutcome.FAILED and not message.poles:
            self._unplaced.add(MapPoint.planned(result))
        if result.outcome is not PointOutcome.SKIPPED and message.poles:
            point = self._point(message.poles[0], result)
            if point is not None:
                self._grown.add(point)
        self._renew()

    def _point(self, message: msg.Poles, result: PointResult | None = None) -> MapPoint | None:
        """Where poles lie on the map; None where they do not, with the reason in the diagnostics.

        Without the result of a scan the place of the tip distinguishes them.
        """
        try:
            poles, origin = poles_from_message(message)
            (level, band) = values(self, "unknown_level", "band")
            if band > len(poles.bands):
                raise ValueError(f"band: {band}; there are poles of {len(poles.bands)} only")
            frame_id = origin.contact.frame_id
            if result is None:
                x_m, y_m, z_m = origin.contact.position_m or (math.nan,) * 3
                result = PointResult(0, x_m=x_m, y_m=y_m, z_m=z_m, frame_id=frame_id)
            result = with_poles(
                result,
                poles.bands[band - 1],
                origin,
                self._classes if band == 1 else (),
                level,
                self._nominal,
            )
            point = MapPoint.of_tip(result, origin)
            if not self._frame_id:
                self._frame_id = frame_id
            if frame_id == self._moved_frame:
                point = point.seen_from(self._table.position_m, self._table.rotation)
                frame_id = self._frame_id
            if frame_id != self._frame_id:
                raise ValueError(
                    f"frame of tip_pose: got {frame_id!r}; accepted is {self._frame_id!r}"
                )
        except ValueError as error:
            self._leave_out(f"poles of measurement {message.measurement_id}: {error}")
            return None
        return point

    def _leave_out(self, reason: str) -> None:
        self._left_out += 1
        self.health.error(reason)

    def _on_parameters(self, _: Sequence[RosParameter]) -> None:
        """Draw anew: parameters that are not fixed say how, and the legend states them."""
        self._renew()

    def _clear(self) -> str:
        cleared, self._grown, self._unplaced = len(self._grown), GrowingMap(), GrowingMap()
        self._renew()
        return f"{counted(cleared, 'point')} cleared"

    def _renew(self) -> None:
        """Show the map, which is another than before."""
        self._old = set(self._publishers_of)
        self._show()

    def _show(self, *, repeat: bool = False) -> None:
        """Publish what is new and read, at once; after the pause where something was just published.

        With `repeat` publish what is not new once more, dated now.
        """
        if not (self.active and self._pause.is_canceled()):
            return
        read = {name for name, each in self._publishers_of.items() if each.get_subscription_count()}
        new = read & self._old
        again = (read - new) & set(self._shown) if repeat else set()
        if not (new or again):
            return
        begun_s = time.monotonic()
        self._make(new)
        for name in again:
            restamp(self._shown[name], self.ros_now_ns())
        for name in new | again:
            self._publishers_of[name].publish(to_cdr(self._shown[name]))
        pause_s = max(PUBLISH_PERIOD_S, (time.monotonic() - begun_s) / BUSY_SHARE)
        self._pause.timer_period_ns = round(1e9 * pause_s)
        self._pause.reset()

    def _on_pause_over(self) -> None:
        self._pause.cancel()
        self._show()

    def _make(self, names: set[str]) -> None:
        """Make messages of the map as it is."""
        (probability, cells) = values(self, "ellipse_probability", "surface_cells")
        header = header_message(self._frame_id, self.ros_now_ns())
        pole_map = self._grown.map
        scale = self._scale(pole_map, probability)
        tissues = tuple(tissue.name for tissue in self._classes)

        def markers() -> Any:
            beside: Sequence[Any] = ()
            if self._boundary_of is not None:
                beside = boundary_markers(pole_map, self._boundary_of(pole_map), header)
            return marker_message(pole_map, scale, probability, header, beside)

        makers: dict[str, Callable[[], Any]] = {
            "": lambda: cloud_message(pole_map, tissues, header),
            "/markers": markers,
            "/legend": lambda: legend_message(
                pole_map, scale, probability, tissues, header, len(self._unplaced)
            ),
            "/surface": lambda: surface_message(pole_map, cells, header),
        }
        for name in names:
            self._shown[name] = makers[name]()
        self._old -= names

    def _scale(self, pole_map: PoleMap, probability: float) -> EllipseScale:
        m_per_hz, m_per_damping = values(self, "ellipse_m_per_hz", "ellipse_m_per_damping")
        fitting = pole_map.ellipse_scale(probability)
        return EllipseScale(m_per_hz or fitting.m_per_hz, m_per_damping or fitting.m_per_damping)


def _boundary_of(
    wanted: LevelSet | None, scene: str
) -> Callable[[PoleMap], Boundary | None] | None:
    """What finds the boundary on a map; None where none is asked for."""
    if not scene:
        return None if wanted is None else (lambda pole_map: pole_map.boundary(wanted))
    where = "adaptive_scene"
    require(wanted is None, where, scene, "empty where boundary_f0_hz is given")
    adaptive = read_scan_scene(shared_file(Path(scene), "config/scenes")).adaptive
    if adaptive is None or not isinstance(adaptive.wanted, LevelSet):
        accepted = "a scene with adaptive positions that look for a boundary or a tissue"
        raise ValueError(f"{where}: got {scene}; accepted is {accepted}")
    return lambda pole_map: adaptive.boundary(pole_map.placed)


main = PoleMapNode.run
