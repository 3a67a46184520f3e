# SPDX-License-Identifier: Apache-2.0
"""Scatter over periods, repetitions, positions and preparations."""

import numpy as np
import pytest

from tactile_resonance.frf.variance_analysis import PAPER_AXES, nested_means

LINES_HZ = np.arange(1.0, 401.0)


def nested(rng, sizes, deviations, lines=LINES_HZ.size):
    """3 + independent circular normal scatter of given deviation at each level, outermost first."""
    g = np.full((*sizes, lines), 3 + 0j)
    for level, deviation in enumerate(deviations):
        shape = (*sizes[: level + 1], *([1] * (len(sizes) - level - 1)), lines)
        z = rng.standard_normal((2, *shape)) / np.sqrt(2)
        g = g + deviation * (z[0] + 1j * z[1])
    return g


def balanced(g, axes=PAPER_AXES):
    """Of (A1, ..., An, F) FRFs, outermost first."""
    index = np.indices(g.shape[:-1]).reshape(g.ndim - 1, -1)
    groups = np.stack([0 * index[0], *index[:-1]], axis=1)
    return nested_means(g.reshape(-1, g.shape[-1]), groups, axes)


def level_db(found, level):
    return found.rms_level_db(level, np.ones(found.mean.shape[-1], bool))


def test_expected_variances_are_those_documented():
    rng = np.random.default_rng(1)
    sizes, deviations = (4, 3, 5, 6), (0.4, 0.2, 0.1, 0.3)
    v = np.array(deviations) ** 2
    result = balanced(nested(rng, sizes, deviations))
    expected = {
        "period": v[3],
        "repetition": v[2] + v[3] / 6,
        "position": v[1] + v[2] / 5 + v[3] / 30,
        "preparation": v[0] + v[1] / 3 + v[2] / 15 + v[3] / 90,
    }
    assert [source.name for source in result.levels] == list(PAPER_AXES)
    for source in result.levels:
        name, value = source.name, expected[source.name]
        # mean over 400 lines of chi-square with 2 dof degrees: relative error 1/sqrt(400 dof)
        tolerance = 4 / np.sqrt(LINES_HZ.size * source.dof)
        assert np.mean(source.variance) == pytest.approx(value, rel=tolerance), name


def test_degrees_of_freedom_and_order():
    result = balanced(nested(np.random.default_rng(2), (2, 3, 4, 5), (1,) * 4))
    assert [source.name for source in result.levels] == list(PAPER_AXES)
    assert [source.dof for source in result.levels] == [1, 2 * 2, 6 * 3, 24 * 4]


def test_closed_form_levels():
    """Two values 3 +- 0.3 vary by 2 * 0.09 about a mean of 3: -17 dB."""
    g = np.array([3.3, 2.7])[:, None] * np.ones(4)
    result = balanced(g, ["repetition"])
    (source,) = result.levels
    assert np.allclose(source.variance, 0.18)
    assert level_db(result, source) == pytest.approx(10 * np.log10(0.02))
    assert np.allclose(result.mean, 3)


def test_scatter_goes_to_where_it_arises():
    rng = np.random.default_rng(3)
    for level in range(4):
        deviations = np.zeros(4)
        deviations[level] = 0.1
        result = balanced(nested(rng, (3, 3, 3, 3), deviations))
        for other in result.levels[level + 1 :]:
            assert np.max(other.variance) < 1e-20
        for k, other in enumerate(result.levels[:level]):
            # of the means over the axes between: their variance falls by 3 with each
            expected = 0.1**2 / 3 ** (level - k)
            assert np.mean(other.variance) == pytest.approx(expected, abs=0.15 * 0.1**2)
        assert level_db(result, result.levels[level]) == pytest.approx(-29.54, abs=1.0)


def test_one_member_has_no_variance():
    g = nested(np.random.default_rng(4), (3, 1, 2), (1, 0, 1))
    result = balanced(g, ["position", "repetition", "period"])
    position, repetition, _ = result.levels
    assert repetition.variance is None
    assert np.isnan(level_db(result, repetition))
    assert repetition.dof == 0
    assert position.variance is not None


def test_groups_of_any_size_and_tissues_that_are_not_compared():
    """Two tissues 3 apart, of one and two preparations: their difference is no scatter."""
    rng = np.random.default_rng(6)
    groups = np.array([[0, 0], [0, 0], [1, 1], [1, 1], [1, 1], [1, 2]])
    tissue = 3.0 * groups[:, :1]
    scatter = rng.standard_normal((6, 4000, 2)) @ [1, 1j] * 0.1 / np.sqrt(2)
    result = nested_means(tissue + scatter, groups, ["preparation", "period"])
    preparation, period = result.levels
    assert (preparation.dof, period.dof) == (1, 3)
    assert np.mean(period.variance) == pytest.approx(0.01, rel=4 / np.sqrt(3 * 4000))
    # of the means of three and of one
    expected = 0.01 * (1 / 3 + 1) / 2
    assert np.mean(preparation.variance) == pytest.approx(expected, rel=4 / np.sqrt(4000))
    assert level_db(result, period) == pytest.approx(10 * np.log10(0.01 / 4.5), abs=0.2)


def test_refusals():
    g, groups = np.ones((3, 4), complex), np.zeros((3, 1), int)
    with pytest.raises(ValueError, match=r"groups: got \(3, 1\); accepted is \(3, 2\)"):
        nested_means(g, groups, ["a", "b"])
    g[1, 2] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        nested_means(g, groups, ["a"])


def test_rms_level_weighs_lines_by_their_response():
    """A line where G vanishes does not rule the level: mean variance over mean power."""
    rng = np.random.default_rng(5)
    scatter = rng.standard_normal((40, 2)) + 1j * rng.standard_normal((40, 2))
    g = np.array([1.0, 1e-6]) + 0.01 / np.sqrt(2) * scatter
    found = balanced(g, ["period"])
    # relative std of a variance of 39 complex degrees of freedom: 0.16, two lines
    assert level_db(found, found.levels[0]) == pytest.approx(10 * np.log10(1e-4 / 0.5), abs=2)
