# SPDX-License-Identifier: Apache-2.0
"""The simulated bench: its time; excitations played on the bimorph, in contact with what lies under the tip."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from importlib import import_module

import numpy as np
from rosgraph_msgs.msg import Clock

from tactile_resonance import msg
from tactile_resonance.clock import PORT as TIME_PORT
from tactile_resonance.clock import ClockLostError, SimulatedClock, time_address
from tactile_resonance.multisine import Excitation
from tactile_resonance.nodes.contact_topics import StopInput
from tactile_resonance.nodes.ideal_contact import IdealContact
from tactile_resonance.nodes.managed_node import TIME_SERVER, ManagedNode
from tactile_resonance.nodes.messages import record_to_message, time_message
from tactile_resonance.nodes.parameters import Fixed, Parameter, file_of, values
from tactile_resonance.nodes.running import RESULTS
from tactile_resonance.nodes.simulated_tip import (
    PlantChild,
    SimulatedTip,
    truth_message,
    truth_to_response,
)
from tactile_resonance.record import Origin
from tactile_resonance.recording.messages import excitation_from_message
from tactile_resonance.simulation.plant.bench_time import BenchTime
from tactile_resonance.simulation.plant.defaults import TABLE_IN_BASE
from tactile_resonance.simulation.sensor.bench import (
    BenchEffects,
    BenchRun,
    ContactSoFar,
    SimulatedBench,
)
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.simulation.tissue.scene import read_scene
from tactile_resonance.simulation.ur5e.reactor import Reactor
from tactile_resonance.srv import Play, Truth

PARAMETERS = (
    Fixed(
        "scene",
        "config/scenes/gelatine_phantoms.yaml",
        "What lies on the table: a file, absolute or in the package's share folder.",
    ),
    Fixed(
        "robot_host",
        "",
        "Address 127.x.y.z at which a simulated robot with its load cell is started too; the tip is then "
        "where that robot holds it. Empty: ideal contact.",
    ),
    Fixed(
        "serve_contact",
        False,
        "Without a robot: serve make_contact and retract with ideal contact, as contact_node does; else the "
        "tip is where tcp_pose states.",
    ),
    Fixed(
        "table_in_base",
        [*TABLE_IN_BASE],
        "Frame of the scene in the robot's base: position [m] and rotation vector [rad].",
    ),
    TIME_SERVER,
    Parameter("seed", 1, "Seed of the simulated noise.", 1, 2**62),
    Parameter("noise", True, "Sensor noise."),
    Parameter("quantisation", True, "Converters that count and saturate."),
    Parameter("nonlinearity", False, "The sensor's static nonlinearity."),
    Fixed("frame_id", "tip", "Frame of the sensor's tip."),
    Fixed("base_frame", "base", "Frame of the robot's base, of all poses."),
)

EFFECTS = ("noise", "quantisation", "nonlinearity")
HERTZ = {"contact_radius_m": math.nan, "depth_m": math.nan}  # of a tip: not that of the plant
STEP_NS = 2_000_000
CLOCK_S = 0.04
"""Between two messages on `/clock`, by the machine's clock."""


