# SPDX-License-Identifier: Apache-2.0
"""What the tip of the simulated sensor touches: as goals or poses put it, or as the simulated robot has it.

The robot is a process of its own (`PlantChild`).
The true poles there are on the topic `bench/truth` and behind the service `bench/get_truth`.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, WrenchStamped

from tactile_resonance import msg
from tactile_resonance.contact.force_spread import joined_spread
from tactile_resonance.contact.vectors import Vector, vector
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import (
    poles_to_message,
    pose_to_message,
    time_message,
    write_force_over,
)
from tactile_resonance.nodes.parameters import pose_of, values
from tactile_resonance.nodes.running import PLACES, STREAM, TRUTHS
from tactile_resonance.poles.result import Poles, PolesStatus
from tactile_resonance.processes import may_take_priority, start_child
from tactile_resonance.record import Contact, ForceSpread, Origin
from tactile_resonance.recording.messages import (
    contact_from_message,
    fill,
    fill_complex,
    time_from_message,
)
from tactile_resonance.simulation.plant.defaults import MOST_STEPS, PRIORITY, READY, order
from tactile_resonance.simulation.sensor.bench import BenchTip, ContactState, SimulatedBench
from tactile_resonance.simulation.sensor.bimorph import CoupledBimorph, parts_of
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.simulation.tissue.scene import LaidScene, PhantomScene
from tactile_resonance.srv import ForceOver
from tactile_resonance.srv import Truth as TruthService

START_WITHIN_S = 90.0
ANSWER_WITHIN_S = 10.0
END_WITHIN_S = 3.0
PLANT_CHECK_S = 0.5
MOST_STAYS = 1000


class PlantChild:
    """Starts `tactile_resonance simulate-ur`, with tissue and load cell, as a process that ends with its owner.

    Parameters
    ----------
    host : str
        Address of the robot, 127.x.y.z.
    scene : Path
    table_in_base : six numbers
    seed : int
    simulated_time : bool
        Its time goes on as those who take part in it let it; else that of the wall clock.

    Raises
    ------
    ValueError
        If it does not come up; with what it printed.
    """

    def __init__(
        self,
        host: str,
        scene: Path,
        table_in_base: Sequence[float],
        seed: int,
        simulated_time: bool,
    ) -> None:
        self._host = host
        pace = ["--priority", str(PRIORITY if may_take_priority(PRIORITY) else 0)]
        command = [
            *(sys.executable, "-m", "tactile_resonance.cli", "simulate-ur", "--host", host),
            *("--scene", str(scene), "--seed", str(seed % 2**31), "--table"),
            *(str(float(value)) for value in table_in_base),
            *(["--simulated-time"] if simulated_time else pace),
        ]
        self._process = start_child(command, stdout=subprocess.PIPE)
        assert self._process.stdout is not None
        out, said, deadline = self._process.stdout.fileno(), "", time.monotonic() + START_WITHIN_S
        while time.monotonic() < deadline:
            if not select.select([out], [], [], 0.1)[0]:
                continue
            read = os.read(out, 1 << 16)  # all lines that have come: select sees none that a reader holds back
            if not read:  # it has ended
                break
            said += read.decode(errors="replace")
            if any(line.startswith(READY) for line in said.splitlines()):
                return
        self.close()
        raise ValueError(
            f"robot_host: no simulated robot at {host}: {' '.join(said.split()) or 'no output'}"
        )

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def ask(self, what: str, **arguments: object) -> dict[str, Any]:
        """Answer of its control port; ``OSError`` where none comes."""
        return order(self._host, what, timeout_s=ANSWER_WITHIN_S, **arguments)

    def close(self) -> None:
        """End the process."""
        with self._process:  # which closes its pipe
            self._process.terminate()
            try:
                self._process.wait(END_WITHIN_S)
            except subprocess.TimeoutExpired:
                self._process.kill()


@dataclass(frozen=True)
class Stay:
    """The tip somewhere, from a time on.

    Attributes
    ----------
    since_ns : int
        ROS time [ns].
    force_n : float
        0 in air.
    pose : PoseStamped
        With an empty frame where it is unknown.
    """

    since_ns: int
    force_n: float
    pose: PoseStamped

    def pose_at(self, time_ns: int) -> PoseStamped:
        """The pose, stamped with a ROS time [ns]."""
        stamped = PoseStamped(pose=self.pose.pose)
        stamped.header.frame_id, stamped.header.stamp = self.pose.header.frame_id, time_message(time_ns)
        return stamped


class Stays:
    """Where the tip was and how hard it pressed, and what follows for an interval."""

    def __init__(self) -> None:
        self._stays: deque[Stay] = deque([Stay(0, 0.0, PoseStamped())], maxlen=MOST_STAYS)

    @property
    def newest(self) -> Stay:
        """The present one."""
        return self._stays[-1]

    def add(self, stay: Stay) -> None:
        """The tip is somewhere else from now on."""
        self._stays.append(stay)

    def serve(self, request: ForceOver.Request, response: ForceOver.Response) -> ForceOver.Response:
        """The force over an interval, as the service `force_over` answers."""
        start_ns, end_ns = time_from_message(request.start), time_from_message(request.end)
        if not start_ns < end_ns:
            return write_force_over(response, "the interval is empty")
        spans: list[tuple[float, float]] = []  # length [ns], force
        until_ns = end_ns
        for stay in reversed(self._stays):
            span_ns = max(0, until_ns - max(start_ns, stay.since_ns))
            if span_ns:
                spans.append((span_ns, stay.force_n))
                response.tip_pose = stay.pose_at((start_ns + end_ns) // 2)
            until_ns = min(until_ns, stay.since_ns)
        seen_ns = sum(span_ns for span_ns, _ in spans)
        response.coverage = seen_ns / (end_ns - start_ns)
        if until_ns > start_ns:
            text = f"the block begins before what is kept, {MOST_STAYS} places"
            return write_force_over(response, text)
        mean_n = sum(span_ns * force_n for span_ns, force_n in spans) / seen_ns
        spread = joined_spread([(f, ForceSpread(0.0, f, f), span_ns) for span_ns, f in spans])
        return write_force_over(response, "", mean_n, 0.0, spread)


class SimulatedTip:
    """The tip as it is now, published on `bench/truth` whenever it is moved.

    Parameters
    ----------
    node : ManagedNode
        fake_hardware_node, whose topics and services of contact they are, until it is cleaned up.
    bench : SimulatedBench
    scene : PhantomScene
    plant : PlantChild or None
        None: contact is ideal, and the tip where it is placed, or where `tcp_pose` states.
    now_ns : callable
        ROS time now [ns].

    Attributes
    ----------
    tip : BenchTip
    ball_radius_m : float
    stays : Stays
    stalls : int
        How often the simulated robot stood still.
    truths : publisher
        Of `truth_message`.
    """

    def __init__(
        self,
        node: ManagedNode,
        bench: SimulatedBench,
        scene: PhantomScene,
        plant: PlantChild | None,
        now_ns: Callable[[], int],
    ) -> None:
        self._node, self._bench, self._scene, self.plant = node, bench, scene, plant
        self.now_ns, self.ball_radius_m = now_ns, bench.sensor.tip.radius_m
        names = "table_in_base", "frame_id", "base_frame"
        table, self.frame_id, self._base_frame = values(node, *names)
        self._laid = LaidScene(scene, pose_of(table, "table_in_base"))
        self.tip, self.stays, self.stalls = BenchTip(None, 0.0, 1.0), Stays(), 0
        self._touched_ns: int | None = None  # of an ideal contact, which creeps from then on
        self._in_scene = False  # whether `tcp_pose` is in the frame of the scene, and not in the base
        self.truths = node.publish_on(msg.Poles, "bench/truth", TRUTHS)
        if plant is not None:
            node.every(PLANT_CHECK_S, self._check_plant)
        else:
            node.serve(ForceOver, "force_over", self.stays.serve)

    def follow_poses(self) -> None:
        """Be where `tcp_pose` states, in the frame of the scene, and publish the force there on `wrench`."""
        self._in_scene = True
        self._wrench = self._node.publish_on(WrenchStamped, "wrench", STREAM)
        # a scan waits until the pose is received, which needs a reliable subscription; others publish
        self._node.listen(PoseStamped, "tcp_pose", self._on_pose, PLACES)
        self._node.listen(PoseStamped, "tcp_pose", self._on_pose, STREAM)

    def above_table(self, height_m: float) -> Vector:
        """Place in the base above the origin of the table [m]."""
        table = self._laid.table
        return vector(table.position_m + table.rotation.apply([0.0, 0.0, height_m]))

    def at(self, place_m: tuple[float, float, float]) -> BenchTip:
        """A tip at a place in the frame of `tcp_pose` [m], at the scene's force."""
        scene, place = self._scene, np.array(place_m)
        tissue = scene.tissue_at(place) if self._in_scene else self._laid.tissue_at(place)
        return BenchTip(tissue, scene.force_n, 1.0)

    @property
    def creeps(self) -> bool:
        """Whether time changes a contact: a robot holds the tip, or it is ideal and of known age."""
        return self.plant is not None or self._touched_ns is not None

    def take_up(self) -> BenchTip:
        """Return the tip as it is now; with a robot that is its truth from now on; raises ValueError."""
        if self.plant is None:
            return replace(self.tip, since_s=self._since_s(self.now_ns()))
        try:
            true = self.plant.ask("truth")
        except OSError as error:
            raise ValueError(f"the simulated robot does not answer: {error}") from error
        self.stalls, force_n = true["stalls"], true["normal_force_n"]
        tip = BenchTip(None, force_n, true["contact_s"] or 1.0)
        if force_n > 0:
            tissue = self._laid.tissue_at(np.array(true["site_m"] or true["tip_m"]))
            if tissue is None or tissue.name != true["tissue"]:  # another was placed there by an order
                tissue = read_tissues()[true["tissue"]]
            tip = replace(
                tip,
                tissue=tissue,
                contact_radius_m=true["contact_radius_m"],
                depth_m=true["depth_m"],
            )
        x, y, z = true["tip_m"]
        place = Contact(position_m=(x, y, z), frame_id=self._base_frame, time_ns=self.now_ns())
        self._plant_ahead_s = true["time_s"] - place.time_ns * 1e-9
        self._put(Stay(place.time_ns, force_n, pose_to_message(place)), tip)
        return tip

    def contact_over(self, from_ns: int, to_ns: int) -> list[ContactState | None]:
        """The contact over an interval, as fine as the sensor follows it; over more than 10 s it is coarser.

        None where the plant ended: the contact stays as it was.
        """
        assert self.plant is not None
        from_s, to_s = (ns * 1e-9 + self._plant_ahead_s for ns in (from_ns, to_ns))
        parts = min(parts_of(to_s - from_s), MOST_STEPS)
        try:
            answer = self.plant.ask("contact_over", after_s=from_s, until_s=to_s, parts=parts)
        except OSError:
            return [None] * parts
        names = ("normal_force_n", "contact_radius_m", "depth_m")
        rows = zip(*(answer[name] for name in names), strict=True)
        return [None if row[0] is None else row for row in rows]

    def _put(self, stay: Stay, tip: BenchTip) -> None:
        self.stays.add(stay)
        self.tip = tip
        coupled = [tip.coupled(self._bench)]
        self.truths.publish(truth_message(stay.pose, tip, coupled, 0, self.frame_id))

    def found_at(self, place_m: np.ndarray, force_n: float) -> tuple[float, float] | None:
        """Depth [m] that brings a force [N] at a place (3,) in the base [m], and the surface's height above it.

        None where nothing is to be touched.
        """
        tissue = self._laid.tissue_at(place_m)
        if tissue is None:
            return None
        contact = BenchTip(tissue, force_n, 1.0).coupled(self._bench).contact
        assert contact is not None
        height_m, _ = self._laid.surface().height_of(place_m)
        return float(contact.indentation_m), -float(height_m)

    def place(self, stay: Stay, touched_ns: int | None = None) -> None:
        """Put the tip somewhere, on what it has touched since a ROS time [ns]; in air where its force is 0."""
        stay = replace(stay, pose=stay.pose_at(stay.since_ns))
        point = stay.pose.pose.position
        tissue = self._laid.tissue_at(np.array([point.x, point.y, point.z]))
        self._touched_ns = touched_ns
        tip = BenchTip(tissue if stay.force_n else None, stay.force_n, self._since_s(stay.since_ns))
        self._put(stay, tip)

    def _since_s(self, now_ns: int) -> float:
        """Age of contact at a ROS time [s]: of unknown age 1 s; above 0, also on a clock that was set back."""
        touched_ns = self._touched_ns
        return 1.0 if touched_ns is None else max(0.002, (now_ns - touched_ns) * 1e-9)

    def _on_pose(self, message: PoseStamped) -> None:
        if message == self.stays.newest.pose:
            return
        position = message.pose.position
        tip = self.at((position.x, position.y, position.z))
        tip = tip if tip.tissue else replace(tip, force_n=0.0)
        self._wrench.publish(pressing(tip.force_n, message.header.stamp, self.frame_id))
        self._put(Stay(self.now_ns(), tip.force_n, message), tip)

    def _check_plant(self) -> None:
        if self.plant is not None and not self.plant.alive:
            self._node.fail("the simulated robot has ended; restarting it")


