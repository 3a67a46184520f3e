# SPDX-License-Identifier: Apache-2.0
"""Scans as scan_node runs them, on the simulated bench in one process and in virtual time, without robot."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from tactile_resonance.configuration import dump_yaml
from tactile_resonance.contact.goal import HoldMode
from tactile_resonance.contact.samples import Pose
from tactile_resonance.frf.measurement import MeasurementFrf
from tactile_resonance.poles.estimator import poles_of_bands
from tactile_resonance.record import Contact, Origin
from tactile_resonance.scan.clearance import Standoffs
from tactile_resonance.scan.failures import PointFailed
from tactile_resonance.scan.hands import Check, Controls, Measured, Touch
from tactile_resonance.scan.measurement import MeasurementDesign, excitation_of
from tactile_resonance.scan.messages import make_message, to_cdr
from tactile_resonance.scan.plan import TRAVEL_M_S, make_plan
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.run_content import RunContent, read_run
from tactile_resonance.scan.run_directory import PointRecording, RunDirectory
from tactile_resonance.scan.runner import ScanRunner
from tactile_resonance.scan.scene import Output, ScanScene, read_scan_scene
from tactile_resonance.scan.surface import Plane
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.sensor.experiments import truth_over
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.simulation.tissue.scene import PhantomScene, read_scene

FORCE_STD_N = 1.5e-4
AGE_S = 1.0
"""Of each contact, held throughout a measurement: the bench's contact does not creep here."""
MODE_HZ = 250.0
"""Near it the mode of all tissues lies."""
RECORD = "tactile_resonance/msg/Record"
SAMPLE_BYTES = 2 * 4
"""Of one sample of both channels, as counts."""


@dataclass
class VirtualHands:
    """`Hands` whose time is what a plan counts for touches and travel, and the vibration itself.

    Attributes
    ----------
    phantoms : PhantomScene
    touch_s : float
        Of a touch, besides the way to it and the blocks.
    bench : SimulatedBench
    vibration_s, computing_s : float
        So far; computing is processor time from a block's samples to its poles.
    sample_bytes : int
        Of the records.
    """

    phantoms: PhantomScene
    touch_s: float
    bench: SimulatedBench = field(default_factory=SimulatedBench.from_configuration)
    free_air: bool = False  # references are the same whatever is skipped
    frame_in_base: Pose | None = None
    standoffs: Standoffs = field(default_factory=lambda: Standoffs(Plane()))
    time_s: float = 0.0
    vibration_s: float = 0.0
    computing_s: float = 0.0
    sample_bytes: int = 0
    touches: int = 0
    _at_m: np.ndarray | None = None
    _seed: tuple[int, ...] = ()

    def now_s(self) -> float:
        """Time so far [s]."""
        return self.time_s

    def begin(self, *integers: int) -> None:
        """Noise from now on follows from these."""
        self._seed = integers

    def missing(self) -> None:
        """Nothing ever is."""

    def held(self) -> bool:
        """Nobody keeps anything from its work."""
        return False

    def touch(self, point: ScanPoint, force_n: float, hold: HoldMode, check: Check) -> None:
        """Travel there and press: time goes on, and the force is off by its error."""
        check()
        there = np.array(point.position_m)
        if self._at_m is not None:
            self.time_s += float(np.linalg.norm(there - self._at_m)) / TRAVEL_M_S
        self.time_s += self.touch_s
        self._at_m, self.touches = there, self.touches + 1

    def find(self, point: ScanPoint, force_n: float, ball_radius_m: float, check: Check) -> Touch:
        """Surfaces are known here."""
        raise PointFailed("find: surfaces are known here")

    def measure(
        self,
        design: MeasurementDesign,
        label: str,
        seed: int,
        enough: Callable[[Measured, int], bool],
        recording: PointRecording,
        check: Check,
    ) -> Measured:
        """Records of the bench, through the functions that the nodes call, block by block."""
        assert self._at_m is not None
        recording.measurement_id = 1000 + seed
        random = np.random.default_rng([*self._seed, 7])
        force_n = self.phantoms.force_n + FORCE_STD_N * float(random.standard_normal())
        run = self.bench.start(
            self.phantoms.tissue_at(self._at_m),
            force_n=force_n,
            hold_time_s=AGE_S,
            seed=int(random.integers(1 << 31)),
        )
        contact = Contact(self.phantoms.force_n, FORCE_STD_N, tuple(self._at_m.tolist()), time_ns=1)
        origin = Origin(measurement_id=1000 + seed, label=label, contact=contact, simulated=True)
        excitation, frf = excitation_of(design, seed), MeasurementFrf(1000 + seed)
        for blocks, record in enumerate(run.play(excitation, design.periods), start=1):
            check()
            self.time_s += design.block_s
            self.vibration_s += design.block_s
            self.sample_bytes += SAMPLE_BYTES * design.samples
            counts = {
                "actuator_counts": record.actuator.samples,
                "sensor_counts": record.sensor.samples,
            }
            recording.write("/record", RECORD, time.time_ns(), to_cdr(make_message(RECORD, **counts)))
            begun_s = time.process_time()
            found = frf.add(replace(record, origin=origin), excitation)
            poles = poles_of_bands(found, design.bands)
            self.computing_s += time.process_time() - begun_s
            measured = Measured(poles, origin, AGE_S, found.distortion)
            if enough(measured, blocks):
                break
        return measured

    def offers_tests(self) -> bool:
        """It does not."""
        return False

    def test(self, *_: object) -> None:
        """Nothing is tested here."""
        raise PointFailed("test: nothing is tested here")

    def retract(self) -> float:
        """Its time is in that of the touch."""
        return 0.0

    def spent_s(self) -> Mapping[str, Any]:
        """The last table of the page has the phases."""
        return {}


@dataclass(frozen=True)
class Scanned:
    """One scan.

    Attributes
    ----------
    scene : ScanScene
    phantoms : PhantomScene
    run : RunContent
    hands : VirtualHands
    """

    scene: ScanScene
    phantoms: PhantomScene
    run: RunContent
    hands: VirtualHands

    def true_f0_hz(self, xy_m: np.ndarray) -> np.ndarray:
        """(...) natural frequency at (..., 2) places, at the scene's force and `AGE_S`."""
        felt = truth_over(self.hands.bench, self.phantoms, xy_m, hold_time_s=AGE_S)
        return np.vectorize(lambda each: each.mode_near(MODE_HZ).f0_hz, otypes=[float])(felt)


def scan(content: Mapping[str, Any], seed: int, touch_s: float) -> Scanned:
    """Scan a scene, given as the content of its file, with all records through the estimator."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scene.yaml"
        text = dump_yaml(dict(content))
        path.write_text(text)
        scene, phantoms = read_scan_scene(path), read_scene(read_tissues(), path)
        plan, hands = make_plan(scene), VirtualHands(phantoms, touch_s)
        if Output.SILENT in scene.outputs:
            hands.time_s += scene.blocks.least * plan.measurement.block_s
        target = Path(folder) / "run"
        places = plan.points if scene.adaptive else ()
        facts = {"seed": seed}
        with RunDirectory.create(target, text, plan.first_points, facts, 0, places) as run:
            ScanRunner(plan, run, hands, Controls(), lambda progress: None, seed).run()
        return Scanned(scene, phantoms, read_run(target), hands)
