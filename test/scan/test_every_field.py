# SPDX-License-Identifier: Apache-2.0
"""Every field of a scene changes what a scan plans, asks of its hands, decides, keeps or draws."""

import copy
import json
import math
import sys
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from tactile_resonance.contact.samples import Pose
from tactile_resonance.poles.result import Poles
from tactile_resonance.report.run_report import pole_maps_of
from tactile_resonance.scan.decision import BlockLimits, Precise
from tactile_resonance.scan.goal import Frames, GoalFiles, ScanGoal
from tactile_resonance.scan.hands import Controls, Touch
from tactile_resonance.scan.point_outcome import judge_drift
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.run_start import start_run
from tactile_resonance.scan.runner import ScanRunner
from tactile_resonance.scan.scene import (
    BENCH_KEYS,
    DriftLimits,
    Gate,
    Notes,
    ScanScene,
    SensorUse,
    TimeLimits,
    read_scan_scene,
)
from tactile_resonance.scan.surface import NormalRequest, TouchRequest

sys.path.insert(0, str(Path(__file__).resolve().parent))
from bench_hands import Bench

FRAMES = Frames("table", "base", Pose(np.array([-0.49, -0.13, 0.2]), np.array([0.0, 0.0, -1.5])))
CLASS = {"f0_hz": 254.0, "damping_ratio": 0.03, "f0_std_hz": 0.1, "damping_ratio_std": 1e-4}
NOMINAL = {
    **{"force_n": 0.0102, "age_s": 1.0, "f0_hz_per_n": 220.0, "damping_ratio_per_n": 1.3},
    **{"f0_std_hz_per_n": 20.0, "damping_ratio_std_per_n": 0.1, "correlation": 0.2},
    **{"creep": 0.03, "creep_std": 0.004, "force_scale_std": 0.01},
    **{"unknown_force_std_n": 3e-4, "unknown_age_factor": 2.0},
}
BASE = {
    "name": "base",
    "frame_id": "table",
    "force_n": 0.01,
    "hold": "force",
    "sensor": {
        **{"name": "bimorph", "band_low_hz": 200.0, "band_high_hz": 300.0, "order": 2},
        **{"residual_terms": 6, "further_bands": [], "sample_rate_hz": 50e3},
        **{"samples_per_period": 20000, "level_v": 1.0, "heading_rad": 0.0},
    },
    "surface": {"plane": {"point_m": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}},
    "positions": {"list": [[0.0, 0.0], [0.004, 0.0], [0.0, 0.004]]},
    "outputs": ["poles", "map"],
    "precision": {"f0_std_hz": 0.0125, "damping_ratio_std": 1e-3},
    "blocks": {"least": 2, "most": 8},
    "gate": {"force_rms_n": 1e-3, "force_error_n": 1e-3, "measurements": 3},
    "tissue_classes": {"a": CLASS, "b": {**CLASS, "f0_hz": 254.2}},
    "unknown_level": 0.01,
    "nominal_contact": NOMINAL,
    "on_failure": "continue",
    "time_limits": {"point_s": 60.0, "scan_s": 3600.0},
    "drift_limits": {"f0_hz": 0.05, "damping_ratio": 5e-5},
    "normals": {
        **{"radius_m": 2e-3, "touches": 3, "force_n": 5e-3},
        **{"most_angle_rad": 0.35, "most_std_rad": 0.03, "tolerance_m": 2e-4},
    },
    "notes": {"temperature_c": 20.0, "tip_wetness": "dry", "adhesion": "", "remarks": ""},
}
FOUND = {
    **{"points_m": [[0.0, 0.0], [0.01, 0.0], [0.0, 0.01], [0.01, 0.01]], "form": "plane"},
    **{"expected_height_m": 0.0, "force_n": 0.004, "tolerance_m": 2e-4, "search_m": 0.0},
}
TOUCHED = {"surface": {"touch": FOUND}}
# without a nominal contact the measured pole is compared, whose distance to the classes is known
SEPARATE = {
    "precision": {"separate": ["a", "b"], "probability": 0.99},
    "tissue_classes": {
        name: {**CLASS, "f0_hz": f0} for name, f0 in zip("abc", (254.0, 254.2, 258.0), strict=True)
    },
    "nominal_contact": None,
}
ADAPTIVE = {
    **{"center_m": [0.0, 0.0], "size_m": [0.01, 0.01], "spacing_m": 0.002},
    **{
        "smallest_m": 0.01,
        "start": 5,
        "most": 12,
        "boundary": {"between": ["a", "b"], "area_m2": 1e-7},
    },
}
CHOSEN = {"positions": {"adaptive": ADAPTIVE}, "normals": None, "gate": None}


