# SPDX-License-Identifier: Apache-2.0
"""Scatter over periods, repetitions, positions and preparations."""

import numpy as np
import pytest

from tactile_resonance.frf.variance_analysis import PAPER_AXES, analyse_variance

LINES_HZ = np.arange(1.0, 401.0)


def nested(rng, sizes, deviations, lines=LINES_HZ.size):
    """3 + independent circular normal scatter of given deviation at each level, outermost first."""
    g = np.full((*sizes, lines), 3 + 0j)
    for level, deviation in enumerate(deviations):
        shape = (*sizes[: level + 1], *([1] * (len(sizes) - level - 1)), lines)
        z = rng.standard_normal((2, *shape)) / np.sqrt(2)
        g = g + deviation * (z[0] + 1j * z[1])
    return g


def test_expected_variances_are_those_documented():
    rng = np.random.default_rng(1)
    sizes, deviations = (4, 3, 5, 6), (0.4, 0.2, 0.1, 0.3)
    v = np.array(deviations) ** 2
    result = analyse_variance(nested(rng, sizes, deviations), LINES_HZ)
    expected = {
        "period": v[3],
        "repetition": v[2] + v[3] / 6,
        "position": v[1] + v[2] / 5 + v[3] / 30,
        "preparation": v[0] + v[1] / 3 + v[2] / 15 + v[3] / 90,
    }
    for name, value in expected.items():
        source = result.source(name)
        # mean over 400 lines of chi-square with 2 dof degrees: relative error 1/sqrt(400 dof)
        tolerance = 4 / np.sqrt(LINES_HZ.size * source.dof)
        assert np.mean(source.variance) == pytest.approx(value, rel=tolerance), name


def test_degrees_of_freedom_and_order():
    result = analyse_variance(nested(np.random.default_rng(2), (2, 3, 4, 5), (1,) * 4), LINES_HZ)
    assert [source.name for source in result.sources] == list(PAPER_AXES)
    assert [source.size for source in result.sources] == [2, 3, 4, 5]
    assert [source.dof for source in result.sources] == [1, 2 * 2, 6 * 3, 24 * 4]


def test_closed_form_levels():
    """Two values 3 +- 0.3 vary by 2 * 0.09 about a mean of 3: -17 dB."""
    g = np.array([3.3, 2.7])[:, None] * np.ones(4)
    result = analyse_variance(g, np.arange(4.0), axes=["repetition"])
    source = result.source("repetition")
    assert np.allclose(source.variance, 0.18)
    assert source.rms_level_db == pytest.approx(10 * np.log10(0.02))
    assert np.allclose(result.mean, 3)


def test_scatter_goes_to_where_it_arises():
    rng = np.random.default_rng(3)
    for level, name in enumerate(PAPER_AXES):
        deviations = np.zeros(4)
        deviations[level] = 0.1
        result = analyse_variance(nested(rng, (3, 3, 3, 3), deviations), LINES_HZ)
        for other in result.sources[level + 1 :]:
            assert np.max(other.variance) < 1e-20
        for k, other in enumerate(result.sources[:level]):
            # of the means over the axes between: their variance falls by 3 with each
            expected = 0.1**2 / 3 ** (level - k)
            assert np.mean(other.variance) == pytest.approx(expected, abs=0.15 * 0.1**2)
        assert result.source(name).rms_level_db == pytest.approx(-29.54, abs=1.0)


def test_one_member_has_no_variance():
    g = nested(np.random.default_rng(4), (3, 1, 2), (1, 0, 1))
    result = analyse_variance(g, LINES_HZ, axes=["position", "repetition", "period"])
    repetition = result.source("repetition")
    assert repetition.variance is None
    assert np.isnan(repetition.rms_level_db)
    assert repetition.dof == 0
    assert result.source("position").variance is not None


def test_refusals():
    g = np.ones((2, 3, 4), complex)
    with pytest.raises(ValueError, match=r"g: shape \(2, 3, 4\), expected 4 leading axes"):
        analyse_variance(g, np.arange(4.0))
    with pytest.raises(ValueError, match="and 5 lines"):
        analyse_variance(g, np.arange(5.0), axes=["a", "b"])
    g[1, 2, 3] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        analyse_variance(g, np.arange(4.0), axes=["a", "b"])
    with pytest.raises(ValueError, match="name: 'c', accepted are a, b"):
        analyse_variance(np.ones((2, 3, 4)), np.arange(4.0), axes=["a", "b"]).source("c")


def test_rms_level_weighs_lines_by_their_response():
    """A line where G vanishes does not rule the level: mean variance over mean power."""
    rng = np.random.default_rng(5)
    scatter = rng.standard_normal((40, 2)) + 1j * rng.standard_normal((40, 2))
    g = np.array([1.0, 1e-6]) + 0.01 / np.sqrt(2) * scatter
    source = analyse_variance(g, [1.0, 2.0], axes=("period",)).sources[0]
    # relative std of a variance of 39 complex degrees of freedom: 0.16, two lines
    assert source.rms_level_db == pytest.approx(10 * np.log10(1e-4 / 0.5), abs=2)
