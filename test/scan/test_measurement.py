# SPDX-License-Identifier: Apache-2.0
"""The period that a plan chooses: lines enough, no more, away from the mains; that of a calibrated sensor."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_resonance.configuration import parse_yaml, share_path
from tactile_resonance.contact.force_spread import spread_of
from tactile_resonance.multisine import Grid
from tactile_resonance.poles.structure import PoleBand
from tactile_resonance.scan.decision import BlockLimits, Precise, Separate
from tactile_resonance.scan.measurement import (
    LEAST_DISTANCE,
    LONGER,
    design_measurement,
    excitation_of,
    lines_of,
    lines_wanted,
    mains_distances,
    mains_in,
    shortest_samples,
)
from tactile_resonance.scan.plan import make_plan, plan_rows
from tactile_resonance.scan.scene import (
    Gate,
    Output,
    parse_scan_scene,
    read_scan_scene,
    residual_terms_of,
)

SCENE = share_path("config/scenes/two_gelatines.yaml")


def test_lines_are_those_of_coefficients_and_noise():
    # numerator 8, denominator 2, transient 6: eight lines; and twelve
    assert lines_wanted(PoleBand(200.0, 300.0, 2, 6)) == 20
    # the transient has no more terms for more residual terms
    assert lines_wanted(PoleBand(200.0, 580.0, 2, 12)) == 23
    assert lines_wanted(PoleBand(200.0, 580.0, 0, 12)) == 23


bands = st.builds(
    lambda low, width, terms: PoleBand(low, low + width, 2, terms),
    st.floats(20.0, 2000.0),
    st.floats(50.0, 1000.0),
    st.integers(1, 14),
)


@settings(max_examples=40, deadline=None)
@given(st.lists(bands, min_size=1, max_size=2), st.sampled_from([1.0, 3 / 8]))
def test_no_shorter_period_has_the_lines(several, share):
    rate_hz = 2e4

    def enough(samples):
        spacing_hz = rate_hz / samples
        return all(lines_of(b.ends_hz, spacing_hz, share) >= lines_wanted(b) for b in several)

    samples = shortest_samples(several, rate_hz, share)
    assert enough(samples)
    shortest = next(n for n in range(4, samples + 1) if enough(n))
    assert samples <= LONGER * shortest
    # longer than that only for the mains: none between is as far from them, or far enough
    between = np.array([n for n in range(shortest, samples) if enough(n)], float)
    away = mains_distances(mains_in(several), rate_hz / between)
    found = mains_distances(mains_in(several), rate_hz / samples)
    assert np.all(away < min(LEAST_DISTANCE, found))


def test_distances_from_the_mains():
    hum_hz = mains_in([PoleBand(200.0, 300.0)])
    np.testing.assert_array_equal(hum_hz, [200, 240, 250, 300])
    np.testing.assert_allclose(mains_distances(hum_hz, [2.5, 16.0, 40.0]), [0, 0, 0])
    np.testing.assert_allclose(mains_distances(np.array([250.0]), 100.0), 0.5)
    assert mains_distances(mains_in([PoleBand(201.0, 239.0)]), 10.0) == 0.5
    np.testing.assert_array_equal(
        mains_in([PoleBand(590.0, 610.0), PoleBand(95.0, 125.0)]), [100, 120, 600]
    )


@pytest.mark.parametrize("ends_hz", [(200.0, 300.0), (200.0, 620.0), (140.0, 420.0)])
def test_residual_terms_follow_a_neighbour_and_not_many_more(ends_hz):
    low_hz, high_hz = ends_hz
    terms = residual_terms_of(ends_hz)
    x = np.cos(np.linspace(0, np.pi, 400))
    s = 2j * np.pi * ((low_hz + high_hz) / 2 + (high_hz - low_hz) / 2 * x)
    neighbour = 1 / (s - 2j * np.pi * low_hz / 2)

    def left(count):
        fitted = np.polynomial.chebyshev.chebfit(x, neighbour, count - 1)
        rest = neighbour - np.polynomial.chebyshev.chebval(x, fitted)
        return np.max(np.abs(rest)) / np.max(np.abs(neighbour))

    assert left(terms) < 2e-6
    assert left(terms - 2) > 1e-6


def test_a_scene_that_leaves_it_to_the_plan():
    scene = read_scan_scene(SCENE)
    design = design_measurement(scene)
    (band,) = design.bands
    assert design.samples == shortest_samples(design.bands, 5e4) == 2948
    assert 0.02 < design.block_s < 0.08
    assert (band.residual_terms, design.lines) == (residual_terms_of(band.ends_hz), 25)
    assert design.sweep
    # nothing beside the band, and the power density of the scene's level
    assert design.stretches_hz == ((200.0, 620.0),)
    assert design.level_v == pytest.approx(np.sqrt(25 / 589))
    assert not excitation_of(design, seed=3).random_phases
    # of two classes one block may be enough; as long a time as ever at most
    assert design.blocks == BlockLimits(1, 55)
    assert 3.2 <= design.blocks.most * design.block_s < 3.2 + design.block_s
    assert 0.8 <= design.of_reference.periods * design.block_s < 0.8 + design.block_s
    assert isinstance(scene.precision, Separate)
    precise = design_measurement(replace(scene, precision=Precise(0.02)))
    assert precise.blocks == BlockLimits(3, 55)
    given = design_measurement(replace(scene, blocks=BlockLimits(2, 4)))
    assert given.blocks == BlockLimits(2, 4)


@pytest.mark.parametrize("width_hz", [1.0, 1e-3, 1e-9])
def test_a_band_too_narrow_for_a_period_is_refused_at_once(width_hz):
    scene = read_scan_scene(SCENE)
    use = replace(scene.sensor, band_high_hz=200.0 + width_hz)
    with pytest.raises(
        ValueError, match=r"^sensor: band .Hz.: got .200.0, .* wide or more with samples_per_period auto"
    ):
        design_measurement(replace(scene, sensor=replace(use, residual_terms=15)))


def test_a_band_too_wide_for_residual_terms_is_named():
    scene = read_scan_scene(SCENE)
    with pytest.raises(ValueError, match=r"^band_low_hz, band_high_hz: got \[50.0, 620.0\]"):
        replace(scene.sensor, band_low_hz=50.0)


def test_a_gate_takes_blocks_whose_force_has_a_spread():
    """`force_spread` knows none of less than 0.15 s: every point would fail."""
    scene = replace(read_scan_scene(SCENE), gate=Gate(1e-3))
    design = design_measurement(scene)
    assert 0.16 <= design.block_s <= LONGER * 0.16
    time_s = np.arange(0.0, design.block_s, 2e-3)
    assert np.isfinite(spread_of(time_s, np.full(time_s.size, 0.01), design.block_s).rms_n)
    assert dict(plan_rows(make_plan(scene)))["period"].endswith("at least 0.16 s for the gate")
    short = replace(scene, sensor=replace(scene.sensor, samples_per_period=5000))
    with pytest.raises(
        ValueError, match=r"samples_per_period: got 5000; accepted is 8000 or more with a gate"
    ):
        design_measurement(short)


def test_what_the_scene_says_stays():
    scene = read_scan_scene(SCENE)
    usual = replace(scene, sensor=replace(scene.sensor, samples_per_period=20_000))
    design = design_measurement(usual)
    assert (design.samples, design.sweep, design.blocks) == (20_000, False, BlockLimits())
    assert design.bands[0].residual_terms == 6
    assert design.of_reference.periods == 3


def test_distortion_has_random_phases_and_enough_of_its_fewer_lines():
    scene = replace(read_scan_scene(SCENE), outputs=(Output.POLES, Output.DISTORTION))
    design = design_measurement(scene)
    assert (design.grid, design.sweep) == (Grid.ODD_RANDOM, False)
    excited = excitation_of(design, seed=1).frequency_hz
    here = np.count_nonzero((excited >= 200) & (excited <= 620))
    assert here >= lines_wanted(design.bands[0]) - 1  # a last block of lines may be incomplete


def test_the_plan_says_who_chose_and_which_hum_it_cannot_tell():
    scene = read_scan_scene(SCENE)
    rows = dict(plan_rows(make_plan(scene)))
    assert rows["period"].startswith("the shortest with 25 lines from 200 to 620 Hz")
    assert rows["mains"].startswith("harmonics of 50 and 60 Hz in the bands are 0.15")
    assert rows["measured"] == "1 to 55 blocks a point"
    assert "a rising sweep" in rows["excited"]
    usual = replace(scene.sensor, band_high_hz=300.0, samples_per_period=20_000)
    rows = dict(plan_rows(make_plan(replace(scene, sensor=usual))))
    assert rows["period"] == "as the scene says"
    assert rows["mains"].startswith("hum at 200, 240, 250, 300 Hz would count as response")


@pytest.mark.parametrize(
    ("sensor", "reason"),
    [
        ({"samples_per_period": "fast"}, "samples_per_period: got 'fast'; accepted is an integer"),
        ({"samples_per_period": 2e4}, "samples_per_period: got 20000.0; accepted is an integer"),
        (
            {"samples_per_period": "auto", "band_low_hz": 20.0, "band_high_hz": 9000.0},
            "accepted is a narrower band with samples_per_period auto: residual terms 208 of up to 20",
        ),
    ],
)
def test_what_cannot_be_chosen_is_refused(sensor, reason):
    content = {"force_n": 0.01, "positions": {"list": [[0, 0]]}, "sensor": sensor}
    with pytest.raises(ValueError, match=reason):
        parse_scan_scene(content, SCENE)


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
        ({"sensor": {"samples_per_period": 300}}, r"excited lines from 200 to 620 Hz: got \d+; accepted"),
    ],
)
def test_what_short_blocks_do_not_hold_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        design_measurement(scene(**changes))


def test_the_plan_says_so():
    rows = dict(plan_rows(make_plan(scene())))
    assert "calibration of poles_node" in rows["sensor"]
    assert "transient is known" in rows["period"]
