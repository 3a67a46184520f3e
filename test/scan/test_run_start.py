# SPDX-License-Identifier: Apache-2.0
"""What is touched before the first point of a scan, in which order, and what is left out."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from tactile_resonance.contact.geometry import TipGeometry
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.samples import Pose
from tactile_resonance.scan.clearance import TipUse
from tactile_resonance.scan.failures import PointFailed, ScanEnded
from tactile_resonance.scan.goal import Frames, GoalFiles, ScanGoal
from tactile_resonance.scan.hands import Touch
from tactile_resonance.scan.plan import make_plan
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.run_start import UNCHECKED, prepare, start_run
from tactile_resonance.scan.scene import ScanScene, read_run_scene
from tactile_resonance.scan.surface import HeightField, NormalRequest, Plane, TouchRequest

sys.path.insert(0, str(Path(__file__).resolve().parent))
from bench_hands import Bench

RADIUS_M = 2.5e-3
USE = TipUse(TipGeometry(), ContactParameters(), Limits(depth_m=4e-3))
AXIS = np.arange(-0.1, 0.1001, 1e-3)
BANK = HeightField(
    AXIS, AXIS, (0.02 / (1 + np.exp((AXIS + 0.05) / 2e-3)))[:, None] + np.zeros(AXIS.size)
)


def scene_of(surface, xy=((0.0, 0.0), (0.05, 0.0), (0.06, 0.0)), **fields):
    positions = np.column_stack([np.array(xy), np.full(len(xy), np.nan)])
    return ScanScene("test", 0.01, positions, surface=surface, **fields)


def finding(slope=(0.0, 0.0), touched=None, bad=()):
    """Balls that lie on a plane through the origin; what was asked for is noted."""

    def find(point, force_n, count):
        if touched is not None:
            touched.append((point.index, force_n, count))
        if point.index in bad and "surface" not in point.label:
            raise PointFailed("adhesion")
        x, y, _ = point.position_m
        lift = RADIUS_M * np.sqrt(1 + np.square(slope).sum())
        return Touch((x, y, slope[0] * x + slope[1] * y + lift), 2e-5, force_n)

    return find


def use(_):
    return USE


def test_points_that_are_not_clear_are_not_even_touched():
    scene, touched = scene_of(BANK, normals=NormalRequest(force_n=5e-3)), []
    plan, facts = prepare(make_plan(scene), RADIUS_M, finding(touched=touched), use)
    assert [point.position_m[0] for point in plan.points] == pytest.approx([0.05, 0.06])
    assert touched == [(n, 5e-3, 2) for n in (0, 0, 0, 1, 1, 1)]
    assert len(facts["normals"]) == 2
    assert plan.skipped[0].what == "the point at x = 0.00, y = 0.00 mm"


def test_normals_that_are_found_are_looked_at_again():
    # the clamp is turned down by 0.17 rad towards what is level there
    level = HeightField(AXIS, AXIS, np.zeros((AXIS.size,) * 2))
    scene = scene_of(level, xy=((0.0, 0.0),), normals=NormalRequest())
    with pytest.raises(ValueError, match="all 1 are left out; the first: at the depth limit"):
        prepare(make_plan(scene), RADIUS_M, finding((0.17, 0.0)), use)
    plan, _ = prepare(make_plan(scene), RADIUS_M, finding((-0.17, 0.0)), use)
    assert len(plan.points) == 1
    np.testing.assert_allclose(plan.points[0].normal[0], 0.17 / np.hypot(1, 0.17))


def test_surface_is_found_first_and_points_are_on_it():
    corners = ((-0.02, -0.02), (0.08, -0.02), (0.08, 0.02), (-0.02, 0.02))
    touched = []
    scene = scene_of(TouchRequest(corners, "plane"), normals=NormalRequest(touches=4))
    plan, facts = prepare(make_plan(scene), RADIUS_M, finding((0.1, 0.05), touched, bad=[1]), use)
    assert len(touched) == 4 + 4 + 1 + 4  # the second point is given up at its first touch
    assert [round(point.position_m[0], 6) for point in plan.points] == [0.0, 0.06]
    assert len(facts["surface"]["touches"]) == 4
    assert plan.skipped[0].why == "normals: adhesion"


@pytest.mark.parametrize("surface", [Plane(), BANK])
def test_what_is_not_looked_at_is_noted(surface):
    scene = scene_of(surface)
    plan = make_plan(scene)
    assert prepare(plan, RADIUS_M, finding(), None)[0] == plan  # nothing is moved
    noted, _ = prepare(plan, RADIUS_M, finding(), lambda _: None)
    assert (UNCHECKED in noted.skipped) is (surface is BANK)
    assert noted.points == plan.points


def test_touches_that_cannot_be_made_refuse_the_scan():
    def find(point, force_n, count):
        raise ScanEnded("the tip is not moved")

    scene = scene_of(Plane(), normals=NormalRequest())
    with pytest.raises(ValueError, match="normals: the tip is not moved"):
        prepare(make_plan(scene), RADIUS_M, find, use)
    scene = scene_of(TouchRequest(((0, 0), (1, 0), (0, 1)), "plane"))
    with pytest.raises(ValueError, match=r"surface\.touch: the tip is not moved"):
        prepare(make_plan(scene), RADIUS_M, find, use)


def started(path, **goal):
    """Plan and run of a goal on a bench."""
    given = ScanGoal(run_directory=str(path), **goal), Frames("table", "base", Pose.at_origin())
    how = {"seed": 1, "tip_use": None, "tell": lambda _: None, "check": lambda: None}
    plan, run, _ = start_run(*given, GoalFiles("", ["/"]), Bench(), **how)
    run.close()
    return plan, run


@pytest.mark.parametrize("named", ["surface.npz", "heights/bins.npz"])
def test_a_run_has_the_file_of_its_surface_and_is_resumed_where_the_scene_is_gone(tmp_path, named):
    scene = tmp_path / "scenes" / "bank.yaml"
    (scene.parent / named).parent.mkdir(parents=True)
    np.savez(scene.parent / named, x_m=AXIS, y_m=AXIS, z_m=BANK.z_m)
    text = f"force_n: 0.01  # as always\nsurface: {{height_field: {{file: {named}}}}}\n"
    scene.write_text(text + "positions: {list: [[0.05, 0.0], [0.06, 0.0]]}\n")
    plan, _ = started(tmp_path / "run", scene=str(scene))
    shutil.rmtree(scene.parent)
    (tmp_path / "elsewhere").mkdir()
    moved = (tmp_path / "run").rename(tmp_path / "elsewhere" / "run")
    assert read_run(moved).problems == ()
    again, _ = started(moved, resume=True)
    assert again.points == plan.points
    assert again.scene.name == plan.scene.name == "bank"
    np.testing.assert_array_equal(read_run_scene(moved / "scene.yaml").surface.z_m, BANK.z_m)
    kept = (moved / "scene.yaml").read_text()
    assert ("as always" in kept) == (named == "surface.npz")  # where nothing is to be changed it stays as it is
    assert (moved / "surface.npz").exists()  # under no name that another file of a run has
