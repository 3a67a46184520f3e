# SPDX-License-Identifier: Apache-2.0
"""First contact from the resonance: the stated probability of a false alarm, and what is told."""

import numpy as np
import pytest
from scipy.stats import binom, chi2, kstest

from benchmarks.lock_in_touch import ScatterTouch, lock_in
from tactile_resonance.contact.resonance_touch import PolesTouch

COVARIANCE = np.array([[0.0086**2, 1e-7], [1e-7, 3e-5**2]])
AIR = np.array([246.6, 0.0119])


@pytest.mark.parametrize("count", [20, 50])
def test_false_alarms_come_as_often_as_stated(count):
    rng, pairs, p = np.random.default_rng(1), 4000, 0.05
    mixing = np.array([[2.0, 0.3], [0.3, 0.1]])
    alarms = 0
    for _ in range(pairs):
        drawn = rng.standard_normal((count + 1, 2)) @ mixing + [5.0, -1.0]
        alarms += ScatterTouch(drawn[:-1], p).touched(drawn[-1])
    low, high = binom.interval(0.9999, pairs, p)
    assert low <= alarms <= high


def test_lock_in_is_the_amplitude_of_its_line_alone():
    rate, window = 50_000.0, 0.008
    t = np.arange(3 * 400 + 17) / rate
    y = 0.3 * np.cos(2 * np.pi * 250 * t) - 0.2 * np.sin(2 * np.pi * 250 * t)
    y += 5.0 + 2.0 * np.cos(2 * np.pi * 1000 * t + 1)  # whole periods of it fit in too
    found = lock_in(y, rate, 250.0, window)
    # Re a exp(j w t): a sine of amplitude -0.2 is +0.2 in quadrature
    np.testing.assert_allclose(found, np.tile([0.3, 0.2], (3, 1)), atol=1e-12)
    for bad in (0.007, 0.00801):
        with pytest.raises(ValueError, match="window_s"):
            lock_in(y, rate, 250.0, bad)


def test_poles_in_air_are_chi_squared_and_a_contact_is_told():
    rng, values = np.random.default_rng(2), []
    root = np.linalg.cholesky(COVARIANCE)
    for _ in range(1500):
        touch = PolesTouch(1e-6, blocks=1)
        touch.add_air(AIR + root @ rng.standard_normal(2), COVARIANCE)
        values.append(touch.statistic(AIR + root @ rng.standard_normal(2), COVARIANCE))
    assert kstest(values, chi2(2).cdf).pvalue > 1e-3
    # a tenth of the change that 1 cN on 10 % gelatine makes
    contact = AIR + 0.1 * np.array([7.23, 0.0217])
    assert touch.touched(contact, COVARIANCE)


@pytest.mark.parametrize("along", [0.0, 1.0])
def test_stated_probability_holds_where_air_scatters_by_more_than_stated(along):
    """Along both axes of the covariance, or along one: no more false alarms than stated from few blocks."""
    rng, runs, p, blocks = np.random.default_rng(3), 2000, 0.01, 3
    root = 30 * np.linalg.cholesky(COVARIANCE) * [1.0, along]
    alarms = 0
    for _ in range(runs):
        touch = PolesTouch(p, blocks)
        for _ in range(blocks):
            touch.add_air(AIR + root @ rng.standard_normal(2), COVARIANCE)
        alarms += touch.touched(AIR + root @ rng.standard_normal(2), COVARIANCE)
    low, high = binom.interval(0.9999, runs, p)
    assert alarms <= high
    if not along:  # the bound is reached there
        assert alarms >= low


def test_contact_is_told_after_the_blocks_in_air_that_are_the_default():
    rng, told, runs = np.random.default_rng(4), 0, 300
    root = np.linalg.cholesky(COVARIANCE)
    for _ in range(runs):
        touch = PolesTouch()
        while not touch.ready:
            touch.add_air(AIR + root @ rng.standard_normal(2), COVARIANCE)
        # a tenth of the change that 1 cN on 10 % gelatine makes
        told += touch.touched(AIR + 0.1 * np.array([7.23, 0.0217]), COVARIANCE)
    assert told == runs


def test_reference_that_scatters_more_than_stated_raises_the_threshold():
    steady, warming = PolesTouch(), PolesTouch()
    for n in range(8):
        steady.add_air(AIR, COVARIANCE)
        warming.add_air(AIR + [0.1 * n, 0.0], COVARIANCE)
    next_one = AIR + [0.8, 0.0]
    assert steady.touched(next_one, COVARIANCE)
    assert not warming.touched(next_one, COVARIANCE)


def test_what_cannot_be_judged_is_refused():
    with pytest.raises(ValueError, match="8 blocks in air first"):
        PolesTouch().statistic(AIR, COVARIANCE)
    with pytest.raises(ValueError, match="positive definite"):
        PolesTouch().add_air(AIR, np.zeros((2, 2)))
    with pytest.raises(ValueError, match="n at least 20"):
        ScatterTouch(np.zeros((3, 2)), 1e-3)
    with pytest.raises(ValueError, match="false_alarm_probability"):
        PolesTouch(0.0)
    with pytest.raises(ValueError, match="pole"):
        PolesTouch().add_air([np.nan, 0.01], COVARIANCE)
