# SPDX-License-Identifier: Apache-2.0
"""A tip that has much to turn is turned away from the surface that it leaves and from that it goes to."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_resonance.contact.geometry import (
    MARGIN_M,
    PASSED_RAD,
    TipGeometry,
    TipPath,
    TurningWay,
    touch_pose,
)
from tactile_resonance.contact.goal import Cause, ContactGoal, State
from tactile_resonance.contact.loop import ContactLoop
from tactile_resonance.contact.machine import ContactController
from tactile_resonance.contact.parameters import Limits, Workspace
from tactile_resonance.contact.samples import ArmSample, Pose
from tactile_resonance.contact.vectors import vector
from tactile_resonance.simulation.plant.contact_bench import ContactBench
from tactile_resonance.simulation.plant.surfaces import PlantSurface
from tactile_resonance.simulation.plant.tip import Tip

sys.path.insert(0, str(Path(__file__).parent))
from contacts import FORCE_N, QUICK, RADIUS_M, SOFT

TIP, LIMITS = TipGeometry(), Limits()
EDGE = np.array([-0.064 * np.cos(0.17), 0.0, 0.064 * np.sin(0.17) - 6e-3])  # of the housing
STILL = (0.0,) * 6


def random_touch(rng, tilt_rad=0.7, heading_rad=np.pi):
    """Somewhere, tilted by up to an angle, the beam in any direction."""
    tilt, azimuth = rng.uniform(0, tilt_rad), rng.uniform(-np.pi, np.pi)
    normal = [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)]
    heading = rng.uniform(-heading_rad, heading_rad)
    place = rng.uniform([-0.02, -0.02, -0.005], [0.02, 0.02, 0.005])
    return touch_pose(place, normal, [np.cos(heading), np.sin(heading), 0.0], RADIUS_M)


def sample(pose):
    return ArmSample(0, 0.0, vector(pose.position_m), vector(pose.rotation_rad), STILL)


def raised(pose, by_m):
    return Pose(pose.position_m + by_m * pose.rotation.as_matrix()[:, 2], pose.rotation_rad)


def heights(touch, places, turns):
    """Of tip and housing above the plane of a touch, seen anew: (n,) each [m]."""
    normal = touch.rotation.as_matrix()[:, 2]
    tip = (places - touch.position_m) @ normal
    return tip, RADIUS_M + tip + turns.apply(EDGE) @ normal


def stops(way):
    """Places (5, 3) and orientations of the way, from where it is known."""
    poses = way.poses
    return np.array([p.position_m for p in poses]), Rotation.concatenate(
        [p.rotation for p in poses]
    )


def turned(first, last, count=400):
    """Orientations between two."""
    whole = (last * first.inv()).as_rotvec()
    return Rotation.from_rotvec(np.linspace(0, 1, count)[:, None] * whole) * first


@pytest.mark.parametrize("pressed", [False, True])
def test_turns_are_just_so_high_that_the_whole_arc_is_clear_of_both_planes(pressed):
    rng = np.random.default_rng(17)
    for _ in range(200):
        old, new = random_touch(rng), random_touch(rng)
        # a tip that was left pressing stands below where the ball touches the surface
        start = raised(old, -LIMITS.depth_m) if pressed else old
        way = TurningWay(TipPath(ContactGoal(new, FORCE_N), TIP), sample(start), QUICK, LIMITS)
        places, turns = stops(way)
        np.testing.assert_allclose(places[1:4] - places[1], 0, atol=1e-15)  # turned in one place
        assert (turns[0].inv() * start.rotation).magnitude() < 1e-9
        assert (turns[4].inv() * new.rotation).magnitude() < 1e-9
        arc = Rotation.concatenate([turned(turns[1], turns[2]), turned(turns[2], turns[3])])
        above = places[4] - raised(new, QUICK.standoff_m).position_m
        # half a turn is clear either way round, and higher than either needs
        half = (turns[3] * turns[2].inv()).magnitude() > np.pi - 2 * PASSED_RAD
        for at, through in ((places[1], arc), (places[4], turns[4])):
            spare = []
            for touch, up in ((start, LIMITS.depth_m), (new, QUICK.early_m)):
                tip, housing = heights(touch, at, through)
                spare.append(np.min(tip) - up - MARGIN_M - LIMITS.near_m)
                spare.append(np.min(housing) - up - MARGIN_M - LIMITS.clearance_m)
            assert min(spare) > -1e-6
            # no higher than needed; the arc as it is sampled may miss its lowest point by a little
            assert half or min(spare) < 1e-5 or (at is places[4] and np.linalg.norm(above) < 1e-9)
        # no steeper than the steeper end
        tilts = [r.as_matrix()[..., 2, 2].min() for r in (arc, turns[1], turns[4])]
        assert tilts[0] > min(tilts[1:]) - 1e-9
        # off the old surface first, neither along it nor turning
        off = places[0] - start.position_m
        np.testing.assert_allclose(
            off, LIMITS.depth_m * start.rotation.as_matrix()[:, 2], atol=1e-9
        )
        # and up it goes all the way over both
        for touch in (old, new):
            assert (places[1] - places[0]) @ touch.rotation.as_matrix()[:, 2] > -1e-9


@pytest.mark.parametrize("short_rad", [0.0, 0.008])
def test_half_a_turn_is_clear_of_both_planes_either_way_round(short_rad):
    rng = np.random.default_rng(18)
    for _ in range(50):
        old, first = random_touch(rng), random_touch(rng)
        swing = np.cross(old.rotation.as_matrix()[:, 2], normal := first.rotation.as_matrix()[:, 2])
        swing *= np.arcsin(np.linalg.norm(swing)) / np.linalg.norm(swing)
        swung = Rotation.from_rotvec(swing) * old.rotation
        half = Rotation.from_rotvec((np.pi - short_rad) * normal)
        new = Pose(first.position_m, (half * swung).as_rotvec())
        way = TurningWay(TipPath(ContactGoal(new, FORCE_N), TIP), sample(old), QUICK, LIMITS)
        angles = np.linspace(0, 2 * np.pi, 400)
        circle = Rotation.from_rotvec(angles[:, None] * normal) * swung
        for touch, up in ((old, LIMITS.depth_m), (new, QUICK.early_m)):
            _, housing = heights(touch, stops(way)[0][2], circle)
            assert np.min(housing) - up - MARGIN_M - LIMITS.clearance_m > -1e-6


class Travel:
    """A bench with nothing to be touched, its controller, and where the tip was in each period."""

    def __init__(self, start, limits=LIMITS, tip=TIP, surface=None):
        surface = PlantSurface.tilted(-0.5) if surface is None else surface
        self.bench = ContactBench(SOFT, surface, start, tip=Tip(RADIUS_M))
        self.controller = ContactController(QUICK, limits, tip)
        rig = self.bench
        self.loop = ContactLoop(rig.arm, rig.cell, rig, self.controller)
        self.poses, self.twists, self.force_n = [], [], []
        rig.on_step.append(self.record)

    def record(self):
        motion = self.bench.motion
        self.poses.append(motion.pose)
        self.twists.append(motion.twist)
        self.force_n.append(self.bench.plant.normal_force_n)

    def go(self, touch):
        self.loop.cycle()
        self.loop.start(ContactGoal(touch, FORCE_N))
        self.loop.run_while(lambda: self.controller.state is State.TRAVEL, 60.0)
        assert self.controller.state is State.TARE, self.controller.result

    @property
    def places(self):
        return np.array([pose.position_m for pose in self.poses])

    @property
    def turns(self):
        return Rotation.from_rotvec([pose.rotation_rad for pose in self.poses])


@pytest.mark.parametrize("seed", range(8))
def test_tip_travels_between_random_orientations_clear_of_both_planes(seed):
    rng = np.random.default_rng(seed)
    old, new = random_touch(rng), random_touch(rng)
    start = raised(old, rng.uniform(-LIMITS.depth_m, QUICK.standoff_m))
    made = Travel(start)
    made.go(new)
    places, turns = made.places, made.turns
    tip_old, housing_old = heights(old, places, turns)
    tip_new, housing_new = heights(new, places, turns)
    off_start = (turns * start.rotation.inv()).magnitude()
    off_goal = (turns * new.rotation.inv()).magnitude()
    rises = off_start < PASSED_RAD / 2
    done = (off_goal < 2 * PASSED_RAD) & ~rises
    turning = ~rises & ~done
    assert turning.sum() > 100
    # not turned yet: never nearer to the old surface than where it began
    begun_tip, begun_housing = heights(old, start.position_m, start.rotation)
    assert tip_old[rises].min() > begun_tip - 1e-4
    assert housing_old[rises].min() > min(begun_housing, LIMITS.clearance_m) - 5e-4
    # turning: clear of both
    assert min(tip_old[turning].min(), tip_new[turning].min()) > LIMITS.near_m
    assert min(housing_old[turning].min(), housing_new[turning].min()) > LIMITS.clearance_m
    # turned: clear of the new one, and aligned where it is near
    assert tip_new[done].min() > QUICK.standoff_m - 1e-4
    assert housing_new[done].min() > LIMITS.clearance_m
    assert off_goal[-1] < 5e-3
    # along: clear of the old one, until it comes down
    along = done & (np.arange(len(places)) < np.flatnonzero(done)[0] + np.argmax(tip_new[done]))
    assert (
        min(tip_old[along].min(initial=1), housing_old[along].min(initial=1)) > LIMITS.clearance_m
    )
    twists = np.array(made.twists)
    assert np.linalg.norm(twists[:, :3], axis=1).max() <= QUICK.travel_speed_m_s * (1 + 1e-6)
    assert np.linalg.norm(twists[:, 3:], axis=1).max() <= LIMITS.angular_speed_rad_s * (1 + 1e-6)


@pytest.mark.parametrize("angle_deg", [5, 25, -25, 40, -40])
@pytest.mark.parametrize("hollow", [False, True])
def test_points_of_a_sphere_follow_each_other(angle_deg, hollow):
    radius, angle = (0.03, np.deg2rad(angle_deg))
    centre = np.array([0, 0, radius if hollow else -radius])
    normal = np.array([np.sin(angle), 0, np.cos(angle)])
    first = touch_pose([0, 0, 0], [0, 0, 1], [1, 0, 0], RADIUS_M)
    second = touch_pose(
        centre + (-radius if hollow else radius) * normal, normal, [1, 0, 0], RADIUS_M
    )
    curved = PlantSurface(np.zeros(3), np.array([0, 0, 1.0]), (-1 if hollow else 1) / radius)
    made = Travel(raised(first, 2.5e-3), surface=curved)
    for touch in (first, second, first):
        result = made.loop.make(ContactGoal(touch, FORCE_N))
        assert result.reached, result.message
        assert made.loop.retract().retracted
    touched = np.array(made.force_n) > 0
    assert (np.diff(touched.astype(int)) == 1).sum() == 3  # three contacts, nothing between them


LEVEL = touch_pose([0, 0, 0], [0, 0, 1], [1, 0, 0], RADIUS_M)
TURNED_DOWN = [(0.0, -0.35, 0.0), (0.25, -0.2, 0.6)]


def start_and_top(turn_rad):
    """A tip that stands turned above a level surface, and the height that it has to rise to."""
    start = Pose(LEVEL.position_m + [0, 0, 0.012], np.array(turn_rad))
    way = TurningWay(TipPath(ContactGoal(LEVEL, FORCE_N), TIP), sample(start), QUICK, LIMITS)
    return start, max(stops(way)[0][:, 2])


@pytest.mark.parametrize("turn_rad", TURNED_DOWN)
def test_turn_that_has_no_room_in_the_workspace_is_refused_with_its_figures(turn_rad):
    start, top = start_and_top(turn_rad)
    for room_m, refused in ((-1e-4, True), (1e-3, False)):
        box = Workspace(LIMITS.workspace.low_m, (1.0, 1.0, top + room_m))
        made = Travel(start, replace(LIMITS, workspace=box))
        if not refused:
            made.go(LEVEL)
            continue
        made.loop.cycle()
        with pytest.raises(
            ValueError, match=r"to turn by 0\.\d+ rad .* has to rise by .* mm .* outside"
        ) as told:
            made.loop.start(ContactGoal(LEVEL, FORCE_N))
        assert f"{top:.3f} m" in str(told.value)
        assert made.controller.state is State.IDLE


@pytest.mark.parametrize("turn_rad", TURNED_DOWN)
def test_goal_begun_before_the_arm_was_seen_ends_before_it_turns(turn_rad):
    start, top = start_and_top(turn_rad)
    box = Workspace(LIMITS.workspace.low_m, (1.0, 1.0, top - 1e-3))
    made = Travel(start, replace(LIMITS, workspace=box))
    result = made.loop.make(ContactGoal(LEVEL, FORCE_N))
    assert result.cause is Cause.HOUSING
    assert "outside of the workspace" in result.message
    made.loop.run_while(lambda: made.controller.state is not State.IDLE, 3.0)
    assert made.controller.state is State.IDLE
    assert np.abs(np.array(made.twists)[:, 3:]).max() < 1e-6


def test_contact_given_up_while_it_leaves_a_surface_is_drawn_off_that_surface():
    rng = np.random.default_rng(3)
    old, new = random_touch(rng), random_touch(rng)
    made = Travel(raised(old, -1e-3))
    made.loop.cycle()
    made.loop.start(ContactGoal(new, FORCE_N))
    made.loop.run_while(lambda: True, 0.05)
    made.loop.retract()
    assert made.controller.state is State.IDLE
    tip, _ = heights(old, made.places[-1], made.turns[-1])
    assert tip > QUICK.standoff_m - 1.2e-3
    assert (made.turns[-1] * old.rotation.inv()).magnitude() < 1e-3
    np.testing.assert_allclose(
        made.places[-1] - made.places[0],
        old.rotation.as_matrix()[:, 2] * (tip + 1e-3),
        atol=1e-4,
    )
