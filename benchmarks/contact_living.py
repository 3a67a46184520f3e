# SPDX-License-Identifier: Apache-2.0
"""Contacts on what lives: tissue that moves, bone below it, what clings; zeros that creep, other forces.

Each case is drawn from the ranges of its row by its own seed. Everything is simulated, in virtual time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.contact_case import FORCE_N, KNOWN, MODES, Case, Rig, Setup
from benchmarks.contact_laws import LIVING_LAWS, steps_of
from tactile_resonance.contact.goal import ContactGoal, State
from tactile_resonance.contact.loop import ContactLoop
from tactile_resonance.contact.machine import ContactController
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.simulation.plant.surfaces import PlantSurface, SurfaceMotion
from tactile_resonance.simulation.plant.tip import Ball, OnSoft, bone, clinging
from tactile_resonance.simulation.tissue.indenter import Indenter

HOLD_S, SETTLED_S, SOFT_PA = 4.0, 0.5, 3e3
"""Held for so long; drawn back within 10 s and this; modulus of the layer on bone."""

Draw = np.random.Generator


@dataclass(frozen=True)
class Row:
    """Cases of one kind.

    Attributes
    ----------
    name : str
    beam : bool
        The sensor's beam, or the ball held rigidly.
    motion : callable or None
        From a generator to how the tissue moves.
    meets : callable or None
        From a generator and the ball's radius to what the ball meets beside tissue.
    adhesion_j_per_m2 : tuple of 2 floats
        Range of the work of adhesion.
    creep_n_per_s : tuple of floats
        Rates at which the zero may creep, from the touch on.
    force_n : float
    period_s : float
        Of robot, cell and loop.
    curvature_m : float
        Radius of the surface; negative: hollow; 0: flat.
    known : bool
        Whether a contact near by has succeeded: else a touch without a beam is slow.
    hold_s : float
    """

    name: str
    beam: bool = False
    motion: Callable[[Draw], SurfaceMotion] | None = None
    meets: Callable[[Draw, float], Callable[[Indenter], Ball]] | None = None
    adhesion_j_per_m2: tuple[float, float] = (0.0, 0.0)
    creep_n_per_s: tuple[float, ...] = ()
    force_n: float = FORCE_N
    period_s: float = 0.002
    curvature_m: float = 0.0
    known: bool = True
    hold_s: float = HOLD_S
    parameters: dict[str, float] = field(default_factory=dict)
    limits: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Moving:
    """Heart of an amplitude at 1 to 2 Hz, breath peak to peak at .2 to .3 Hz [m]."""

    heart_m: float = 0.0
    breath_m: float = 0.0

    def __call__(self, rng: Draw) -> SurfaceMotion:
        return SurfaceMotion(
            breath_m=self.breath_m,
            breath_hz=rng.uniform(0.2, 0.3),
            heart_m=2 * self.heart_m,
            heart_hz=rng.uniform(1.0, 2.0),
            phase_seed=int(rng.integers(1 << 30)),
        )


@dataclass(frozen=True)
class Bone:
    """10 MPa under a layer whose thickness is uniform up to `layer_m`."""

    layer_m: float

    def __call__(self, rng: Draw, radius_m: float) -> Callable[[Indenter], Ball]:
        layer_m = rng.uniform(0.0, self.layer_m)
        return lambda soft: OnSoft(soft, bone(layer_m, radius_m))


class Film:
    """Pulls with .3 to 1 N s/m and tears .5 to 2 mm above the surface."""

    def __call__(self, rng: Draw, radius_m: float) -> Callable[[Indenter], Ball]:
        damping, tears_m = rng.uniform(0.3, 1.0), rng.uniform(5e-4, 2e-3)

        def pull(height_m: float, up_m_s: float) -> float | None:
            return None if height_m > tears_m else damping * max(0.0, up_m_s)

        return lambda soft: OnSoft(soft, clinging(pull))


class Hook:
    """Pulls with 5 to 40 N/m and does not tear."""

    def __call__(self, rng: Draw, radius_m: float) -> Callable[[Indenter], Ball]:
        stiffness = rng.uniform(5.0, 40.0)
        hook = clinging(lambda height_m, _: stiffness * height_m)
        return lambda soft: OnSoft(soft, hook)


MOTIONS = {
    "heart .05 mm": Moving(0.05e-3),
    "heart .2 mm": Moving(0.2e-3),
    "heart .5 mm": Moving(0.5e-3),
    "breath 1 mm": Moving(breath_m=1e-3),
    "breath 2 mm": Moving(breath_m=2e-3),
    "breath 3 mm": Moving(breath_m=3e-3),
    "heart .1 and breath 1 mm": Moving(0.1e-3, 1e-3),
}

WIDE = {"standoff_m": 4e-3, "early_m": 3e-3, "search_m": 3e-3}
"""Where the surface is known to move by 3 mm."""

MOTION_ROWS = tuple(
    Row(f"{name}, {'beam' if beam else 'rigid'}", beam, motion, parameters=WIDE)
    for beam in (False, True)
    for name, motion in MOTIONS.items()
)

BONE_ROWS = tuple(
    Row(
        f"{name}, {'beam' if beam else 'rigid'}", beam, meets=Bone(layer_m), known=False, hold_s=1.0
    )
    for beam in (False, True)
    for name, layer_m in (("bare", 0.0), ("under 0 to 1 mm of 3 kPa", 1e-3))
)

CLINGING_ROWS = (
    Row("adhesion .02 to .5 J/m2, rigid", adhesion_j_per_m2=(0.02, 0.5), hold_s=1.0),
    Row("adhesion .02 to .5 J/m2, beam", True, adhesion_j_per_m2=(0.02, 0.5), hold_s=1.0),
    Row("film, rigid", meets=Film(), hold_s=1.0),
    Row("film, beam", True, meets=Film(), hold_s=1.0),
    Row("hook, rigid", meets=Hook(), hold_s=1.0),
    Row("hook, beam", True, meets=Hook(), hold_s=1.0),
)

OTHER_ROWS = (
    Row("still, rigid"),
    Row("still, beam", True),
    *(
        Row(f"zero creeps by {1e3 * rate:g} mN/s", creep_n_per_s=(-rate, rate))
        for rate in (0.25e-3, 0.75e-3, 2.5e-3)
    ),
    Row(
        "robot and cell at 125 Hz, beam",
        True,
        period_s=0.008,
        parameters={"period_s": 0.008, "tare_s": 0.8, "tare_std_n": 4e-4},
        limits={"force_age_s": 0.04, "arm_age_s": 0.08},
    ),
    *(
        Row(
            f"{100 * force_n:g} cN",
            force_n=force_n,
            parameters={"cell_noise_n": 1e-3},
            limits={
                "abort_force_n": max(0.03, 2 * force_n),
                "hard_force_n": max(0.05, 3 * force_n),
                "depth_m": 8e-3,
            },
        )
        for force_n in (2e-3, 5e-3, 20e-3, 50e-3)
    ),
    Row("ball of 10 mm", curvature_m=0.01),
    Row("hollow of 10 mm", curvature_m=-0.01),
)


@dataclass(frozen=True)
class Held:
    """What became of one case; NaN where it was not reached.

    Attributes
    ----------
    ready, held : bool
        Whether the force was reached, and kept for the whole time.
    ready_s : float
        From the first touch.
    rms : float
        Of the true force about the aim while held, as a share of it.
    peak_n, pull_n : float
        Largest true force, and largest pull, from the touch until 0.5 s after the end.
    stated_error : float
        Of the stated mean force, in its deviations.
    cause : str
        Of the end.
    needed_n : float
        Pull that adhesion itself needs.
    """

    ready: bool
    held: bool
    ready_s: float
    rms: float
    peak_n: float
    pull_n: float
    stated_error: float
    cause: str
    needed_n: float = np.nan


def drawn(row: Row, seed: int) -> tuple[Rig, float]:
    """Bench of a row's case, and the pull that adhesion itself needs [N]."""
    rng = np.random.default_rng([seed, 17])
    radius_m = rng.uniform(1.5e-3, 3e-3)
    modulus_pa = float(np.exp(rng.uniform(np.log(3e3), np.log(30e3))))
    if isinstance(row.meets, Bone):
        modulus_pa = SOFT_PA
    motion = None if row.motion is None else row.motion(rng)
    height_m = rng.uniform(-5e-4, 5e-4) - (0.0 if motion is None else motion.breath_m / 2)
    case = Case(radius_m, modulus_pa, rng.uniform(0.5, 3.0), height_m, 0.0, seed)
    work = rng.uniform(*row.adhesion_j_per_m2)
    surface = None
    if row.curvature_m:
        # its top, or bottom, at the height of the case and up to 1 mm beside the place asked for
        place = np.array([*rng.uniform(-1e-3, 1e-3, 2), case.height_m])
        surface = PlantSurface(place, np.array([0.0, 0.0, 1.0]), 1 / row.curvature_m)
    rig = Rig(
        case,
        Setup(row.name, beam=row.beam),
        surface=surface,
        adhesion_j_per_m2=work,
        meets=None if row.meets is None else row.meets(rng, radius_m),
        period_s=row.period_s,
    )
    rig.bench.plant.motion = motion
    if row.creep_n_per_s:
        rate, faults, began = rng.choice(row.creep_n_per_s), rig.bench.cell.faults, []

        def creep() -> None:
            if rig.bench.plant.in_contact or began:
                began.append(1)
                # under the sample a press is a negative force
                faults.bias_step_n = -rate * row.period_s * len(began)

        rig.bench.on_step.append(creep)
    # Johnson, Kendall & Roberts (1971)
    return rig, 1.5 * np.pi * work * radius_m


