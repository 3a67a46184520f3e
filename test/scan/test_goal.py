# SPDX-License-Identifier: Apache-2.0
"""What a goal of a scan asks for: exact places, what it has in place of its scene, and why it is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_resonance.contact.samples import Pose
from tactile_resonance.scan.decision import Precise
from tactile_resonance.scan.goal import (
    Frames,
    ScanGoal,
    named_frames,
    read_goal,
    resumed_run,
)
from tactile_resonance.scan.scene import read_scan_scene

TABLE_IN_BASE = Pose(np.array([-0.49, -0.13, 0.2]), np.array([0.3, -0.2, -1.5]))
FRAMES = Frames("table", "base", TABLE_IN_BASE, {"phantom": TABLE_IN_BASE})
TILTED = Rotation.from_rotvec([0.1, -0.2, 0.7])
POSES = ((0.0, 0.001, 0.0, 0.0, 0.0, 0.0, 1.0), (0.004, -0.003, 0.0021, *TILTED.as_quat().tolist()))
GOAL = ScanGoal(poses=POSES, frame_id="table", force_n=0.012)
SCENE = """
name: slope
frame_id: phantom
force_n: 0.01
surface: {plane: {point_m: [0, 0, 0], normal: [0, 0.1, 1]}}
positions: {list: [[0, 0], [0.004, 0]]}
precision: {f0_std_hz: 0.05}
regions: [{name: gelatine 10 %, gelatine_percent: 10.0, disc: {center_m: [0, 0], radius_m: 0.03}}]
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "slope.yaml"
    path.write_text(SCENE)
    return str(path)


def again(text, tmp_path):
    """The scene as a run that is gone on with reads it."""
    path = tmp_path / "again.yaml"
    path.write_text(text)
    return read_scan_scene(path)


def test_poses_need_no_scene_and_give_points_at_exactly_these_places(tmp_path):
    plan, text, _ = read_goal(GOAL, FRAMES)
    assert tuple((*p.position_m, *p.orientation_xyzw) for p in plan.points) == POSES
    assert plan.points[1].normal == pytest.approx(TILTED.apply([0, 0, 1]).tolist())
    for scene in (plan.scene, again(text, tmp_path)):
        assert (scene.force_n, scene.frame_id) == (0.012, "table")


def test_poses_in_the_base_are_those_places_in_the_frame_of_the_scene(scene):
    for named in ("", scene):
        poses = in_base(TABLE_IN_BASE, POSES)
        goal = ScanGoal(scene=named, poses=poses, frame_id="base", force_n=0.012)
        for point, pose in zip(read_goal(goal, FRAMES)[0].points, POSES, strict=True):
            assert point.position_m == pytest.approx(pose[:3], abs=1e-12)
            turned = Rotation.from_quat(point.orientation_xyzw) * Rotation.from_quat(pose[3:]).inv()
            assert turned.magnitude() < 1e-12


def test_a_goal_has_force_precision_notes_and_places_in_place_of_its_scene(scene, tmp_path):
    plan, text, _ = read_goal(ScanGoal(scene=scene), FRAMES)
    assert text == SCENE
    assert [p.position_m[2] for p in plan.points] == [0.0, 0.0]
    goal = ScanGoal(
        scene=scene,
        poses=POSES,
        frame_id="phantom",
        force_n=0.02,
        damping_ratio_std=1e-4,
        notes="{tip_wetness: wet}",
    )
    plan, text, _ = read_goal(goal, FRAMES)
    for read in (plan.scene, again(text, tmp_path)):
        assert read.force_n == 0.02
        assert read.precision == Precise(None, 1e-4)
        assert read.notes.tip_wetness == "wet"
        assert read.positions_m.tolist() == [list(pose[:3]) for pose in POSES]
    assert "gelatine_percent" in text  # the bench reads it too
    unset, _, _ = read_goal(ScanGoal(scene=scene, force_n=math.nan, f0_std_hz=math.nan), FRAMES)
    assert (unset.scene.force_n, unset.scene.precision) == (0.01, Precise(0.05))


