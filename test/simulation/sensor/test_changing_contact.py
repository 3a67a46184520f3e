# SPDX-License-Identifier: Apache-2.0
"""A contact that changes while it is measured: by creep, or part by part as the plant had it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tactile_resonance.simulation.sensor.bench import (
    BenchEffects,
    BenchRun,
    BenchTip,
    ContactSoFar,
)
from tactile_resonance.simulation.sensor.bimorph import (
    INTERVAL_S,
    CoupledBimorph,
    VaryingStream,
    parts_of,
    pole_trajectory,
    sensor_model,
)
from tactile_resonance.simulation.sensor.response import Lines, ResponseStream
from tactile_resonance.simulation.tissue.indenter import Indenter, indent

RADIUS = 2.5e-3
IDEAL = BenchEffects.none()


def creeping(bench, tissue, since_s=1.0):
    """The sensor on a contact that creeps under a held force, from so long after it was put on."""
    return lambda time_s: bench.coupled(tissue, hold_time_s=since_s + time_s)


def test_under_force_the_pole_moves_as_published(bench, library):
    # physics of the contact: under 1 cN from 1 to 4.2 s, 10 % gelatine +0.10 Hz, cortex -0.73 Hz
    for name, shift_hz, tolerance in (("gel10", 0.10, 0.01), ("cortex", -0.73, 0.03)):
        poles = pole_trajectory(map(creeping(bench, library[name]), np.linspace(0, 3.2, 9)))
        f0 = np.abs(poles) / (2 * np.pi)
        assert f0[-1] - f0[0] == pytest.approx(shift_hz, abs=tolerance)
        assert np.all(np.diff(f0) * np.sign(shift_hz) > 0)


def test_at_a_held_depth_the_force_relaxes_and_the_poles_stay(bench, library):
    tissue, time = library["cortex"], np.linspace(0, 5, 2501)
    ball = Indenter(tissue, tip_radius_m=RADIUS, poisson_ratio=library.contact.poisson_ratio)
    force_n, radius_m = indent(ball, time, 3e-4 * np.minimum(time / 0.2, 1))
    at = np.searchsorted(time, [0.3, 1.3, 4.3])
    # by 65 % at 10 s from the end of the ramp; from 0.1 s after it, in 4.7 s, about half
    assert force_n[-1] < 0.6 * force_n[at[0]]
    poles = pole_trajectory(
        BenchTip(tissue, force_n[k], time[k], radius_m[k], 3e-4).coupled(bench) for k in at
    )
    np.testing.assert_allclose(poles, poles[0], rtol=1e-9)


def drive(lines, t):
    return float((np.exp(2j * np.pi * lines.frequency_hz * t) @ lines.phasor_v).real)


def test_changing_contact_satisfies_the_changing_differential_equation(bench, library, multisine):
    """Against direct integration in physical states, for a change far faster than creep."""
    cortex = library["cortex"]
    coupled_at = creeping(bench, cortex, since_s=0.5)
    lines = Lines.of(multisine(1, band_hz=(150, 400), samples_per_period=5000))
    stream = VaryingStream(coupled_at)
    found = np.concatenate([stream.play(lines) for _ in range(5)])

    # states of the beam as they are, Prony deformations z_j in metres: continuous as they change
    terms = len(cortex.prony_times_s)
    grid = np.linspace(0, 1.0, 501)
    systems = []
    for t in grid:
        coupled = coupled_at(float(t))
        a, b, c, d = coupled.state_space
        scale = np.ones(b.size)
        scale[-terms:] = np.sqrt(coupled.contact.stiffness.relaxing_n_per_m)
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
    poles = pole_trajectory(map(coupled_at, [0.0, 0.05]))
    speed = abs(poles[1] - poles[0]) / 0.05
    stated = speed * INTERVAL_S**2 / 12
    # without the lag of the resonance it would be more
    assert stated < 0.7 * speed / poles[0].real ** 2
    error = np.abs(found[:25_000:5] - expected).max() / np.abs(expected).max()
    assert error < stated
    # and the change itself is far larger: the first contact throughout would be wrong
    frozen = ResponseStream(coupled_at(0.0).modal)
    still = np.concatenate([frozen.play(lines) for _ in range(5)])
    assert np.abs(still[:25_000:5] - expected).max() / np.abs(expected).max() > 5 * error


def test_creep_of_the_library_is_slow_for_the_steps(bench, library):
    """How far the steps are off from 1 s on: at most 1.1e-3 of the resonance."""
    stated = {}
    for name in ("gel10", "white", "cortex", "liver"):
        poles = pole_trajectory(map(creeping(bench, library[name]), [0.0, 0.02]))
        speed = abs(poles[1] - poles[0]) / 0.02  # fastest at the start
        stated[name] = speed * INTERVAL_S**2 / 12
    assert 5e-4 < max(stated.values()) < 1.1e-3
    assert stated["gel10"] < 1e-4


def test_contact_at_rest_is_the_exact_response(bench, library, multisine, silence):
    lines = Lines.of(multisine(1))
    at_rest = bench.coupled(library["liver"])
    for skew in (0.0, 1.3e-4, -1e-5):
        effects = replace(IDEAL, channel_skew_s=skew)
        found = BenchRun(bench.sensor, lambda time_s: at_rest, effects=effects)
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
        one.carry_state(state, CoupledBimorph(sensor_model(sensor), None))


def test_the_sensor_follows_the_contact(bench, library):
    early, late = map(creeping(bench, library["cortex"]), (0.0, 3.2))
    assert late.mode_near(250).f0_hz - early.mode_near(250).f0_hz == pytest.approx(-0.73, abs=0.03)
    assert late.contact.contact_radius_m > early.contact.contact_radius_m
    assert late.contact.force_n == early.contact.force_n == 0.01


def test_a_nonlinear_sensor_on_a_changing_contact_is_refused(bench, library):
    with pytest.raises(ValueError, match="nonlinearity.*off"):
        BenchRun(
            bench.sensor,
            creeping(bench, library["gel10"]),
            effects=BenchEffects(nonlinearity=True),
        )


def near_250(coupled):
    return min((mode.f0_hz for mode in coupled.modes), key=lambda f: abs(f - 250))


def state_under(bench, tissue, force_n):
    contact = bench.coupled(tissue, force_n=force_n).contact
    return force_n, contact.contact_radius_m, contact.indentation_m


def test_poles_follow_the_force_part_by_part(bench, library):
    gel, forces = library["gel10"], [0.009, 0.010, 0.011]
    so_far = ContactSoFar(bench, BenchTip(gel, 0.01, 1.0))
    assert near_250(so_far.coupled_at(0.3)) == near_250(bench.coupled(gel, force_n=0.01))
    so_far.extend(0.12, [state_under(bench, gel, force) for force in forces])
    found = [near_250(so_far.coupled_at(t)) for t in (0.0, 0.05, 0.1)]
    hertz = [near_250(bench.coupled(gel, force_n=force)) for force in forces]
    np.testing.assert_allclose(found, hertz, rtol=1e-12)
    # as published: 0.216 Hz/mN on 10 % gelatine
    assert (found[2] - found[0]) / 2 == pytest.approx(0.216, abs=0.005)
    assert [part.contact.force_n for part in so_far.parts] == forces
    so_far.extend(0.04, [state_under(bench, gel, 0.012)])
    assert so_far.coupled_at(0.125) is so_far.parts[3]
    assert so_far.coupled_at(0.115) is so_far.parts[2]


def test_a_force_that_is_held_creeps_on_as_hertz_contact(bench, library):
    cortex = library["cortex"]
    so_far = ContactSoFar(bench, BenchTip(cortex, 0.008, 0.5))
    for length_s in (0.4, 1.0):
        so_far.extend(length_s, so_far.held(length_s))
    middles_s = 0.02 + np.arange(35) * 0.04
    found = [near_250(so_far.coupled_at(t)) for t in middles_s]
    hertz = [
        near_250(bench.coupled(cortex, force_n=0.008, hold_time_s=0.5 + t)) for t in middles_s.tolist()
    ]
    np.testing.assert_allclose(found, hertz, rtol=1e-12)
    assert found[0] - found[-1] > 0.3


def test_a_plant_that_stands_still_keeps_its_contact_and_a_lost_one_is_nearly_air(bench, library):
    gel = library["gel10"]
    so_far = ContactSoFar(bench, BenchTip(gel, 0.01, 1.0))
    so_far.extend(0.08, [None, (0.0, 0.0, 0.0)])
    assert near_250(so_far.coupled_at(0.01)) == near_250(bench.coupled(gel, force_n=0.01))
    air, held = near_250(bench.coupled(None)), near_250(bench.coupled(gel))
    assert abs(near_250(so_far.coupled_at(0.06)) - air) < 0.02 * (held - air)


def test_a_run_on_it_is_that_of_each_contact(bench, library, multisine):
    """A contact that does not change is the run at rest; one that does is played as far as it is known."""
    gel = library["gel10"]
    start = bench.coupled(gel).contact
    tip = BenchTip(gel, 0.01, 1.0, start.contact_radius_m, start.indentation_m)
    so_far, excitation = ContactSoFar(bench, tip), multisine(1)
    still = bench.start(gel, seed=3)
    following = BenchRun(bench.sensor, so_far.coupled_at, seed=3)
    period_s = excitation.samples_per_period / excitation.sample_rate_hz
    expected = list(still.play(excitation, 2))
    found = following.play(excitation, 2)
    so_far.extend(period_s, [(0.01, start.contact_radius_m, start.indentation_m)] * 3)
    one_count_v = expected[0].sensor.scale_v  # where rounding decides
    first = next(found).sensor.volts()
    np.testing.assert_allclose(first, expected[0].sensor.volts(), rtol=0, atol=1.01 * one_count_v)
    so_far.extend(period_s, [state_under(bench, gel, 0.012)] * 3)
    change = next(found).sensor.volts() - expected[1].sensor.volts()
    assert np.abs(change).max() > 1e-3 * np.abs(expected[1].sensor.volts()).max()


def test_parts_are_as_fine_as_the_sensor_follows():
    assert parts_of(0.4) == 10
    assert parts_of(0.0401) == 2
    assert parts_of(0.01) == 1