def run_case(job: tuple[Row, int, str]) -> Held:
    """Run one case of a row with our controller, or with a simple law by its name."""
    row, seed, law = job
    rig, needed_n = drawn(row, seed)
    held = _simple(row, rig, law) if law else _ours(row, rig)
    return replace(held, needed_n=needed_n)


def _ours(row: Row, rig: Rig) -> Held:
    bench = rig.bench
    parameters = ContactParameters(
        beam_stiffness_n_per_m=MODES.static_stiffness_n_per_m if row.beam else 0.0,
        **(KNOWN if row.known else {}) | row.parameters,
    )
    limits = replace(Limits(depth_m=4.5e-3, approach_s=30.0), **row.limits)
    controller = ContactController(parameters, limits)
    loop = ContactLoop(bench.arm, bench.cell, bench, controller)
    loop.start(ContactGoal(rig.touch, row.force_n))
    loop.run_while(lambda: controller.result is None)
    at, ready = len(rig.force_n), controller.state is State.HOLD
    loop.run_while(lambda: controller.state is State.HOLD, row.hold_s)
    end, held = len(rig.force_n), controller.state is State.HOLD
    controller.retract()
    loop.run_while(lambda: controller.state is not State.IDLE and not controller.settled, 10.0)
    loop.run_while(lambda: True, SETTLED_S)
    result = controller.result
    assert result is not None
    error = np.nan
    if ready and end > at and result.force_n is not None and result.force_std_n is not None:
        error = (result.force_n - np.mean(rig.force_n[at:end])) / result.force_std_n
    return _held(row, rig, at if ready else None, end, held, result.cause.value, error)


