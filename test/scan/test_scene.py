# SPDX-License-Identifier: Apache-2.0
"""Scene files: what is read, and what is refused with one line that names field, value and accepted."""

import numpy as np
import pytest
import yaml

from tactile_resonance.configuration import share_path
from tactile_resonance.contact.goal import HoldMode
from tactile_resonance.scan.decision import Precise, Separate
from tactile_resonance.scan.plan import make_plan
from tactile_resonance.scan.scene import OnFailure, Output, read_scan_scene
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.simulation.tissue.scene import read_scene
from tactile_resonance.tissue.classify import classify, posteriors
from tactile_resonance.tissue.nominal_contact import ContactLoad, refer_to_nominal
from tactile_resonance.tissue.references import read_classes

SCENES = sorted(path.name for path in share_path("config/scenes").glob("*.yaml"))
LEAST = {"force_n": 0.01, "positions": {"list": [[0, 0], [0.01, 0]]}}
CLASSES = {
    name: {"f0_hz": f0, "damping_ratio": 0.03, "f0_std_hz": 0.1, "damping_ratio_std": 1e-4}
    for name, f0 in (("a", 250.0), ("b", 255.0))
}
NOMINAL = {
    **{"force_n": 0.02, "age_s": 3.0, "f0_hz_per_n": 220.0, "damping_ratio_per_n": 1.3},
    **{"f0_std_hz_per_n": 20.0, "damping_ratio_std_per_n": 0.1},
}


def read(tmp_path, **content):
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump({**LEAST, **content}))
    return read_scan_scene(path)


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_serves_bench_and_scan(name):
    path = share_path("config/scenes") / name
    scene, phantoms = read_scan_scene(path), read_scene(read_tissues(), path)
    assert scene.force_n == phantoms.force_n
    points = make_plan(scene).points
    assert all(phantoms.tissue_at(p.position_m) is not None for p in points)


def test_classes_of_the_inclusion_are_the_benchs_own():
    path = share_path("config/scenes/inclusion_scan.yaml")
    scene, phantoms = read_scan_scene(path), read_scene(read_tissues(), path)
    bench = SimulatedBench.from_configuration()

    nominal = scene.nominal_contact

    def poles(tissue, force_n=nominal.force_n, hold_time_s=nominal.age_s):
        modes = bench.coupled(tissue, force_n=force_n, hold_time_s=hold_time_s).modes
        mode = min(modes, key=lambda m: abs(m.f0_hz - 250))
        return np.array([mode.f0_hz, mode.damping_ratio])

    plain, _ = scene.tissue_classes
    gelatine = read_tissues().gelatine
    # the spread is that of 0.33 % w/w alone: force and age of contact are accounted for separately
    rng = np.random.default_rng(1)
    drawn = np.array([poles(gelatine(10 + 0.33 * rng.standard_normal())) for _ in range(100)])
    std = drawn.std(axis=0, ddof=1)
    assert np.all(np.abs(plain.mean - drawn.mean(axis=0)) < 4 * std / 10)
    np.testing.assert_allclose(np.sqrt(np.diag(plain.spread)), std, rtol=4 / np.sqrt(200))
    correlation = plain.spread[0, 1] / np.sqrt(plain.spread[0, 0] * plain.spread[1, 1])
    assert correlation == pytest.approx(np.corrcoef(drawn.T)[0, 1], abs=4 * 0.2 / 10)
    noise = np.diag([0.01**2, 5e-5**2])
    called = [
        classify(poles(phantoms.tissue_at((0.002, y))), noise, scene.tissue_classes).name
        for y in (0.02, -0.001, 0.001)
    ]
    assert called == ["gelatine 10 %", "inclusion", "inclusion"]

    # members at any force of 0.15 mN about nominal and any age are as often unknown as the level says
    def tail(percent, force_n, age_s):
        x = poles(gelatine(percent), force_n, age_s)
        at = refer_to_nominal(x, noise, ContactLoad(force_n, 5e-5, age_s), nominal)
        return posteriors(at.compared, at.covariance, [plain])[1][0]

    tails = [
        tail(
            10 + 0.33 * rng.standard_normal(),
            0.01 + 1.5e-4 * rng.standard_normal(),
            np.exp(rng.uniform(np.log(1.2), np.log(5))),
        )
        for _ in range(200)
    ]
    assert np.mean(np.array(tails) < 0.1) < 0.1 + 4 * np.sqrt(0.1 * 0.9 / 200)


def test_defaults_and_choices(tmp_path):
    scene = read(tmp_path)
    assert (scene.hold, scene.on_failure) == (HoldMode.FORCE, OnFailure.CONTINUE)
    assert scene.outputs == (Output.POLES, Output.MAP)
    assert scene.precision is None
    assert scene.frame_id == "table"
    scene = read(
        tmp_path,
        hold="indentation",
        on_failure="stop",
        outputs=["distortion", "poles"],
        precision={"f0_std_hz": 0.02},
        blocks={"least": 2},
        tissue_classes=CLASSES,
    )
    assert (scene.hold, scene.on_failure) == (HoldMode.INDENTATION, OnFailure.STOP)
    assert scene.outputs == (Output.POLES, Output.DISTORTION)
    assert scene.precision == Precise(f0_std_hz=0.02)
    assert (scene.blocks.least, scene.blocks.most) == (2, 8)
    scene = read(
        tmp_path, tissue_classes=CLASSES, precision={"separate": ["a", "b"], "probability": 0.99}
    )
    assert isinstance(scene.precision, Separate)
    assert scene.precision.second is scene.tissue_classes[1]


