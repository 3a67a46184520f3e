# SPDX-License-Identifier: Apache-2.0
"""What a goal of the action ``scan`` asks for: scene, points and folders, and why it is refused."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tactile_resonance._typing import FloatArray
from tactile_resonance.configuration import dump_yaml, share_path
from tactile_resonance.contact.samples import Pose
from tactile_resonance.fields import number, read_yaml, require
from tactile_resonance.scan.plan import Plan, make_plan, plan_points
from tactile_resonance.scan.points import require_near, scan_points
from tactile_resonance.scan.scene import ScanScene, parse_notes, parse_scan_scene
from tactile_resonance.scan.surface import with_file_beside
from tactile_resonance.tissue.references import with_library


@dataclass(frozen=True)
class ScanGoal:
    """A goal, as ``action/Scan.action`` gives unit and meaning of each field.

    ``poses``, each of place [m] and quaternion (x, y, z, w), and ``frame_id`` stand for its ``poses``.
    """

    scene: str = ""
    poses: Sequence[Sequence[float]] = ()
    frame_id: str = ""
    force_n: float = 0.0
    f0_std_hz: float = 0.0
    damping_ratio_std: float = 0.0
    run_directory: str = ""
    resume: bool = False
    seed: int = 0
    notes: str = ""


@dataclass(frozen=True)
class Frames:
    """Frames in which poses and scenes may be given, as they stand for one scan.

    Attributes
    ----------
    table : str
        Name of the table: the frame of poses without a scene, and of scenes that name none.
    base : str
        Name of the robot's base.
    table_in_base : Pose
    others : mapping of str to Pose
        Other frames in the base.
    no_others : str
        Why there are no more of them.
    """

    table: str
    base: str
    table_in_base: Pose
    others: Mapping[str, Pose] = field(default_factory=dict)
    no_others: str = ""

    def of_scene(self, frame_id: str) -> str:
        """Name of a scene's frame: `table` there is the table, whatever its name here."""
        return self.table if frame_id == ScanScene.frame_id else frame_id

    def in_base(self, name: str, what: str) -> Pose:
        """Where a frame stands in the base; ``ValueError`` that says of what, where that is not known."""
        known = {
            **self.others,
            self.base: Pose.at_origin(),
            self.table: self.table_in_base,
        }
        reason = f" ({self.no_others})" if self.no_others else ""
        require(name in known, what, name, f"{self.table!r} or {self.base!r}{reason}")
        return known[name]


def named_frames(goal: ScanGoal, frames: Frames) -> tuple[str, ...]:
    """Frames beside table and base in which a goal has its poses or its scene.

    Raises
    ------
    ValueError, OSError
        If its scene cannot be read.
    """
    scene = read_yaml(scene_path(goal.scene)).get("frame_id") if goal.scene else None
    named = (scene and frames.of_scene(str(scene)), goal.frame_id if goal.poses else None)
    return tuple({name for name in named if name and name not in (frames.table, frames.base)})


def read_goal(goal: ScanGoal, frames: Frames) -> tuple[Plan, str, Path | None]:
    """Plan and text of the scene that a goal for a new run asks for, and the file of its surface, if any.

    Plan and text have what the goal gives in place of the scene's. The text expects the file beside it.

    Raises
    ------
    ValueError
        One line that names the field, its value and what is accepted.
    OSError
        If its scene cannot be read.
    """
    path = scene_path(goal.scene) if goal.scene else Path("goal")
    content = read_yaml(path) if goal.scene else _without_file(goal)
    changes = _changes(goal)
    frame_id = frames.of_scene(str(content.get("frame_id", ScanScene.frame_id)))
    place = frames.in_base(frame_id, f"{path.name}: frame_id")
    poses = _poses_in_scene(goal, frame_id, place, frames)
    if len(poses):
        content.pop("surface", None)
        changes["positions"] = {"list": poses[:, :3].tolist()}
    named = isinstance(content.get("tissue_classes"), str)
    content = with_library({**content, **changes}, path)  # a run holds what it was scanned with
    scene = replace(parse_scan_scene(content, path), frame_id=frame_id)
    beside, file = with_file_beside(content.get("surface"), path.parent)
    if file is not None and beside != content["surface"]:
        content["surface"] = changes["surface"] = beside
    text = dump_yaml(content)
    if goal.scene and not (changes or named):
        text = path.read_text(encoding="utf-8")
    if not len(poses):
        return make_plan(scene), text, file
    normals = Rotation.from_quat(poses[:, 3:]).apply([0.0, 0.0, 1.0])  # (n, 3)
    points = scan_points(scene.name, poses[:, :3], normals, poses[:, 3:])
    return plan_points(scene, points), text, file


def resumed_run(goal: ScanGoal) -> Path:
    """Folder of the run that a goal goes on with.

    Raises
    ------
    ValueError
        If there is no run, or the goal asks for something else than the run does.
    """
    path = expanded(goal.run_directory, "run_directory")
    good = bool(goal.run_directory) and (path / "run.json").is_file()
    require(good, "run_directory", goal.run_directory, "the folder of a run, to resume it")
    only = ScanGoal(run_directory=goal.run_directory, resume=True)
    for name, value in asdict(goal).items():
        default = getattr(only, name)
        unset = isinstance(value, float) and math.isnan(value)
        require(value == default or unset, name, value, f"{default!r} with resume: it is the run's")
    return path


