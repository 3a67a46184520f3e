# SPDX-License-Identifier: Apache-2.0
"""Multisines: lines, amplitudes, phases; those with small peaks."""

import numpy as np
import pytest

from tactile_resonance.multisine import (
    Excitation,
    Grid,
    compress_crest_factor,
    design_multisine,
    harmonics_on_grid,
    mains_lines,
)


def test_default_is_the_papers_signal():
    """10 Hz-10 kHz in steps of 2.5 Hz at 50 kHz (arXiv 1805.00682)."""
    excitation = design_multisine()
    assert excitation.harmonics[0] == 4
    assert excitation.harmonics[-1] == 4000
    assert excitation.harmonics.size == 3997
    assert excitation.frequency_hz[0] == pytest.approx(10.0, rel=1e-15)


@pytest.mark.parametrize("grid", [Grid.FULL, Grid.ODD, Grid.ODD_RANDOM])
def test_energy_is_on_the_excited_lines_only(grid):
    excitation = design_multisine(
        sample_rate_hz=1000.0, samples_per_period=500, band_hz=(10, 300), grid=grid, seed=7
    )
    spectrum = np.fft.rfft(excitation.period()) / 500
    lines = excitation.harmonics
    others = np.delete(spectrum, lines)
    assert np.max(np.abs(others)) < 1e-15
    np.testing.assert_allclose(2 * np.abs(spectrum[lines]), excitation.amplitude_v, rtol=1e-12)
    np.testing.assert_allclose(
        np.exp(1j * np.angle(spectrum[lines])), np.exp(1j * excitation.phase_rad), rtol=1e-9
    )


@pytest.mark.parametrize(
    ("scale_by", "measure"), [("rms", np.std), ("peak", lambda x: max(abs(x)))]
)
def test_level_is_what_was_asked_for(scale_by, measure):
    excitation = design_multisine(level_v=2.5, scale_by=scale_by, seed=3)
    assert measure(excitation.period()) == pytest.approx(2.5, rel=1e-12)


def test_shaped_amplitude_keeps_its_shape():
    shape = np.linspace(1, 3, 3997)
    excitation = design_multisine(relative_amplitude=shape, level_v=1.0)
    np.testing.assert_allclose(excitation.amplitude_v / excitation.amplitude_v[0], shape)
    assert excitation.level_v == pytest.approx(1.0)
    for factor in (1e-200, 1e200):
        same = design_multisine(relative_amplitude=factor * shape, level_v=1.0)
        np.testing.assert_allclose(same.amplitude_v, excitation.amplitude_v)


