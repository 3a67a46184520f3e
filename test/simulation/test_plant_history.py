# SPDX-License-Identifier: Apache-2.0
"""What the plant keeps is what was true, in pieces that can be put together."""

from types import SimpleNamespace

import numpy as np
import pytest

from tactile_resonance.simulation.plant_history import KEEP_STEPS, MOST_STEPS, PlantHistory


def test_pieces_make_up_the_whole_and_the_oldest_go():
    plant = SimpleNamespace(time_s=0.0, tip_m=(0.0, 0.0, 0.0), normal_force_n=0.0)
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
