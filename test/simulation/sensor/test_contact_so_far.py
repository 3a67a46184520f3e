# SPDX-License-Identifier: Apache-2.0
"""A simulated sensor feels the contact radius that the plant had, part by part."""

import numpy as np
import pytest

from tactile_resonance.simulation.sensor.changing_contact import (
    BenchTip,
    ContactSoFar,
    parts_of,
)
from tactile_resonance.simulation.sensor.response import INTERVAL_S


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
    following = bench.start_varying(so_far.coupled_at, seed=3)
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
    assert parts_of(0.4, INTERVAL_S) == 10
    assert parts_of(0.0401, INTERVAL_S) == 2
    assert parts_of(0.01, INTERVAL_S) == 1
