# SPDX-License-Identifier: Apache-2.0
"""What the simulated bench is made of, as figures: sensor on tissues, indentation, scene, creep."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from tactile_resonance._typing import FloatArray
from tactile_resonance.cantilever import mode_shape
from tactile_resonance.report.drawing import SIMULATED, new_figure
from tactile_resonance.simulation.plant.tip import SprungIndenter
from tactile_resonance.simulation.sensor.bench import BenchTip, SimulatedBench
from tactile_resonance.simulation.sensor.bimorph import pole_trajectory, sensor_modes
from tactile_resonance.simulation.sensor.experiments import truth_over
from tactile_resonance.simulation.tissue.indenter import Indenter, indent
from tactile_resonance.simulation.tissue.library import Tissue, TissueLibrary
from tactile_resonance.simulation.tissue.scene import PhantomScene, Sphere


def draw_tissues(bench: SimulatedBench, library: TissueLibrary, names: Sequence[str]) -> Figure:
    """Mode shapes, frequency response in air and on tissues, and the poles of one mode."""
    figure = new_figure(17, 9, f"The bimorph in air and on tissue at 1 cN ({SIMULATED})")
    shapes, whole, zoom, plane = figure.subplots(2, 2).ravel()
    modes = sensor_modes(bench.sensor)
    x = np.linspace(0, 1, 400)
    scale = modes.tip_deflection / mode_shape(modes.eigenvalues, np.ones(1))[:, 0]
    shape = mode_shape(modes.eigenvalues, x) * scale[:, None]
    for n in range(5):
        label = f"mode {n + 1}, {modes.natural_rad_s[n] / (2 * np.pi):.1f} Hz"
        shapes.plot(1e3 * x * bench.sensor.beam.free_length_m, shape[n], label=label)
    shapes.set(
        xlabel="position on the beam [mm]",
        ylabel="mass-normalised [kg^-1/2]",
        title="the first five of ten modes, in air, electrodes short-circuited",
    )
    shapes.legend(fontsize="small")
    wide, near = np.geomspace(10, 10e3, 4000), np.linspace(200, 300, 2000)
    for k, name in enumerate(("air", *names)):
        tissue = None if name == "air" else library[name]
        coupled = bench.coupled(tissue)
        colour, label = f"C{k}", name if tissue is None else tissue.label
        for axes, frequency in ((whole, wide), (zoom, near)):
            level = 20 * np.log10(np.abs(coupled.frequency_response(frequency)))
            axes.plot(frequency, level, color=colour, lw=1, label=label)
        mode = coupled.mode_near(250)
        plane.plot(mode.f0_hz, mode.damping_ratio, "o", color=colour)
        plane.annotate(f" {label}", (mode.f0_hz, mode.damping_ratio), va="center", fontsize="small")
    whole.set_xscale("log")
    whole.set(xlabel="frequency [Hz]", ylabel="|U_sensor / U_actuator| [dB]", title="ten modes")
    whole.legend(fontsize="small")
    zoom.set(xlabel="frequency [Hz]", ylabel="[dB]", title="the mode used")
    plane.set(xlabel="f0 [Hz]", ylabel="damping ratio", title="its pole")
    plane.margins(x=0.25)
    return figure


def draw_indentation(bench: SimulatedBench, library: TissueLibrary, names: Sequence[str]) -> Figure:
    """Force over depth in and out, relaxation of the force, adhesion, and the tip on the beam."""
    figure = new_figure(17, 9, f"A ball of 5 mm pressed into tissue ({SIMULATED})")
    cycle, relaxation, adhesion, sprung = figure.subplots(2, 2).ravel()
    for k, name in enumerate(names):
        tissue, colour = library[name], f"C{k}"
        depth, force = _cycle(bench, tissue, 0.0)
        cycle.plot(1e3 * depth, force / force.max(), color=colour, label=tissue.label)
        time, force = _relaxation(bench, tissue)
        share = 100 * force / force.max()
        relaxation.semilogx(time, share, color=colour, label=tissue.label)
        time, at_base, tip = _approach(bench, tissue)
        sprung.plot(time, 1e3 * at_base, color=colour, label=tissue.label)
        sprung.plot(time, 1e3 * tip, ":", color=colour)
    cycle.set(
        xlabel="depth [mm]",
        ylabel="force / its peak",
        title="0.5 mm in and out at 1 mm/s, twice, rigid tip: the dent is still there",
    )
    relaxation.set(
        xlabel="time after the start of a ramp of 0.2 s [s]",
        ylabel="force / its peak [%]",
        title="held at one depth, rigid tip",
    )
    relaxation.axhline(40, color="grey", lw=0.7, ls=":")
    for work in (0.0, 0.01, 0.03):
        depth, force = _cycle(bench, library["gel10"], work)
        adhesion.plot(1e3 * depth, 1e3 * force, label=f"{1e3 * work:g} mJ/m2")
    adhesion.axhline(0, color="grey", lw=0.7)
    adhesion.set(
        xlabel="depth [mm]",
        ylabel="force [mN]",
        title="work of adhesion (assumed), gelatine 10 %",
        xlim=(-0.03, 0.12),
        ylim=(-0.6, 2.2),
    )
    sprung.set(
        xlabel="time [s]",
        ylabel="force [mN]",
        title="base started and stopped at once, 5 mm/s: at the base (full), on the tip (dotted)",
    )
    for axes in (cycle, relaxation, adhesion, sprung):
        axes.legend(fontsize="small")
    return figure


def _cycle(bench: SimulatedBench, tissue: Tissue, work: float) -> tuple[FloatArray, FloatArray]:
    """Depth and force of going twice 0.5 mm in and 0.2 mm above the surface, at 1 mm/s."""
    turns = np.array([0.0, 5e-4, -2e-4, 5e-4, -2e-4])
    way = np.concatenate([[0.0], np.abs(np.diff(turns)).cumsum()])
    time = np.arange(0, way[-1] / 1e-3, 1e-3)
    depth = np.interp(1e-3 * time, way, turns)
    return depth, indent(_ball(bench, tissue, work), time, depth)[0]


def _relaxation(bench: SimulatedBench, tissue: Tissue) -> tuple[FloatArray, FloatArray]:
    """Time and force of a ramp of 0.2 s and a hold."""
    time = np.concatenate([np.linspace(0, 0.2, 101), np.geomspace(0.201, 180, 300)])
    return time, indent(_ball(bench, tissue), time, 1e-3 * np.minimum(time / 0.2, 1))[0]


def _ball(bench: SimulatedBench, tissue: Tissue, work: float = 0.0) -> Indenter:
    return Indenter(
        tissue,
        tip_radius_m=bench.sensor.tip.radius_m,
        poisson_ratio=bench.contact.poisson_ratio,
        adhesion_j_per_m2=work,
    )


def _approach(bench: SimulatedBench, tissue: Tissue) -> tuple[FloatArray, FloatArray, FloatArray]:
    ball = _ball(bench, tissue)
    tip = SprungIndenter(ball, sensor_modes(bench.sensor).spring)
    time = np.arange(0, 0.6, 1e-3)
    rows = []
    for t in time:
        force = tip.step(-2e-4 + min(5e-3 * t, 1.0e-3), 1e-3)
        rows.append((force, tip.indenter.force_n))
    at_base, at_tip = np.array(rows).T
    return time, at_base, at_tip


def draw_scene(bench: SimulatedBench, scene: PhantomScene, points: np.ndarray) -> Figure:
    """Truth over the surface of a scene with something buried in it, about positions (n, 2) of a scan [m]."""
    low, high = points.min(axis=0), points.max(axis=0)
    x, y = (np.linspace(a, b, 31) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(x, y), axis=-1)  # (31, 31, 2)
    felt = truth_over(bench, scene, grid)

    def over(value: Callable[[Any], float]) -> np.ndarray:
        return np.array([np.nan if at is None else value(at) for at in felt.flat]).reshape(felt.shape)

    figure = new_figure(17, 5.5, f"What the tip feels over the scene '{scene.name}' ({SIMULATED})")
    panels = (
        ("E(1 s) felt [kPa]", over(lambda at: at.contact.tissue.relaxation_modulus_1s_pa / 1e3)),
        ("f0 [Hz]", over(lambda at: at.mode_near(250.0).f0_hz)),
        ("damping ratio", over(lambda at: at.mode_near(250.0).damping_ratio)),
    )
    angle = np.linspace(0, 2 * np.pi, 100)
    for axes, (title, values) in zip(figure.subplots(1, 3), panels, strict=True):
        image = axes.pcolormesh(1e3 * x, 1e3 * y, values, shading="gouraud")
        figure.colorbar(image, ax=axes)
        axes.plot(*(1e3 * points.T), "k.", ms=1)
        for buried in scene.buried:
            if isinstance(buried.shape, Sphere):
                cx, cy = buried.shape.center_m[:2]
                r = buried.shape.radius_m
                axes.plot(1e3 * (cx + r * np.cos(angle)), 1e3 * (cy + r * np.sin(angle)), "w--")
        axes.set(title=title, xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    return figure


def draw_creep(bench: SimulatedBench, library: TissueLibrary, names: Sequence[str]) -> Figure:
    """Force, contact radius and pole while force or depth are held."""
    figure = new_figure(17, 5.5, f"A contact from 1 s on: force held (full), depth held (dotted) ({SIMULATED})")
    force_axes, radius_axes, pole_axes = figure.subplots(1, 3)
    time = np.linspace(1, 10, 40)
    ramp = np.concatenate([np.linspace(0, 0.2, 101)[1:], np.linspace(0.21, 10, 980)])
    for k, name in enumerate(names):
        tissue, colour = library[name], f"C{k}"
        held = [bench.coupled(tissue, hold_time_s=t) for t in time.tolist()]
        assert held[0].contact is not None
        depth_m = held[0].contact.indentation_m
        pressed = indent(_ball(bench, tissue), ramp, depth_m * np.minimum(ramp / 0.2, 1))
        still = [
            BenchTip(tissue, force_n, 1.0, radius_m, depth_m).coupled(bench)
            for force_n, radius_m in zip(*(np.interp(time, ramp, x) for x in pressed), strict=True)
        ]
        for sensors, style in ((held, "-"), (still, ":")):
            contacts: list[Any] = [at.contact for at in sensors]
            f0 = np.abs(pole_trajectory(sensors)) / (2 * np.pi)
            label = tissue.label if style == "-" else None
            force = [1e3 * contact.force_n for contact in contacts]
            radius = [1e3 * contact.contact_radius_m for contact in contacts]
            force_axes.plot(time, force, style, color=colour, label=label)
            radius_axes.plot(time, radius, style, color=colour)
            pole_axes.plot(time, f0 - f0[0], style, color=colour)
    force_axes.set(xlabel="time [s]", ylabel="force [mN]", title="force")
    radius_axes.set(xlabel="time [s]", ylabel="contact radius [mm]", title="contact radius")
    pole_axes.set(xlabel="time [s]", ylabel="change of f0 [Hz]", title="mode used")
    force_axes.legend(fontsize="small")
    return figure
