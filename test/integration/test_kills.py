# SPDX-License-Identifier: Apache-2.0
"""Nodes are killed while they scan; `python -m benchmarks.kills --kills 50` does it more often."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from benchmarks.killed_scan import ALL, KilledScan

VICTIMS = ("frf_node", "scan_node", ALL)


@pytest.mark.slow
def test_no_finished_point_is_lost_or_repeated(domain, tmp_path):
    random = np.random.default_rng(8)
    victims = [str(name) for name in random.permutation(VICTIMS)]
    with KilledScan(tmp_path, (3, 2)) as scan:
        expected = scan.undisturbed()
        # looks at every file after every kill, and at the whole run at its end
        scans = scan.disturbed(victims, random)
        kills = scan.kills
    assert [kill.victim for kill in kills] == victims
    assert any(kill.in_the_midst for kill in kills), "the kills met no point being recorded"
    for poles in scans:
        assert len(poles) == 6
        assert poles == expected  # to the bit: the bench's noise follows from the point's seed
