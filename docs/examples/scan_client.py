# SPDX-License-Identifier: Apache-2.0
"""A node that asks for six points, and steers the scan by how far it is."""

import sys

import rclpy
from geometry_msgs.msg import Point, Pose
from rclpy.node import Node

from tactile_resonance.client import TactileClient


class Palpation(Node):
    def __init__(self):
        super().__init__("palpation")
        self.tactile = TactileClient(self)
        steps = (self.tactile.pause, self.repeat, self.tactile.skip, self.tactile.cancel)
        self.steps = dict(enumerate(steps, 1))  # by the number of finished points

    def start(self):
        places = [Pose(position=Point(x=0.003 * k)) for k in range(6)]  # +z out of the tissue
        return self.tactile.scan(
            poses=places, frame="table", force_n=0.012, f0_std_hz=0.1,
            on_feedback=self.on_feedback, on_point=self.on_point,
        )  # fmt: skip

    def on_feedback(self, feedback):
        self.steps.pop(feedback.finished, lambda: None)()

    def repeat(self):  # the last point, for the scan is paused
        self.tactile.repeat().add_done_callback(lambda _: self.tactile.resume())

    def on_point(self, point):  # also references in air, and what is skipped or discarded
        if point.kind == point.KIND_TISSUE and point.outcome == point.OUTCOME_DONE:
            print(f"{point.label}: {point.f0_hz:.2f} +- {point.f0_std_hz:.2f} Hz")


rclpy.init()
node = Palpation()
future = node.start()  # in a coroutine: outcome = await node.start()
rclpy.spin_until_future_complete(node, future)
outcome = future.result()
print(f"{outcome.ending.value}: {outcome.done} of {outcome.points} points; {outcome.message}")
print(outcome.run_directory, file=sys.stderr)