def _simple(row: Row, rig: Rig, law: str) -> Held:
    ready: int | None = None
    for now_ready in steps_of(rig, LIVING_LAWS[law](), row.force_n):
        if ready is None and now_ready:
            ready = len(rig.force_n)
        if ready is not None and len(rig.force_n) >= ready + round(row.hold_s / row.period_s):
            break
    end = len(rig.force_n)
    force = np.array(rig.force_n)
    # out of contact for as long as our controller calls it lost, or beyond the hard limit
    lost = ready is not None and _longest_run(force[ready:] <= 0) * row.period_s > 0.05
    held = ready is not None and not lost and bool(force.max() < Limits().hard_force_n)
    return _held(row, rig, ready, end, held, "none" if held else "lost")


def _longest_run(where: np.ndarray) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], where.astype(int), [0]])))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


def _held(
    row: Row,
    rig: Rig,
    ready: int | None,
    end: int,
    held: bool,
    cause: str,
    error: float = np.nan,
) -> Held:
    force = np.array(rig.force_n)
    touched = int(np.argmax(force > 0)) if (force > 0).any() else 0
    rms = np.nan
    if ready is not None and end > ready:
        rms = float(np.sqrt(np.mean((force[ready:end] / row.force_n - 1) ** 2)))
    return Held(
        ready=ready is not None,
        held=held,
        ready_s=np.inf if ready is None else (ready - touched) * row.period_s,
        rms=rms,
        peak_n=float(force.max()),
        pull_n=float(-force.min()),
        stated_error=float(error),
        cause=cause,
    )