def otherwise(left_out, **given):
    """Adaptive positions with some fields left out and others given."""
    kept = {key: value for key, value in ADAPTIVE.items() if key not in left_out}
    return {**CHOSEN, "positions": {"adaptive": {**kept, **given}}}


TRIANGLE = [[0.0, 0.0], [0.01, 0.0], [0.0, 0.01]]
IN_POLYGON = otherwise(("center_m", "size_m"), polygon_m=TRIANGLE)
TISSUE = otherwise(("boundary",), tissue={"name": "a", "area_m2": 4e-7})
MAP = otherwise(("boundary",), map={"f0_std_hz": 0.5})
# A field, what it becomes, and what of the base it needs to be otherwise for that to show.
CHANGES = {
    "name": ("other", {}),
    "frame_id": ("base", {}),
    "force_n": (0.0105, {}),
    "hold": ("indentation", {}),
    "protocols": ([{"kind": "creep", "hold_s": 5.0, "points": [2]}], {}),
    "sensor.band_low_hz": (210.0, {}),
    "sensor.band_high_hz": (310.0, {}),
    "sensor.order": (0, {}),
    "sensor.residual_terms": (8, {}),
    "sensor.further_bands": ([{"low_hz": 600.0, "high_hz": 800.0}], {}),
    "sensor.sample_rate_hz": (40e3, {}),
    "sensor.samples_per_period": (10000, {}),
    "sensor.level_v": (0.5, {}),
    "sensor.heading_rad": (0.5, {}),
    "sensor.calibrated": (True, {"gate": None}),
    "surface.plane.point_m": ([0.0, 0.0, 1e-3], {}),
    "surface.plane.normal": ([0.0, 0.1, 1.0], {}),
    "surface.touch.points_m": ([[0.0, 0.0], [0.01, 0.0], [0.0, 0.012]], TOUCHED),
    "surface.touch.form": (
        "quadric",
        {
            "surface": {
                "touch": {
                    **FOUND,
                    "points_m": [
                        [0.0, 0.0],
                        [0.01, 0.0],
                        [0.0, 0.01],
                        [0.01, 0.01],
                        [-0.01, 0.0],
                        [0.0, -0.01],
                        [-0.01, -0.01],
                    ],
                }
            }
        },
    ),
    "surface.touch.expected_height_m": (1e-3, TOUCHED),
    "surface.touch.force_n": (0.003, TOUCHED),
    "surface.touch.tolerance_m": (1e-9, TOUCHED),
    "surface.touch.search_m": (4e-3, TOUCHED),
    "positions.list": ([[0.0, 0.0], [0.004, 0.0]], {}),
    "positions.adaptive.center_m": ([0.001, 0.0], CHOSEN),
    "positions.adaptive.size_m": ([0.012, 0.01], CHOSEN),
    "positions.adaptive.polygon_m": ([[0.0, 0.0], [0.01, 0.0], [0.0, 0.008]], IN_POLYGON),
    "positions.adaptive.spacing_m": (0.0015, CHOSEN),
    "positions.adaptive.smallest_m": (0.004, CHOSEN),
    "positions.adaptive.start": (6, CHOSEN),
    "positions.adaptive.most": (9, CHOSEN),
    "positions.adaptive.boundary": ({"f0_hz": 253.97, "area_m2": 1e-7}, CHOSEN),
    "positions.adaptive.tissue": ({"name": "a", "area_m2": 1e-12}, TISSUE),
    "positions.adaptive.map": ({"f0_std_hz": 1e-3}, MAP),
    "outputs": (["poles"], {}),
    "precision.f0_std_hz": (0.009, {}),
    "precision.damping_ratio_std": (1.2e-5, {}),
    "precision.separate": (["a", "c"], SEPARATE),
    "precision.probability": (0.6, SEPARATE),
    "blocks.least": (4, {}),
    "blocks.most": (2, {}),
    "gate.force_rms_n": (1e-4, {}),
    "gate.force_error_n": (1e-4, {}),
    "gate.measurements": (5, {"gate": {"force_rms_n": 1e-5, "measurements": 3}}),
    "tissue_classes.a.f0_hz": (253.9, {}),
    "unknown_level": (0.9, {}),
    "on_failure": ("stop", {"gate": {"force_rms_n": 1e-5}}),
    "time_limits.point_s": (0.015, {}),
    "time_limits.scan_s": (0.05, {}),
    "drift_limits.f0_hz": (0.01, {}),
    "drift_limits.damping_ratio": (1e-5, {}),
    "normals.radius_m": (3e-3, {}),
    "normals.touches": (4, {}),
    "normals.force_n": (0.004, {}),
    "normals.most_angle_rad": (0.01, {}),
    "normals.most_std_rad": (1e-4, {}),
    "normals.tolerance_m": (1e-9, {"normals": {"touches": 5}}),
    "notes.temperature_c": (37.0, {}),
    "notes.tip_wetness": ("wet", {}),
    "notes.adhesion": ("sticks", {}),
    "notes.remarks": ("fresh", {}),
}
CHANGES |= {f"nominal_contact.{key}": (value * 1.1, {}) for key, value in NOMINAL.items()}
CHANGES["nominal_contact.unknown_force_std_n"] = (4e-4, {"force_n": 0.010001})
CHANGES["nominal_contact.unknown_age_factor"] = (3.0, {"force_n": 0.010002})
FURTHER_OUTPUTS = ("frf", "distortion", "silent")