def test_odd_random_grid_leaves_out_one_of_each_block():
    harmonics = harmonics_on_grid(1, 799, Grid.ODD_RANDOM, seed=5, block_lines=4)
    assert np.all(harmonics % 2 == 1)
    per_block = np.bincount((harmonics - 1) // 8, minlength=100)
    assert np.all(per_block == 3)
    left_out = np.setdiff1d(np.arange(1, 800, 2), harmonics)
    places = np.bincount(((left_out - 1) // 2) % 4, minlength=4)
    # 100 draws of four places: beyond 25 +- 20 with a probability below 1e-5
    assert np.all(np.abs(places - 25) < 20)


@pytest.mark.parametrize("grid", [Grid.FULL, Grid.ODD, Grid.ODD_RANDOM])
def test_lines_at_harmonics_of_the_mains_are_not_excited(grid):
    whole = design_multisine(grid=grid, seed=5)
    left = design_multisine(grid=grid, seed=5, mains_hz=np.array([50.0, 60.0]))
    # on the grid of 2.5 Hz these are multiples of 20 and 24; one line beside each is left out too
    far = [min(n % 20, -n % 20) > 1 and min(n % 24, -n % 24) > 1 for n in whole.harmonics]
    np.testing.assert_array_equal(left.harmonics, whole.harmonics[far])
    assert 0.5 * whole.harmonics.size < left.harmonics.size < 0.8 * whole.harmonics.size
    assert left.level_v == pytest.approx(1.0, rel=1e-12)
    assert np.ptp(left.amplitude_v) < 1e-15


def test_mains_between_lines_takes_the_nearest_ones():
    spacing_hz = 5000 / 2048
    frequency_hz = np.arange(1, 200) * spacing_hz
    for beside in (0, 1, 2):
        found = frequency_hz[mains_lines(frequency_hz, spacing_hz, (50.0,), beside)]
        near = found[np.abs(found - 250) < 25]
        nearest = np.argsort(np.abs(frequency_hz - 250))[: 2 * beside + 1]
        np.testing.assert_array_equal(near, np.sort(frequency_hz[nearest]))
    # neither zero frequency nor what lies below the mains has anything to do with it
    assert found.min() > 40


def test_realisations_share_lines_but_not_phases_and_seeds_repeat():
    make = {"grid": Grid.ODD_RANDOM, "seed": 11, "realisations": 2}
    first = design_multisine(realisation=0, **make)
    second = design_multisine(realisation=1, **make)
    np.testing.assert_array_equal(first.harmonics, second.harmonics)
    assert np.max(np.abs(first.phase_rad - second.phase_rad)) > 1
    again = design_multisine(realisation=1, **make)
    np.testing.assert_array_equal(second.phase_rad, again.phase_rad)


def test_a_sweep_rises_over_the_period_and_is_flat():
    lines = {"sample_rate_hz": 5e4, "samples_per_period": 2948, "band_hz": (200.0, 580.0)}
    random, sweep = (design_multisine(**lines, sweep=chosen, seed=4) for chosen in (False, True))
    np.testing.assert_array_equal(sweep.harmonics, random.harmonics)
    np.testing.assert_array_equal(sweep.amplitude_v, random.amplitude_v)
    assert (sweep.random_phases, random.random_phases) == (False, True)
    assert sweep.crest_factor() < 2 < random.crest_factor()
    # of each fifth of the period the mean frequency: as that of a linear sweep
    parts = sweep.period()[:2945].reshape(5, -1) * np.hanning(589)
    power = np.abs(np.fft.rfft(parts, 2948)) ** 2
    mean_hz = power @ np.fft.rfftfreq(2948, 1 / 5e4) / power.sum(axis=1)
    np.testing.assert_allclose(mean_hz, 200 + 380 * (np.arange(5) + 0.5) / 5, atol=38)
    # phases follow the power: a line of nine tenths of it takes nine tenths of the time
    shape = np.ones(sweep.harmonics.size)
    shape[0] = np.sqrt(9 * (shape.size - 1))
    loud = design_multisine(**lines, sweep=True, relative_amplitude=shape).period()
    assert np.sqrt(np.mean(loud[300:2350] ** 2)) == pytest.approx(loud.std(), rel=0.1)
    with pytest.raises(ValueError, match="realisations: got 2; accepted is 1 with sweep"):
        design_multisine(**lines, sweep=True, realisations=2)


def test_blocks_of_one_line_would_leave_all_lines_out():
    with pytest.raises(ValueError, match="block_lines: got 1; accepted is a whole number, at least 2"):
        harmonics_on_grid(1, 99, Grid.ODD_RANDOM, block_lines=1)


def test_phases_are_uniform():
    """Mean of exp(j phi) over n phases has variance 1/n: here below 4.2 of its std (99.99 %)."""
    phases = np.concatenate([design_multisine(seed=s).phase_rad for s in range(20)])
    assert abs(np.mean(np.exp(1j * phases))) < 4.2 / np.sqrt(phases.size)
    assert abs(np.mean(np.exp(2j * phases))) < 4.2 / np.sqrt(phases.size)


def test_crest_factor_of_random_phases_is_near_four():
    """Gaussian-like: about sqrt(2 ln(2 N / sqrt(...))), 3.6-4.8 for 20000 samples."""
    factors = [design_multisine(seed=s).crest_factor() for s in range(10)]
    assert 3.5 < np.mean(factors) < 4.6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"band_hz": (0.0, 100.0)}, r"band_hz: got \(0.0, 100.0\); accepted is \(low, high\)"),
        ({"band_hz": (10.0, 30e3)}, "band_hz"),
        ({"band_hz": (10.1, 10.2)}, "band: got 'harmonics 5..4'; accepted is one that holds a line"),
        ({"level_v": 0.0}, "level_v: got 0.0; accepted is a voltage above 0"),
        ({"level_v": float("nan")}, "level_v: got nan; accepted is a finite number"),
        ({"sample_rate_hz": 0.0}, "sample_rate_hz: got 0.0; accepted is a number above 0"),
        ({"scale_by": "mean"}, "scale_by: got 'mean'; accepted is 'rms' or 'peak'"),
        ({"relative_amplitude": np.ones(3)}, "relative_amplitude"),
        ({"grid": Grid.CUSTOM}, "grid: got 'custom'; accepted is full, odd or odd_random"),
        ({"grid": Grid.ODD_RANDOM, "block_lines": 0}, "block_lines: got 0; accepted is a whole number"),
        ({"periods": 0}, "periods: got 0; accepted is a whole number"),
        ({"mains_hz": (50.0, 5.0)}, "mains_hz: got 5.0; accepted is above 7.5 Hz"),
        ({"mains_hz": (float("nan"),)}, "mains_hz.0.: got nan; accepted is a finite number"),
        ({"mains_hz": (50.0,), "band_hz": (248, 252)}, "mains_hz: got .* leaves a line"),
        ({"lines_beside": -1}, "lines_beside: got -1; accepted is a whole number, at least 0"),
        ({"band_hz": [(200, 300), (100, 150)]}, "band_hz: .* ascending and share no line"),
        ({"band_hz": [(200, 300), (300, 400)]}, "band_hz: .* ascending and share no line"),
        ({"sweep": "no"}, "sweep: got a str; accepted is a bool"),
        ({"label": 5}, "label: got a int; accepted is a str"),
        ({"bands": ((200.0, 300.0),)}, "bands: got a tuple; accepted is a PoleBand"),
        ({"measurement_id": -1}, "measurement_id: got -1; accepted is a whole number"),
    ],
)
def test_bad_input_names_the_field(change, message):
    with pytest.raises(ValueError, match=message):
        design_multisine(**change)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"harmonics": np.array([3, 2])}, "harmonics"),
        ({"harmonics": np.array([1, 50])}, "harmonics"),
        ({"harmonics": np.array([], int)}, "harmonics"),
        ({"phase_rad": np.zeros(1)}, "phase_rad"),
        ({"amplitude_v": np.array([1.0, np.nan])}, "amplitude_v"),
        ({"sample_rate_hz": 0.0}, "sample_rate_hz"),
        ({"samples_per_period": 1}, "samples_per_period"),
    ],
)
def test_lines_that_make_no_signal_are_refused_by_name(change, named):
    good = {
        "harmonics": np.array([1, 2]),
        "amplitude_v": np.ones(2),
        "phase_rad": np.zeros(2),
        "sample_rate_hz": 100.0,
        "samples_per_period": 100,
    }
    Excitation(**good)
    with pytest.raises(ValueError, match=f"{named}: got .*; accepted is "):
        Excitation(**(good | change))


