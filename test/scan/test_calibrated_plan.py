# SPDX-License-Identifier: Apache-2.0
"""What a plan makes of a scene with a calibrated sensor."""

from pathlib import Path

import pytest

from tactile_resonance.configuration import share_path
from tactile_resonance.scan.measurement import design_measurement
from tactile_resonance.scan.plan import make_plan
from tactile_resonance.scan.plan_text import plan_rows
from tactile_resonance.scan.scene import parse_scan_scene
from tactile_resonance.strict_yaml import parse_yaml

SCENE = share_path("config/scenes/two_gelatines.yaml")


def scene(**changes):
    content = parse_yaml(SCENE.read_text(encoding="utf-8"))
    content["sensor"] |= {"calibrated": True} | changes.pop("sensor", {})
    return parse_scan_scene(content | changes, Path("changed.yaml"))


def test_blocks_are_of_20_ms_and_one_may_do():
    design = design_measurement(scene())
    assert design.block_s == pytest.approx(0.02)
    assert design.blocks.least == 1
    assert design.sweep
    assert design.stretches_hz == ((200.0, 620.0),)  # all lines lie in the band
    assert design.lines == 9


def test_each_line_is_as_high_as_without_a_calibration():
    short, usual = design_measurement(scene()), design_measurement(scene(sensor={"calibrated": False}))
    power = [design.level_v**2 / design.lines * design.block_s for design in (short, usual)]
    # of all lines at once, whose number goes as the period
    assert power[0] / power[1] == pytest.approx(1.0, rel=0.02)


def test_a_reference_in_air_is_as_without_a_calibration():
    short, usual = design_measurement(scene()), design_measurement(scene(sensor={"calibrated": False}))
    assert short.of_reference == usual.of_reference


def test_a_period_of_the_scene_s_own_is_kept():
    design = design_measurement(scene(sensor={"samples_per_period": 600}))
    assert design.block_s == pytest.approx(0.012)
    assert design.of_reference.samples > 2000


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"outputs": ["poles", "distortion"]}, "outputs: got"),
        (
            {"sensor": {"further_bands": [{"low_hz": 650.0, "high_hz": 800.0}]}},
            "sensor.further_bands",
        ),
        ({"gate": {"force_rms_n": 1e-3}}, "gate: got"),
        ({"sensor": {"samples_per_period": 300}}, r"sensor: got \d+ excited lines in the band"),
    ],
)
def test_what_short_blocks_do_not_hold_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        design_measurement(scene(**changes))


def test_the_plan_says_so():
    rows = dict(plan_rows(make_plan(scene())))
    assert "calibration of poles_node" in rows["sensor"]
    assert "transient is known" in rows["period"]
