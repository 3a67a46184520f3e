# SPDX-License-Identifier: Apache-2.0
"""When it is enough: Wald's test against its theory, precision against what it must do."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from tactile_resonance.poles.result import MainMode
from tactile_resonance.scan.decision import (
    BlockLimits,
    Precise,
    Separate,
    Verdict,
    decide,
)
from tactile_resonance.tissue.classify import TissueClass
from tactile_resonance.tissue.nominal_contact import (
    ContactLoad,
    ForceSensitivity,
    NominalContact,
)

# of one block
BLOCK = np.array([[0.02**2, 0.2 * 0.02 * 8e-5], [0.2 * 0.02 * 8e-5, 8e-5**2]])
LIMITS = BlockLimits(least=1, most=200)


def decide_mode(estimate, covariance, noise, *asked):
    """`decide` of a measurement with one mode, compared as it is."""
    nothing = np.full(2, np.nan)
    mode = MainMode(np.array(estimate), covariance, noise, -50 + 1600j, nothing, nothing)
    poles = SimpleNamespace(main=mode, bands=[SimpleNamespace(main=mode)])
    return decide(poles, ContactLoad(), None, *asked)


def point_classes(distance, spread=None):
    """Two classes `distance` standard deviations of one block apart, in both quantities."""
    spread = np.zeros((2, 2)) if spread is None else spread
    direction = np.array([0.02, 3e-5])
    unit = direction / np.sqrt(direction @ np.linalg.solve(BLOCK, direction))
    first = np.array([253.8, 0.0336])
    return (
        TissueClass("first", first, spread),
        TissueClass("second", first + distance * unit, spread),
    )


def run(rng, wanted, mean, limits=LIMITS):
    """Blocks until a decision, as a scan does: poles of all blocks so far."""
    total = np.zeros(2)
    factor = np.linalg.cholesky(BLOCK)
    for blocks in range(1, limits.most + 1):
        total += mean + factor @ rng.standard_normal(2)
        decision = decide_mode(
            total / blocks, BLOCK / blocks, BLOCK / blocks, blocks, wanted, limits, 0.4
        )
        if decision.stop:
            return decision
    raise AssertionError("unreachable")


# physics.md: d' per block -> blocks of a fixed test, mean of the sequential one, both at 99 %
PUBLISHED = {0.5: (87, 38.7), 1.0: (22, 10.5), 2.0: (6, 3.2), 4.65: (2, 1.1), 6.0: (1, 1.0)}


@pytest.mark.parametrize("distance", PUBLISHED)
def test_sequential_test_needs_the_blocks_that_were_published(distance):
    fixed, mean = PUBLISHED[distance]
    assert int(np.ceil((2 * stats.norm.isf(0.01) / distance) ** 2)) == fixed
    rng, runs = np.random.default_rng(5), 400
    wanted = Separate(*point_classes(distance), probability=0.99)
    decisions = [run(rng, wanted, wanted.first.mean) for _ in range(runs)]
    blocks = np.array([d.blocks for d in decisions])
    standard_error = blocks.std() / np.sqrt(runs)
    # half a unit of the last digit that was published, and the Monte Carlo of both
    assert blocks.mean() == pytest.approx(mean, abs=5 * standard_error + 0.1)
    wrong = sum(d.called != "first" for d in decisions)
    # Wald: at most 1 %; exceeded with probability 1e-4 by chance
    assert wrong <= stats.binom.isf(1e-4, runs, 0.01)
    assert all(d.verdict in (Verdict.SEPARATED, Verdict.NEITHER) for d in decisions)
    assert all(d.blocks_saved == LIMITS.most - d.blocks for d in decisions)
    assert decisions[0].saved_s == pytest.approx(0.4 * decisions[0].blocks_saved)


def test_errors_stay_below_what_is_allowed_with_spread_in_the_classes():
    rng, runs = np.random.default_rng(6), 500
    spread = 4 * BLOCK
    wanted = Separate(*point_classes(9.0, spread), probability=0.95)
    wrong = 0
    for i in range(runs):
        tissue = (wanted.first, wanted.second)[i % 2]
        sample = rng.multivariate_normal(tissue.mean, spread)
        decision = run(rng, wanted, sample, BlockLimits(1, 30))
        wrong += bool(decision.called) and decision.called != tissue.name
    assert wrong <= stats.binom.isf(1e-4, runs, 0.05)


def test_likelihood_ratio_of_all_blocks_is_the_sum_over_blocks():
    rng = np.random.default_rng(7)
    wanted = Separate(*point_classes(1.5), probability=0.99)
    x = rng.multivariate_normal(wanted.first.mean, BLOCK, 6)
    together = wanted.log_likelihood_ratio(x.mean(axis=0), BLOCK / 6)
    apart = sum(wanted.log_likelihood_ratio(xi, BLOCK) for xi in x)
    assert together == pytest.approx(apart, rel=1e-9)


def test_what_is_neither_ends_it():
    wanted = Separate(*point_classes(3.0), probability=0.99)
    far = wanted.first.mean + [1.0, 0.0]
    decision = decide_mode(far, BLOCK, BLOCK, 3, wanted, BlockLimits(), 0.4)
    assert decision.verdict is Verdict.NEITHER
    assert decision.called == ""


def precise(blocks, noise_std, floor=0.0, **wanted):
    noise = np.diag([noise_std**2, (noise_std / 100) ** 2])
    total = noise + np.diag([floor**2, 0])
    wanted = Precise(**(wanted or {"f0_std_hz": 0.01}))
    return decide_mode([250.0, 0.03], total, noise, blocks, wanted, BlockLimits(3, 8), 0.4)


def test_stops_at_the_block_where_it_is_precise_enough():
    # noise of one block 0.02 Hz: 0.01 Hz takes four
    verdicts = [precise(n, 0.02 / np.sqrt(n)).verdict for n in range(1, 5)]
    assert verdicts == [Verdict.CONTINUE] * 3 + [Verdict.PRECISE]
    last = precise(4, 0.01)
    assert (last.blocks_saved, last.saved_s) == (4, pytest.approx(1.6))
    assert precise(2, 1e-6).verdict is Verdict.CONTINUE  # fewer than the least
    assert precise(8, 0.013).verdict is Verdict.MOST_BLOCKS
    both = precise(4, 0.005, f0_std_hz=0.01, damping_ratio_std=4e-5)
    assert both.verdict is Verdict.CONTINUE


def test_gives_up_what_no_block_will_bring():
    # noise alone would come down, a floor of distortion does not
    hopeless = precise(3, 0.012, floor=0.02)
    assert hopeless.verdict is Verdict.HOPELESS
    assert hopeless.blocks_saved == 5
    # within reach of the blocks left, and at the margin of what an estimate can tell: go on
    assert precise(3, 0.016).verdict is Verdict.CONTINUE
    assert precise(3, 0.02).verdict is Verdict.CONTINUE
    assert precise(3, 0.1).verdict is Verdict.HOPELESS


def test_without_poles_or_precision_it_goes_on_to_the_most_blocks():
    unknown = np.full((2, 2), np.nan)
    for wanted in (None, Precise(f0_std_hz=0.01), Separate(*point_classes(3), probability=0.99)):
        for n, verdict in ((3, Verdict.CONTINUE), (8, Verdict.MOST_BLOCKS)):
            decision = decide_mode([np.nan] * 2, unknown, unknown, n, wanted, BlockLimits(), 0.4)
            assert decision.verdict is verdict
            assert decision.blocks_saved == 0


def middle(wanted, share=0.5):
    """Between the means of both classes."""
    return wanted.first.mean + share * (wanted.second.mean - wanted.first.mean)


def test_gives_up_between_the_classes_only_where_no_block_left_would_help():
    wanted = Separate(*point_classes(25.0, 25 * BLOCK), probability=0.99)

    def at(share, blocks, noise):
        limits = BlockLimits(1, 50)
        return decide_mode(middle(wanted, share), noise, noise, blocks, wanted, limits, 0.06)

    # the noise is small beside the spread: where the pole lies now decides
    stopped = at(0.5, 2, BLOCK / 2)
    assert (stopped.verdict, stopped.called) == (Verdict.HOPELESS, "")
    assert stopped.blocks_saved == 48
    assert at(0.1, 2, BLOCK / 2).verdict is Verdict.SEPARATED
    # the noise is large: it may yet come to lie anywhere
    assert at(0.5, 1, 30 * BLOCK).verdict is Verdict.CONTINUE
    assert at(0.5, 50, BLOCK / 50).verdict is Verdict.MOST_BLOCKS


@pytest.mark.parametrize("distance", [2.0, 3.5])
def test_errors_are_as_allowed_with_a_covariance_of_few_lines(distance):
    """Of a level that twelve complex degrees of freedom a block tell, as `levels.level_of` states it."""
    rng, runs, dof = np.random.default_rng(8), 1500, 12
    wanted = Separate(*point_classes(distance), probability=0.99)
    limits, factor, wrong = BlockLimits(1, 200), np.linalg.cholesky(BLOCK), 0
    for _ in range(runs):
        total, level = np.zeros(2), 0.0
        for blocks in range(1, limits.most + 1):
            total += wanted.first.mean + factor @ rng.standard_normal(2)
            level += rng.gamma(dof)
            nu = dof * blocks
            stated = BLOCK / blocks * level / nu * nu / (nu - 1)
            decision = decide_mode(total / blocks, stated, stated, blocks, wanted, limits, 0.06)
            if decision.stop:
                break
        wrong += decision.called == "second"
    assert wrong <= stats.binom.isf(1e-4, runs, 0.01)


def test_tissues_are_told_apart_by_the_pole_at_the_nominal_contact():
    slope = np.array([300.0, 1.3])
    nominal = NominalContact(0.01, 1.0, ForceSensitivity(slope, np.zeros((2, 2))))
    wanted, nothing = Separate(*point_classes(9.0), probability=0.99), np.full(2, np.nan)
    pressed_by = ContactLoad(0.011, 1e-6, 1.0)  # 1 mN too much
    at = middle(wanted, 0.1) + 1e-3 * slope
    poles = SimpleNamespace(main=MainMode(at, BLOCK, BLOCK, -50 + 1600j, nothing, nothing))
    asked = (1, wanted, LIMITS, 0.06)
    referred = decide(poles, pressed_by, nominal, *asked)
    assert (referred.verdict, referred.called) == (Verdict.SEPARATED, "first")
    assert decide(poles, pressed_by, None, *asked).called != "first"
    unknown = decide(poles, ContactLoad(), nominal, *asked)
    assert unknown.verdict is Verdict.CONTINUE