class Watched(Bench):
    """Keeps what it is asked for; the surface it touches is tilted and not quite even."""

    force_known = True
    age_known = True

    def touch(self, point, force_n, hold, check):
        self.log.append((point.position_m, point.orientation_xyzw, point.label, force_n, hold))
        super().touch(point, force_n, hold, check)

    def find(self, point, force_n, ball_radius_m, check):
        self.log.append(("find", point.position_m, force_n))
        x, y, _ = point.position_m
        uneven = 2e-5 * math.sin(900 * x) * math.cos(700 * y)
        return Touch((x, y, 0.02 * x + ball_radius_m + uneven), 2e-5, force_n)

    def measure(self, design, label, seed, enough, recording, check):
        self.log.append(design)

        def unknown(measured, blocks):
            return enough(self.seen(measured), blocks)

        return self.seen(super().measure(design, label, seed, unknown, recording, check))

    def seen(self, measured):
        if not self.force_known:
            contact = measured.origin.contact
            contact = type(contact)(
                position_m=contact.position_m, frame_id="base", spread=contact.spread
            )
            measured = type(measured)(measured.poles, type(measured.origin)(contact=contact), 2.0)
        return measured if self.age_known else type(measured)(measured.poles, measured.origin)


def observed(tmp_path, content):
    """All that a scan of this content does: what it plans, asks, finds, tells and draws, as text."""
    tmp_path.mkdir()
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(content))
    bench = Watched(rms_n=lambda measurements, blocks: 5e-4, force_n=0.0103)
    bench.force_known = content["force_n"] != 0.010001
    bench.age_known = content["force_n"] != 0.010002
    goal = ScanGoal(scene=str(path), run_directory=str(tmp_path / "run"))
    try:
        plan, run, _ = start_run(
            *(goal, FRAMES, GoalFiles("", ["/"]), bench),
            seed=1,
            tip_use=None,
            tell=lambda _: None,
            check=lambda: None,
        )
    except ValueError as error:
        return str(error)
    with run:
        summary = ScanRunner(plan, run, bench, Controls(), lambda _: None).run()
    run = read_run(tmp_path / "run")
    results = [asdict(result) for result in run.latest]
    for result in results:
        for name in ("time_ns", "measurement_id"):
            del result[name]
    air = np.array([254.0, 0.03])
    air, moved = (
        replace(Poles().main, estimate=estimate, covariance=np.diag([1e-6, 1e-14]))
        for estimate in (air, air + [0.02, 2e-5])
    )
    told = {
        "log": bench.log,
        "frame": bench.frame_in_base.vector.tolist(),
        "results": results,
        "drift": judge_drift(air, moved, plan.scene.drift_limits),
        "maps": len(pole_maps_of(run)),
        "summary": summary.message,
        "found": {
            key: run.facts[key] for key in ("surface", "normals", "notes") if key in run.facts
        },
        "skipped": run.facts["skipped"],
        "files": sorted(file.name for file in run.files),
    }
    return json.dumps(told, default=str, sort_keys=True)


