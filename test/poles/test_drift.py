# SPDX-License-Identifier: Apache-2.0
"""A mode that changes while it is measured: told, and its mean poles over the record given."""

from functools import lru_cache

import numpy as np
import pytest
import scipy.linalg
from scipy import stats

from tactile_resonance.poles.estimator import identify_poles_from_records
from tactile_resonance.poles.result import PolesStatus
from tactile_resonance.poles.structure import ModelStructure

RATE_HZ, SAMPLES, HARMONICS = 5000.0, 2000, np.arange(4, 401)
F0_HZ, DAMPING, BARE = 250.0, 0.03, ModelStructure(2, 2)
RUNS = 40


def steady(time_s):
    return time_s


def creep(time_s):
    """Logarithmic from 0.3 s on, with a mean of 0; the line nearest to it rises by 1/s."""
    age_s = 0.3 + time_s - time_s[0]
    curve = np.log(age_s)
    return (curve - curve.mean()) / np.polyfit(time_s, curve, 1)[0]


def trembling(seed):
    """Steady, and beside it what few polynomials do not describe: 0.03 s of the rise, rms, of 1 to 6 Hz."""
    rng = np.random.default_rng([5, seed])
    frequency_hz, phase_rad = rng.uniform(1.0, 6.0, (12, 1)), rng.uniform(0, 2 * np.pi, (12, 1))

    def shape(time_s):
        tremor = np.cos(2 * np.pi * frequency_hz * time_s + phase_rad).sum(axis=0) / np.sqrt(6)
        both = time_s + 0.03 * tremor
        return both - both.mean()

    return shape


