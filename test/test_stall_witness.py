# SPDX-License-Identifier: Apache-2.0
"""The witness of stalls: told are those of one processor too, as a shared machine takes them away."""

import os
import subprocess
import sys
import time

import pytest
from stall_witness import LONG_S, StallWitness

from tactile_resonance.processes import may_take_priority

TAKEN_S = 0.06
PRIORITY = 90  # above all that the tests start
TAKE = f"""
import os, sys, time
os.sched_setaffinity(0, {{int(sys.argv[1])}})
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({PRIORITY}))
end_s = time.monotonic() + {TAKEN_S}
while time.monotonic() < end_s:
    pass
"""


@pytest.mark.skipif(not may_take_priority(PRIORITY), reason="taking a processor away needs rtprio")
def test_each_processor_that_stands_still_is_told():
    witness = StallWitness()
    try:
        time.sleep(1.0)  # until it watches
        for processor in os.sched_getaffinity(0):
            start_s = time.monotonic()
            subprocess.run([sys.executable, "-c", TAKE, str(processor)], check=True)
            assert max(witness.stalls(start_s), default=0.0) > TAKEN_S / 2 > LONG_S
    finally:
        witness.end()
