# SPDX-License-Identifier: Apache-2.0
"""From a goal to a run that is open: what is refused or touched first, and what the run says of itself."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from tactile_resonance.configuration import PACKAGE_NAME, package_version
from tactile_resonance.contact.samples import Pose
from tactile_resonance.fields import require
from tactile_resonance.scan.clearance import Standoffs, TipUse, clear_points
from tactile_resonance.scan.failures import PointFailed, ScanEnded
from tactile_resonance.scan.goal import Frames, GoalFiles, ScanGoal, read_goal, resumed_run
from tactile_resonance.scan.hands import Check, Hands, Phase, Progress, Touch
from tactile_resonance.scan.measurement import Skipped
from tactile_resonance.scan.plan import Plan, make_plan, plan_points
from tactile_resonance.scan.points import ScanPoint
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.run_directory import RunDirectory, ended_by_storage, expected_bytes
from tactile_resonance.scan.scene import ScanScene, read_run_scene
from tactile_resonance.scan.surface import Plane, TouchRequest
from tactile_resonance.scan.surface_search import find_normals, find_surface
from tactile_resonance.sensor import sensor_named

_LIBRARIES = ("numpy", "scipy", "rosbags", "ur-rtde", "python-can")
UNCHECKED = Skipped(
    "the check that the housing is clear of the surface",
    "how the sensor is used is not known: it is kept clear of a plane only",
)
StartedRun = tuple[Plan, RunDirectory, int]
"""A run that is open: its plan, folder and seed."""


def new_run(
    goal: ScanGoal, frames: Frames, files: GoalFiles, *, forces: bool
) -> tuple[Plan, str, Path | None, Path, int]:
    """What a goal asks for, with nothing moved or written yet: `read_goal`, the run's folder and its bytes.

    Parameters
    ----------
    goal : ScanGoal
        Its files checked.
    frames : Frames
    files : GoalFiles
    forces : bool
        Whether forces are measured.

    Raises
    ------
    ValueError, OSError
        If it is wrong, or the run cannot begin in its folder.
    """
    plan, text, beside = read_goal(goal, frames)
    _require_force(plan.scene, forces)
    path = Path(goal.run_directory) if goal.run_directory else files.unused()
    needed = expected_bytes(plan.most_points, plan.measurement)
    RunDirectory.check_new(path, needed)
    return plan, text, beside, path, needed


def start_run(
    goal: ScanGoal,
    frames: Frames,
    files: GoalFiles,
    hands: Hands,
    *,
    seed: int,
    tip_use: Callable[[str], TipUse | None] | None,
    tell: Callable[[Progress], None],
    check: Check,
) -> StartedRun:
    """Begin the run of a goal, or open the one that it goes on with.

    Parameters
    ----------
    goal, frames, files
        As `new_run`.
    hands : Hands
        Touches surface and normals where the scene asks for it; knows the scene's frame from now on.
    seed : int
        Of a goal that names none.
    tip_use : callable or None
        See `prepare`.
    tell, check : callable
        Receives each touch; raises `Interrupted` where the goal is cancelled.

    Raises
    ------
    ValueError, OSError
        If it is refused.
    """
    if goal.resume:
        return _resumed(resumed_run(goal), frames, hands)
    wanted, text, beside, path, needed = new_run(goal, frames, files, forces=hands.free_air)
    scene = _placed(wanted.scene, frames, hands)
    _require_tests(scene, hands)
    radius_m = sensor_named(scene.sensor.name).tip.radius_m

    def find(point: ScanPoint, force_n: float, count: int) -> Touch:
        tell(Progress(point, Phase.SURFACE, point.index, count))
        return hands.find(point, force_n, radius_m, check)

    plan, found = prepare(wanted, radius_m, find, tip_use)
    seed = goal.seed or seed
    facts = {
        **run_facts(plan, seed),
        "name": scene.name,
        "notes": scene.notes.as_json(),
        "scan_node": {
            "contact": _contact_of(hands),
            "table_in_base": frames.table_in_base.vector.tolist(),
            "base_frame": frames.base,
        },
        "frames": {name: pose.vector.tolist() for name, pose in frames.others.items()},
        **found,
    }
    places = plan.points if scene.adaptive else ()
    run = RunDirectory.create(path, text, plan.first_points, facts, needed, places, beside)
    return plan, run, seed


def prepare(
    plan: Plan,
    ball_radius_m: float,
    find: Callable[[ScanPoint, float, int], Touch],
    tip_use: Callable[[str], TipUse | None] | None,
) -> tuple[Plan, dict[str, Any]]:
    """Touch what the scene asks for, and leave out what is not clear, before and after normals are known.

    Parameters
    ----------
    plan : Plan
        As it was compiled: before anything was touched.
    ball_radius_m : float
    find : callable
        Touches a point with a force, one of so many.
    tip_use : callable or None
        How the sensor of a name is used; it returns None where that is not to be had. None: nothing is moved.

    Returns
    -------
    plan : Plan
        To go by.
    facts : dict
        What the run keeps of surface and normals that were found.

    Raises
    ------
    ValueError
        Where a surface is not found, touches cannot be made, or no point is left.
    """
    scene = plan.scene
    facts: dict[str, Any] = {}
    heading_rad, surface = scene.sensor.heading_rad, scene.surface
    if isinstance(surface, TouchRequest):
        force_n, count = surface.force_n or scene.force_n, len(surface.points_m)
        try:
            found, touches = find_surface(
                surface, ball_radius_m, heading_rad, lambda point: find(point, force_n, count)
            )
        except (ValueError, PointFailed, ScanEnded) as error:
            raise ValueError(f"surface.touch: {error}") from error
        facts["surface"], surface = found.as_json(touches), found
        plan = make_plan(scene, surface)
    use: TipUse | None = None
    # of a plane contact control keeps the sensor clear itself
    if tip_use is not None and not isinstance(surface, Plane):
        use = tip_use(scene.sensor.name)
        if use is None:
            plan = replace(plan, left_out=(UNCHECKED, *plan.left_out))

    def clear(plan: Plan) -> Plan:
        return plan if use is None else plan.with_points(*clear_points(plan.points, surface, use))

    plan = clear(plan)
    asked = scene.normals
    if asked is None:
        return plan, facts
    force_n, count = asked.force_n or scene.force_n, len(plan.points)
    try:
        points, normals, left = find_normals(
            plan.points,
            asked,
            ball_radius_m,
            heading_rad,
            lambda point: find(point, force_n, count),
        )
    except (PointFailed, ScanEnded) as error:
        raise ValueError(f"normals: {error}") from error
    facts["normals"] = normals
    return clear(plan.with_points(points, left)), facts


def _resumed(path: Path, frames: Frames, hands: Hands) -> StartedRun:
    try:
        run = RunDirectory.open(path)
    except OSError as error:  # the disk is still full
        text = ended_by_storage(path, error, len(read_run(path).latest))
        raise ValueError(f"run: {text}") from error
    try:
        facts = run.content.facts
        # where the table is known better now, that is another place
        noted, table = facts.get("scan_node", {}), frames.table_in_base.vector.tolist()
        began = noted.get("table_in_base")
        accepted = f"{began}, with which the run began, to resume it"
        require(began in (None, table), "table_in_base", table, accepted)
        # without contact the tip is taken to be where nothing may have brought it
        contact, began = _contact_of(hands), noted.get("contact")
        accepted = f"{began}, with which the run began, to resume it"
        require(began in (None, contact), "contact", contact, accepted)
        scene = read_run_scene(run.path / "scene.yaml")
        scene = replace(scene, name=facts.get("name", scene.name))  # else of the file as it was
        _require_force(scene, hands.free_air)
        _require_tests(scene, hands)
        # of an earlier version every scene's frame was the table
        stood = facts.get("frames", {scene.frame_id: frames.table_in_base.vector})
        others = {name: Pose.from_vector(vector) for name, vector in stood.items()}
        scene = _placed(scene, replace(frames, others=others), hands)
        points = run.content.places or run.content.points
        return plan_points(scene, points), run, int(facts["seed"])
    except BaseException:
        run.close()
        raise


def _contact_of(hands: Hands) -> str:
    """Value of scan_node's parameter ``contact``."""
    return "robot" if hands.free_air else "none"