def test_peaks_shrink_and_nothing_else_changes():
    """Random phases give about 4; clipping is known to reach below 1.7 (a sine has 1.41)."""
    random = design_multisine(
        sample_rate_hz=5e3, samples_per_period=2000, band_hz=(10, 1000), seed=3
    )
    compressed = compress_crest_factor(random, passes=300)
    assert random.crest_factor() > 3
    assert compressed.crest_factor() < 1.7
    np.testing.assert_array_equal(compressed.amplitude_v, random.amplitude_v)
    np.testing.assert_array_equal(compressed.harmonics, random.harmonics)
    assert compressed.level_v == random.level_v
    assert not compressed.random_phases
    others = np.delete(np.fft.rfft(compressed.period()) / 2000, compressed.harmonics)
    assert np.max(np.abs(others)) < 1e-15


def test_more_passes_never_make_it_worse():
    random = design_multisine(sample_rate_hz=5e3, samples_per_period=2000, band_hz=(10, 1000))
    assert compress_crest_factor(random, passes=1).crest_factor() <= random.crest_factor() * 1.001


def test_refused_where_statistics_need_random_phases():
    with pytest.raises(ValueError, match="realisations: got 2; accepted is 1: compressed phases"):
        compress_crest_factor(design_multisine(realisations=2))
    with pytest.raises(ValueError, match="passes: got 0; accepted is a whole number, at least 1"):
        compress_crest_factor(design_multisine(), passes=0)
