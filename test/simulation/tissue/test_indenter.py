# SPDX-License-Identifier: Apache-2.0
"""The ball through time: Lee-Radok, Ting, Hertz, Johnson-Kendall-Roberts, energy; the sprung tip."""

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

from tactile_resonance.simulation.plant.tip import SprungIndenter
from tactile_resonance.simulation.sensor.bimorph import sensor_modes
from tactile_resonance.simulation.tissue.indenter import Indenter
from tactile_resonance.simulation.tissue.library import Tissue

RADIUS, POISSON = 2.5e-3, 0.49
ELASTIC = Tissue("elastic", 10e3, (1.0,), (0.0,))
PLANE_MODULUS = 10e3 / (1 - POISSON**2)


@pytest.fixture(params=["gel10", "cortex", "liver"])
def tissue(request, library):
    return library[request.param]


def indenter(tissue, **options):
    return Indenter(tissue, tip_radius_m=RADIUS, poisson_ratio=POISSON, **options)


def follow(tip, depth, dt):
    """Force at each depth, shape (T,); the tip is at the first depth at the start."""
    return np.array([tip.step(float(x), dt) for x in depth])


def hertz(depth):
    return 4 / 3 * PLANE_MODULUS * np.sqrt(RADIUS) * np.maximum(depth, 0) ** 1.5


def lee_radok(tissue, time, depth):
    """Force while the contact grows, each convolution a sum over all steps before, shape (T,).

    ``4 sqrt(R) / (3 (1 - nu^2)) integral E(t - t') d(depth^(3/2))``, exact for depth^(3/2) linear
    in each step.
    """
    rate = np.diff(depth**1.5) / np.diff(time)  # (T - 1,)
    late, early = (
        np.maximum(time[:, None] - edge, 0) for edge in (time[1:], time[:-1])
    )  # (T, T - 1): elapsed since the end and the start of each step
    weight = tissue.prony.equilibrium_pa * (early - late)
    for modulus, tau in zip(tissue.prony.moduli_pa, tissue.prony_times_s, strict=True):
        weight += modulus * tau * (np.exp(-late / tau) - np.exp(-early / tau))
    return 4 * np.sqrt(RADIUS) / (3 * (1 - POISSON**2)) * weight @ rate


def test_loading_and_hold_are_those_of_lee_and_radok(tissue):
    time = np.linspace(0, 3, 1501)
    depth = 5e-4 * np.minimum(time / 0.2, 1) ** 1.3
    expected = lee_radok(tissue, time, depth)
    tip = indenter(tissue)
    found = follow(tip, depth, time[1])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * expected.max())
    assert tip.contact_radius_m == pytest.approx(np.sqrt(RADIUS * 5e-4))


def test_elastic_limit_is_hertz_on_every_way():
    rng = np.random.default_rng(1)
    turns = np.append(0.0, rng.uniform(-2e-4, 1e-3, 12))
    depth = np.concatenate([np.linspace(*ends, 50) for ends in zip(turns, turns[1:], strict=False)])
    found = follow(indenter(ELASTIC), depth, 1e-3)
    np.testing.assert_allclose(found, hertz(depth), rtol=0, atol=1e-12 * hertz(1e-3))


def ting(tissue, peak, rise_s, times):
    """Force while unloading as fast as loading (Ting 1966), from its two integrals."""
    moduli, taus = tissue.prony.moduli_pa, np.asarray(tissue.prony_times_s)

    def weight(start, stop, t):
        late, early = np.exp(-(t - stop) / taus), np.exp(-(t - start) / taus)
        return tissue.prony.equilibrium_pa * (stop - start) + moduli * taus @ (late - early)

    force = []
    for t in times:
        down = weight(rise_s, t, t)
        if weight(0, rise_s, t) <= down:
            force.append(0.0)
            continue
        same_radius = brentq(lambda s, t=t, d=down: weight(s, rise_s, t) - d, 0, rise_s, xtol=1e-14)
        # u = t'^(3/2) takes the place of time: d(depth^(3/2)) is uniform in it
        value = quad(
            lambda u, t=t: float(tissue.prony.relaxation_modulus(t - u ** (2 / 3))),
            0, same_radius**1.5, limit=400, epsabs=0, epsrel=1e-10,
        )[0]  # fmt: skip
        scale = 4 * np.sqrt(RADIUS) / 3 / (1 - POISSON**2)
        force.append(scale * (peak / rise_s) ** 1.5 * value)
    return np.array(force)


