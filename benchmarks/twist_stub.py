# SPDX-License-Identifier: Apache-2.0
"""A stub of a twist controller as a node, in lockstep with who commands it; for benchmark and tests."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import rclpy
import yaml
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rosgraph_msgs.msg import Clock

from benchmarks.twist_controller import TwistController
from tactile_resonance.configuration import share_path
from tactile_resonance.contact.samples import Pose
from tactile_resonance.contact.vectors import quaternion_from_vector, vector
from tactile_resonance.nodes.messages import time_message
from tactile_resonance.nodes.running import COMMANDS, PLACES
from tactile_resonance.recording.messages import time_from_message
from tactile_resonance.sensor import read_sensor
from tactile_resonance.simulation.plant.contact_bench import ContactBench
from tactile_resonance.simulation.plant.defaults import TABLE_IN_BASE
from tactile_resonance.simulation.plant.surfaces import PlantSurface
from tactile_resonance.simulation.plant.tip import Tip
from tactile_resonance.simulation.sensor.bimorph import sensor_modes
from tactile_resonance.simulation.tissue.library import read_tissues

COMMAND_TOPIC, POSE_TOPIC, WRENCH_TOPIC = "twist_commands", "tool_pose", "tool_wrench"
CLEAR_M = 0.02
LATENCY_S = 0.002
"""A wrench of the bench's cell arrives, and is stamped, a period after it was measured [s]."""
CELL_HZ = 500.0


class TwistStub:
    """The node, spinning in a thread of its own; a context that ends it.

    Each step publishes wrench, pose and time, and waits for a command with that time as its stamp.

    Parameters
    ----------
    rate_hz : float

    Attributes
    ----------
    controller : TwistController
    poses : bool
        False: poses are not published, the rest goes on.
    commands : list of (float, tuple of 6 floats)
        Stamp [s] and twist of every command that was answered with a step.
    """

    def __init__(self, rate_hz: float) -> None:
        sensor = read_sensor()
        self._tissues = read_tissues()
        start = Pose.from_vector(np.array(TABLE_IN_BASE))
        bench = ContactBench(
            self._tissues["gel10"],
            PlantSurface(np.array(TABLE_IN_BASE[:3]), np.array([0.0, 0.0, 1.0])),
            Pose(start.position_m + [0.0, 0.0, CLEAR_M], start.rotation_rad),
            tip=Tip(sensor.tip.radius_m, sensor_modes(sensor)),
            seed=1,
        )
        self._plant = bench.plant
        self.controller = TwistController(bench, rate_hz)
        self.poses = True
        self.commands: list[tuple[float, tuple[float, ...]]] = []

    def place_tissue(self, name: str) -> None:
        """What the tip finds at its next new place."""
        tissue = self._tissues[name]
        self._plant.tissue_at = lambda _: tissue

    def __enter__(self) -> TwistStub:
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        node = self._node = rclpy.create_node("twist_stub", context=self._context)
        self._wrench = node.create_publisher(WrenchStamped, WRENCH_TOPIC, PLACES)
        self._pose = node.create_publisher(PoseStamped, POSE_TOPIC, PLACES)
        self._clock = node.create_publisher(Clock, "clock", PLACES)
        node.create_subscription(TwistStamped, COMMAND_TOPIC, self._on_command, COMMANDS)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            return

    def _on_command(self, message: TwistStamped) -> None:
        controller, twist = self.controller, message.twist
        stamp_ns = time_from_message(message.header.stamp)
        if stamp_ns not in (0, controller.time_ns):  # it knows of no step yet, or of the newest
            return
        parts = (twist.linear.x, twist.linear.y, twist.linear.z)
        parts += (twist.angular.x, twist.angular.y, twist.angular.z)
        controller.command(controller.time_ns, parts)
        self.commands.append((1e-9 * controller.time_ns, parts))
        controller.step()
        self._publish()

    def _publish(self) -> None:
        controller = self.controller
        stamp = time_message(controller.time_ns)
        for sample in controller.wrenches:
            wrench = WrenchStamped()
            wrench.header.stamp = time_message(sample.time_ns + round(1e9 * LATENCY_S))
            force, torque = wrench.wrench.force, wrench.wrench.torque
            force.x, force.y, force.z, torque.x, torque.y, torque.z = sample.wrench
            self._wrench.publish(wrench)
        if self.poses:
            pose = PoseStamped()
            pose.header.stamp, pose.header.frame_id = stamp, "base"
            place, turn = pose.pose.position, pose.pose.orientation
            place.x, place.y, place.z = vector(controller.pose.position_m)
            rotation = vector(controller.pose.rotation_rad)
            turn.x, turn.y, turn.z, turn.w = quaternion_from_vector(rotation)
            self._pose.publish(pose)
        self._clock.publish(Clock(clock=stamp))


def stub_parameters(folder: Path, rate_hz: float) -> dict[str, object]:
    """Parameters of a contact_node that commands the stub; its files go into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    robot = {"kind": "twist", "command_topic": COMMAND_TOPIC, "pose_topic": POSE_TOPIC}
    robot |= {"tip_in_tool": [0.0] * 6, "rate_hz": rate_hz, "lockstep": True}
    force = yaml.safe_load(share_path("config/force/topic.yaml").read_text(encoding="utf-8"))
    force |= {"topic": WRENCH_TOPIC, "rate_hz": CELL_HZ, "latency_s": LATENCY_S}
    force["frame"] = {"position_m": [0.0] * 3, "rotation_rad": [0.0] * 3}
    for name, content in (("robot", robot), ("force", force)):
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    return {
        "robot_config": str(folder / "robot.yaml"),
        "force_config": str(folder / "force.yaml"),
        "contact.period_s": 1 / rate_hz,
        "publish_rate_hz": 50.0,
    }