def changed(content, field, value):
    content = copy.deepcopy(content)
    *into, last = field.split(".")
    inner = content
    for key in into:
        inner = inner.setdefault(key, {})
    inner[last] = value
    return content


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    """What scans of a content do, each made once."""
    done = {}

    def of(content):
        key = json.dumps(content, sort_keys=True)
        if key not in done:
            done[key] = observed(tmp_path_factory.mktemp("scan") / "here", content)
        return done[key]

    return of


@pytest.mark.parametrize("field", CHANGES)
def test_a_field_that_is_changed_changes_what_is_done(field, known):
    value, needed = CHANGES[field]
    base = {key: each for key, each in {**BASE, **needed}.items() if each is not None}
    if field.startswith("normals") or field.startswith("surface.touch"):
        base = {key: each for key, each in base.items() if key != "gate"}
    elif not needed.get("normals"):
        base = {key: each for key, each in base.items() if key != "normals"}
    if field.startswith("surface.touch"):
        base.pop("normals", None)
    assert known(changed(base, field, value)) != known(base)


@pytest.mark.parametrize("output", FURTHER_OUTPUTS)
def test_an_output_changes_what_is_done(output, known):
    base = {key: each for key, each in BASE.items() if key != "normals"}
    assert known({**base, "outputs": ["poles", "map", output]}) != known(base)


def test_no_field_is_forgotten():
    sections = {
        **{"sensor": SensorUse, "blocks": BlockLimits, "gate": Gate, "time_limits": TimeLimits},
        **{"drift_limits": DriftLimits, "normals": NormalRequest, "notes": Notes},
        **{"precision": Precise, "surface.touch": TouchRequest},
    }
    tested = {*CHANGES, *(field.split(".")[0] for field in CHANGES)}
    chosen = {"positions_m", "adaptive"}
    whole = {field.name for field in fields(ScanScene)} - chosen | {"positions"}
    assert whole <= tested
    for section, kind in sections.items():
        # the only sensor there is: any other name is refused
        own = {f"{section}.{field.name}" for field in fields(kind)} - {"sensor.name"}
        assert own <= tested, section
    # what is left are fields of the simulated bench
    assert {"regions", "buried", "motion"} == BENCH_KEYS


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("sensor.name", "other"),
        ("outputs", ["poles", "relaxation"]),
        ("outputs", ["map"]),
        ("protocol", "sweep"),
    ],
)
def test_what_is_not_built_is_refused(tmp_path, field, value):
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(changed(BASE, field, value)))
    with pytest.raises(ValueError, match=rf"{field}.*got .*; accepted is"):
        read_scan_scene(path)
