# SPDX-License-Identifier: Apache-2.0
"""Fixtures shared by all tests."""

import signal
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tactile_resonance.processes import ENDING

# The same examples in every run, as all random numbers here are seeded: a change is judged by what it changes.
# ``--hypothesis-profile default`` looks for new ones. How long they take is not judged: a machine may have
# other work.
settings.register_profile(
    "seeded", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("seeded")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of records with reference answers; its tests are skipped where it is absent."""
    folder = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("records with reference answers (../shared/data) are not here")
    return folder


@pytest.fixture
def handlers():
    """Handlers of signals are as they were, afterwards."""
    before = {number: signal.getsignal(number) for number in ENDING}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(autouse=True)
def no_open_context(monkeypatch):
    """An open context that is dropped ends Python with a segmentation fault at an interrupt of a later test."""
    opened = []
    if rclpy := sys.modules.get("rclpy"):
        init = rclpy.Context.init

        def note(context, *args, **options):
            opened.append(context)
            init(context, *args, **options)

        monkeypatch.setattr(rclpy.Context, "init", note)
    yield
    left = [context for context in opened if context.ok()]
    for context in left:
        context.shutdown()
    assert not left
