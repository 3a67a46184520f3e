# SPDX-License-Identifier: Apache-2.0
"""Time response: against the differential equation, the analytic response, and itself in pieces."""

import numpy as np
import pytest
from scipy.integrate import simpson, solve_ivp
from scipy.linalg import expm

from tactile_resonance.simulation.sensor.response import (
    Lines,
    ResponseStream,
    free_decay,
    sample_period,
    steady_state,
)


@pytest.fixture(params=[None, "gel10", "cortex"], ids=str)
def coupled(request, bench, library):
    return bench.coupled(None if request.param is None else library[request.param])


def drive(lines, time_s):
    """Evaluate ``u(t)`` directly from its definition."""
    phase = 2j * np.pi * np.multiply.outer(time_s, lines.frequency_hz)
    return (np.exp(phase) @ lines.phasor_v).real


def integrate(coupled, u, stop_s, times_s, start=None):
    """Integrate the state equations; returns the output at `times_s` and the last state."""
    a, b, c, d = coupled.state_space
    solution = solve_ivp(
        lambda t, x: a @ x + b * u(t), (0, stop_s), np.zeros(b.size) if start is None else start,
        method="DOP853", rtol=1e-12, atol=1e-15, t_eval=np.append(times_s, stop_s),
    )  # fmt: skip
    states = solution.y[:, :-1]
    return c @ states + d * np.array([u(t) for t in times_s]), solution.y[:, -1]


def test_samples_of_a_period_are_the_definition(multisine):
    excitation = multisine(3, samples_per_period=500)
    lines = Lines.of(excitation)
    time = np.arange(500) / 50e3
    expected = sum(
        a * np.cos(2 * np.pi * h * 100.0 * time + p)
        for a, h, p in zip(
            excitation.amplitude_v, excitation.harmonics, excitation.phase_rad, strict=True
        )
    )
    np.testing.assert_allclose(sample_period(lines), expected, atol=1e-12)
    np.testing.assert_allclose(
        sample_period(lines, shift_s=0.3e-3), drive(lines, time + 0.3e-3), atol=1e-12
    )


def test_a_line_at_zero_frequency_is_a_constant():
    lines = Lines(np.array([0, 2]), np.array([0.5, 1.0 + 0j]), 100.0, 20)
    np.testing.assert_allclose(sample_period(lines), drive(lines, np.arange(20) / 100), atol=1e-14)


def test_from_rest_the_response_satisfies_the_differential_equation(coupled, multisine):
    lines = Lines.of(multisine(1, band_hz=(100, 3000), samples_per_period=500))
    stream = ResponseStream(coupled.modal)
    found = np.concatenate([stream.play(lines) for _ in range(2)])
    times = np.arange(1000) / 50e3
    expected, _ = integrate(coupled, lambda t: drive(lines, t), 0.02, times)
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_change_of_excitation_and_ring_down_carry_the_state(coupled, multisine, silence):
    first = Lines.of(multisine(1, band_hz=(100, 3000), samples_per_period=500))
    second = Lines.of(multisine(2, band_hz=(100, 3000), samples_per_period=500))
    stream = ResponseStream(coupled.modal)
    found = np.concatenate(
        [
            stream.play(first),
            stream.play(first, 137),
            stream.play(second),
            stream.play(silence(50e3, 500), 200),
        ]
    )
    spans = [(first, 637), (second, 500), (None, 200)]
    expected, state = [], None
    for lines, samples in spans:
        u = (lambda t: 0.0) if lines is None else (lambda t, lines=lines: drive(lines, t))
        times = np.arange(samples) / 50e3
        part, state = integrate(coupled, u, samples / 50e3, times, state)
        expected.append(part)
    expected = np.concatenate(expected)
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_steady_state_response_is_the_analytic_one(coupled, multisine):
    lines = Lines.of(multisine(5, samples_per_period=100_000))
    stream = ResponseStream(coupled.modal)
    for _ in range(1000):  # 2000 s: longer than the slowest relaxation
        record = stream.play(lines)
    spectrum = (
        np.fft.rfft(record)[lines.harmonics] / np.fft.rfft(sample_period(lines))[lines.harmonics]
    )
    expected = coupled.frequency_response(lines.frequency_hz)
    np.testing.assert_allclose(spectrum, expected, rtol=1e-9)


def test_steady_state_is_what_a_long_time_integration_ends_in(coupled):
    """State equations and drive as one system, stepped by its matrix exponential over 800 s."""
    harmonics = np.array([1, 3, 4, 9])
    lines = Lines(harmonics, np.exp(1j * harmonics) * 0.3, 50e3, 500)
    a, b, c, d = coupled.state_space
    n, omega = b.size, 2 * np.pi * lines.frequency_hz
    whole = np.zeros((n + 8, n + 8))
    whole[:n, :n] = a
    for k, w in enumerate(omega):  # each line an oscillator (cos, -sin) of its own
        i = n + 2 * k
        whole[i, i + 1], whole[i + 1, i] = w, -w
        whole[:n, i] = b
    start = np.zeros(n + 8)
    start[n::2], start[n + 1 :: 2] = lines.phasor_v.real, -lines.phasor_v.imag
    step = expm(whole / 50e3)
    state = np.linalg.matrix_power(step, 500 * 80_000) @ start
    found = []
    for _ in range(500):
        found.append(c @ state[:n] + d * state[n::2].sum())
        state = step @ state
    expected = sample_period(lines, coupled.frequency_response(lines.frequency_hz))
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6 * np.abs(expected).max())


