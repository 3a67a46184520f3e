# SPDX-License-Identifier: Apache-2.0
"""A contact that changes while it is measured."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tactile_resonance.simulation.sensor.acquisition import BenchEffects
from tactile_resonance.simulation.sensor.bimorph import couple
from tactile_resonance.simulation.sensor.changing_contact import ContactHistory, pole_trajectory
from tactile_resonance.simulation.sensor.linear import Lines
from tactile_resonance.simulation.sensor.response import INTERVAL_S, ResponseStream, VaryingStream

RADIUS = 2.5e-3
IDEAL = BenchEffects.none()


def test_under_force_the_pole_moves_as_published(sensor, library):
    # physics of the contact: under 1 cN from 1 to 4.2 s, 10 % gelatine +0.10 Hz, cortex -0.73 Hz
    for name, shift_hz, tolerance in (("gel10", 0.10, 0.01), ("cortex", -0.73, 0.03)):
        history = ContactHistory.under_force(library[name], RADIUS, library.contact, duration_s=3.2)
        poles = pole_trajectory(sensor, history, np.linspace(0, 3.2, 9))
        f0 = np.abs(poles) / (2 * np.pi)
        assert f0[-1] - f0[0] == pytest.approx(shift_hz, abs=tolerance)
        assert np.all(np.diff(f0) * np.sign(shift_hz) > 0)


def test_at_a_held_depth_the_force_relaxes_and_the_poles_stay(sensor, library):
    time = np.linspace(0, 5, 2501)
    depth = 3e-4 * np.minimum(time / 0.2, 1)
    history = ContactHistory.of_depth(
        library["cortex"], RADIUS, library.contact, time, depth, start_s=0.3
    )
    # by 65 % at 10 s from the end of the ramp; from 0.1 s after it, in 4.7 s, about half
    assert history.force_n[-1] < 0.6 * history.force_n[0]
    poles = pole_trajectory(sensor, history, [0.0, 1.0, 4.0])
    np.testing.assert_allclose(poles, poles[0], rtol=1e-9)


def drive(lines, t):
    return float((np.exp(2j * np.pi * lines.frequency_hz * t) @ lines.phasor_v).real)


def test_changing_contact_satisfies_the_changing_differential_equation(sensor, library, multisine):
    """Against direct integration in physical states, for a change far faster than creep."""
    history = ContactHistory.under_force(
        library["cortex"], RADIUS, library.contact, since_s=0.5, duration_s=1.0, steps=50
    )
    lines = Lines.of(multisine(1, band_hz=(150, 400), samples_per_period=5000))
    stream = VaryingStream(lambda t: history.coupled_at(sensor, t))
    found = np.concatenate([stream.play(lines) for _ in range(5)])

    # states of the beam as they are, Prony deformations z_j in metres: continuous as they change
    terms = len(history.tissue.prony_times_s)
    grid = np.linspace(0, 1.0, 501)
    systems = []
    for t in grid:
        coupled = history.coupled_at(sensor, float(t))
        a, b, c, d = coupled.state_space
        scale = np.ones(b.size)
        scale[-terms:] = np.sqrt(coupled.contact.prony_stiffness_n_per_m)
        systems.append((a * scale / scale[:, None], b / scale, c * scale))
    matrices = np.array([s[0] for s in systems])
    inputs = np.array([s[1] for s in systems])

    def slope(t, x):
        place = min(t / grid[1], grid.size - 1.000001)
        n, part = int(place), place - int(place)
        a = (1 - part) * matrices[n] + part * matrices[n + 1]
        b = (1 - part) * inputs[n] + part * inputs[n + 1]
        return a @ x + b * drive(lines, t)

    # the radial change of a is followed on the grid; 0.5 s of it are enough
    times = np.arange(0, 25_000, 5) / 50e3
    solution = solve_ivp(
        slope, (0, times[-1]), np.zeros(inputs.shape[1]), t_eval=times, method="LSODA",
        rtol=1e-7, atol=1e-12,
    )  # fmt: skip
    expected = systems[0][2] @ solution.y + d * np.array([drive(lines, t) for t in times])
    poles = pole_trajectory(sensor, history, [0.0, 0.05, 0.4, 0.5])
    speed = abs(poles[1] - poles[0]) / 0.05
    stated = speed * INTERVAL_S**2 / 12
    # without the lag of the resonance it would be more
    assert stated < 0.7 * speed / poles[0].real ** 2
    error = np.abs(found[:25_000:5] - expected).max() / np.abs(expected).max()
    assert error < stated
    # and the change itself is far larger: the first contact throughout would be wrong
    frozen = ResponseStream(history.coupled_at(sensor, 0.0).modal)
    still = np.concatenate([frozen.play(lines) for _ in range(5)])
    assert np.abs(still[:25_000:5] - expected).max() / np.abs(expected).max() > 5 * error


def test_creep_of_the_library_is_slow_for_the_steps(sensor, library):
    """How far the steps are off from 1 s on: at most 1.1e-3 of the resonance."""
    stated = {}
    for name in ("gel10", "white", "cortex", "liver"):
        history = ContactHistory.under_force(library[name], RADIUS, library.contact, duration_s=3.2)
        poles = pole_trajectory(sensor, history, [0.0, 0.02])
        speed = abs(poles[1] - poles[0]) / 0.02  # fastest at the start
        stated[name] = speed * INTERVAL_S**2 / 12
    assert 5e-4 < max(stated.values()) < 1.1e-3
    assert stated["gel10"] < 1e-4


def test_contact_at_rest_is_the_exact_response(bench, library, sensor, multisine, silence):
    lines = Lines.of(multisine(1))
    contact = bench.coupled(library["liver"]).contact
    history = ContactHistory(
        contact.tissue, library.contact, np.array([0.0]), np.array([contact.contact_radius_m]),
        np.array([contact.force_n]), np.array([contact.indentation_m]),
    )  # fmt: skip
    for skew in (0.0, 1.3e-4, -1e-5):
        effects = replace(IDEAL, channel_skew_s=skew)
        found = bench.start_varying(partial(history.coupled_at, bench.sensor), effects=effects)
        expected = bench.start(library["liver"], effects=effects)
        for run in (found, expected):
            run.block(lines)
        pairs = [(r.block(lines, 2), r.block(silence(50e3, 799))) for r in (found, expected)]
        for one, other in zip(*pairs, strict=True):
            np.testing.assert_allclose(one.sensor.volts(), other.sensor.volts(), atol=1e-12)


def test_state_carried_to_another_contact_and_back_is_the_same(sensor, library, bench):
    one = bench.coupled(library["cortex"], force_n=0.01)
    other = bench.coupled(library["cortex"], force_n=0.012)
    rng = np.random.default_rng(0)
    size = one.modal.poles_rad_s.size
    state = rng.standard_normal(size) + 1j * rng.standard_normal(size)
    state[one.modal.poles_rad_s.imag == 0] = state[one.modal.poles_rad_s.imag == 0].real
    carried = one.carry_state(state, other)
    np.testing.assert_allclose(other.carry_state(carried, one), state, rtol=1e-7, atol=1e-9)
    # the sensor voltage does not jump
    before = one.modal.weights @ state.real
    assert other.modal.weights @ carried.real == pytest.approx(before, rel=1e-9)
    with pytest.raises(ValueError, match="after"):
        one.carry_state(state, couple(sensor, None))


def test_truth_of_a_run_follows_the_contact(bench, library):
    history = ContactHistory.under_force(library["cortex"], RADIUS, library.contact, duration_s=3.2)
    run = bench.start_varying(partial(history.coupled_at, bench.sensor))
    early, late = (run.truth(time_s=t) for t in (0.0, 3.2))
    assert late.mode_near(250).f0_hz - early.mode_near(250).f0_hz == pytest.approx(-0.73, abs=0.03)
    assert late.contact.contact_radius_m > early.contact.contact_radius_m
    assert late.contact.force_n == early.contact.force_n == 0.01


def test_bad_histories_are_refused_by_name(bench, library):
    one = np.array([0.0, 1.0])
    good = {"time_s": one, "contact_radius_m": one + 1, "force_n": one, "indentation_m": one}
    for name, value in (
        ("time_s", one[::-1]), ("contact_radius_m", one), ("force_n", one[:1]),
        ("indentation_m", one * np.nan),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=f"{name}.*accepted"):
            ContactHistory(library["gel10"], library.contact, **(good | {name: value}))
    history = ContactHistory(library["gel10"], library.contact, **good)
    with pytest.raises(ValueError, match="nonlinearity.*off"):
        bench.start_varying(
            partial(history.coupled_at, bench.sensor), effects=BenchEffects(nonlinearity=True)
        )
    with pytest.raises(ValueError, match="start_s"):
        ContactHistory.of_depth(library["gel10"], RADIUS, library.contact, one, one, start_s=2.0)