def truth_message(
    pose: PoseStamped,
    tip: BenchTip,
    coupled: Sequence[CoupledBimorph],
    measurement_id: int,
    frame_id: str,
) -> msg.Poles:
    """Exact modes of a tip at a pose and its time.

    Parameters
    ----------
    pose : PoseStamped
    tip : BenchTip
    coupled : sequence of CoupledBimorph
        The tip as it is, or a contact that changes, in equal parts: modes and force are means over them, as an
        estimate has them.
    measurement_id : int
        Of the measurement whose poles they are; 0: of none.
    frame_id : str
        Of the tip.
    """
    modes = [each.modes for each in coupled]
    forces_n = [each.contact.force_n if each.contact else 0.0 for each in coupled]

    def mean(name: str) -> npt.NDArray:
        return np.mean([[getattr(mode, name) for mode in at] for at in modes], axis=0)

    truth = Poles(
        poles_rad_s=mean("pole_rad_s"),
        f0_hz=mean("f0_hz"),
        damping_ratio=mean("damping_ratio"),
        residues=mean("residue_rad_s"),
        method="simulation",
        status=PolesStatus.TRUTH,
        message="exact poles of the simulated sensor on this tissue",
    )
    origin = Origin(
        measurement_id=measurement_id,
        time_ns=time_from_message(pose.header.stamp),
        final=True,
        frame_id=frame_id,
        label=tip.tissue.name if tip.tissue else "air",
        simulated=True,
        contact=replace(
            contact_from_message(pose, float(np.mean(forces_n)), 0.0),
            spread=ForceSpread(float(np.std(forces_n)), min(forces_n), max(forces_n)),
        ),
    )
    return poles_to_message(truth, origin)