@pytest.mark.parametrize("samples", [500, 5000, 20_000])
@pytest.mark.parametrize("periods", [1, 3])
def test_from_rest_less_its_transient_the_response_is_the_analytic_one(
    coupled, multisine, samples, periods
):
    lines = Lines.of(multisine(6, samples_per_period=samples, band_hz=(20, 10e3)))
    stream = ResponseStream(coupled.modal)
    record = np.concatenate([stream.play(lines) for _ in range(periods)])
    transient = -steady_state(coupled.modal, lines)  # it starts at the negative steady state
    record = record - free_decay(coupled.modal, transient, record.size, 1 / 50e3)
    bins = periods * lines.harmonics
    drive_v = np.tile(sample_period(lines), periods)
    ratio = np.fft.rfft(record)[bins] / np.fft.rfft(drive_v)[bins]
    np.testing.assert_allclose(ratio, coupled.frequency_response(lines.frequency_hz), rtol=1e-9)


@pytest.mark.parametrize("samples", [1001, 2501])
def test_burst_from_rest_to_rest_has_the_analytic_response_at_any_frequency(
    coupled, multisine, silence, samples
):
    """The Laplace transforms of response and burst, from their samples by Simpson's rule."""
    rate_hz = 400e3
    lines = Lines.of(
        multisine(9, band_hz=(100, 600), samples_per_period=20_000, sample_rate_hz=rate_hz)
    )
    until = ResponseStream(coupled.modal).play(lines, samples)  # its last sample still driven
    stream = ResponseStream(coupled.modal)
    stream.play(lines, samples - 1)
    after = stream.play(silence(rate_hz, 400_001))  # 1 s
    time = np.arange(samples + after.size - 1) / rate_hz
    drive_v = sample_period(lines)[:samples]
    for frequency in (130.0, 251.7, 402.3):
        s = 20 + 2j * np.pi * frequency  # damped: what is left after 1 s counts exp(-20)
        early, late = np.exp(-s * time[:samples]), np.exp(-s * time[samples - 1 :])
        burst = simpson(drive_v * early, dx=1 / rate_hz)
        answer = simpson(until * early, dx=1 / rate_hz) + simpson(after * late, dx=1 / rate_hz)
        assert answer / burst == pytest.approx(complex(coupled.response(s)), rel=1e-6)


def test_free_decay_equals_the_sum_of_exponentials(coupled):
    model = coupled.modal
    rng = np.random.default_rng(0)
    size = model.poles_rad_s.size
    start = rng.standard_normal(size) + 1j * rng.standard_normal(size)
    start[model.poles_rad_s.imag == 0] = start[model.poles_rad_s.imag == 0].real
    time = 1e-4 + np.arange(3001) * 2e-5
    expected = np.exp(np.outer(time, model.poles_rad_s)) @ (model.weights * start)
    found = free_decay(model, start, 3001, 2e-5, 1e-4)
    np.testing.assert_allclose(found, expected.real, atol=1e-12)


def test_what_has_decayed_costs_nothing_and_adds_nothing(bench, multisine):
    model = bench.coupled(None).modal
    lines = Lines.of(multisine(5))
    stream = ResponseStream(model)
    for _ in range(1000):
        stream.play(lines)
    np.testing.assert_array_equal(stream.play(lines), stream.play(lines))


def test_response_is_linear(coupled, multisine):
    one, two = multisine(1, samples_per_period=1000), multisine(2, samples_per_period=1000)
    both = Lines.of(one)
    both = Lines(both.harmonics, both.phasor_v - 3 * Lines.of(two).phasor_v, 50e3, 1000)
    a, b, c = (ResponseStream(coupled.modal).play(Lines.of(x)) for x in (one, two, both))
    np.testing.assert_allclose(c, a - 3 * b, atol=1e-13)


def test_pieces_of_a_period_are_the_period(coupled, multisine):
    lines = Lines.of(multisine(7, samples_per_period=1000))
    whole = ResponseStream(coupled.modal)
    expected = np.concatenate([whole.play(lines), whole.play(lines)])
    pieces = ResponseStream(coupled.modal)
    found = np.concatenate([pieces.play(lines, n) for n in (1, 299, 700, 300, 700)])
    np.testing.assert_allclose(found, expected, atol=1e-14)
    np.testing.assert_allclose(pieces.state, whole.state, atol=1e-14)


@pytest.mark.parametrize("quarters", [0, 1, 4, 4001, 9])
def test_delay_shifts_the_response(coupled, multisine, quarters):
    first = Lines.of(multisine(8, samples_per_period=1000))
    second = Lines.of(multisine(9, samples_per_period=1000))
    fine = ResponseStream(coupled.modal)
    dense = np.concatenate([fine.play(x.resampled(4)) for x in (first, first, second)])
    late = ResponseStream(coupled.modal, delay_s=quarters / 200e3)
    found = np.concatenate([late.play(x) for x in (first, first, second)])
    expected = np.concatenate([np.zeros(quarters), dense])[: dense.size : 4]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_sample_rate_must_not_change(coupled, multisine):
    stream = ResponseStream(coupled.modal)
    stream.play(Lines.of(multisine(1)))
    with pytest.raises(ValueError, match="sample_rate_hz"):
        stream.play(Lines.of(multisine(1, sample_rate_hz=40e3)))
