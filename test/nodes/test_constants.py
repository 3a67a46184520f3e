# SPDX-License-Identifier: Apache-2.0
"""What the core calls phases and states is what the interfaces have constants for."""

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from tactile_resonance.action import Scan
from tactile_resonance.msg import ContactState

from tactile_resonance.contact.goal import State
from tactile_resonance.scan.hands import Phase


@pytest.mark.parametrize(
    ("names", "interface", "prefix"),
    [(Phase, Scan.Feedback, "PHASE_"), (State, ContactState, "STATE_")],
)
def test_each_name_has_a_constant_and_each_constant_a_name(names, interface, prefix):
    constants = {
        name: getattr(interface, name) for name in dir(interface) if name.startswith(prefix)
    }
    assert constants == {prefix + item.name: item.value for item in names}
