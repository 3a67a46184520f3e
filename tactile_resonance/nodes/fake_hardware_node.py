# SPDX-License-Identifier: Apache-2.0
"""The simulated bench: plays excitations on the bimorph, in contact with whatever lies under the tip."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from std_srvs.srv import Trigger

from tactile_resonance import msg
from tactile_resonance.clock import PORT as TIME_PORT
from tactile_resonance.clock import ClockLostError, SimulatedClock
from tactile_resonance.configuration import share_path
from tactile_resonance.identification.result import Poles, PolesStatus
from tactile_resonance.multisine import Excitation
from tactile_resonance.nodes.bench_clock import BenchNow, BenchServer
from tactile_resonance.nodes.conversions import (
    contact_from_message,
    excitation_from_message,
    poles_to_message,
    pose_to_message,
    record_to_message,
    time_from_message,
    time_message,
    truth_to_response,
)
from tactile_resonance.nodes.ideal_contact import IdealContact, Stay, Stays
from tactile_resonance.nodes.managed_node import TIME_SERVER, ManagedNode
from tactile_resonance.nodes.parameters import Parameter, pose_of, values
from tactile_resonance.nodes.plant_child import PlantChild
from tactile_resonance.nodes.running import PLACES, RESULTS, STREAM, TRUTHS, run_node
from tactile_resonance.record import Channel, Contact, Origin, Record
from tactile_resonance.simulation.acquisition import BenchEffects, Block, ChannelSamples
from tactile_resonance.simulation.bench import SimulatedBench
from tactile_resonance.simulation.bench_run import BenchRun
from tactile_resonance.simulation.bench_tip import BenchTip
from tactile_resonance.simulation.library import read_tissues
from tactile_resonance.simulation.plant_defaults import TABLE_IN_BASE
from tactile_resonance.simulation.plant_process import LaidScene
from tactile_resonance.simulation.scene import read_scene
from tactile_resonance.simulation.truth import truth_of
from tactile_resonance.srv import ForceOver, Play, Truth

PARAMETERS = (
    Parameter(
        "scene",
        "config/scenes/gelatine_phantoms.yaml",
        "What lies on the table: a file, absolute or in the package's share folder.",
        read_only=True,
    ),
    Parameter(
        "robot_host",
        "",
        "Address 127.x.y.z at which a simulated robot with its load cell is started too; the tip is then "
        "where that robot holds it. Empty: ideal contact.",
        read_only=True,
    ),
    Parameter(
        "serve_contact",
        False,
        "Without a robot: serve make_contact and retract with ideal contact, as contact_node does; else the "
        "tip is wherever tcp_pose says.",
        read_only=True,
    ),
    Parameter(
        "table_in_base",
        [*TABLE_IN_BASE],
        "Frame of the scene in the robot's base: position [m] and rotation vector [rad].",
        read_only=True,
    ),
    TIME_SERVER,
    Parameter("seed", 1, "Seed of the simulated noise.", 1, 2**62),
    Parameter("noise", True, "Sensor noise."),
    Parameter("quantisation", True, "Converters that count and saturate."),
    Parameter("nonlinearity", False, "The sensor's static nonlinearity."),
    Parameter("frame_id", "tip", "Frame of the sensor's tip.", read_only=True),
    Parameter("base_frame", "base", "Frame of the robot's base, of all poses.", read_only=True),
)


PLANT_CHECK_S = 0.5
LEAST_HOLD_S = 0.1  # creep is given from here on; a contact that young is not measured


class FakeHardwareNode(ManagedNode):
    """Serves `bench/play`, `bench/stop` and `bench/get_truth`, hands out `bench/block`.

    With a robot the tip is where the robot holds it, and the contact that of the plant as an excitation
    begins: its force held from then on, the tissue creeping. Without one contact is ideal, at the scene's
    force or the one asked for: wherever `tcp_pose` says, or where the action `make_contact` puts the tip,
    which this node serves then; the force comes back on `wrench` and from the service `force_over`. What the
    simulation knows of the poles is on `bench/truth` (latched, all modes): under the tip as it is put
    somewhere or an excitation begins; of a contact that creeps also with each block. In simulated time it
    publishes `/clock`.
    """

    def __init__(self) -> None:
        super().__init__("fake_hardware_node", PARAMETERS)
        self._playing: threading.Thread | None = None
        self._stop = threading.Event()
        self._player_clock: SimulatedClock | None = None

    def configure(self) -> None:
        """Read the scene, make the sensor and, where it is asked for, the robot."""
        scene, self._frame_id = values(self, "scene", "frame_id")
        path = Path(scene)
        scene_path = path if path.is_absolute() else share_path(scene)
        self._scene = read_scene(read_tissues(), scene_path)
        self._bench = SimulatedBench.from_configuration()
        self._stays = Stays()
        self._tip = BenchTip(None, 0.0, 1.0)
        self._plant: PlantChild | None = None
        self._blocks = self.publish_on(msg.Record, "bench/block", RESULTS)
        self._truth = self.publish_on(msg.Poles, "bench/truth", TRUTHS)
        host, table, seed, serve = values(
            self, "robot_host", "table_in_base", "seed", "serve_contact"
        )
        self._laid = LaidScene(self._scene, pose_of(table, "table_in_base"))
        server = self.time_server
        if host:
            if server and server != f"{host}:{TIME_PORT}":
                raise ValueError(
                    f"time_server: {server!r}, the robot at {host} serves {host}:{TIME_PORT}"
                )
            self._plant = PlantChild(host, scene_path, table, seed, bool(server))
            self.resources.callback(self._plant.close)
            self.every(PLANT_CHECK_S, self._check_plant)
        elif server:
            self.resources.callback(BenchServer(server).close)
        self._now_ns = BenchNow(self, server)
        if not host:
            self._serve_ideal_contact(serve)
        self.serve(Play, "bench/play", self._on_play)
        self.serve(Trigger, "bench/stop", self._on_stop)
        self.serve(Truth, "bench/get_truth", self._on_truth)
        self._said_lines = 0
        self._stalls = 0

    def details(self) -> dict[str, str]:
        """How often the simulated robot stood still, as of the last measurement."""
        return {"simulator stalls": str(self._stalls)} if getattr(self, "_stalls", 0) else {}

    def deactivate(self) -> None:
        """Silence the output."""
        self._silence()

    def _serve_ideal_contact(self, by_action: bool) -> None:
        if by_action:
            base_frame, frame_id = values(self, "base_frame", "frame_id")
            IdealContact(
                self, self._stays, self._found_at, self._placed, self._now_ns, base_frame, frame_id
            )
        else:
            self._wrench = self.publish_on(WrenchStamped, "wrench", STREAM)
            # whoever puts the tip somewhere waits until it is heard; others may tell as they like
            self.listen(PoseStamped, "tcp_pose", self._on_pose, PLACES)
            self.listen(PoseStamped, "tcp_pose", self._on_pose, STREAM)
        self.serve(ForceOver, "force_over", self._stays.serve)

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
        stay = self._stays.newest
        point = stay.pose.pose.position
        tissue = self._laid.tissue_at(np.array([point.x, point.y, point.z]))
        self._put(BenchTip(tissue if stay.force_n else None, stay.force_n, 1.0), stay.pose)

    def _on_pose(self, message: PoseStamped) -> None:
        if message == self._stays.newest.pose:
            return
        position = message.pose.position
        tissue = self._scene.tissue_at((position.x, position.y, position.z))
        tip = BenchTip(tissue, self._scene.force_n if tissue else 0.0, 1.0)
        self._stays.add(Stay(self._now_ns(), tip.force_n, message))
        wrench = WrenchStamped()
        wrench.header.stamp = message.header.stamp
        wrench.header.frame_id = self._frame_id
        wrench.wrench.force.z = tip.force_n
        self._wrench.publish(wrench)
        self._put(tip, message)

    def _put(self, tip: BenchTip, pose: PoseStamped) -> None:
        self._tip = tip
        self._publish_truth(pose, tip)

    def _publish_truth(
        self,
        pose: PoseStamped,
        tip: BenchTip,
        measurement_id: int = 0,
        force_n: float | None = None,
    ) -> None:
        """Tell the exact modes of a tip; `force_n` where the force was another one on the mean."""
        modes = truth_of(tip.coupled(self._bench), ()).modes
        truth = Poles(
            poles_rad_s=np.array([mode.pole_rad_s for mode in modes]),
            f0_hz=np.array([mode.f0_hz for mode in modes]),
            damping_ratio=np.array([mode.damping_ratio for mode in modes]),
            residues=np.array([mode.residue_rad_s for mode in modes]),
            method="simulation",
            status=PolesStatus.TRUTH,
            message="exact poles of the simulated sensor on this tissue",
        )
        origin = Origin(
            measurement_id=measurement_id,
            time_ns=time_from_message(pose.header.stamp),
            final=True,
            frame_id=self._frame_id,
            label=tip.tissue.name if tip.tissue else "air",
            simulated=True,
            contact=contact_from_message(pose, tip.force_n if force_n is None else force_n, 0.0),
        )
        self._truth.publish(poles_to_message(truth, origin))

    def _check_plant(self) -> None:
        if self._plant is not None and not self._plant.alive:
            self.fail("the simulated robot has ended; starting it anew")

    def _take_up_contact(self) -> None:
        """With a robot: the contact as it is now, and its truth; raises ValueError."""
        if self._plant is None:
            return
        try:
            true = self._plant.truth()
        except OSError as error:
            raise ValueError(f"the simulated robot does not answer: {error}") from error
        self._stalls = true.stalls
        touching = true.force_n > 0
        tissue = self._laid.tissue_at(true.tip_m) if touching else None
        self._tip = BenchTip(tissue, true.force_n, max(true.since_s, LEAST_HOLD_S), creeping=True)
        x, y, z = true.tip_m.tolist()
        place = Contact(position_m=(x, y, z), frame_id="base", time_ns=self._now_ns())
        self._plant_ahead_s = true.time_s - place.time_ns * 1e-9
        self._stays.add(Stay(place.time_ns, true.force_n, pose_to_message(place)))
        self._publish_truth(self._stays.newest.pose, self._tip)

    def _on_play(self, request: Play.Request, response: Play.Response) -> Play.Response:
        if not self.active:
            response.message = f"fake_hardware_node is {self.state_name()}"
            return response
        try:
            excitation = excitation_from_message(request.excitation)
            effects = BenchEffects(
                **dict(
                    zip(
                        ("noise", "quantisation", "nonlinearity"),
                        values(self, "noise", "quantisation", "nonlinearity"),
                        strict=True,
                    )
                )
            )
            (seed,) = values(self, "seed")
            # noise repeats with the excitation's own seed, whatever was played before
            entropy = np.random.SeedSequence([seed, excitation.seed, excitation.realisation])
            self._take_up_contact()
            run = self._tip.start(
                self._bench,
                excitation.periods * excitation.period_s,
                int(entropy.generate_state(1, np.uint64)[0]),
                effects,
            )
            self._silence()
            start_ns = self._now_ns()
            if self.time_server:
                self._player_clock = SimulatedClock(self.time_server, "bench")
        except (ValueError, ClockLostError) as error:
            response.message = str(error)
            return response
        self._say_effort(run, excitation)
        self._stop = threading.Event()
        self._playing = threading.Thread(
            target=self._play,
            args=(run, excitation, start_ns, self._stop, self._stays.newest.pose, self._tip),
            name="bench",
            daemon=True,
        )
        self._playing.start()
        response.accepted, response.start = True, time_message(start_ns)
        return response

    def _say_effort(self, run: BenchRun, excitation: Excitation) -> None:
        effort = run.effort(excitation)
        if effort.lines != self._said_lines:
            self._said_lines = effort.lines
            self.get_logger().info(str(effort))

    def _on_truth(self, request: Truth.Request, response: Truth.Response) -> Truth.Response:
        if not self.active:
            response.message = f"fake_hardware_node is {self.state_name()}"
            return response
        place = request.position
        try:
            if request.here:
                self._take_up_contact()
                tip = self._tip
            else:
                tissue = self._scene.tissue_at((place.x, place.y, place.z))
                tip = BenchTip(tissue, self._scene.force_n, 1.0)
            coupled = replace(
                tip,
                force_n=request.force_n or tip.force_n,
                since_s=request.hold_time_s or tip.since_s,
            ).coupled(self._bench)
            truth_to_response(truth_of(coupled, request.frequency_hz), response)
        except (ValueError, ClockLostError) as error:
            response.message = str(error)
        return response

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._silence()
        response.success = True
        return response

    def _silence(self) -> None:
        self._stop.set()
        if self._player_clock is not None:
            self._player_clock.interrupt()
        if self._playing is not None:
            self._playing.join()
            self._playing = None
        if self._player_clock is not None:
            self._player_clock.close()
            self._player_clock = None

    def _play(
        self,
        run: BenchRun,
        excitation: Excitation,
        start_ns: int,
        stop: threading.Event,
        pose: PoseStamped,
        tip: BenchTip,
    ) -> None:
        """Publish block after block, each when its last sample would have been taken.

        A contact that creeps has its truth with every block: that of the middle of all blocks so far, with
        the stamp that their poles will have, and the plant's mean force over them.
        """
        for block in run.play(excitation, excitation.periods):
            due_ns = start_ns + round((block.index + 1) * excitation.period_s * 1e9)
            if not self._wait_until(due_ns, stop):
                return
            if tip.creeping:
                half_s = (block.index + 1) * excitation.period_s / 2
                middle = replace(tip, since_s=tip.since_s + half_s)
                pose.header.stamp = time_message(start_ns + round(half_s * 1e9))
                force_n = self._plant_force_n(start_ns, due_ns)
                self._publish_truth(pose, middle, excitation.measurement_id, force_n)
            first_ns = start_ns + round(block.start_time_s * 1e9)
            self._blocks.publish(record_to_message(self._record(block, excitation, first_ns)))

    def _plant_force_n(self, from_ns: int, to_ns: int) -> float:
        """Mean force of the plant over an interval; NaN where the plant has ended."""
        assert self._plant is not None
        from_s, to_s = (ns * 1e-9 + self._plant_ahead_s for ns in (from_ns, to_ns))
        try:
            return self._plant.mean_force_n(from_s, to_s)
        except OSError:
            return math.nan

    def _wait_until(self, due_ns: int, stop: threading.Event) -> bool:
        """Wait for a time; whether what is played goes on."""
        if self._player_clock is None:
            stop.wait(max(0, due_ns - time.time_ns()) / 1e9)
            return not stop.is_set()
        try:
            self._player_clock.sleep_until(due_ns)
        except ClockLostError:
            return False
        return not stop.is_set()

    def _record(self, block: Block, excitation: Excitation, first_ns: int) -> Record:
        return Record(
            actuator=_channel(block.actuator),
            sensor=_channel(block.sensor),
            sample_rate_hz=block.sample_rate_hz,
            samples_per_period=block.samples_per_period,
            realisation=excitation.realisation,
            block_index=block.index,
            origin=Origin(
                measurement_id=excitation.measurement_id,
                excitation_id=excitation.excitation_id,
                time_ns=first_ns,
                frame_id=self._frame_id,
                label=excitation.label,
                simulated=True,
            ),
        )


def _channel(samples: ChannelSamples) -> Channel:
    if samples.counts is None:
        return Channel(samples.volts, saturated=samples.saturated)
    return Channel(samples.counts, samples.scale_v, 0.0, samples.saturated)


def main() -> None:
    """Console script."""
    run_node(FakeHardwareNode)


if __name__ == "__main__":
    main()
