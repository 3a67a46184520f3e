# SPDX-License-Identifier: Apache-2.0
"""Fixtures shared by all tests."""

import os
import time
from pathlib import Path

import pytest
from hypothesis import settings
from stall_witness import StallWitness

# The same examples in every run, as all random numbers here are seeded: a change is judged by what it changes.
# ``--hypothesis-profile default`` looks for new ones.
settings.register_profile("seeded", derandomize=True)
settings.load_profile("seeded")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of records with reference answers; its tests are skipped where it is absent."""
    folder = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("records with reference answers (../shared/data) are not here")
    return folder


# Tests in which processes meet on the wall clock: a machine that stands still for some hundredths of a second
# fails them, as it would fail a real robot. Such a run says nothing and is repeated; one that fails while the
# machine kept its pace is a failure at once.
WALL_CLOCK = (
    *("nodes/test_topic_wrench.py", "simulation/test_tcp_bus.py", "integration/test_scan.py"),
    *("integration/test_contact_faults.py", "integration/test_contact_requests.py"),
    *("integration/test_demo.py", "integration/test_touch.py", "integration/test_kills.py"),
)
REPEATS = 2
COVERAGE = "COVERAGE_PROCESS_CONFIG"
_TRACING = {}


def pytest_collection_modifyitems(items):
    here = Path(__file__).resolve().parent
    for item in items:
        if item.path.is_relative_to(here):
            where = item.path.relative_to(here).as_posix()
            if where.startswith(WALL_CLOCK):
                mark = pytest.mark.flaky(
                    reruns=REPEATS, reruns_delay=1, condition="config.machine_stood_still()"
                )
                item.add_marker(mark)
                item.on_the_wall_clock = True


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Have the machine watched while a test lives by the wall clock."""
    on_the_wall_clock = getattr(item, "on_the_wall_clock", False)
    _trace_processes(not on_the_wall_clock)
    if not on_the_wall_clock:
        return
    config, start_s = item.config, time.monotonic()
    if not hasattr(config, "stall_witness"):
        config.stall_witness = StallWitness()
        config.add_cleanup(config.stall_witness.end)
    config.machine_stood_still = lambda: bool(config.stall_witness.stalls(start_s))


def _trace_processes(wanted):
    """Let coverage follow processes that tests start, or not: traced, they need half as much time again."""
    if wanted:
        os.environ.update(_TRACING)
        _TRACING.clear()
    elif (value := os.environ.pop(COVERAGE, None)) is not None:
        _TRACING[COVERAGE] = value


def pytest_runtest_logreport(report):
    """Say beside a failure that nothing excuses it."""
    if report.failed and getattr(report, "rerun", REPEATS) < REPEATS:
        report.sections.append(("wall clock", "the machine kept its pace: not repeated"))
