# SPDX-License-Identifier: Apache-2.0
"""A whole scan of a scene on the simulated bench, in this process: the core as scan_node drives it."""

from dataclasses import replace

import numpy as np

from tactile_resonance.multisine import design_multisine
from tactile_resonance.poles.estimator import identify_poles_from_records
from tactile_resonance.record import Contact, Origin
from tactile_resonance.scan.decision import decide
from tactile_resonance.scan.hands import Measured
from tactile_resonance.scan.plan import make_plan
from tactile_resonance.scan.point_outcome import attempt_at, measured_result
from tactile_resonance.scan.run_directory import RunDirectory, expected_bytes
from tactile_resonance.scan.run_start import run_facts
from tactile_resonance.scan.scene import read_scan_scene
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.simulation.tissue.scene import read_scene
from tactile_resonance.tissue.nominal_contact import ContactLoad

START_NS = 1_700_000_000_000_000_000
AGE_S = 1.0  # of contacts of the bench that do not creep


def begin(path, folder):
    """A run of a scene file, nothing measured yet."""
    scene = read_scan_scene(path)
    plan = make_plan(scene)
    needed = expected_bytes(len(plan.points), plan.measurement)
    return RunDirectory.create(folder, path.read_text(), plan.points, run_facts(plan, 1), needed)


def go_on(path, run, most=None):
    """Measure the next points, at most so many."""
    scene, phantoms = read_scan_scene(path), read_scene(read_tissues(), path)
    design = make_plan(scene).measurement
    bench = SimulatedBench.from_configuration()
    for _ in range(most or len(run.content.points)):
        point = run.content.next_point
        if point is None:
            break
        with run.begin_point(point.index) as recording:
            measured = measure(scene, phantoms, design, bench, point, recording.attempt)
            recording.finish(measured)


def measure(scene, phantoms, design, bench, point, attempt):
    """Block by block until it is enough."""
    excitation = design_multisine(
        band_hz=design.stretches_hz,
        level_v=design.level_v,
        grid=design.grid,
        seed=1 + point.index,
        periods=design.periods,
    )
    running = bench.start(
        phantoms.tissue_at(point.position_m), force_n=scene.force_n, seed=100 + point.index
    )
    band = (scene.sensor.band_low_hz, scene.sensor.band_high_hz)
    u, y = [], []
    for block in running.play(excitation, design.periods):
        u.append(block.actuator.volts())
        y.append(block.sensor.volts())
        poles = identify_poles_from_records(
            np.array(u),
            np.array(y),
            sample_rate_hz=excitation.sample_rate_hz,
            harmonics=excitation.harmonics,
            band_hz=band,
        )
        asked = len(u), scene.precision, scene.blocks, design.block_s
        decision = decide(poles, ContactLoad(), None, *asked)
        if decision.stop:
            break
    contact = Contact(
        scene.force_n, 1e-5, point.position_m, point.orientation_xyzw, scene.frame_id, START_NS
    )
    origin = Origin(
        measurement_id=1000 + point.index, label=point.label, simulated=True, contact=contact
    )
    result = replace(
        attempt_at(point, attempt, scene.frame_id),
        time_ns=START_NS + point.index * 10**9,
        duration_s=2.5 + decision.blocks * design.block_s,
    )
    return measured_result(result, scene, Measured(poles, origin, AGE_S), decision)


def true_poles(path, position_m):
    """(2,) f0 [Hz] and damping ratio of the mode near 250 Hz at a point of a scene."""
    phantoms = read_scene(read_tissues(), path)
    bench = SimulatedBench.from_configuration()
    modes = bench.coupled(phantoms.tissue_at(position_m), force_n=phantoms.force_n).modes
    mode = min(modes, key=lambda m: abs(m.f0_hz - 250))
    return np.array([mode.f0_hz, mode.damping_ratio])