def test_unloading_is_that_of_ting(tissue):
    count, rise = 1000, 0.4
    time = np.linspace(0, 2 * rise, 2 * count + 1)
    depth = 8e-4 * (1 - np.abs(time / rise - 1))
    found = follow(indenter(tissue), depth, time[1])
    chosen = np.arange(count, 2 * count, 37)
    expected = ting(tissue, 8e-4, rise, time[chosen])
    np.testing.assert_allclose(found[chosen], expected, rtol=0, atol=2e-5 * found.max())
    lost = time[count:][found[count:] == 0][0]
    assert lost < 2 * rise - 0.01  # contact ends while the tip is still below the surface


def row_of_springs(tissue, depth, dt, count=600):
    """Force by marching a row of independent springs, each touching or free, by brute force."""
    x = (np.arange(count) + 0.5) * 1.7e-3 / count
    moduli = tissue.prony.moduli_pa[:, None]
    decay = np.exp(-dt / np.asarray(tissue.prony_times_s))[:, None]
    u, z = np.zeros(count), np.zeros((moduli.size, count))
    force = []
    for d in depth:
        # free: u is that of no load (z decays towards u, taken half way by iteration)
        free, z_free = u, z
        for _ in range(3):
            z_free = decay * z + (1 - decay) * (free + u) / 2
            free = (moduli * z_free).sum(axis=0) / tissue.prony.instantaneous_pa
        held = d - x**2 / RADIUS
        z_held = decay * z + (1 - decay) * (held + u) / 2
        touching = held > free
        u, z = np.where(touching, held, free), np.where(touching, z_held, z_free)
        load = tissue.prony.equilibrium_pa * u + (moduli * (u - z)).sum(axis=0)
        force.append(2 / (1 - POISSON**2) * load[touching].sum() * (x[1] - x[0]))
    return np.array(force)


def test_repeated_contact_is_that_of_a_row_of_springs(tissue):
    # in, part of the way out, in deeper, all the way out, back into the dent
    turns = np.array([0.0, 5e-4, 2e-4, 7e-4, -1e-4, 4e-4])
    depth = np.concatenate(
        [np.linspace(*ends, 251)[1:] for ends in zip(turns, turns[1:], strict=False)]
    )
    found = follow(indenter(tissue), depth, 1e-3)
    # brute force needs eight steps in place of one
    fine = np.interp(np.arange(8 * depth.size) / 8, np.arange(depth.size), depth)
    expected = row_of_springs(tissue, fine, 1e-3 / 8)[::8]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3 * expected.max())
    # the same contact, but for the width of one spring of the row
    assert np.count_nonzero((found > 0) != (expected > 0)) <= 3


def test_no_closed_cycle_gives_energy_and_no_force_pulls(tissue):
    rng = np.random.default_rng(3)
    for _ in range(5):
        turns = np.concatenate([[-1e-4], rng.uniform(-3e-4, 9e-4, 8), [-1e-4]])
        steps = rng.integers(5, 120, turns.size - 1)
        depth = np.concatenate(
            [
                np.linspace(low, high, n + 1)[1:]
                for low, high, n in zip(turns, turns[1:], steps, strict=False)
            ]
        )
        force = follow(indenter(tissue), np.append(turns[0], depth), 2e-3)
        assert force.min() >= 0
        work = np.sum((force[1:] + force[:-1]) / 2 * np.diff(np.append(turns[0], depth)))
        assert work > 0


def test_quick_retraction_loses_contact_below_the_surface(tissue):
    tip = indenter(tissue)
    follow(tip, np.linspace(0, 5e-4, 200), 2e-3)
    out = np.linspace(5e-4, 0, 100)
    force = follow(tip, out, 1e-3)
    lost = out[np.flatnonzero(force == 0)[0]]
    assert lost > 1e-5
    # the surface comes back: touched again lower than the surface at once, at it after long
    assert tip.step(0.5 * lost, 1e-3) == 0.0
    tip.step(-1e-3, 3600.0)
    assert tip.step(1e-7, 1e-3) > 0


