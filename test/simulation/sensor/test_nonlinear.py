# SPDX-License-Identifier: Apache-2.0
"""The nonlinear sensor: against the differential equation, settled, its calibration."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tactile_resonance.sensor import NonlinearParameters
from tactile_resonance.simulation.sensor.nonlinear import NonlinearStream
from tactile_resonance.simulation.sensor.response import Lines, ResponseStream, sample_period

LINEAR = NonlinearParameters(0.0, 0.0)


def settled(model, nonlinear, lines, seconds=4.0, **options):
    """A period of the output after a time: the sensing layer drains in 0.3 s."""
    stream = NonlinearStream(model, nonlinear, **options)
    for _ in range(round(seconds / lines.period_s)):
        found = stream.play(lines)
    return found


@pytest.fixture(scope="module")
def model(bench, library):
    return bench.coupled(library["gel10"]).modal


def test_without_coefficients_it_is_the_linear_response(model, multisine, silence):
    lines = Lines.of(multisine(1))
    linear, found = ResponseStream(model), NonlinearStream(model, LINEAR)
    for _ in range(2):
        np.testing.assert_allclose(found.play(lines), linear.play(lines), atol=1e-13)
    quiet = silence(50e3, 99)
    np.testing.assert_allclose(found.play(quiet), linear.play(quiet), atol=1e-13)


@pytest.mark.parametrize("even", [0.0, 0.3])
def test_from_rest_it_satisfies_the_differential_equation(bench, library, sensor, multisine, even):
    coupled = bench.coupled(library["gel10"])
    nonlinear = replace(
        sensor.nonlinear, actuator_quadratic_per_v=0.01 * even, strain_quadratic_per_v=even
    )
    lines = Lines.of(multisine(1, level_v=4.0, band_hz=(100, 3000), samples_per_period=500))
    stream = NonlinearStream(coupled.modal, nonlinear)
    found = np.concatenate([stream.play(lines), stream.play(lines)])
    linear = ResponseStream(coupled.modal)
    distortion = found - np.concatenate([linear.play(lines), linear.play(lines)])

    # poles and residues of the strain, driven by the effective voltage, integrated directly
    poles, residues, weights = (
        coupled.modal.poles_rad_s, coupled.modal.residues_rad_s, coupled.modal.weights,
    )  # fmt: skip

    def u(t):
        return (np.exp(2j * np.pi * lines.frequency_hz * t) @ lines.phasor_v).real

    def slope(t, z):
        v, s = u(t), weights @ z.real
        effective = v + nonlinear.actuator_quadratic_per_v * v**2
        effective += nonlinear.actuator_cubic_per_v2 * v**3
        effective += nonlinear.strain_quadratic_per_v * s**2 + nonlinear.strain_cubic_per_v2 * s**3
        return poles * z + residues * effective

    times = np.arange(1000) / 50e3
    solution = solve_ivp(
        slope, (0, 0.02), np.zeros(poles.size, dtype=complex), method="DOP853",
        rtol=1e-10, atol=1e-13, t_eval=times,
    )  # fmt: skip
    expected = weights @ solution.y.real + coupled.sensor.feedthrough * np.array([u(t) for t in times])
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(distortion).max())


def test_odd_and_even_products_fall_where_they_must(model, sensor, multisine):
    lines = Lines.of(multisine(3, level_v=2.0, step=2))  # odd harmonics
    spectrum = np.abs(np.fft.rfft(settled(model, sensor.nonlinear, lines, 9.0)))
    assert spectrum[0::2].max() < 1e-7 * spectrum.max()  # of the drain
    assert spectrum[2::2].max() < 1e-9 * spectrum.max()
    even = replace(sensor.nonlinear, actuator_quadratic_per_v=1e-2)
    spectrum = np.abs(np.fft.rfft(settled(model, even, lines, 9.0)))
    assert spectrum[2::2].max() > 1e-5 * spectrum.max()


def test_at_low_drive_superposition_holds_and_distortion_falls_with_the_square(
    model, sensor, multisine
):
    relative = []
    for level in (0.1, 0.2):
        lines = Lines.of(multisine(4, level_v=level))
        nonlinear = settled(model, sensor.nonlinear, lines)
        linear = sample_period(lines, model.frequency_response(lines.frequency_hz))
        relative.append(np.linalg.norm(nonlinear - linear) / np.linalg.norm(linear))
    assert relative[0] < 1e-4
    assert relative[1] / relative[0] == pytest.approx(4, rel=0.01)


def best_linear_approximation(model, sensor, multisine, level_v, realisations=6):
    """Mean and standard deviation over phase realisations of the steady-state response."""
    responses = []
    for seed in range(realisations):
        lines = Lines.of(multisine(seed, level_v=level_v, samples_per_period=20_000))
        output = settled(model, sensor.nonlinear, lines, 2.4)
        drive = sample_period(lines)
        ratio = np.fft.rfft(output)[lines.harmonics] / np.fft.rfft(drive)[lines.harmonics]
        band = (lines.frequency_hz >= 200) & (lines.frequency_hz <= 300)
        responses.append(ratio[band])
    responses = np.array(responses)
    return responses.mean(axis=0), responses.std(axis=0, ddof=1), lines.frequency_hz[band]


# The reference gives -57 dB (1 V) and -31 dB (4 V); how it averages is not stated there, hence the
# 4 dB left for it.
@pytest.mark.parametrize(("level_v", "reference_db"), [(1.0, -57), (4.0, -31)])
def test_distortion_is_calibrated_to_the_paper(model, sensor, multisine, level_v, reference_db):
    mean, deviation, _ = best_linear_approximation(model, sensor, multisine, level_v)
    ratio_db = 20 * np.log10(np.linalg.norm(deviation) / np.linalg.norm(mean))
    assert ratio_db == pytest.approx(reference_db, abs=4)


def test_resonance_falls_by_about_a_third_of_a_hertz_at_4_v(bench, library, sensor, multisine):
    coupled = bench.coupled(library["gel10"])
    mean, _, frequency = best_linear_approximation(coupled.modal, sensor, multisine, 4.0)
    # to first order the best linear approximation changes by (dG/dp) times the change of the pole
    mode = coupled.mode_near(250)
    s = 2j * np.pi * frequency
    sensitivity = mode.residue_rad_s / (s - mode.pole_rad_s) ** 2
    basis = np.column_stack([sensitivity, 1 / (s - mode.pole_rad_s), np.ones_like(s), s / s[-1]])
    change = np.linalg.lstsq(basis, mean - coupled.frequency_response(frequency), rcond=None)[0][0]
    shift_hz = (abs(mode.pole_rad_s + change) - abs(mode.pole_rad_s)) / (2 * np.pi)
    assert -0.5 < shift_hz < -0.2


def test_a_drive_beyond_the_model_is_refused(model, sensor, multisine):
    narrow = Lines.of(multisine(1, level_v=4.0, band_hz=(200, 300), samples_per_period=20_000))
    with pytest.raises(ValueError, match="amplitude_v.*4 V rms.*accepted"):
        settled(model, sensor.nonlinear, narrow)


def test_the_strain_term_is_integrated_to_fourth_order(model, sensor, multisine):
    lines = Lines.of(multisine(5, level_v=4.0, band_hz=(20.0, 3e3)))
    fine, *coarse = (
        settled(model, sensor.nonlinear, lines, 0.2, oversampling=n) for n in (32, 4, 8)
    )
    errors = [np.abs(each - fine).max() for each in coarse]
    assert errors[0] / errors[1] > 12  # 16 for fourth order
