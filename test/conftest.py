# SPDX-License-Identifier: Apache-2.0
"""Fixtures shared by all tests."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of records with reference answers; its tests are skipped where it is absent."""
    folder = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("records with reference answers (../shared/data) are not here")
    return folder


# Tests in which processes meet on the wall clock: a machine that stands still for some hundredths of a
# second fails them, as it would fail a real robot. Such a run says nothing and is repeated, four times at most.
WALL_CLOCK = (
    *("drivers/ur/", "drivers/test_can_wrench.py", "drivers/test_force_sources.py"),
    *("nodes/test_topic_wrench.py", "simulation/test_tcp_bus.py", "integration/test_scan.py"),
    "integration/test_contact_faults.py",
)


def pytest_collection_modifyitems(items):
    here = Path(__file__).resolve().parent
    for item in items:
        if item.path.is_relative_to(here):
            where = item.path.relative_to(here).as_posix()
            if where.startswith(WALL_CLOCK):
                item.add_marker(pytest.mark.flaky(reruns=4, reruns_delay=1))