def test_pull_off_in_the_elastic_limit_is_that_of_jkr():
    work = 0.02
    tip = indenter(ELASTIC, adhesion_j_per_m2=work)
    depth = np.concatenate([np.linspace(0, 2e-4, 100), np.linspace(2e-4, -2e-4, 4000)])
    force = follow(tip, depth, 1e-3)
    assert force.min() == pytest.approx(-1.5 * np.pi * work * RADIUS, rel=1e-4)
    assert force[-1] == 0
    assert tip.contact_radius_m == 0
    # equilibrium curve F(a), depth(a) of Johnson, Kendall & Roberts
    tip = indenter(ELASTIC, adhesion_j_per_m2=work)
    follow(tip, [0.0, 1.5e-4], 1e-3)
    a = tip.contact_radius_m
    expected = 4 * PLANE_MODULUS * a**3 / (3 * RADIUS) - np.sqrt(
        8 * np.pi * a**3 * work * PLANE_MODULUS
    )
    assert tip.force_n == pytest.approx(expected, rel=1e-9)
    assert tip.depth_m == pytest.approx(
        a**2 / RADIUS - np.sqrt(2 * np.pi * a * work / PLANE_MODULUS), rel=1e-9
    )


def test_tangent_predicts_the_next_force(tissue):
    tip = indenter(tissue)
    follow(tip, np.linspace(0, 4e-4, 100), 2e-3)
    for change in (1e-8, -1e-8, 0.0):
        held, stiffness = tip.tangent(1e-3)
        depth = tip.depth_m + change
        assert tip.step(depth, 1e-3) == pytest.approx(held + stiffness * change, rel=1e-7)


@pytest.mark.parametrize(
    ("action", "named"),
    [
        (lambda t: Indenter(t, tip_radius_m=0.0, poisson_ratio=0.4), "tip_radius_m"),
        (lambda t: Indenter(t, tip_radius_m=1e-3, poisson_ratio=0.6), "poisson_ratio"),
        (lambda t: indenter(t, adhesion_j_per_m2=-1.0), "adhesion_j_per_m2"),
        (lambda t: indenter(t).step(0.0, 0.0), "dt_s"),
    ],
)
def test_bad_values_are_refused_by_name(action, named):
    with pytest.raises(ValueError, match=f"{named}.*accepted"):
        action(ELASTIC)


def test_sprung_tip_satisfies_its_differential_equation(sensor):
    modes = sensor_modes(sensor)
    k, natural = modes.static_stiffness_n_per_m, modes.natural_rad_s[0]
    m = k / natural**2
    c = 2 * modes.damping_ratio * natural * m
    speed, dt, count = 5e-3, 2e-3, 150

    def slope(t, state):
        x, v = state
        return [v, (k * (speed * t - x) + c * (speed - v) - hertz(x)) / m]

    times = np.arange(1, count + 1) * dt
    solution = solve_ivp(slope, (0, times[-1]), [0, 0], t_eval=times, rtol=1e-9, atol=1e-14)
    tip = SprungIndenter(indenter(ELASTIC), modes.spring)
    tip.step(0.0, dt)
    depth = []
    for t in times:
        tip.step(speed * t, dt)
        depth.append(tip.tip_depth_m)
    error = np.abs(np.array(depth) - solution.y[0]).max()
    assert error < 5e-3 * solution.y[0].max()


def test_sprung_tip_rests_in_balance_and_rings_at_its_mode(sensor, tissue):
    modes = sensor_modes(sensor)
    tip = SprungIndenter(indenter(tissue), modes.spring)
    tip.step(-1e-4, 1e-3)
    for depth in np.linspace(-1e-4, 7e-4, 200):
        tip.step(depth, 2e-3)
    for _ in range(1500):
        tip.step(7e-4, 2e-3)
    assert tip.force_n == pytest.approx(tip.indenter.force_n, rel=1e-3)
    bent = 7e-4 - tip.tip_depth_m
    assert tip.force_n == pytest.approx(modes.static_stiffness_n_per_m * bent, rel=1e-3)
    # in air, after a sudden stop
    tip = SprungIndenter(indenter(tissue), modes.spring)
    tip.step(-0.2, 1e-3)
    for depth in np.linspace(-0.2, -0.1, 50)[1:]:
        tip.step(depth, 1e-3)
    motion = []
    for _ in range(4000):
        tip.step(-0.1, 2.5e-4)
        motion.append(tip.tip_depth_m + 0.1)
    ups = np.flatnonzero((np.array(motion[:-1]) < 0) & (np.array(motion[1:]) >= 0))
    period = np.mean(np.diff(ups)) * 2.5e-4
    assert 1 / period == pytest.approx(modes.natural_rad_s[0] / (2 * np.pi), rel=0.01)
