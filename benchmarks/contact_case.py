# SPDX-License-Identifier: Apache-2.0
"""One simulated contact: tissue, tip, mount; run with our controller or with a simple law."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tactile_resonance.contact.geometry import touch_pose
from tactile_resonance.contact.goal import Cause, ContactGoal, State
from tactile_resonance.contact.loop import ContactLoop
from tactile_resonance.contact.machine import ContactController
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.payload import Mount
from tactile_resonance.contact.samples import Pose
from tactile_resonance.sensor import read_sensor
from tactile_resonance.simulation.cell.transducer import CellParameters
from tactile_resonance.simulation.plant.contact_bench import ContactBench
from tactile_resonance.simulation.plant.surfaces import PlantSurface
from tactile_resonance.simulation.plant.tip import Ball, Tip
from tactile_resonance.simulation.sensor.bimorph import sensor_modes
from tactile_resonance.simulation.tissue.indenter import Indenter
from tactile_resonance.simulation.tissue.library import Tissue
from tactile_resonance.simulation.ur5e.machine import TrackingParameters

FORCE_N, RELAXATION, STANDOFF_M, TOOL_KG = 0.01, 0.6, 3e-3, 0.03
TOOL = {
    "carried_kg": TOOL_KG,
    "acceleration_m_s2": 0.3,
    "relief_acceleration_m_s2": 0.3,
    "approach_speed_m_s": 3e-3,
}
"""A tool on the cell: its inertia is known, it shakes with the robot, and it is started gently."""

KNOWN = {"unknown_speed_m_s": 5e-3}
"""As where a contact near by has succeeded: the touch is fast."""

DEEPEST_M = 4.5e-3
"""The softest tissue creeps deeper than the default limit allows, and the beam bends."""

MODES = sensor_modes(read_sensor())


@dataclass(frozen=True)
class Setup:
    """What is on the robot, and how it shakes."""

    name: str
    beam: bool = False
    mount: Mount = Mount.TABLE
    jitter_m: float = 3e-6
    noise_n: float = 1e-3


@dataclass(frozen=True)
class Case:
    """One tissue at one place."""

    radius_m: float
    modulus_pa: float
    relaxation_s: float
    height_m: float
    tilt_rad: float
    seed: int

    def tissue(self) -> Tissue:
        """One relaxation time; `modulus_pa` is that of a sudden step, 60 % of it relax."""
        left = 1 - RELAXATION * (1 - np.exp(-1 / self.relaxation_s))
        return Tissue(
            "case",
            self.modulus_pa * left,
            (self.relaxation_s,),
            (RELAXATION / left,),
        )


@dataclass(frozen=True)
class Outcome:
    """What became of it, from the true force along the tip's axis.

    Attributes
    ----------
    ready_s : float
        From the first touch; infinite where never.
    overshoot, mean_error : float
        Share of the force: largest force until 1 s after ready; mean over that second.
    bounces : int
    cause : str
    stated_std, stated_error : float
        Stated standard deviation of the mean force, as a share, and the error of the stated mean in
        such deviations; NaN for simple laws.
    """

    ready_s: float
    overshoot: float
    mean_error: float
    bounces: int
    cause: str
    stated_std: float = np.nan
    stated_error: float = np.nan


class Rig:
    """Bench of one case, and the record of its true force."""

    def __init__(
        self,
        case: Case,
        setup: Setup,
        *,
        surface: PlantSurface | None = None,
        adhesion_j_per_m2: float = 0.0,
        meets: Callable[[Indenter], Ball] | None = None,
        period_s: float = 0.002,
    ) -> None:
        self.touch = touch_pose([0, 0, 0], [0, 0, 1], [1, 0, 0], case.radius_m)
        bench = self.bench = ContactBench(
            case.tissue(),
            surface or PlantSurface.tilted(case.height_m, case.tilt_rad, 2.0 * case.seed),
            Pose(self.touch.position_m + [0, 0, STANDOFF_M], self.touch.rotation_rad),
            tip=Tip(
                case.radius_m,
                MODES if setup.beam else None,
                adhesion_j_per_m2=adhesion_j_per_m2,
                meets=meets,
            ),
            mount=setup.mount,
            tool_kg=TOOL_KG,
            tracking=TrackingParameters(jitter_rms_m=setup.jitter_m),
            cell_parameters=replace(CellParameters.from_yaml(), force_noise_rms_n=setup.noise_n),
            period_s=period_s,
            seed=case.seed,
        )
        self.force_n: list[float] = []
        bench.on_step.append(lambda: self.force_n.append(float(bench.plant.force_n[2])))

    def outcome(
        self, ready_n: int | None, cause: str, stated: tuple[float, float] | None = None
    ) -> Outcome:
        """Judge the record; `ready_n` periods after the start the contact was called ready.

        `stated` is the mean force over the second after that, and its deviation, as reported.
        """
        force, dt = np.array(self.force_n), self.bench.motion.period_s
        touched = int(np.argmax(force > 0)) if (force > 0).any() else 0
        if ready_n is None:
            return Outcome(np.inf, force.max() / FORCE_N - 1, np.nan, 0, cause)
        second = force[ready_n : ready_n + round(1 / dt)]
        mean = float(second.mean())
        std, error = np.nan, np.nan
        if stated is not None:
            std, error = stated[1] / FORCE_N, (stated[0] - mean) / stated[1]
        return Outcome(
            ready_s=(ready_n - touched) * dt,
            overshoot=force[: ready_n + round(1 / dt)].max() / FORCE_N - 1,
            mean_error=abs(mean / FORCE_N - 1),
            bounces=self.bench.plant.touches - 1,
            cause=cause,
            stated_std=std,
            stated_error=error,
        )


def run_controller(
    case: Case,
    setup: Setup,
    parameters: ContactParameters | None = None,
    record: list[float] | None = None,
) -> Outcome:
    """Run our controller, told what is on the robot but nothing of the tissue.

    The true force of each period is appended to `record`.
    """
    rig = Rig(case, setup)
    bench = rig.bench
    if parameters is None:
        noise = max(setup.noise_n, 1e-3)
        parameters = ContactParameters(
            cell_noise_n=1.6 * noise if setup.mount is Mount.TOOL else noise,
            tare_std_n=3e-4 * noise / 1e-3,
            beam_stiffness_n_per_m=MODES.static_stiffness_n_per_m if setup.beam else 0.0,
            **KNOWN,
            **(TOOL if setup.mount is Mount.TOOL else {}),
        )
    limits = Limits(
        depth_m=DEEPEST_M,
        # what trips on single forces is as wide as the noise needs
        pull_force_n=8.0 * max(setup.noise_n, 1e-3),
        force_rate_n_per_s=1.2 * max(setup.noise_n, 1e-3) / 1e-3,
    )
    controller = ContactController(parameters, limits)
    loop = ContactLoop(bench.arm, bench.cell, bench, controller)
    loop.start(ContactGoal(rig.touch, FORCE_N))
    loop.run_while(lambda: controller.result is None)
    ready = len(rig.force_n) if controller.state is State.HOLD else None
    loop.run_while(lambda: controller.state is State.HOLD, 1.0)
    result = controller.result
    assert result is not None
    if record is not None:
        record += rig.force_n
    stated = None
    if ready is not None and result.force_n is not None and result.force_std_n is not None:
        stated = result.force_n, result.force_std_n
    return rig.outcome(ready, result.cause.value, stated)


def stiff_peaks(count: int) -> np.ndarray:
    """Largest true force of contacts on tissue ten times stiffer than the stiffest expected [N], (count,)."""
    peaks = []
    for seed in range(count):
        # the place of the touch between two periods varies
        rig = Rig(Case(2.5e-3, 400e3, 1.0, 1e-3 + 2e-6 * seed, 0.0, seed), Setup("stiff"))
        bench = rig.bench
        controller = ContactController(ContactParameters(**KNOWN), Limits())
        loop = ContactLoop(bench.arm, bench.cell, bench, controller)
        loop.make(ContactGoal(rig.touch, FORCE_N))
        loop.run_while(lambda: True, 0.3)
        peaks.append(max(rig.force_n))
    return np.array(peaks)


def contact_series(count: int) -> np.ndarray:
    """Mean true force over 0.3 s of so many contacts in a row at one place [N], (count,)."""
    rig = Rig(Case(2.5e-3, 10e3, 1.0, 1.5e-3, 0.0, 1), Setup("series"))
    bench = rig.bench
    parameters = ContactParameters(tare_s=0.2, **KNOWN)
    controller = ContactController(parameters, Limits())
    loop = ContactLoop(bench.arm, bench.cell, bench, controller)
    means = []
    for _ in range(count):
        made = loop.make(ContactGoal(rig.touch, FORCE_N))
        if made.cause is Cause.TARE:  # noise passes for a drift of the zero about once in ten thousand tares
            loop.retract()
            made = loop.make(ContactGoal(rig.touch, FORCE_N))
        if not made.reached:
            raise RuntimeError(f"contact {len(means)} failed: {made}")
        rig.force_n.clear()
        loop.run_while(lambda: controller.state is State.HOLD, 0.3)
        means.append(float(np.mean(rig.force_n)))
        loop.retract()
    return np.array(means)