def test_classes_from_a_file_and_from_points(tmp_path):
    points = [[250.0, 0.03], [250.1, 0.031], [249.8, 0.0305], [250.3, 0.0302]]
    content = {"tissue_classes": {"measured": {"points": points, "prior": 2.0}}}
    (tmp_path / "classes.yaml").write_text(yaml.safe_dump(content))
    scene = read(tmp_path, tissue_classes="classes.yaml")
    assert scene.nominal_contact is None
    (tissue,) = scene.tissue_classes
    np.testing.assert_allclose(tissue.mean, np.mean(points, axis=0))
    assert (tissue.degrees_of_freedom, tissue.prior) == (2.0, 2.0)
    # the contact to which they refer stands beside them
    (tmp_path / "classes.yaml").write_text(yaml.safe_dump(content | {"nominal_contact": NOMINAL}))
    scene = read(tmp_path, tissue_classes="classes.yaml")
    assert (scene.nominal_contact.force_n, scene.nominal_contact.age_s) == (0.02, 3.0)
    # as pole_map_node reads a scene
    (same,), nominal = read_classes(tmp_path / "scene.yaml")
    assert (same.name, same.degrees_of_freedom, nominal.age_s) == ("measured", 2.0, 3.0)
    (tmp_path / "none.yaml").write_text("name: x\n")
    with pytest.raises(ValueError, match="none.yaml: tissue_classes: got None"):
        read(tmp_path, tissue_classes="none.yaml")
    with pytest.raises(
        ValueError, match="nominal_contact: got 'one'; accepted is none: it belongs"
    ):
        read(tmp_path, tissue_classes="classes.yaml", nominal_contact=NOMINAL)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ({"force": 1}, r"scene.yaml: force: got 1; accepted is one of"),
        ({"force_n": -1}, "force_n: got -1.0; accepted is a number above 0"),
        ({"force_n": 8}, "force_n: got 8.0; accepted is at most 1; contact control accepts less"),
        ({"force_n": "1 cN"}, "force_n: got '1 cN'; accepted is a finite number"),
        ({"hold": "pressure"}, "hold: got 'pressure'; accepted is one of force, indentation"),
        (
            {"outputs": ["poles", "sound"]},
            r"outputs\[1\]: got .sound.; accepted is one of poles, frf",
        ),
        ({"outputs": []}, "outputs: got"),
        ({"outputs": ["map"]}, r"outputs: got .'map'.; accepted is a list with poles"),
        (
            {"outputs": ["poles", "relaxation"]},
            r"outputs\[1\]: got .relaxation.; accepted is one of poles, frf, distortion, map, silent",
        ),
        ({"sensor": {"order": 30}}, "sensor.order: got 30; accepted is 0"),
        ({"sensor": {"samples_per_period": 2}}, "sensor.samples_per_period: got 2"),
        (
            {"sensor": {"further_bands": [{"low_hz": 600, "high_hz": 500}]}},
            r"sensor.further_bands\[0\].band: 600 to 500 Hz",
        ),
        ({"blocks": {"least": 5, "most": 4}}, "blocks.most: got 4; accepted is at least least = 5"),
        ({"blocks": {"least": 2.5}}, "blocks.least: got 2.5; accepted is an integer"),
        ({"blocks": {"fewest": 2}}, "blocks.fewest"),
        ({"sensor": {"band_low_hz": 300.0, "band_high_hz": 200.0}}, "sensor.band_high_hz: got 200"),
        ({"sensor": {"name": "bimorf"}}, "sensor.name: got .bimorf.; accepted is one of .*bimorph"),
        ({"time_limits": {"point_s": 0.0}}, "time_limits.point_s: got 0"),
        ({"precision": {}}, "precision: got {}"),
        ({"precision": {"f0_std_hz": 0}}, "precision.f0_std_hz: got 0"),
        ({"precision": {"separate": ["a", "b"], "probability": 0.9}}, r"two out of .*\[\]"),
        (
            {"tissue_classes": CLASSES, "precision": {"separate": ["a", "b"], "probability": 0.4}},
            "precision.probability: got 0.4; accepted is between 0.5 and 1",
        ),
        ({"tissue_classes": {"a": {"f0_hz": 250.0}}}, "tissue_classes.a.damping_ratio: got None"),
        ({"tissue_classes": "none.yaml"}, "none.yaml"),
        (
            {"nominal_contact": NOMINAL},
            "tissue_classes: got None; accepted is classes, to which nominal_contact",
        ),
        (
            {"tissue_classes": CLASSES, "nominal_contact": NOMINAL | {"force_n": 10.0}},
            "nominal_contact.force_n: got 10.0; accepted is a tenth to ten times force_n, 0.0",
        ),
        (
            {"tissue_classes": CLASSES, "nominal_contact": NOMINAL | {"age_s": 0}},
            "scene.yaml: nominal_contact.age_s: got 0.0; accepted is a number above 0",
        ),
        ({"positions": None}, "positions: got None"),
        (
            {"positions": {"around": {"centres_m": [[0, 0]]}}},
            "positions.around.offsets_m: got None",
        ),
        ({"frame_id": 3}, "frame_id: got 3"),
        ({"surface": {"plane": {"normal": [0, 0, -1]}}}, "surface.plane.normal"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, content, reason):
    with pytest.raises(ValueError, match=reason) as caught:
        read(tmp_path, **content)
    assert "\n" not in str(caught.value) or "none.yaml" in reason
