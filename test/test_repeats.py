# SPDX-License-Identifier: Apache-2.0
"""Tests on the wall clock that are repeated, or not: what their module started is ended in any case."""

import subprocess
import sys

import pytest

pytest.importorskip("pytest_rerunfailures", reason="tests are not repeated without it")

MODULE = """
import pytest

@pytest.fixture(scope="module")
def robot():
    yield
    print("robot ended")

@pytest.mark.flaky(reruns=2, condition={condition})
def test_that_fails(robot):
    print("run")
    assert False
"""


@pytest.mark.parametrize(("stood_still", "runs"), [(False, 1), (True, 3)])
def test_what_a_module_started_is_ended_before_the_next_one(tmp_path, stood_still, runs):
    module = MODULE.format(condition=stood_still)
    (tmp_path / "test_a.py").write_text(module)
    (tmp_path / "test_b.py").write_text("def test_next():\n    print('next module')\n")
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-s", "-p", "no:cacheprovider", "."],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    told = run.stdout
    assert "1 failed, 1 passed" in told
    assert told.count("run\n") == runs
    assert told.count("robot ended") == 1
    assert told.index("robot ended") < told.index("next module")
