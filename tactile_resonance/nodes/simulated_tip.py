# SPDX-License-Identifier: Apache-2.0
"""What the tip of the simulated sensor touches: as goals or poses put it, or as the simulated robot has it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped

from tactile_resonance.nodes.ideal_contact import IdealContact, Stay, Stays
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import pose_to_message
from tactile_resonance.nodes.parameters import pose_of, values
from tactile_resonance.nodes.plant_child import PlantChild
from tactile_resonance.nodes.running import PLACES, STREAM
from tactile_resonance.nodes.stop_input import StopInput
from tactile_resonance.nodes.truth_topic import TruthTopic
from tactile_resonance.record import Contact
from tactile_resonance.simulation.plant.tabletop import LaidScene
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.sensor.bimorph import parts_of
from tactile_resonance.simulation.sensor.changing_contact import BenchTip, ContactState
from tactile_resonance.simulation.tissue.scene import PhantomScene
from tactile_resonance.srv import ForceOver

PLANT_CHECK_S = 0.5
CLEAR_M = 0.05  # above the table: where an ideal contact's tip is before its first goal


class SimulatedTip:
    """The tip as it is now, published on `bench/truth` whenever it is moved.

    Parameters
    ----------
    node : ManagedNode
        fake_hardware_node, whose topics and services of contact they are, until it is cleaned up.
    bench : SimulatedBench
    scene : PhantomScene
    plant : PlantChild or None
        None: contact is ideal, by goals where the node's parameter says so, else where `tcp_pose` states.
    now_ns : callable
        ROS time now [ns].
    stop : StopInput or None
        Of the goals.

    Attributes
    ----------
    tip : BenchTip
    stays : Stays
    truth : TruthTopic
    stalls : int
        How often the simulated robot stood still.
    """

    def __init__(
        self,
        node: ManagedNode,
        bench: SimulatedBench,
        scene: PhantomScene,
        plant: PlantChild | None,
        now_ns: Callable[[], int],
        stop: StopInput | None,
    ) -> None:
        self._node, self._bench, self._scene, self.plant = node, bench, scene, plant
        self._now_ns = now_ns
        table, self._frame_id, base_frame = values(node, "table_in_base", "frame_id", "base_frame")
        self._laid = LaidScene(scene, pose_of(table, "table_in_base"))
        self.tip, self.stays, self.stalls = BenchTip(None, 0.0, 1.0), Stays(), 0
        self.truth = TruthTopic(node, bench, self._frame_id)
        self._contact: IdealContact | None = None
        if plant is not None:
            node.every(PLANT_CHECK_S, self._check_plant)
            return
        if stop is not None:
            table = self._laid.table
            x, y, z = (table.position_m + table.rotation.apply([0.0, 0.0, CLEAR_M])).tolist()
            place = Contact(position_m=(x, y, z), frame_id=base_frame)
            self.stays.add(Stay(0, 0.0, pose_to_message(place)))
            self._contact = IdealContact(
                node,
                self.stays,
                self._found_at,
                self._placed,
                now_ns,
                stop,
                base_frame,
                self._frame_id,
            )
        else:
            self._wrench = node.publish_on(WrenchStamped, "wrench", STREAM)
            # a scan waits until the pose is received, which needs a reliable subscription; others publish
            node.listen(PoseStamped, "tcp_pose", self._on_pose, PLACES)
            node.listen(PoseStamped, "tcp_pose", self._on_pose, STREAM)
        node.serve(ForceOver, "force_over", self.stays.serve)

    def draw_back(self) -> None:
        """Lift the tip off, where goals put it."""
        if self._contact is not None:
            self._contact.draw_back()

    def at(self, place_m: tuple[float, float, float]) -> BenchTip:
        """A tip at a place of the scene, at the scene's force."""
        return BenchTip(self._scene.tissue_at(place_m), self._scene.force_n, 1.0)

    def take_up(self) -> None:
        """With a robot: the contact as it is now, and its truth; raises ValueError."""
        if self.plant is None:
            return
        try:
            true = self.plant.truth()
        except OSError as error:
            raise ValueError(f"the simulated robot does not answer: {error}") from error
        self.stalls = true.stalls
        touching = true.force_n > 0
        tissue = self._laid.tissue_at(true.site_m) if touching else None
        tip = BenchTip(tissue, true.force_n, true.since_s or 1.0)
        if touching:
            tip = replace(tip, contact_radius_m=true.contact_radius_m, depth_m=true.depth_m)
        x, y, z = true.tip_m.tolist()
        place = Contact(position_m=(x, y, z), frame_id="base", time_ns=self._now_ns())
        self._plant_ahead_s = true.time_s - place.time_ns * 1e-9
        self.stays.add(Stay(place.time_ns, true.force_n, pose_to_message(place)))
        self._put(tip)

    def contact_over(self, from_ns: int, to_ns: int) -> list[ContactState | None]:
        """The contact over an interval, as fine as the sensor follows it; unchanged where the plant ended."""
        assert self.plant is not None
        from_s, to_s = (ns * 1e-9 + self._plant_ahead_s for ns in (from_ns, to_ns))
        parts = parts_of(to_s - from_s)
        try:
            return self.plant.contact_over(from_s, to_s, parts)
        except OSError:
            return [None] * parts

    def _put(self, tip: BenchTip) -> None:
        self.tip = tip
        self.truth.publish(self.stays.newest.pose, tip)

    def _found_at(self, place_m: np.ndarray, force_n: float) -> tuple[float, float] | None:
        """Depth that brings a force at a place in the base, and height of the surface above that place."""
        tissue = self._laid.tissue_at(place_m)
        if tissue is None:
            return None
        contact = BenchTip(tissue, force_n, 1.0).coupled(self._bench).contact
        assert contact is not None
        height_m, _ = self._laid.surface().height_of(place_m)
        return float(contact.indentation_m), -float(height_m)

    def _placed(self) -> None:
        """The tip has been put somewhere by a goal."""
        stay = self.stays.newest
        point = stay.pose.pose.position
        tissue = self._laid.tissue_at(np.array([point.x, point.y, point.z]))
        self._put(BenchTip(tissue if stay.force_n else None, stay.force_n, 1.0))

    def _on_pose(self, message: PoseStamped) -> None:
        if message == self.stays.newest.pose:
            return
        position = message.pose.position
        tip = self.at((position.x, position.y, position.z))
        tip = tip if tip.tissue else replace(tip, force_n=0.0)
        self.stays.add(Stay(self._now_ns(), tip.force_n, message))
        wrench = WrenchStamped()
        wrench.header.stamp = message.header.stamp
        wrench.header.frame_id = self._frame_id
        wrench.wrench.force.z = tip.force_n
        self._wrench.publish(wrench)
        self._put(tip)

    def _check_plant(self) -> None:
        if self.plant is not None and not self.plant.alive:
            self._node.fail("the simulated robot has ended; restarting it")
