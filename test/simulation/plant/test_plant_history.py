# SPDX-License-Identifier: Apache-2.0
"""What the plant keeps is what was true, in pieces that can be put together."""

from types import SimpleNamespace

import numpy as np
import pytest

from tactile_resonance.simulation.plant.tabletop import KEEP_STEPS, MOST_STEPS, PlantHistory


def a_plant():
    return SimpleNamespace(
        time_s=0.0,
        tip_m=(0.0, 0.0, 0.0),
        normal_force_n=0.0,
        contact_radius_m=0.0,
        depth_m=0.0,
    )


def test_pieces_make_up_the_whole_and_the_oldest_go():
    plant = a_plant()
    history = PlantHistory(plant)
    count = KEEP_STEPS + 700
    for n in range(1, count + 1):
        plant.time_s, plant.tip_m, plant.normal_force_n = n / 500, (n, n, n), 2.0 * n
        history.step()
    after, times, forces, tips = (count - 600) / 500, [], [], []
    while part := history.since({"after_s": after})["time_s"]:
        answer = history.since({"after_s": after})
        assert len(part) <= MOST_STEPS
        times, forces = times + part, forces + answer["normal_force_n"]
        tips += answer["tip_m"]
        after = part[-1]
    expected = np.arange(count - 599, count + 1)
    np.testing.assert_allclose(times, expected / 500)
    np.testing.assert_allclose(forces, 2.0 * expected)
    np.testing.assert_allclose(tips, np.tile(expected, (3, 1)).T)
    assert history.since({})["time_s"][0] == pytest.approx((count - KEEP_STEPS + 1) / 500)
    with pytest.raises(ValueError, match="after_s"):
        history.since({"after_s": "now"})


def test_contact_over_an_interval_is_the_mean_of_each_part():
    plant = a_plant()
    history = PlantHistory(plant)
    for n in range(1, 401):
        if 200 < n <= 240:
            continue  # the plant stands still
        plant.time_s, plant.normal_force_n = n / 500, float(n)
        plant.contact_radius_m, plant.depth_m = 2.0 * n, 3.0 * n
        history.step()
    # a step stands for the time up to it: 0.2 to 0.24 s are the steps 101 to 120
    answer = history.contact_over({"after_s": 0.2, "until_s": 0.6, "parts": 10})
    means = [100 + 20 * k + 10.5 for k in range(10)]
    means[5] = means[6] = None
    assert answer["normal_force_n"] == means
    assert answer["contact_radius_m"] == [m and 2 * m for m in means]
    assert answer["depth_m"] == [m and 3 * m for m in means]
    whole = history.contact_over({"after_s": 0.2, "until_s": 0.4, "parts": 1})
    assert whole["normal_force_n"] == [150.5]
    nothing = history.contact_over({"after_s": 5.0, "until_s": 6.0, "parts": 2})
    assert nothing["normal_force_n"] == [None, None]
    for wrong in ({"parts": 0}, {"parts": 1.5}, {"until_s": 0.1}, {"after_s": None}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            history.contact_over({"after_s": 0.2, "until_s": 0.6, "parts": 1} | wrong)