def test_a_run_holds_the_classes_of_the_library_that_its_scene_names(scene, tmp_path):
    path = tmp_path / "with_library" / "scene.yaml"
    path.parent.mkdir()
    path.write_text(SCENE + "tissue_classes: library.yaml\n")
    (path.parent / "library.yaml").write_text(
        "tissue_classes:\n  gel: {f0_hz: 254, damping_ratio: 0.03, f0_std_hz: 1, damping_ratio_std: 1e-3}\n"
        "spread: {}\n"
    )
    plan, text, _ = read_goal(ScanGoal(scene=str(path)), FRAMES)
    for read in (plan.scene, again(text, tmp_path)):
        assert [each.name for each in read.tissue_classes] == ["gel"]


def test_a_library_that_an_earlier_version_made_of_too_few_preparations_is_refused(tmp_path):
    """By fewer than three degrees of freedom calls of more than 99 % are wrong in 3 to 13 %."""
    path, library = tmp_path / "scene.yaml", tmp_path / "library.yaml"
    path.write_text(SCENE + "tissue_classes: library.yaml\n")
    entry = "{f0_hz: 254, damping_ratio: 0.03, f0_std_hz: 1, damping_ratio_std: 1e-3, degrees_of_freedom: %s}"
    library.write_text(f"tissue_classes: {{gel: {entry % 3.0}}}\n")
    assert read_goal(ScanGoal(scene=str(path)), FRAMES)[0].scene.tissue_classes[0].degrees_of_freedom == 2.0
    library.write_text(f"tissue_classes: {{gel: {entry % 2.9}}}\n")
    with pytest.raises(ValueError, match=r"library.yaml: gel.degrees_of_freedom: got 2.9; .* 3 or more"):
        read_goal(ScanGoal(scene=str(path)), FRAMES)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"poses": ()}, "scene: got ''; accepted is a scene file, or poses and force_n"),
        ({"scene": "config/scenes/none.yaml"}, "config/scenes/none.yaml"),
        ({"frame_id": "camera"}, "frame_id: got 'camera'; accepted is 'table' or 'base'"),
        ({"frame_id": ""}, "frame_id: got ''; accepted is 'table' or 'base'"),
        ({"force_n": 0.0}, "force_n: got 0.0; accepted is a number above 0"),
        ({"force_n": math.nan}, "force_n: got nan; accepted is a number above 0"),
        ({"force_n": -0.01}, "force_n: got -0.01; accepted is a number above 0"),
        ({"force_n": math.inf}, "force_n: got inf; accepted is a number above 0"),
        ({"f0_std_hz": -1.0}, "f0_std_hz: got -1.0; accepted is a number above 0"),
        ({"damping_ratio_std": math.inf}, "damping_ratio_std: got inf"),
        ({"notes": "{tip_wetness: damp}"}, "notes.tip_wetness: got 'damp'"),
        ({"poses": ((0, math.nan, 0, 0, 0, 0, 1),)}, r"poses\[0\]: y: got nan"),
        (
            {"poses": (POSES[0], (0, 1e200, 0, 0, 0, 0, 1))},
            r"poses\[1\]: got \[0.0, 1e\+200, 0.0\]",
        ),
        ({"poses": (POSES[0], (0,) * 7)}, r"poses\[1\].orientation: got \(0, 0, 0, 0\)"),
    ],
)
def test_a_goal_that_is_wrong_is_refused_with_the_field_its_value_and_what_is_accepted(
    changes, reason
):
    with pytest.raises((ValueError, OSError), match=reason):
        read_goal(replace(GOAL, **changes), FRAMES)


def in_base(frame, poses):
    """Poses (n, 7) of a frame in the base, by rotation matrices."""
    return tuple(
        (
            *(frame.position_m + frame.rotation.as_matrix() @ pose[:3]),
            *(frame.rotation * Rotation.from_quat(pose[3:])).as_quat(),
        )
        for pose in poses
    )


