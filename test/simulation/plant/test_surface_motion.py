# SPDX-License-Identifier: Apache-2.0
"""Tissue that moves: closed forms of its motion, and the forces that follow."""

import numpy as np
import pytest

from tactile_resonance.configuration import share_path
from tactile_resonance.contact.samples import Pose
from tactile_resonance.contact.vectors import transform_from_pose
from tactile_resonance.simulation.plant.plant import Plant
from tactile_resonance.simulation.plant.surfaces import PlantSurface, SurfaceMotion
from tactile_resonance.simulation.plant.tabletop import move_surface, table_plant
from tactile_resonance.simulation.plant.tip import Tip
from tactile_resonance.simulation.tissue.library import Tissue
from tactile_resonance.simulation.tissue.scene import LaidScene, read_scene

RADIUS_M, NU, MODULUS_PA = 2.5e-3, 0.49, 10e3
BREATH = SurfaceMotion(breath_m=1e-3, breath_hz=0.25)
HEART = SurfaceMotion(heart_m=2e-4, heart_hz=1.2)


def over(motion, function, seconds, count=20_000):
    times = (np.arange(count) + 0.5) * seconds / count
    return np.array([getattr(motion, function)(t) for t in times])


@pytest.mark.parametrize(("power", "mean"), [(1, 1 / 2), (2, 3 / 8), (3, 5 / 16)])
def test_breath_is_the_power_of_a_cosine_quiet_at_end_expiration(power, mean):
    motion = SurfaceMotion(breath_m=1e-3, breath_hz=0.25, breath_power=power)
    rise = over(motion, "displacement_m", 4.0)
    assert rise.min() == pytest.approx(0, abs=1e-9)
    assert rise.max() == pytest.approx(1e-3, rel=1e-6)
    # mean of cos^{2n} over a period: (2n - 1)!! / (2n)!!
    assert rise.mean() == pytest.approx(1e-3 * mean, rel=1e-9)
    # below a tenth for as long as |cos| < 0.1^(1 / 2n)
    low = 1 - 2 / np.pi * np.arccos(0.1 ** (1 / (2 * power)))
    assert np.mean(rise < 1e-4) == pytest.approx(low, abs=2e-4)
    for t in (0.3, 1.7, 3.9):
        assert motion.displacement_m(t + 4.0) == pytest.approx(motion.displacement_m(t), abs=1e-12)


def test_heart_is_a_sinusoid_about_the_breath():
    beat = over(HEART, "displacement_m", 1 / 1.2)
    assert beat.mean() == pytest.approx(0, abs=1e-12)
    assert beat.std() == pytest.approx(1e-4 / np.sqrt(2), rel=1e-9)
    assert np.ptp(beat) == pytest.approx(2e-4, rel=1e-6)
    both = SurfaceMotion(breath_m=1e-3, heart_m=2e-4)
    for t in (0.0, 1.234, 77.7):
        alone = BREATH.displacement_m(t) + HEART.displacement_m(t)
        assert both.displacement_m(t) == pytest.approx(alone, rel=1e-12)


def test_fastest_heartbeat_is_pi_times_peak_to_peak_times_rate():
    count, period_s = 20_000, 1 / 1.2
    speed = np.gradient(over(HEART, "displacement_m", period_s, count), period_s / count)
    assert speed.max() == pytest.approx(np.pi * 2e-4 * 1.2, rel=1e-6)


def test_phases_follow_from_the_seed():
    starts = {SurfaceMotion(breath_m=1e-3, phase_seed=seed).displacement_m(0) for seed in range(9)}
    assert len(starts) == 9
    assert SurfaceMotion(breath_m=1e-3).displacement_m(5.0) == BREATH.displacement_m(5.0)


def test_a_tip_that_stands_is_pressed_as_the_tissue_rises():
    """Hertz at the depth that place and motion make, on a surface that is tilted."""
    tilt, depth_m = 0.2, 3e-4
    surface = PlantSurface.tilted(0.1, tilt)
    tissue = Tissue("elastic", MODULUS_PA, (), ())
    plant = Plant(surface, lambda _: tissue, Tip(RADIUS_M, poisson_ratio=NU))
    plant.motion = motion = SurfaceMotion(breath_m=2e-4, heart_m=1e-4)
    place = surface.point_m + surface.normal * (RADIUS_M - depth_m)
    forces, times = [], []
    for _ in range(2000):
        plant.step(transform_from_pose([*place, 0, 0, 0]), 0.002)
        forces.append(plant.normal_force_n)
        times.append(plant.time_s)
        assert plant.contact_radius_m == pytest.approx(np.sqrt(RADIUS_M * plant.depth_m), rel=1e-3)
    depths = depth_m + np.array([motion.displacement_m(t) for t in times])
    hertz = 4 / 3 * MODULUS_PA / (1 - NU**2) * np.sqrt(RADIUS_M) * depths**1.5
    np.testing.assert_allclose(forces, hertz, rtol=2e-4)
    assert max(forces) > 1.5 * min(forces)
    np.testing.assert_allclose(plant.force_n, plant.normal_force_n * surface.normal, atol=1e-12)


def test_a_scene_and_the_control_port_set_the_motion(library, sensor):
    scene = read_scene(library, share_path("config/scenes/breathing.yaml"))
    laid = LaidScene(scene, Pose.at_origin())
    plant = table_plant(library, sensor, laid.surface(), laid.tissue_at, scene.motion)
    assert plant.motion == SurfaceMotion(breath_m=1e-3, heart_m=1e-4)
    move_surface(plant, {"command": "move_surface", "heart_m": 5e-4})
    assert plant.motion == SurfaceMotion(heart_m=5e-4)
    move_surface(plant, {"command": "move_surface"})
    assert plant.motion is None


def test_wrong_motions_are_refused_by_name():
    for field, value in (
        *(("breath_m", -1e-3), ("breath_m", 0.03), ("breath_hz", 0.0), ("breath_power", 4)),
        *(("heart_m", float("nan")), ("heart_hz", 50.0), ("phase_seed", -1)),
    ):
        with pytest.raises(ValueError, match=f"{field}: got .* accepted is"):
            SurfaceMotion(**{field: value})
