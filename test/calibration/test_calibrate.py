# SPDX-License-Identifier: Apache-2.0
"""Parameters of a sensor from simulated records: right within their deviations, or declared not determined."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_resonance.calibration.fit import calibrate
from tactile_resonance.calibration.records import Load
from tactile_resonance.report.drawing import draw_calibration


def of_loads(records, *loads):
    return [record for record in records if record.load.value in loads]


def test_every_parameter_is_within_its_deviations(fitted, truth):
    found = fitted.calibration
    assert found.determined.all()
    assert found.model.modes == 10
    off = (found.model.values - truth.values) / found.std
    assert np.abs(off).max() < 4, dict(zip(found.model.names, off, strict=True))
    # 44 parameters: with .95 each, fewer than 36 inside once in a thousand
    assert np.count_nonzero(np.abs(off) < 1.96) >= 36
    # a thousandth of the mode's frequency is .25 Hz, its deviation far below
    assert found.std[1] < 1e-4 * truth.natural_rad_s[1]


def test_residuals_are_noise(fitted):
    for residual in fitted.residuals:
        assert 0.8 < np.mean(np.abs(residual) ** 2) < 2.0
    # 0.5 mV rms in 25 kHz
    assert fitted.calibration.noise_v_per_root_hz == pytest.approx(5e-4 / np.sqrt(25e3), rel=0.05)


def test_residuals_are_drawn_in_their_own_standard_deviations_and_none_is_cut_off(fitted):
    rng = np.random.default_rng(1)
    noise = [rng.normal(size=(2, r.frf.g.size)) * np.sqrt(0.5) for r in fitted.records]  # E|.|^2 is 1
    residuals = tuple(real + 1j * imaginary for real, imaginary in noise)
    residuals[0][3] = 20.0
    figure = draw_calibration(replace(fitted, residuals=residuals), "drawn")
    below = figure.axes[len(residuals) :]
    for axes in below:
        for line in axes.lines[:2]:
            assert np.mean(np.abs(line.get_ydata()) < 1.96) == pytest.approx(0.95, abs=0.02)
            low, high = axes.get_ylim()
            assert low <= np.min(line.get_ydata()) <= np.max(line.get_ydata()) <= high
    assert all(axes.get_ylim() == (-6, 6) for axes in below[1:])


def test_without_a_load_the_tip_is_declared_unknown(records, truth):
    found = calibrate(of_loads(records, "air", "loopback")).calibration
    n = found.model.modes
    assert not found.determined[3 * n : 4 * n].any()
    assert not found.knows_tip()
    assert "tip" in found.message
    others = np.delete(np.arange(4 * n + 4), np.arange(3 * n, 4 * n))
    assert found.determined[others].all()
    off = (found.model.values - truth.values)[others] / found.std[others]
    assert np.abs(off).max() < 4


def test_without_a_loopback_the_gain_is_declared_assumed(records):
    found = calibrate(of_loads(records, "air", "mass")).calibration
    at = found.model.names.index("gain")
    assert not found.determined[at]
    assert found.model.gain == 1
    assert "no loop-back" in found.message


def test_a_spring_alone_gives_the_tip_its_scale_too(records, truth):
    found = calibrate(of_loads(records, "air", "spring", "loopback")).calibration
    n = found.model.modes
    assert found.knows_tip()
    off = (found.model.tip_deflection - truth.tip_deflection)[:2] / found.std[3 * n : 3 * n + 2]
    assert np.abs(off).max() < 4
    # a stiffness of 20 N/m hardly moves modes of some kHz: what it does not determine is said
    assert found.std[4 * n - 1] > 5 * found.std[3 * n]


def test_the_scale_of_the_tip_is_that_of_the_mass(records, fitted):
    """Ten percent more mass makes the tip's shapes five percent smaller, whatever else."""
    heavier = [
        replace(record, value=1.1 * record.value) if record.load is Load.MASS else record
        for record in of_loads(records, "air", "mass", "loopback")
    ]
    found = calibrate(heavier).calibration.model
    right = fitted.calibration.model
    np.testing.assert_allclose(
        found.tip_deflection[:4], right.tip_deflection[:4] / np.sqrt(1.1), rtol=5e-3
    )
    np.testing.assert_allclose(found.natural_rad_s, right.natural_rad_s, rtol=1e-3)


def test_an_uncertain_mass_makes_the_tip_as_uncertain(records):
    doubtful = [
        replace(record, value_std=0.02 * record.value) if record.load is Load.MASS else record
        for record in of_loads(records, "air", "mass", "loopback")
    ]
    found = calibrate(doubtful).calibration
    n = found.model.modes
    relative = found.std[3 * n] / found.model.tip_deflection[0]
    assert relative == pytest.approx(0.01, rel=0.05)  # of the root of the mass


def test_a_mode_above_the_band_is_found_by_what_it_leaves_in_it(records, truth):
    """The band ends between the ninth mode and the tenth."""
    top_hz = 0.5 * (truth.natural_rad_s[-2:].sum()) / (2 * np.pi)
    cut = [
        replace(record, frf=record.frf.band(0, top_hz))
        for record in of_loads(records, "air", "mass", "loopback")
    ]
    found = calibrate(cut).calibration
    assert found.model.modes == 10
    off = (found.model.values - truth.values) / found.std
    assert np.abs(off[found.determined]).max() < 4


def test_without_a_record_in_air_there_is_no_calibration(records):
    with pytest.raises(ValueError, match="in air"):
        calibrate(of_loads(records, "mass", "loopback"))


def test_a_mass_needs_a_value(records):
    with pytest.raises(ValueError, match="mass: got 0"):
        replace(of_loads(records, "mass")[0], value=0.0)
    with pytest.raises(ValueError, match="mass std"):
        replace(of_loads(records, "mass")[0], value_std=1.0)


def test_masses_that_contradict_each_other_are_declared_and_make_the_tip_uncertain(records, truth):
    """One mass, once stated as it is and once as 2/5 of it: either may be wrong."""
    of_air_and_mass = of_loads(records, "air", "mass", "loopback")
    lighter = [
        replace(record, value=2e-5, name="other")
        for record in of_air_and_mass
        if record.load is Load.MASS
    ]
    found = calibrate([*of_air_and_mass, *lighter]).calibration
    n = found.model.modes
    assert "the known loads contradict each other (5e-05 of mass fits as " in found.message
    off = (found.model.tip_deflection - truth.tip_deflection) / found.std[3 * n : 4 * n]
    assert np.abs(off).max() < 4


@pytest.mark.filterwarnings("error")
def test_channels_that_are_swapped_are_refused_by_name(records):
    swapped = [
        replace(record, frf=replace(record.frf, g=1 / record.frf.g))
        for record in of_loads(records, "air")
    ]
    with pytest.raises(ValueError, match="records: got .'air'.*are channels swapped"):
        calibrate(swapped)
