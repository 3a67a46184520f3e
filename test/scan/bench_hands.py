# SPDX-License-Identifier: Apache-2.0
"""A bench without robot and nodes, whose poles have a known spread and whose time is told, and scans on it."""

import time
from dataclasses import dataclass, field, fields, replace

import numpy as np

from tactile_resonance.poles.result import Poles
from tactile_resonance.record import Contact, ForceSpread, Origin
from tactile_resonance.recording.messages import write_indentation
from tactile_resonance.scan.decision import BlockLimits, Precise
from tactile_resonance.scan.failures import PointFailed
from tactile_resonance.scan.hands import Controls, Measured
from tactile_resonance.scan.messages import make_message, message_types, to_cdr
from tactile_resonance.scan.plan import make_plan
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.run_directory import RunDirectory
from tactile_resonance.scan.runner import ScanRunner
from tactile_resonance.scan.scene import ScanScene
from tactile_resonance.scan.tissue_tests import TOPIC, TYPE

SPREAD_HZ = 0.02
TOUCH_S, BLOCK_S = 0.01, 0.01
AGE_S = 2.0


@dataclass
class Bench:
    """Hands on a bench whose poles have a spread that falls with the root of the blocks.

    Its time goes on by `TOUCH_S` in a touch and by `BLOCK_S` in a block.
    """

    log: list = field(default_factory=list)
    failing: tuple = ()
    on_measure: object = None
    holding: bool = False
    free_air: bool = True
    zero_moved_n: float = 0.0
    spent: dict | None = None
    time_s: float = 1000.0
    seeds: list = field(default_factory=list)
    silent: list = field(default_factory=list)
    force_n: float = 0.01
    rms_n: object = (
        None  # of the force over the blocks so far, from the number of the measurement and of these
    )
    measurements: int = 0
    f0_of: object = (
        None  # of a position (3,); None: 254 Hz everywhere. With noise of the stated spread
    )
    at: object = None  # position of the point in contact
    testing: bool = True
    tests: object = None  # record of a point and of what is asked there; raises where it fails
    beside: Poles | None = None  # another mode, of lower frequency, reported before the main one

    def now_s(self):
        return self.time_s

    def begin(self, *integers):
        self.seeds.append(integers)

    def missing(self):
        return None

    def held(self):
        return False

    def touch(self, point, force_n, hold, check):
        check()
        assert not self.holding, "the tip was not drawn back before the next point"
        if point.index in self.failing:
            raise PointFailed("contact: surface_missing: nothing there")
        self.time_s += TOUCH_S
        self.holding = True
        self.at = point.position_m
        self.log.append(("touch", point.index))

    def measure(self, design, label, seed, enough, recording, check):
        blocks = 0
        self.silent.append(design.silent)
        contact = Contact(self.force_n, 1e-4, (0.0, 0.0, 0.0), frame_id="base", time_ns=1)
        origin = Origin(measurement_id=1000 + seed, contact=contact, simulated=True)
        recording.measurement_id = 1000 + seed
        recording.write("/note", "std_msgs/msg/String", time.time_ns(), note(label))
        f0_hz, noise_hz = 254.0, 0.0
        if self.f0_of is not None and label != "air":
            f0_hz = self.f0_of(self.at)
            noise_hz = SPREAD_HZ * np.random.default_rng(self.seeds[-1]).standard_normal()
        while blocks < design.periods:
            check()
            blocks += 1
            self.time_s += BLOCK_S
            covariance = np.diag([SPREAD_HZ**2, 1e-9]) / blocks
            poles = Poles(
                poles_rad_s=np.array([-50 + 1600j]),
                f0_hz=np.array([f0_hz + noise_hz / np.sqrt(blocks)]),
                damping_ratio=np.array([0.03]),
                residues=np.array([100 + 0j]),
                covariance=covariance[None],
                total_covariance=covariance[None],
            )
            if self.beside is not None:
                poles = joined(self.beside, poles)
            if self.on_measure is not None and label != "air":
                self.on_measure(self, blocks)
            if self.rms_n is not None and label != "air":
                spread = ForceSpread(self.rms_n(self.measurements, blocks), 0.009, 0.011)
                origin = replace(origin, contact=replace(contact, spread=spread))
            measured = Measured(poles, origin, AGE_S)
            if enough(measured, blocks):
                break
        self.log.append(("measure", label, seed, blocks))
        self.measurements += label != "air"
        return measured

    def offers_tests(self):
        return self.testing

    def test(self, point, asked, force_n, recording, check):
        check()
        assert not self.holding, "the tip was not drawn back before the test"
        self.log.append(("test", point.index, asked, force_n))
        if self.tests is None:
            return
        record = self.tests(point, asked)
        message = make_message(TYPE)
        write_indentation(message, record)
        recording.write(f"/{TOPIC}", TYPE, time.time_ns(), to_cdr(message))

    def retract(self):
        self.holding = False
        return self.zero_moved_n

    def spent_s(self):
        return {} if self.spent is None else dict(self.spent)


def joined(first, second):
    names = [each.name for each in fields(Poles) if each.name.endswith("covariance")]
    names += ["poles_rad_s", "f0_hz", "damping_ratio", "residues"]
    pairs = {name: (getattr(first, name), getattr(second, name)) for name in names}
    known = {name: pair for name, pair in pairs.items() if pair[1] is not None}
    return replace(second, **{name: np.concatenate(pair) for name, pair in known.items()})


def note(text):
    types = message_types()
    kind = "std_msgs/msg/String"
    return types.serialize_cdr(types.types[kind](data=text), kind)


def scene(points=4, **changes):
    positions = np.zeros((points, 3))
    positions[:, 0] = 1e-3 * np.arange(points)
    made = ScanScene(
        name="test",
        force_n=0.01,
        positions_m=positions,
        precision=Precise(f0_std_hz=SPREAD_HZ / 2),
        blocks=BlockLimits(least=2, most=8),
    )
    return replace(made, **changes)


def begin(path, made):
    plan = make_plan(made)
    run = RunDirectory.create(path, "name: test\n", plan.points, {"seed": 1})
    return plan, run


def scan(path, made, bench, controls=None):
    plan, run = begin(path, made)
    told = []
    with run:
        summary = ScanRunner(plan, run, bench, controls or Controls(), told.append).run()
    return summary, read_run(path), told
