# SPDX-License-Identifier: Apache-2.0
"""The simulated bench: plays excitations on the bimorph, in contact with whatever lies under the tip."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.duration import Duration
from std_srvs.srv import Trigger

from tactile_resonance import msg
from tactile_resonance.configuration import share_path
from tactile_resonance.identification.result import Poles, PolesStatus
from tactile_resonance.multisine import Excitation
from tactile_resonance.nodes.conversions import (
    contact_from_message,
    excitation_from_message,
    poles_to_message,
    record_to_message,
    time_from_message,
)
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.parameters import Parameter, values
from tactile_resonance.nodes.running import LATCHED, RESULTS, STREAM, run_node
from tactile_resonance.record import Channel, Origin, Record
from tactile_resonance.simulation.acquisition import BenchEffects, Block, ChannelSamples
from tactile_resonance.simulation.bench import SimulatedBench
from tactile_resonance.simulation.bench_run import BenchRun
from tactile_resonance.simulation.library import read_tissues
from tactile_resonance.simulation.scene import read_scene
from tactile_resonance.simulation.tissue import Tissue
from tactile_resonance.srv import Play

PARAMETERS = (
    Parameter(
        "scene",
        "config/scenes/gelatine_phantoms.yaml",
        "What lies on the table: a file, absolute or in the package's share folder.",
        read_only=True,
    ),
    Parameter("speed", 1.0, "Signal time over real time; 0: as fast as possible.", 0.0, 1e3),
    Parameter("seed", 1, "Seed of the simulated noise.", 1, 2**62),
    Parameter("noise", True, "Sensor noise."),
    Parameter("quantisation", True, "Converters that count and saturate."),
    Parameter("nonlinearity", False, "The sensor's static nonlinearity."),
    Parameter("frame_id", "tip", "Frame of the sensor's tip.", read_only=True),
)


ACKNOWLEDGED_WITHIN_S = 5.0


class FakeHardwareNode(ManagedNode):
    """Serves `bench/play` and `bench/stop`, hands out `bench/block`.

    The tip is where `tcp_pose` says, in ideal contact at the scene's force wherever there is tissue: the
    force comes back on `wrench`, and what the simulation knows of the poles on `bench/truth` (latched, all
    modes), both with the stamp of the pose they belong to.
    """

    def __init__(self) -> None:
        super().__init__("fake_hardware_node", PARAMETERS)
        self._playing: threading.Thread | None = None
        self._stop = threading.Event()

    def configure(self) -> None:
        """Read the scene and make the sensor."""
        scene, self._frame_id = values(self, "scene", "frame_id")
        path = Path(scene)
        self._scene = read_scene(read_tissues(), path if path.is_absolute() else share_path(scene))
        self._bench = SimulatedBench.from_configuration()
        self._pose = PoseStamped()
        self._tissue: Tissue | None = None
        self._blocks = self.publish_on(msg.Record, "bench/block", RESULTS)
        self._truth = self.publish_on(msg.Poles, "bench/truth", LATCHED)
        self._wrench = self.publish_on(WrenchStamped, "wrench", STREAM)
        self.listen(PoseStamped, "tcp_pose", self._on_pose, STREAM)
        self.serve(Play, "bench/play", self._on_play)
        self.serve(Trigger, "bench/stop", self._on_stop)

    def deactivate(self) -> None:
        """Silence the output."""
        self._silence()

    def _on_pose(self, message: PoseStamped) -> None:
        if message == self._pose:
            return
        self._pose = message
        position = message.pose.position
        self._tissue = self._scene.tissue_at((position.x, position.y, position.z))
        force_n = self._force_n()
        wrench = WrenchStamped()
        wrench.header.stamp = message.header.stamp
        wrench.header.frame_id = self._frame_id
        wrench.wrench.force.z = force_n
        self._wrench.publish(wrench)
        run = self._bench.start(self._tissue, force_n=force_n or None)
        modes = run.truth().modes
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
            time_ns=time_from_message(message.header.stamp),
            final=True,
            frame_id=self._frame_id,
            label=self._tissue.name if self._tissue else "air",
            simulated=True,
            contact=contact_from_message(message, force_n, 0.0),
        )
        self._truth.publish(poles_to_message(truth, origin))

    def _force_n(self) -> float:
        return self._scene.force_n if self._tissue else 0.0

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
            run = self._bench.start(
                self._tissue,
                force_n=self._force_n() or None,
                seed=int(entropy.generate_state(1, np.uint64)[0]),
                effects=effects,
            )
        except ValueError as error:
            response.message = str(error)
            return response
        self._silence()
        self._stop = threading.Event()
        self._playing = threading.Thread(
            target=self._play, args=(run, excitation, self._stop), name="bench", daemon=True
        )
        self._playing.start()
        response.accepted = True
        return response

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._silence()
        response.success = True
        return response

    def _silence(self) -> None:
        self._stop.set()
        if self._playing is not None:
            self._playing.join()
            self._playing = None

    def _play(self, run: BenchRun, excitation: Excitation, stop: threading.Event) -> None:
        """Publish block after block, each when its last sample would have been taken."""
        (speed,) = values(self, "speed")
        start_ns = time.time_ns()
        for block in run.play(excitation, excitation.periods):
            if speed > 0:
                due_ns = start_ns + round((block.index + 1) * excitation.period_s / speed * 1e9)
                stop.wait(max(0, due_ns - time.time_ns()) / 1e9)
            if stop.is_set():
                return
            first_ns = start_ns + round(block.start_time_s * 1e9)
            self._blocks.publish(record_to_message(self._record(block, excitation, first_ns)))
            if speed == 0:
                # no clock holds the bench back: wait until readers have the block
                self._blocks.wait_for_all_acked(Duration(seconds=ACKNOWLEDGED_WITHIN_S))

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
