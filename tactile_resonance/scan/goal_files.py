# SPDX-License-Identifier: Apache-2.0
"""Which files a goal may name: whoever is in the graph may send goals."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from tactile_resonance.configuration import share_path
from tactile_resonance.fields import require
from tactile_resonance.scan.goal import ScanGoal, expanded, scene_path


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