def record(
    periods, f0_drift_hz_per_s, damping_drift_per_s, damping=DAMPING, shape=steady, power=0, seed=1
):
    """From rest; the nominal f0 and damping ratio are the means over the record.

    The residue goes with a power of the natural frequency.

    One interval after the other with the input straight between samples and the pole of the interval's
    middle: exact but for a smooth factor of the response, which the feed-through does not have.
    """
    rng = np.random.default_rng(seed)
    spectrum = np.zeros(SAMPLES // 2 + 1, complex)
    spectrum[HARMONICS] = np.exp(2j * np.pi * rng.random(HARMONICS.size))
    u = np.tile(np.fft.irfft(spectrum, SAMPLES), periods) * SAMPLES / np.sqrt(2 * HARMONICS.size)
    interval = 1 / RATE_HZ
    time_s = (np.arange(u.size - 1) + 0.5) * interval - (u.size - 1) * interval / 2
    zeta = damping + damping_drift_per_s * shape(time_s)
    w = 2 * np.pi * (F0_HZ + f0_drift_hz_per_s * shape(time_s))
    q = w * (-zeta + 1j * np.sqrt(1 - zeta**2)) * interval
    residue = 2 * damping * (2 * np.pi * F0_HZ) / (2j * np.sqrt(1 - damping**2)) * interval
    residue = residue * (w / (2 * np.pi * F0_HZ)) ** power
    late = (np.exp(q) - 1 - q) / q**2
    drive = residue * ((np.expm1(q) / q - late) * u[:-1] + late * u[1:])
    x = np.zeros(u.size, complex)
    # x[k + 1] = exp(q[k]) x[k] + drive[k], all at once
    bands = np.ones((2, u.size), complex)
    bands[1, :-1] = -np.exp(q)
    x = scipy.linalg.solve_banded((1, 0), bands, np.append(0, drive))
    return tuple(values.reshape(periods, SAMPLES) for values in (u, 0.1 * u + 2 * x.real))


def fits(periods, f0_drift_hz_per_s=0.0, damping_drift_per_s=0.0, structure=BARE, shape=steady):
    noise = 5e-3
    return repeated(record(periods, f0_drift_hz_per_s, damping_drift_per_s, shape=shape), noise, structure)


def repeated(samples, noise, structure=BARE, runs=RUNS, first=2):
    """Poles of a record without noise, as often with noise of its own."""
    u, y = samples
    rng = np.random.default_rng(first)
    for _ in range(runs):
        yield identify_poles_from_records(
            u + noise / 10 * rng.standard_normal(u.shape),
            y + noise * rng.standard_normal(y.shape),
            sample_rate_hz=RATE_HZ,
            harmonics=HARMONICS,
            band_hz=(200.0, 300.0),
            structure=structure,
        )


@lru_cache
def constant_fits(periods, structure=BARE):
    return list(fits(periods, structure=structure))


def inside(errors, covariances):
    """How many are in their 95 % ellipses."""
    solved = np.linalg.solve(covariances, errors[..., None])[..., 0]
    return np.sum(np.sum(errors * solved, axis=-1) < -2 * np.log(0.05))


@pytest.mark.parametrize("structure", [BARE, ModelStructure()], ids=["bare", "default"])
@pytest.mark.parametrize("periods", [2, 3, 8])
@pytest.mark.parametrize("drift", [(0.3, 0.0), (-0.5, 1e-3)], ids=["slow", "fast"])
def test_drift_is_estimated_with_honest_ellipses(drift, periods, structure):
    if periods == 8:
        drift = (drift[0] / 4, drift[1] / 4)
    found = list(fits(periods, *drift, structure))
    assert all(p.status is PolesStatus.OK for p in found)
    assert all("changes: f0 by" in p.message for p in found)
    assert {p.instant_s for p in found} == {(periods * SAMPLES - 1) / RATE_HZ / 2}
    are_honest(found, constant_fits(periods, structure), drift)


@pytest.mark.parametrize("periods", [3, 8])
def test_creep_slows_down_and_its_mean_is_as_precise_as_a_constant_mode(periods):
    drift = (-0.2, 2e-3)
    found = list(fits(periods, *drift, shape=creep))
    assert all(p.status is PolesStatus.OK for p in found)
    are_honest(found, constant_fits(periods), drift)
    # the instant is when the mode passes its mean, before the middle
    time_s = (np.arange(periods * SAMPLES) + 0.5) / RATE_HZ
    passing_s = np.interp(0, creep(time_s), time_s)
    assert passing_s < 0.46 * time_s[-1]
    assert np.median([p.instant_s for p in found]) == pytest.approx(passing_s, rel=0.03)


def are_honest(found, constant, drift):
    rates = np.array([[p.f0_drift_hz_per_s[0], p.damping_drift_per_s[0]] for p in found])
    of_rates = np.stack([p.drift_covariance[0] for p in found])
    poles = np.array([[p.f0_hz[0], p.damping_ratio[0]] for p in found])
    unchanged = np.array([[p.f0_hz[0], p.damping_ratio[0]] for p in constant])
    # beside the constant mode's bias, from how the record is computed
    bias = unchanged.mean(axis=0) - [F0_HZ, DAMPING]
    assert np.all(np.abs(bias) < [0.01, 1e-4])
    for count in (
        inside(rates - drift, of_rates),
        inside(poles - bias - [F0_HZ, DAMPING], np.stack([p.covariance[0] for p in found])),
    ):
        assert stats.binom.cdf(count, RUNS, 0.94) > 0.0005
    # as precise as where nothing changes
    std, of_constant = (
        np.sqrt(np.median([p.covariance[0, 0, 0] for p in some])) for some in (found, constant)
    )
    assert std < 1.2 * of_constant


@pytest.mark.parametrize("periods", [2, 8])
def test_a_constant_mode_does_not_change(periods):
    for poles in constant_fits(periods):
        assert poles.f0_drift_hz_per_s is None
        assert poles.drift_covariance is None
        assert poles.instant_s is None
        assert poles.message == "" or "two residual terms more" in poles.message


def test_tremor_beside_a_drift_is_noise_at_the_mode():
    structure, runs, squared = ModelStructure(), 120, []
    for seed in range(runs):
        samples = record(3, 1.0, 3e-3, shape=trembling(seed), seed=seed)
        poles = next(repeated(samples, 5e-3, structure, first=[2, seed]))
        assert poles.drift_covariance is not None
        error = poles.main.estimate - [F0_HZ, DAMPING]
        squared.append(error @ np.linalg.solve(poles.main.covariance, error))
    # chi-square of two degrees of freedom each; 1.5 times as much where the noise is taken for flat
    assert np.sum(squared) < 2 * 1.3 * runs


@pytest.mark.parametrize("of_u", [0.0, 0.02])
def test_noise_of_the_generator_does_not_change_the_mode(of_u):
    """It comes through the mode, as a drift does, and so does what the noise of the input leaves of it."""
    u, y = record(4, 0.0, 0.0)
    s, w0 = 2j * np.pi * np.fft.rfftfreq(u.size, 1 / RATE_HZ), 2 * np.pi * F0_HZ
    g = 0.1 + 2 * DAMPING * w0**2 / (s**2 + 2 * DAMPING * w0 * s + w0**2)
    rng, found = np.random.default_rng(4), []
    for _ in range(RUNS):
        more = 0.05 * rng.standard_normal(u.size)
        through = np.fft.irfft(g * np.fft.rfft(more), u.size)
        seen = more + of_u * rng.standard_normal(u.size)
        both = u + seen.reshape(u.shape), y + through.reshape(u.shape)
        found += repeated(both, 1e-3, runs=1)
    assert not any("changes over the record" in poles.message for poles in found)
    assert np.mean([poles.status is PolesStatus.OK for poles in found]) > 0.9


def from_rest(periods, f0_drift_hz_per_s, damping, noise=2e-3, runs=12):
    return repeated(record(periods, f0_drift_hz_per_s, 0.0, damping), noise, runs=runs)


@pytest.mark.parametrize(("drift", "damping"), [(3.0, 0.02), (1.0, 0.01), (0.3, 0.005)])
def test_what_decays_from_the_start_has_the_changing_pole_of_the_start(drift, damping):
    """The mean over runs is that of a constant mode, to half a deviation of one."""
    found = list(from_rest(2, drift, damping))
    constant = [p.main.estimate for p in from_rest(2, 0.0, damping)]
    assert all(p.status is PolesStatus.OK for p in found)
    off = [(p.main.estimate - np.mean(constant, axis=0)) / p.main.std for p in found]
    assert np.all(np.abs(np.mean(off, axis=0)) < 0.6)
    rates = [(p.f0_drift_hz_per_s[0] - drift) / np.sqrt(p.drift_covariance[0, 0, 0]) for p in found]
    assert abs(np.mean(rates)) < 1


@pytest.mark.parametrize(("periods", "damping"), [(2, 0.002), (4, 0.002)])
def test_a_mode_too_narrow_for_its_drift_is_a_model_error(periods, damping):
    """Means are off by three to five of their deviations there."""
    for poles in from_rest(periods, 0.3, damping, runs=4):
        assert poles.status is PolesStatus.MODEL_ERROR
        assert "too narrow for such a drift" in poles.message


def test_without_noise_rounding_is_no_change():
    u, y = record(3, 0.0, 0.0)
    poles = identify_poles_from_records(
        u, y, sample_rate_hz=RATE_HZ, harmonics=HARMONICS, band_hz=(200.0, 300.0)
    )
    assert poles.f0_hz == pytest.approx([F0_HZ], abs=0.01)
    rate = poles.f0_drift_hz_per_s
    assert rate is None or abs(rate[0]) < 1e-4


def identify(u, y, seed):
    rng = np.random.default_rng(seed)
    return identify_poles_from_records(
        u + 5e-4 * rng.standard_normal(u.shape),
        y + 5e-3 * rng.standard_normal(y.shape),
        sample_rate_hz=RATE_HZ,
        harmonics=HARMONICS,
        band_hz=(200.0, 300.0),
        structure=BARE,
    )


@pytest.mark.parametrize("periods", [2, 3, 8])
def test_a_drift_of_a_narrow_mode_is_not_taken_for_tones(periods):
    """It fills the bins beside the line at 250 Hz, where hum would lie too."""
    drift = 0.3 if periods < 8 else 0.075
    u, y = record(periods, drift, 0.0, damping=0.005)
    found = [identify(u, y, seed) for seed in range(10)]
    assert not any("tone" in p.message for p in found)
    rates = np.array([p.f0_drift_hz_per_s[0] for p in found])
    stated = np.array([np.sqrt(p.drift_covariance[0, 0, 0]) for p in found])
    assert np.all(np.abs(rates - drift) < 4.5 * stated)


@pytest.mark.parametrize("power", [-1, 1])
def test_a_spring_that_changes_is_a_drift_of_its_mode(power):
    """Under a constant force the residue changes by as much of itself as the pole."""
    u, y = record(8, 0.5, 0.0, power=power)
    rng = np.random.default_rng(3)
    for _ in range(15):
        poles = identify_poles_from_records(
            u,
            y + 5e-3 * rng.standard_normal(y.shape),
            sample_rate_hz=RATE_HZ,
            harmonics=HARMONICS,
            band_hz=(200.0, 300.0),
            structure=BARE,
        )
        assert poles.status is PolesStatus.OK, poles.message
        assert abs(poles.f0_hz[0] - F0_HZ) < 5 * np.sqrt(poles.covariance[0, 0, 0])


@pytest.mark.parametrize("kind", ["gain", "step", "lost"])
def test_a_gain_that_changes_is_no_drift_of_a_mode(kind):
    """An amplifier, or a contact that is lost in the last period: poles are constant, and no drift is sure."""
    u, y = record(3, 0.0, 0.0)
    if kind == "gain":
        y = y * np.linspace(0.98, 1.02, y.size).reshape(y.shape)
    elif kind == "step":
        y = y * np.where(np.arange(y.size) < y.size // 2, 1.0, 1.02).reshape(y.shape)
    else:
        y = y * np.array([[1.0], [1.0], [0.0]])
    for seed in range(10):
        poles = identify(u, y, seed)
        assert poles.status is PolesStatus.MODEL_ERROR
        assert "the gain changes over the record as well" in poles.message
