# SPDX-License-Identifier: Apache-2.0
"""The transform of pairs by periods equals a long transform of each at every bin it offers."""

import numpy as np
import pytest

from tactile_resonance.frf.record_transform import PairTransform


def told_apart(spectrum, places):
    mixed = spectrum.gather(places)  # (..., W, 2, L)
    mirrored = mixed[..., 1, :].conj()
    return (mixed[..., 0, :] + mirrored) / 2, (mixed[..., 0, :] - mirrored) / (2j * spectrum.scale)


@pytest.mark.parametrize("samples", [60, 61])
@pytest.mark.parametrize("periods", [1, 2, 3, 4, 7, 16])
@pytest.mark.parametrize("reach", [0, 2, 99])
def test_equals_the_long_transforms(samples, periods, reach):
    rng = np.random.default_rng(periods)
    y, u = rng.standard_normal((2, 5, periods, samples))
    u *= 1e-4
    long_y, long_u = (np.fft.rfft(record.reshape(5, -1)) for record in (y, u))
    last = periods * samples // 2
    near = [o for o in range(-20, 21) if min(o % periods, -o % periods) <= reach]
    for harmonics in (np.arange(1, 28), np.arange(2, 28, 3), np.array([1, 2, 9]), np.array([4])):
        centre = harmonics * periods
        offsets = np.array([o for o in near if centre[0] + o >= 0 and centre[-1] + o <= last])
        transform = PairTransform(samples, periods, offsets)
        mine = told_apart(transform(y, u), transform.places(centre, offsets))
        where = centre + offsets[:, None]  # (W, L)
        for channel, long in zip(mine, (long_y, long_u), strict=True):
            assert np.allclose(channel, long[:, where], rtol=0, atol=1e-13 * np.abs(long).max())


def test_only_rows_in_reach_are_computed():
    transform = PairTransform(100, 16, np.arange(-2, 3))
    assert transform.rows.tolist() == [0, 1, 2, 14, 15]
    assert transform(np.zeros((16, 100)), np.zeros((16, 100))).values.shape == (5, 100)


def test_balance_is_exact():
    """Powers of two: the scale of a channel changes nothing but the scale of its spectrum."""
    rng = np.random.default_rng(1)
    y, u = rng.standard_normal((2, 4, 500))
    transform = PairTransform(500, 4, np.array([0, 1]))
    places = transform.places(np.arange(4, 400, 4), np.array([0, 1]))
    reference = told_apart(transform(y, u), places)
    small = told_apart(transform(y, u * 2.0**-40), places)
    assert np.array_equal(small[0], reference[0])
    assert np.array_equal(small[1], reference[1] * 2.0**-40)


def test_a_dead_channel_does_no_harm():
    rng = np.random.default_rng(2)
    x = rng.standard_normal((4, 50))
    transform = PairTransform(50, 4, np.array([0]))
    places = transform.places(np.arange(4, 40, 4), np.array([0]))
    for y, u in ((x, 0 * x), (0 * x, x)):
        for channel, record in zip(told_apart(transform(y, u), places), (y, u), strict=True):
            expected = np.fft.rfft(record.ravel())[4:40:4]
            assert np.allclose(channel[0], expected, rtol=0, atol=1e-13)