class BenchServer:
    """Serves the time of a bench without a robot, in a thread of its own.

    Parameters
    ----------
    address : str
        ``HOST:PORT``.

    Raises
    ------
    ValueError
        If the port cannot be opened.
    """

    def __init__(self, address: str) -> None:
        host, port = time_address(address)
        self._reactor = Reactor(host)
        self._time = BenchTime(self._reactor, STEP_NS, simulated=True)
        try:
            self._reactor.listen(port, self._time.serve)
        except ValueError:
            self._reactor.close()
            raise
        self._thread = threading.Thread(target=self._time.run, name="bench time", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the time, for all participants."""
        self._time.stop()
        self._thread.join()
        self._reactor.close()


class BenchNow:
    """ROS time as the bench has it; for any thread.

    Parameters
    ----------
    node : ManagedNode
        Publishes simulated time on `/clock` until it is cleaned up, where it lives in that.
    """

    def __init__(self, node: ManagedNode) -> None:
        self._clock: SimulatedClock | None = None
        self._lock = threading.Lock()
        if node.time_server:
            self._clock = SimulatedClock(node.time_server, node.get_name())
            node.resources.callback(self._clock.close)
            self._publisher = node.publish_on(Clock, "/clock", 1)
            node.every(CLOCK_S, self._publish)

    def __call__(self) -> int:
        """Time now [ns]."""
        if self._clock is None:
            return time.time_ns()
        with self._lock:
            return self._clock.ask_ns()

    def _publish(self) -> None:
        with contextlib.suppress(ClockLostError):  # the bench has ended, which its owner reports
            self._publisher.publish(Clock(clock=time_message(self())))


class Playing:
    """An excitation that is played, in a thread of its own, until its end or until it is silenced.

    Parameters
    ----------
    time_server : str
        Address of the simulated time in which it plays; empty: the machine's clock.
    ends_ns : iterable of int
        ROS times of the ends of its blocks [ns].
    hand_out : callable
        Called in the thread with each of them, at that time.

    Raises
    ------
    ClockLostError
        If no bench serves the simulated time.
    """

    def __init__(
        self, time_server: str, ends_ns: Iterable[int], hand_out: Callable[[int], None]
    ) -> None:
        self._clock = SimulatedClock(time_server, "bench") if time_server else None
        self._stop = threading.Event()

        def play() -> None:
            for end_ns in ends_ns:
                if not self._wait_until(end_ns):
                    return
                hand_out(end_ns)

        self._thread = threading.Thread(target=play, name="bench", daemon=True)
        self._thread.start()

    def silence(self) -> None:
        """Stop at once; returns when nothing more is handed out."""
        self._stop.set()
        if self._clock is not None:
            self._clock.interrupt()
        self._thread.join()
        if self._clock is not None:
            self._clock.close()

    def _wait_until(self, time_ns: int) -> bool:
        """Wait for a ROS time [ns]; False where it was silenced meanwhile."""
        if self._clock is None:
            return not self._stop.wait(max(0, time_ns - time.time_ns()) / 1e9)
        try:
            self._clock.sleep_until(time_ns)
        except ClockLostError:
            return False
        return not self._stop.is_set()


class FakeHardwareNode(ManagedNode):
    """Serves `bench/play`, `bench/stop` and `bench/get_truth`, hands out `bench/block`.

    With a robot the tip is where the robot holds it, and the contact that of the plant, whatever becomes of it
    while an excitation is played; one that begins in air stays in air. Without one contact is ideal, at the
    scene's force or the one asked for, also on tissue that moves: where `tcp_pose` states, or where the action
    `make_contact` puts the tip, which this node serves then; the force comes back on `wrench` and from the
    service `force_over`. What the
    simulation knows of the poles is on `bench/truth` (latched, all modes): under the tip as it is put
    somewhere or an excitation begins; of a contact that creeps also with each block. In simulated time it
    publishes `/clock`.
    """

    def __init__(self) -> None:
        super().__init__("fake_hardware_node", PARAMETERS)
        self._playing: Playing | None = None
        self._played: tuple[msg.Excitation, Play.Response] | None = None  # and the answer
        self._touch: SimulatedTip | None = None
        (serves_contact,) = values(self, "serve_contact")
        self._stop = StopInput(self) if serves_contact else None

    def configure(self) -> None:
        """Read the scene, make the sensor and, if the parameters ask for one, the robot."""
        scene, self._frame_id = values(self, "scene", "frame_id")
        scene_path = file_of(scene)
        self._bench = SimulatedBench.from_configuration()
        if values(self, "nonlinearity")[0]:  # now: numba takes a while to load
            import_module("tactile_resonance.simulation.sensor.nonlinear")
        read = read_scene(read_tissues(), scene_path)
        host, table, seed = values(self, "robot_host", "table_in_base", "seed")
        server, plant = self.time_server, None
        if host:
            if server and server != f"{host}:{TIME_PORT}":
                raise ValueError(
                    f"time_server: {server!r}, the robot at {host} serves {host}:{TIME_PORT}"
                )
            plant = PlantChild(host, scene_path, table, seed, bool(server))
            self.resources.callback(plant.close)
        elif server:
            self.resources.callback(BenchServer(server).close)
        self._now_ns = BenchNow(self)
        self._touch = SimulatedTip(self, self._bench, read, plant, self._now_ns)
        if plant is None and self._stop is None:
            self._touch.follow_poses()
        elif plant is None:
            IdealContact(self, self._touch, self._stop)
        self._blocks = self.publish_on(msg.Record, "bench/block", RESULTS)
        self.serve(Play, "bench/play", self._on_play)
        self.serve_trigger("bench/stop", self._silence)
        self.serve(Truth, "bench/get_truth", self._on_truth)

    def details(self) -> dict[str, str]:
        """How often the simulated robot stood still, as of the last measurement."""
        stalls = 0 if self._touch is None else self._touch.stalls
        return {"simulator stalls": str(stalls)} if stalls else {}

    def deactivate(self) -> None:
        """Silence the output."""
        self._silence()

    def _silence(self) -> str:
        if self._playing is not None:
            self._playing.silence()
        self._playing = self._played = None
        return ""

    def _on_play(self, request: Play.Request, response: Play.Response) -> Play.Response:
        self.require_active()
        asked = request.excitation
        if asked.excitation_id and self._played is not None and self._played[0] == asked:
            return self._played[1]  # asked again: the answer was lost, or late
        excitation = excitation_from_message(asked)
        effects = BenchEffects(**dict(zip(EFFECTS, values(self, *EFFECTS), strict=True)))
        (seed,) = values(self, "seed")
        # noise repeats with the excitation's own seed, whatever was played before
        entropy = np.random.SeedSequence([seed, excitation.seed, excitation.realisation])
        start_ns = self._now_ns()  # of the contact that is taken up, too, however long it takes to begin
        tip, so_far = self._touch.take_up(), None
        pressed = tip.tissue is not None and self._touch.creeps
        if pressed and not effects.nonlinearity:  # which takes the contact as fixed
            so_far = ContactSoFar(self._bench, tip)
        coupled = tip.coupled(self._bench) if so_far is None else so_far.coupled_at
        noise_seed = int(entropy.generate_state(1, np.uint64)[0])
        run = BenchRun(self._bench.sensor, coupled, noise_seed, effects)
        self._silence()
        ends_ns = (
            start_ns + round(count * excitation.period_s * 1e9)
            for count in range(1, excitation.periods + 1)
        )
        hand_out = self._hand_out(run, excitation, start_ns, so_far, pressed)
        self._playing = Playing(self.time_server, ends_ns, hand_out)
        response.accepted, response.start = True, time_message(start_ns)
        self._played = asked, response
        return response

    def _on_truth(self, request: Truth.Request, response: Truth.Response) -> Truth.Response:
        place = request.position
        self.require_active()
        tip = self._touch.take_up() if request.here else self._touch.at((place.x, place.y, place.z))
        coupled = replace(
            tip,
            force_n=request.force_n or tip.force_n,
            since_s=request.hold_time_s or tip.since_s,
            **(HERTZ if request.force_n or request.hold_time_s else {}),
        ).coupled(self._bench)
        truth_to_response(coupled, request.frequency_hz, response)
        return response

    def _hand_out(
        self,
        run: BenchRun,
        excitation: Excitation,
        start_ns: int,
        so_far: ContactSoFar | None,
        pressed: bool,
    ) -> Callable[[int], None]:
        """What makes and publishes a block at its end: only then is it known what became of the contact.

        A contact that creeps (`pressed`) has its truth with every block: the mean over all blocks so far, with
        the stamp that their poles will have.
        """
        touch, blocks = self._touch, run.play(excitation, excitation.periods)
        pose, tip = touch.stays.newest.pose_at(start_ns), touch.tip
        block_ns = round(excitation.period_s * 1e9)

        def hand_out(end_ns: int) -> None:
            if so_far is not None:
                if touch.plant is None:
                    states = so_far.held(excitation.period_s)
                else:
                    states = touch.contact_over(end_ns - block_ns, end_ns)
                so_far.extend(excitation.period_s, states)
            if pressed:
                parts = [run.coupled] if so_far is None else so_far.parts
                pose.header.stamp = time_message((start_ns + end_ns) // 2)
                whose = excitation.measurement_id, self._frame_id
                touch.truths.publish(truth_message(pose, tip, parts, *whose))
            block = next(blocks)
            origin = Origin(
                measurement_id=excitation.measurement_id,
                excitation_id=excitation.excitation_id,
                time_ns=start_ns + block.origin.time_ns,
                frame_id=self._frame_id,
                label=excitation.label,
                simulated=True,
            )
            record = replace(
                block,
                realisation=excitation.realisation,
                channel_delay_s=0.0,
                anti_alias_filter="ideal",
                origin=origin,
            )
            self._blocks.publish(record_to_message(record))

        return hand_out


main = FakeHardwareNode.run