def expanded(given: str, name: str) -> Path:
    """Path with ``~`` in place; ``ValueError`` where there is no such home."""
    try:
        return Path(given).expanduser()
    except RuntimeError as error:
        accepted = "a path; there is no such home"
        raise ValueError(f"{name}: got {given!r}; accepted is {accepted}") from error


def scene_path(scene: str) -> Path:
    """Path of a scene file, absolute or in the package's share folder; ``ValueError`` where it is not there."""
    path = expanded(scene, "scene")
    if path.is_absolute():
        return path
    try:
        return share_path(path)
    except (ValueError, FileNotFoundError) as error:
        accepted = "a file of the package, config/scenes/demo.yaml for example, or a whole path"
        raise ValueError(f"scene: got {scene!r}; accepted is {accepted}") from error


def _without_file(goal: ScanGoal) -> dict[str, Any]:
    require(len(goal.poses) > 0, "scene", goal.scene, "a scene file, or poses and force_n")
    wanted = goal.force_n != 0 and not math.isnan(goal.force_n)
    require(wanted, "force_n", goal.force_n, "a number above 0 where no scene has one")
    return {"name": "poses"}


def _changes(goal: ScanGoal) -> dict[str, Any]:
    """Sections of the scene that the goal has others for."""
    given = {}
    for name in ("force_n", "f0_std_hz", "damping_ratio_std"):
        value = getattr(goal, name)
        if value == 0 or math.isnan(value):
            continue
        require(0 < value < math.inf, name, value, "a number above 0 (0 or NaN: the scene's)")
        given[name] = value
    changes: dict[str, Any] = {}
    if "force_n" in given:
        changes["force_n"] = given.pop("force_n")
    if given:
        changes["precision"] = given
    if goal.notes:
        changes["notes"] = parse_notes(goal.notes, "notes").as_json()
    return changes


def _poses_in_scene(goal: ScanGoal, frame_id: str, place: Pose, frames: Frames) -> FloatArray:
    """(n, 7) places [m] and unit quaternions of the goal's poses, in the frame of the scene, of that place."""
    if not goal.poses:
        return np.zeros((0, 7))
    given = frames.in_base(goal.frame_id, "poses.header.frame_id")
    for index, pose in enumerate(goal.poses):
        for value, name in zip(pose, "xyzxyzw", strict=True):
            number(value, f"poses[{index}]: {name}")
        good = 0.99 < math.hypot(*pose[3:]) < 1.01
        require(good, f"poses[{index}].orientation", tuple(pose[3:]), "a unit quaternion")
    poses = np.array(goal.poses, dtype=float)
    if goal.frame_id != frame_id:
        seen = given.seen_from(place)
        places = seen.position_m + seen.rotation.apply(poses[:, :3])
        turns = (seen.rotation * Rotation.from_quat(poses[:, 3:])).as_quat()
        poses = np.concatenate([places, turns], axis=1)
    require_near(poses[:, :3], "poses")
    return poses


class GoalFiles:
    """The folders in which scenes, runs and files of goals may be.

    Parameters
    ----------
    run_folder : str
        Folder of the runs; empty: tactile_resonance/runs in ``$ROS_HOME``, ``~/.ros`` where that is not set.
    goal_folders : sequence of str
        Others, for scenes, runs and files.
    """

    def __init__(self, run_folder: str, goal_folders: Sequence[str]) -> None:
        home = Path(os.environ.get("ROS_HOME") or Path.home() / ".ros")
        runs = Path(run_folder).expanduser() if run_folder else home / "tactile_resonance" / "runs"
        self._runs = runs.absolute()
        self._others = [Path(name).expanduser() for name in goal_folders if name]

    def checked(self, goal: ScanGoal) -> ScanGoal:
        """Return a goal with the whole path of its run; ``ValueError`` where a file is out of the folders."""
        scene, scenes = scene_path(goal.scene), share_path("config")
        # what an installation has linked to elsewhere is the package's all the same
        if goal.scene and not Path(os.path.normpath(scene)).is_relative_to(scenes):
            require_within(scene, "scene", [scenes, *self._others])
        if not goal.run_directory:
            return goal
        path = self.to_write(goal.run_directory, "run_directory")
        return replace(goal, run_directory=str(path))

    def to_write(self, given: str, name: str) -> Path:
        """Path of a file or folder that a goal wants written, relative to the folder of the runs."""
        path = self._runs / expanded(given, name)
        require_within(path, name, [self._runs, *self._others])
        return path

    def unused(self) -> Path:
        """Folder for a run that names none."""
        stamp, number = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime()), 1
        while (path := self._runs / (stamp if number == 1 else f"{stamp}-{number}")).exists():
            number += 1
        return path


def require_within(path: Path, name: str, folders: Sequence[Path]) -> None:
    """Raise ``ValueError`` where a path of a goal leads out of all of some folders, by a link or ``..`` too."""
    real = Path(os.path.realpath(path))
    within = any(real.is_relative_to(os.path.realpath(folder)) for folder in folders)
    listed = " or ".join(map(str, folders))
    require(within, name, str(path), f"a path in {listed} (goal_folders of scan_node adds others)")
