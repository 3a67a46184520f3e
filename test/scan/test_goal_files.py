# SPDX-License-Identifier: Apache-2.0
"""Goals name files in configured folders only."""

from pathlib import Path

import pytest

from tactile_resonance.scan.goal import GoalFiles, ScanGoal, require_within


def test_a_path_that_leads_out_of_the_folders_is_refused(tmp_path):
    folders = [tmp_path / "runs", tmp_path / "more"]
    for folder in folders:
        folder.mkdir()
    (tmp_path / "runs" / "link").symlink_to(tmp_path)
    (tmp_path / "linked").symlink_to(tmp_path / "more")
    for inside in ("runs/a/b", "more/../runs/c", "linked/d", "runs"):
        require_within(tmp_path / inside, "run_directory", folders)
    for outside in ("runs/../a", "runs/link/a", "runs2", ""):
        with pytest.raises(ValueError, match="^run_directory: got .*; accepted is a path in .*runs or"):
            require_within(tmp_path / outside, "run_directory", folders)
    require_within(tmp_path, "run_directory", [Path("/")])


def test_a_run_that_names_no_folder_gets_one_that_is_not_used(tmp_path, monkeypatch):
    monkeypatch.setenv("ROS_HOME", str(tmp_path))
    files = GoalFiles("", [""])
    first = files.unused()
    assert first.parent == tmp_path / "tactile_resonance" / "runs"
    first.mkdir(parents=True)
    assert files.unused() != first
    assert files.checked(ScanGoal(run_directory="mine")).run_directory == str(first.parent / "mine")


def test_scenes_are_those_of_the_package_and_of_the_folders(tmp_path):
    files = GoalFiles(str(tmp_path / "runs"), [str(tmp_path / "scenes")])
    for scene in ("config/scenes/demo.yaml", str(tmp_path / "scenes" / "a.yaml")):
        assert files.checked(ScanGoal(scene=scene)).scene == scene
    for scene in ("nowhere.yaml", "../setup.py"):
        with pytest.raises(ValueError, match="^scene: got .*; accepted is a file of the package"):
            files.checked(ScanGoal(scene=scene))
    for scene in (str(tmp_path / "runs" / "a.yaml"), "/etc/passwd"):
        with pytest.raises(ValueError, match="got .*; accepted is a path in"):
            files.checked(ScanGoal(scene=scene))


def test_a_home_that_nobody_has_is_refused_by_field(tmp_path):
    files = GoalFiles(str(tmp_path), [""])
    for name in ("scene", "run_directory"):
        with pytest.raises(ValueError, match=f"^{name}: got '~nobody-has-it/a'; accepted is a path"):
            files.checked(ScanGoal(**{name: "~nobody-has-it/a"}))
