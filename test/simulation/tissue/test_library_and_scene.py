# SPDX-License-Identifier: Apache-2.0
"""Configuration: exact values, gelatine at any concentration, phantoms, clear refusals."""

import numpy as np
import pytest
import yaml

from tactile_resonance.configuration import share_path
from tactile_resonance.scan.scene import read_scan_scene
from tactile_resonance.sensor import read_sensor
from tactile_resonance.simulation.plant.surfaces import SurfaceMotion
from tactile_resonance.simulation.tissue.library import read_tissues, uniform
from tactile_resonance.simulation.tissue.scene import (
    Box,
    HalfSpace,
    PhantomScene,
    Region,
    Sphere,
    read_scene,
)


def write(tmp_path, content):
    path = tmp_path / "file.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


def load(relative):
    return yaml.safe_load(share_path(relative).read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("percent", "modulus_pa"), [(10, 18.3e3), (12, 26.5e3), (14, 36.5e3), (16, 48.5e3)]
)
def test_tabulated_gelatine_is_reproduced_exactly(library, percent, modulus_pa):
    tissue = library.gelatine(percent)
    assert tissue.relaxation_modulus_1s_pa == modulus_pa
    assert tissue == library[f"gel{percent}"]


def test_gelatine_is_continuous_and_rises_as_a_power_law(library):
    percent = np.linspace(8, 20, 2401)
    modulus = np.array([library.gelatine(p).relaxation_modulus_1s_pa for p in percent])
    exponent = np.diff(np.log(modulus)) / np.diff(np.log(percent))
    # close to the square, as gels are; a jump would show as a far larger or smaller exponent
    assert np.all((exponent > 1.9) & (exponent < 2.3))


@pytest.mark.parametrize("percent", [7.9, 20.1, np.nan])
def test_gelatine_far_from_the_table_is_refused(library, percent):
    with pytest.raises(ValueError, match="percent.*8 to 20"):
        library.gelatine(percent)


def test_unknown_tissue_is_refused_with_the_known_ones(library):
    with pytest.raises(ValueError, match="tissue: got 'jelly'.*gel10"):
        library["jelly"]


@pytest.mark.parametrize(
    ("section", "key", "value", "named"),
    [
        ("beam", "width_m", -0.004, r"beam\.width_m: got -0.004; accepted is a number above 0"),
        ("beam", "mode_count", 2.5, r"beam\.mode_count: got 2.5; accepted is an integer"),
        ("beam", "lenght_m", 1.0, r"beam\.lenght_m.*one of"),
        ("beam", "width_m", "1 mm", r"beam\.width_m: got '1 mm'.*finite number"),
        ("tip", "mass_kg", None, r"tip\.mass_kg"),
        ("electric", "feedthrough", 1.5, r"electric\.feedthrough: got 1.5; accepted is a number above 0"),
        ("acquisition", "adc_bits", 64, r"acquisition\.adc_bits: got 64; accepted is 8 to 31"),
    ],
)
def test_a_wrong_sensor_field_is_named(tmp_path, section, key, value, named):
    content = load("config/sensors/bimorph.yaml")
    content[section][key] = value
    with pytest.raises(ValueError, match=named):
        read_sensor(write(tmp_path, content))


def test_a_missing_sensor_field_is_named(tmp_path):
    content = load("config/sensors/bimorph.yaml")
    del content["tip"]["radius_m"]
    with pytest.raises(ValueError, match=r"tip\.radius_m.*missing"):
        read_sensor(write(tmp_path, content))
    del content["electric"]
    with pytest.raises(ValueError, match=r"tip\.radius_m|electric.*mapping"):
        read_sensor(write(tmp_path, content))


def test_unreadable_files_are_one_clear_error(tmp_path):
    with pytest.raises(ValueError, match="cannot be read"):
        read_sensor(tmp_path / "absent.yaml")
    broken = tmp_path / "broken.yaml"
    broken.write_text("beam: [", encoding="utf-8")
    with pytest.raises(ValueError, match="cannot be read"):
        read_tissues(broken)
    with pytest.raises(ValueError, match="accepted is a mapping"):
        read_tissues(write(tmp_path, [1, 2]))