def truth_to_response(
    truth: CoupledBimorph, frequency_hz: Sequence[float], response: TruthService.Response
) -> None:
    """Fill the answer of `bench/get_truth`, with the response at frequencies (F,) [Hz]."""
    response.success = True
    response.feedthrough = float(truth.sensor.feedthrough)
    fill_complex(response, "pole_", truth.poles_rad_s, "_rad_s")
    fill_complex(response, "residue_", truth.residues_rad_s, "_rad_s")
    fill(response.f0_hz, [mode.f0_hz for mode in truth.modes])
    fill(response.damping_ratio, [mode.damping_ratio for mode in truth.modes])
    frequency = np.asarray(frequency_hz, dtype=float)
    fill_complex(response, "response_", truth.frequency_response(frequency))
    contact = truth.contact
    if contact is not None:
        response.tissue = contact.tissue.name
        response.force_n = contact.force_n
        response.contact_radius_m = contact.contact_radius_m
        response.indentation_m = contact.indentation_m
        response.relaxation_modulus_1s_pa = contact.tissue.relaxation_modulus_1s_pa
        stiffness = contact.dynamic_stiffness(2j * np.pi * frequency)
        fill_complex(response, "stiffness_", stiffness, "_n_per_m")


def pressing(force_n: float, stamp: Time, frame_id: str) -> WrenchStamped:
    """Wrench of a force along the normal."""
    wrench = WrenchStamped()
    wrench.header.stamp, wrench.header.frame_id = stamp, frame_id
    wrench.wrench.force.z = force_n
    return wrench
