# SPDX-License-Identifier: Apache-2.0
"""Scans of tissue that breathes, through robot, load cell and all nodes in simulated time."""

import dataclasses

import numpy as np
import pytest
import yaml

pytest.importorskip("rtde_control", reason="ur-rtde is not here")

from robot_at_hand import own_host

from benchmarks.load_case import Load, demonstrate
from tactile_resonance.report.point_details import STATE_TYPE, deviations, truths_of
from tactile_resonance.scan.point_file import read_messages
from tactile_resonance.scan.point_result import PointOutcome
from tactile_resonance.scan.recorded import RECORD
from tactile_resonance.scan.run_content import read_run

HOST = own_host(19)
MOTION = {"breath_m": 1.0e-3, "heart_m": 1.0e-4}
"""Peak to peak: motion that the controller is known to hold."""
RATES = {"breath_hz": 0.25, "heart_hz": 1.2}
PLACES = [[0.0, 0.0], [0.004, 0.0], [0.004, 0.004]]
GATE_N = 2.2e-4  # now and then the motion is more, now and then less
NOISE_N = 1.2e-4  # of the rms of a force of GATE_N and more that is measured for 0.8 s and more
SCENE = """
name: breathing
force_n: 0.01
regions:
  - {{name: gelatine 10 %, gelatine_percent: 10.0, disc: {{center_m: [0.0, 0.0], radius_m: 0.025}}}}
motion: {motion}
positions: {{list: {places}}}
blocks: {{least: 2, most: {blocks}}}
"""


@dataclasses.dataclass(frozen=True)
class Breathed:
    """A run, what the bench knew of its points, and what the command printed."""

    run: object
    truths: dict
    printed: str

    @property
    def done(self):
        return [r for r in self.run.latest if r.outcome is PointOutcome.DONE]

    def recorded(self, index, kind):
        """Messages of a point, whether they count or not."""
        path = next((self.run.path / "recording").glob(f"point-{index:05}-*.mcap"))
        return [message for _, _, message in read_messages(path, kind)]


def breathe(folder, motion, places, blocks, more=""):
    scene = folder / "scene.yaml"
    asked = yaml.safe_dump({**RATES, **motion}, default_flow_style=True)
    scene.write_text(SCENE.format(motion=asked.strip(), places=places, blocks=blocks) + more)
    shown = demonstrate(folder, scene, HOST, Load("no load"))
    assert shown.status == 0, shown.errors
    assert shown.left == ()
    run = read_run(shown.run_folder)
    found = Breathed(run, truths_of(run), shown.printed)
    # every point ends with poles or with a reason that has a name
    assert len(run.latest) == len(run.points) == len(places)
    for result in run.latest:
        named = result.reason.startswith(("contact: ", "gate: ", "time_limits."))
        assert result.outcome is PointOutcome.DONE or named, result.reason
    # where there are poles they are those of a contact that moves, as far off as they say
    off = deviations(found.done, found.truths)
    assert np.abs(off).max() < 4
    for result in found.done:
        truth = found.truths[result.index]
        # noise is taken off the mean square: what is left of a small one is off by more in its root
        off_n2 = 2 * NOISE_N * max(truth.force_rms_n, GATE_N)
        assert result.force_rms_n**2 == pytest.approx(truth.force_rms_n**2, abs=off_n2)
        assert result.force_min_n < truth.force_n < result.force_max_n
    return found


def test_tissue_that_breathes_is_measured_and_its_motion_stated(domain, tmp_path):
    # a breath that is never quiet: of any 1.6 s of it a quarter of the way is seen, in means of a block
    found = breathe(tmp_path, {**MOTION, "breath_power": 1}, PLACES[:2], blocks=4)
    assert len(found.done) == 2
    # it did move: the tip followed the breath of a flat surface, creep is 20 um
    heights = [r.tip_pose.pose.position.z for n in range(2) for r in found.recorded(n, RECORD)]
    assert 0.2 * MOTION["breath_m"] < np.ptp(heights) < 2 * MOTION["breath_m"]
    assert len(heights) == 2 * 4
    # contact_node stated half of the way that it saw, while it held the tip and not otherwise
    states = [state for n in range(2) for state in found.recorded(n, STATE_TYPE)]
    stated = np.array([state.tissue_moves_m for state in states if state.state == "hold"])
    assert 0.1 * MOTION["breath_m"] < np.nanmax(stated) < MOTION["breath_m"]
    assert all(np.isnan(state.tissue_moves_m) for state in states if state.state != "hold")
    page = (found.run.path / "report.html").read_text()
    assert "rms of the force, smallest to largest [mN]" in page


def test_a_gate_keeps_what_is_measured_between_breaths(domain, tmp_path):
    found = breathe(tmp_path, MOTION, PLACES, 2, f"gate: {{force_rms_n: {GATE_N}}}\n")
    assert len(found.done) >= 2
    for result in found.done:
        assert result.force_rms_n <= GATE_N
        # the truth of the same time is quiet too
        assert found.truths[result.index].force_rms_n < GATE_N + NOISE_N
    left_out = [r for r in found.run.latest if r.gate or r.reason.startswith("gate: ")]
    assert left_out
    for result in left_out:
        assert len(found.recorded(result.index, RECORD)) > result.blocks  # all of it is recorded
    for result in set(found.done) - set(left_out):
        assert len(found.recorded(result.index, RECORD)) == result.blocks
