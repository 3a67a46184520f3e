# SPDX-License-Identifier: Apache-2.0
"""Runs on the simulated bench whose files hold what nodes record: FRF, poles, truth, force, result."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import tactile_resonance as tr
from tactile_resonance.configuration import share_path
from tactile_resonance.multisine import design_multisine
from tactile_resonance.poles.result import STATUSES, Poles, PolesStatus
from tactile_resonance.recording.messages import POLES_STATUS, write_indentation
from tactile_resonance.report.point_details import FRF_TYPE, STATE_TYPE
from tactile_resonance.scan.messages import header_message, make_message, to_cdr
from tactile_resonance.scan.plan import make_plan
from tactile_resonance.scan.point_result import POLES_TYPE, PointOutcome, PointResult
from tactile_resonance.scan.recorded import EXCITATION
from tactile_resonance.scan.scene import read_scan_scene
from tactile_resonance.scan.tissue_tests import TYPE as INDENTATION_TYPE
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.simulation.tissue.scene import read_scene

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "scan"))
from scanned import START_NS, begin, measure

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)> %{x} & \u2028"
PERIODS = 4
BAND_HZ = (200.0, 300.0)
SIMULATED_NS, STATE_STEP_NS = 30 * 10**9, 40_000_000


def write_scene(path, spacing_m=0.01, name="gelatine with an inclusion", tissue="gelatine 10 %"):
    """The inclusion's scene with points so far apart, and other names."""
    text = share_path("config/scenes/inclusion_scan.yaml").read_text()
    text = text.replace("spacing_m: 0.005", f"spacing_m: {spacing_m}")
    text = text.replace("name: gelatine with an inclusion", f"name: {quoted(name)}", 1)
    classes, rest = text.split("tissue_classes:")
    path.write_text(classes + "tissue_classes:" + rest.replace("gelatine 10 %:", f"{quoted(tissue)}:", 1))
    return path


def quoted(text):
    return '"' + text.replace('"', '\\"').replace("\u2028", "\\u2028") + '"'


def scan(scene_path, folder, failed=(), most=None, tests=None, reasons=None):
    """Measure the points of a scene, all but those that fail; returns the FRFs and poles by point.

    Of some points mechanical tests, by index, and reasons why others were not carried out.
    """
    scene, phantoms = read_scan_scene(scene_path), read_scene(read_tissues(), scene_path)
    design, bench, known = make_plan(scene).measurement, SimulatedBench.from_configuration(), {}
    with begin(scene_path, folder) as run:
        for point in run.content.points[:most]:
            with run.begin_point(point.index) as recording:
                if point.index in failed:
                    x_m, y_m, z_m = point.position_m
                    lost, why = PointOutcome.FAILED, f"lost {HOSTILE}"
                    place = {"x_m": x_m, "y_m": y_m, "z_m": z_m}
                    recording.finish(PointResult(point.index, 0, HOSTILE, lost, why, **place))
                    continue
                result = measure(scene, phantoms, design, bench, point, recording.attempt)
                known[point.index] = record(recording, result, phantoms, bench, design)
                for test in (tests or {}).get(point.index, ()):
                    message = make_message(INDENTATION_TYPE)
                    write_indentation(message, test)
                    recording.write("/left/indentation", INDENTATION_TYPE, result.time_ns, to_cdr(message))
                recording.finish(replace(result, reason=(reasons or {}).get(point.index, "")))
    return known


def record(recording, result, phantoms, bench, design):
    """Write what nodes send while a point is measured."""
    excitation = design_multisine(
        band_hz=design.stretches_hz, level_v=design.level_v, grid=design.grid, seed=1, periods=PERIODS
    )
    tissue = phantoms.tissue_at(result.position_m)
    blocks = list(bench.start(tissue, force_n=0.01, seed=result.index).play(excitation, PERIODS))
    u, y = (np.array([getattr(b, name).volts() for b in blocks]) for name in ("actuator", "sensor"))
    taken = tr.make_recording(u, y, sample_rate_hz=excitation.sample_rate_hz)
    frf, poles = tr.estimate_frf(taken), tr.identify_poles(taken, band_hz=BAND_HZ)
    stamp_ns = START_NS + result.index * 10**9
    own = {"header": header_message("tip", stamp_ns), "measurement_id": result.measurement_id}

    def write(topic, kind, after_ns=0, **values):
        whole = {k: np.ascontiguousarray(v) if isinstance(v, np.ndarray) else v for k, v in values.items()}
        message = make_message(kind, **(own if "header" not in values else {}), **whole)
        recording.write(topic, kind, stamp_ns + after_ns, to_cdr(message))

    write("/left/excitation", EXCITATION, sample_rate_hz=5e4, samples_per_period=20000)
    for k in range(10):
        force_n = 0.01 + 1e-4 * np.sin(k)
        # in simulated time: a millisecond there takes three of the recording
        header = header_message("tip", SIMULATED_NS + (k + 1) * STATE_STEP_NS)
        state = {"header": header, "state": "hold", "force_n": force_n}
        write("/left/contact_state", STATE_TYPE, 3 * (k + 1) * STATE_STEP_NS, **state)
    of_frf = {"frequency_hz": frf.frequency_hz, "real": frf.g.real, "imag": frf.g.imag}
    counts = {"periods": PERIODS, "realisations": 1, "noise_dof": frf.noise_dof}
    write("/left/frf", FRF_TYPE, 500_000_000, **of_frf, variance_noise=frf.variance_noise, **counts)
    write("/left/poles", POLES_TYPE, 510_000_000, **poles_values(poles))
    mode = bench.coupled(tissue, force_n=0.01).mode_near(250.0)
    values = {"f0_hz": [mode.f0_hz], "damping_ratio": [mode.damping_ratio]}
    truth = Poles(**{name: np.array(value) for name, value in values.items()}, status=PolesStatus.TRUTH)
    truth = {**poles_values(truth), "real_rad_s": np.array([-1.0]), "imag_rad_s": np.array([1.0])}
    truth |= {name: np.ones(1) for name in ("residue_real", "residue_imag")}
    write("/left/bench/truth", POLES_TYPE, 520_000_000, **truth, label=HOSTILE)
    return frf, poles


def poles_values(poles):
    assert poles.status in STATUSES
    values = {
        "real_rad_s": poles.poles_rad_s.real,
        "imag_rad_s": poles.poles_rad_s.imag,
        "residue_real": poles.residues.real,
        "residue_imag": poles.residues.imag,
        "f0_hz": poles.f0_hz,
        "damping_ratio": poles.damping_ratio,
    }
    for name in ("covariance", "total_covariance"):
        known = getattr(poles, name)
        values[name] = np.zeros(0) if known is None else known.ravel()
    low, high = BAND_HZ
    return {
        **values,
        **{"order": poles.structure.order, "numerator_order": poles.structure.numerator_order},
        **{"band_low_hz": low, "band_high_hz": high, "status": POLES_STATUS[poles.status]},
        **{"message": f"fitted {HOSTILE}", "instant_s": float("nan")},
    }
