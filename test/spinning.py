# SPDX-License-Identifier: Apache-2.0
"""Nodes spun in the test's own thread."""

import time


def spin_until(executor, holds, within_s=60.0):
    """Spin until a condition holds; whether it does in time."""
    deadline_s = time.monotonic() + within_s
    while not holds() and time.monotonic() < deadline_s:
        executor.spin_once(0.05)
    return holds()