def test_a_wrong_tissue_field_is_named(tmp_path):
    content = load("config/tissues.yaml")
    content["tissues"]["gel10"]["slow_ratios"] = [0.1]
    with pytest.raises(ValueError, match=r"tissues\.gel10\.slow_ratios.*3 numbers"):
        read_tissues(write(tmp_path, content))


def test_gelatine_scene_lies_as_described(library):
    scene = read_scene(library)
    assert scene.force_n == 0.01
    positions = read_scan_scene(share_path("config/scenes/gelatine_phantoms.yaml")).positions_m
    percent = [scene.tissue_at(place[:2]).gelatine_percent for place in positions]
    assert percent == [10] * 5 + [12] * 5 + [14] * 5 + [16] * 5
    assert scene.tissue_at((0.03, 0.0)) is None
    grid = np.stack(np.meshgrid([0, 0.03, 0.06], [0.0, 0.026]), axis=-1)  # (2, 3, 2)
    np.testing.assert_array_equal(scene.region_index(grid), [[0, -1, 1], [-1, -1, -1]])


def test_later_regions_cover_earlier_ones(library):
    gel, liver = library["gel10"], library["liver"]
    scene = PhantomScene(
        "nodule",
        0.01,
        (
            Region("block", Box((-1.0, -1.0, -1.0), (1.0, 1.0, 0.0)), uniform(gel)),
            Region("right", HalfSpace((0.5, 0.0), (-1.0, 0.0)), uniform(liver)),
            Region("nodule", Sphere((0.0, 0.0, -0.1), 0.2), uniform(library["gel16"])),
        ),
    )
    places = [(0.0, 0.15, 0.0), (0.0, 0.15, -0.3), (0.6, 0.0, -0.5)]
    found = [scene.regions[index].name for index in scene.region_index(places)]
    assert found == ["nodule", "block", "right"]
    assert scene.region_index((0.0, 0.15)) == scene.region_index((0.0, 0.15, 0.0))  # height 0
    assert scene.region_index((-0.6, 0.0, 0.5)) == -1


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"tissue": "jelly"}, r"regions\[0\]\.tissue: got 'jelly'"),
        ({"gelatine_percent": 99.0}, r"regions\[0\]\.gelatine_percent: got 99"),
        ({"sphere": {"center_m": [0, 0, 0], "radius_m": 1}}, r"regions\[0\].*exactly one of"),
        ({"colour": "red"}, r"regions\[0\]\.colour"),
        ({"disc": {"center_m": [0, 0, 0], "radius_m": 1}}, r"disc\.center_m.*2 numbers"),
        ({"disc": {"center_m": [0, 0], "radius_m": 0}}, r"disc\.radius_m.*above 0"),
    ],
)
def test_a_wrong_region_is_named(tmp_path, library, change, named):
    content = load("config/scenes/gelatine_phantoms.yaml")
    region = content["regions"][0] | change
    if "tissue" in change:
        del region["gelatine_percent"]
    content["regions"][0] = region
    with pytest.raises(ValueError, match=named):
        read_scene(library, write(tmp_path, content))


def test_motion_of_a_scene_is_read_and_refused_by_name(tmp_path, library):
    path = share_path("config/scenes/breathing.yaml")
    assert read_scene(library, path).motion == SurfaceMotion(1e-3, 0.25, 3, 1e-4, 1.2, 1)
    assert read_scene(library).motion is None
    read_scan_scene(path)
    content = load("config/scenes/breathing.yaml")
    for motion, named in (
        ({"breath_m": 0.5}, r"motion\.breath_m: got 0.5; accepted is 0 to 0.02"),
        ({"breath_mm": 1.0}, r"motion\.breath_mm.*one of"),
        ([1e-3], "motion: got .* accepted is a mapping"),
    ):
        content["motion"] = motion
        with pytest.raises(ValueError, match=named):
            read_scene(library, write(tmp_path, content))


def test_shared_files_are_found_through_the_ament_index(tmp_path, monkeypatch):
    share = tmp_path / "share" / "tactile_resonance" / "config"
    share.mkdir(parents=True)
    (share / "only_here.yaml").write_text("{}", encoding="utf-8")
    with pytest.raises(FileNotFoundError, match="only_here.yaml"):
        share_path("config/only_here.yaml")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nonexistent:{tmp_path}")
    assert share_path("config/only_here.yaml") == share / "only_here.yaml"
    with pytest.raises(ValueError, match="relative"):
        share_path("../secret")
