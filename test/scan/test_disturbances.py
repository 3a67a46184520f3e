# SPDX-License-Identifier: Apache-2.0
"""How often an attempt that was disturbed is repeated."""

from tactile_resonance.scan.failures import (
    ATTEMPTS,
    ATTEMPTS_WITHOUT_NODE,
    Disturbances,
    NodeAway,
    PointDisturbed,
)


def test_nodes_that_leave_do_not_use_up_the_attempts_at_a_late_sensor():
    late = PointDisturbed("contact: force_stale: 11 ms", "force_stale")
    away = NodeAway("frf: /frf_node is not active", "node away")
    disturbed = Disturbances()
    # either may be the reason for every attempt but the last one
    assert all(disturbed.again(away) for _ in range(ATTEMPTS_WITHOUT_NODE - 1))
    assert all(disturbed.again(late) for _ in range(ATTEMPTS - 1))
    assert not disturbed.again(late)
    assert not disturbed.again(away)
    assert disturbed.total == ATTEMPTS + ATTEMPTS_WITHOUT_NODE - 2
    assert str(disturbed) == f"force_stale {ATTEMPTS - 1}, node away {ATTEMPTS_WITHOUT_NODE - 1}"