def _placed(scene: ScanScene, frames: Frames, hands: Hands) -> ScanScene:
    """Tell the hands of the scene's frame and surface, and return the scene with that frame's name."""
    frame_id = frames.of_scene(scene.frame_id)
    hands.frame_in_base = frames.in_base(frame_id, "frame_id")
    hands.standoffs = Standoffs(scene.surface)
    return replace(scene, frame_id=frame_id)


def _require_force(scene: ScanScene, forces: bool) -> None:
    """A gate judges a force that is measured; so does a mechanical test."""
    accepted = "none where scan_node's parameter contact is none: no force is measured then"
    require(scene.gate is None or forces, "gate", scene.gate, accepted)
    asked = [str(each) for each in scene.protocols]
    require(not asked or forces, "protocols", asked, accepted)


def _require_tests(scene: ScanScene, hands: Hands) -> None:
    asked = [str(each) for each in scene.protocols]
    accepted = "none where no node offers the action indent: ideal contact does not"
    require(not asked or hands.offers_tests(), "protocols", asked, accepted)


def run_facts(plan: Plan, seed: int) -> dict[str, Any]:
    """Facts of a run that begins now with excitations of a seed, as JSON holds them."""
    design = plan.measurement
    return {
        "begun": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "seed": seed,
        "versions": _versions(),
        "shortest_s": plan.shortest_s,
        "longest_s": plan.longest_s,
        "measurement": {
            "grid": design.grid.value,
            "stretches_hz": design.stretches_hz,
            "bands": [asdict(band) for band in design.bands],
            "sample_rate_hz": design.sample_rate_hz,
            "samples_per_period": design.samples,
            "level_v": design.level_v,
            "sweep": design.sweep,
            "most_periods": design.periods,
        },
        "skipped": [asdict(skipped) for skipped in plan.skipped],
    }


def _versions() -> dict[str, str]:
    """Of this package, Python and the libraries that results depend on; those absent are left out."""
    found = {PACKAGE_NAME: package_version(), "python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
