# SPDX-License-Identifier: Apache-2.0
"""What a contact that ended means for the point."""

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from tactile_resonance import msg
from tactile_resonance.contact.result import Cause
from tactile_resonance.nodes.tip_contact import _failure
from tactile_resonance.scan.hands import PointDisturbed

NOT_OF_THE_POINT = ("force_stale", "force_source", "force_invalid", "arm_stale", "arm_link", "cancelled")
OF_THE_POINT = ("force_hard", "force_abort", "force_overload", "surface_missing", "tilt")


@pytest.mark.parametrize("cause", [*NOT_OF_THE_POINT, *OF_THE_POINT])
def test_a_point_comes_again_where_the_cause_says_nothing_of_it(cause):
    known = {member.value for member in Cause}
    if cause not in known:
        pytest.fail(f"{cause}: expected one of {sorted(known)}")
    failure = _failure(msg.ContactState(cause=cause, message="told"))
    assert isinstance(failure, PointDisturbed) == (cause in NOT_OF_THE_POINT)
    assert cause in str(failure)
    assert "told" in str(failure)
