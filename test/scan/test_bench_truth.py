# SPDX-License-Identifier: Apache-2.0
"""The truth of a point is that of the blocks its poles rest on, and the table says how far off they are."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.report.point_details import deviations, truths_of
from tactile_resonance.report.run_tables import point_table, repeats_sentence, table_notes
from tactile_resonance.scan.messages import header_message, make_message, message_types, to_cdr
from tactile_resonance.scan.point_result import TYPE as RESULT
from tactile_resonance.scan.point_result import PointOutcome
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.run_directory import RunDirectory

sys.path.insert(0, str(Path(__file__).resolve().parent))
from run_tables import POLES, START_NS, plan, result

TRUTH = 100


def poles(recording, topic, status, measurement_id, middle_ns, f0_hz):
    stamp_ns = START_NS + middle_ns
    values = {"f0_hz": [f0_hz], "damping_ratio": [0.03], "real_rad_s": [-50.0]}
    values |= {"imag_rad_s": [1600.0], "residue_real": [1.0], "residue_imag": [0.0]}
    message = make_message(
        POLES,
        header=header_message("tip", stamp_ns),
        status=status,
        measurement_id=measurement_id,
        label="gel10",
        **{name: np.array(value) for name, value in values.items()},
    )
    recording.write(topic, POLES, stamp_ns, to_cdr(message))


@pytest.fixture
def run(tmp_path):
    with RunDirectory.create(tmp_path / "run", "name: t\n", plan(3), {"seed": 1}) as run:
        with run.begin_point(0) as recording:
            poles(recording, "/left/bench/truth", TRUTH, 6, 400_000_000, 200.0)  # the one before
            for block in (1, 2, 3):  # the bench played on for one block more
                middle_ns = block * 200_000_000
                poles(recording, "/left/bench/truth", TRUTH, 7, middle_ns, 250.0 + 0.01 * block)
                if block < 3:
                    poles(recording, "/left/poles", 0, 7, middle_ns, 250.5)
            measured = {"f0_hz": 250.05, "f0_std_hz": 0.01, "damping_ratio": 0.0301}
            measured |= {"damping_ratio_std": 1e-4, "repeats": 3}
            measured |= {"disturbances": "arm_stale 1, force_stale 2", "force_n": 0.01}
            of_point = result(0, measurement_id=7, simulated=True, **measured)
            recording.finish(of_point)
            (told,) = message_types().deserialize_cdr(recording.message_of(of_point), RESULT).poles
            # the last poles, and no truth
            assert (told.header.stamp.nanosec, told.status, told.f0_hz[0]) == (400_000_000, 0, 250.5)
        with run.begin_point(1) as recording:  # of hardware: nobody knows the truth
            poles(recording, "/poles", 0, 8, 400_000_000, 251.0)
            recording.finish(result(1, measurement_id=8))
        with run.begin_point(2) as recording:
            recording.finish(result(2, outcome=PointOutcome.FAILED, reason="contact: surface_missing"))
    return read_run(tmp_path / "run")


def test_truth_is_that_of_the_same_blocks(run):
    truths = truths_of(run)
    assert list(truths) == [0]
    np.testing.assert_allclose(truths[0].estimate, [250.02, 0.03])
    assert truths[0].tissue == "gel10"
    np.testing.assert_allclose(deviations(run.latest, truths), [[3.0, 1.0]])


def test_the_table_tells_truth_failures_and_repeats(run):
    lines = point_table(run.latest, truths_of(run)).split("\n")
    assert lines[2].split()[-4:] == ["250.020", "+3.0", "0.03000", "+1.0"]
    assert lines[3].rstrip().endswith("-")
    assert lines[4].endswith("failed: contact: surface_missing")
    deviation, repeats = table_notes(run.latest, truths_of(run))
    assert "rms 3.00 of f0, 1.00 of the damping ratio; largest 3.0" in deviation
    assert repeats == "1 of 3 points had to be repeated, 3 times in all: force_stale 2, arm_stale 1"
    assert "true f0" not in point_table(run.latest, {})
    assert "ok" not in lines[2]
    doubted = [dataclasses.replace(run.latest[0], poles_status="model error")]
    assert point_table(doubted, {}).endswith("  model error")
    assert repeats_sentence(run.latest[1:]) == "no point had to be repeated"