def test_poses_in_a_third_frame_are_the_same_points_wherever_the_frame_stands(scene):
    """The places of POSES in the table, told in the camera's frame and in that of the scene."""
    camera = Pose(np.array([0.2, 0.3, 0.9]), np.array([2.0, -1.0, 0.5]))
    phantom = Pose(np.array([-0.4, 0.1, 0.25]), np.array([0.1, 0.0, 0.3]))
    frames = replace(FRAMES, others={"camera": camera, "phantom": phantom})
    places = in_base(TABLE_IN_BASE, POSES)
    seen = []
    for pose in places:
        back = camera.rotation.inv()
        turn = (back * Rotation.from_quat(pose[3:])).as_quat()
        seen.append((*back.apply(np.array(pose[:3]) - camera.position_m), *turn))
    for named, stands in (("", TABLE_IN_BASE), (scene, phantom)):
        goal = ScanGoal(scene=named, poses=seen, frame_id="camera", force_n=0.012)
        plan, _, _ = read_goal(goal, frames)
        assert plan.scene.frame_id == ("phantom" if named else "table")
        points = [(*p.position_m, *p.orientation_xyzw) for p in plan.points]
        for found, pose in zip(in_base(stands, points), places, strict=True):
            assert found[:3] == pytest.approx(pose[:3], abs=1e-12)
            turned = Rotation.from_quat(found[3:]) * Rotation.from_quat(pose[3:]).inv()
            assert turned.magnitude() < 1e-12


def test_frames_beside_table_and_base_are_to_be_looked_up(scene, tmp_path):
    assert named_frames(GOAL, FRAMES) == ()
    assert named_frames(replace(GOAL, frame_id="base"), FRAMES) == ()
    assert named_frames(replace(GOAL, frame_id="camera"), FRAMES) == ("camera",)
    assert named_frames(ScanGoal(scene=scene, frame_id="camera"), FRAMES) == ("phantom",)
    both = named_frames(replace(GOAL, scene=scene, frame_id="camera"), FRAMES)
    assert set(both) == {"phantom", "camera"}
    (tmp_path / "slope.yaml").write_text(SCENE.replace("phantom", "table"))
    assert named_frames(ScanGoal(scene=scene), replace(FRAMES, table="left/table")) == ()


def test_the_frame_of_a_scene_must_be_known(scene, tmp_path):
    alone = Frames("left/table", "base", TABLE_IN_BASE, no_others="there is no tf2")
    reason = "slope.yaml: frame_id: got 'phantom'; accepted is 'left/table' or 'base' .there is no"
    with pytest.raises(ValueError, match=reason):
        read_goal(ScanGoal(scene=scene), alone)
    # `table` in a scene is the table, whatever it is called here; in a goal frames are those of tf2
    (tmp_path / "slope.yaml").write_text(SCENE.replace("phantom", "table"))
    assert read_goal(ScanGoal(scene=scene), alone)[0].scene.frame_id == "left/table"
    with pytest.raises(ValueError, match="poses.header.frame_id: got 'table'; accepted is 'left"):
        read_goal(GOAL, alone)


def test_a_run_is_resumed_as_it_was_asked_for(tmp_path):
    goal = ScanGoal(run_directory=str(tmp_path), resume=True)
    with pytest.raises(ValueError, match=r"run_directory: got .*; accepted is the folder of a run"):
        resumed_run(goal)
    (tmp_path / "run.json").write_text("{}")
    assert resumed_run(replace(goal, force_n=math.nan)) == tmp_path
    for changes in ({"force_n": 0.02}, {"scene": "x.yaml"}, {"poses": POSES}, {"seed": 2}):
        (name,) = changes
        with pytest.raises(ValueError, match=f"{name}: got .* with resume: it is the run's"):
            resumed_run(replace(goal, **changes))
