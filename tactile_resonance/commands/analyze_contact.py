# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance analyze --calibration`: contacts through a calibrated sensor."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from tactile_resonance.analysis import Analysis
from tactile_resonance.calibration.file import CalibratedSensor, read_calibration
from tactile_resonance.calibration.validity import as_of_today
from tactile_resonance.contact_analysis import (
    ContactAnalysis,
    contact_content,
    estimate_contact,
)
from tactile_resonance.files import write_whole
from tactile_resonance.front import read_run
from tactile_resonance.recording.recording import Recording


def analyze_contacts(
    options: argparse.Namespace,
    read: Callable[[int | None], Recording],
    as_text: Callable[[Analysis], str],
) -> int:
    """Contact of one record, or of each point of a run.

    Parameters
    ----------
    options : Namespace
        Of the command `analyze`.
    read : callable
        Recording of a measurement; of the only one for None.
    as_text : callable
        What a person reads of an analysis without a calibration.
    """
    for name in ("plot", "silent", "distortion"):
        if getattr(options, name):
            raise ValueError(f"--{name}: not with --calibration")
    sensor = read_calibration(options.calibration)
    if (options.record / "run.json").is_file():
        sensor = _as_of_run(options.record, sensor)
    contents = {}
    for key, label, (force_n, force_std_n) in _pressed(options):
        found = estimate_contact(
            read(key),
            sensor,
            band_hz=options.band,
            force_n=force_n if options.force is None else options.force,
            force_std_n=force_std_n if options.force is None else 0.0,
            from_rest=options.from_rest,
            relaxed_ratio=options.relaxed_ratio,
        )
        print(contact_as_text(found, as_text, label))
        contents[key] = contact_content(found)
    if options.json:
        one = len(contents) == 1
        content = next(iter(contents.values())) if one else contents
        write_whole(options.json, json.dumps(content, indent=1, allow_nan=False).encode())
    return 0


def _as_of_run(run: Path, sensor: CalibratedSensor) -> CalibratedSensor:
    """The sensor as the run found it in air, which is printed."""
    content = read_run(run)
    from tactile_resonance.scan.references import calibration_in_air

    found = calibration_in_air(content, sensor.calibration)
    print(f"sensor in air: {found.message}")
    return replace(sensor, calibration=as_of_today(sensor.calibration, found))


def _pressed(
    options: argparse.Namespace,
) -> list[tuple[int | None, str, tuple[float, float]]]:
    """Measurement, name, force and its deviation [N] of each record that is asked for."""
    unknown = (float("nan"), 0.0)
    if not (options.record / "run.json").is_file():
        return [(options.measurement, "", unknown)]
    wanted = options.measurement
    points = [
        (of.measurement_id, f"point {of.index} {of.label}".strip(), (of.force_n, of.force_std_n))
        for of in read_run(options.record).results
        if of.blocks and wanted in (None, of.measurement_id)
    ]
    points = [
        (key, label, force if np.isfinite(force).all() else unknown) for key, label, force in points
    ]
    if not points and wanted is not None:  # a reference
        return [(wanted, "", unknown)]
    if not points:
        raise ValueError(f"{options.record}: no point with a record")
    return [*points]


def contact_as_text(
    analysis: ContactAnalysis, as_text: Callable[[Analysis], str], label: str = ""
) -> str:
    """What a person reads first of a contact."""
    contact, moduli, main = analysis.contact, analysis.moduli, analysis.contact.poles.main
    k, k_std = contact.stiffness_n_per_m, np.sqrt(np.diag(contact.stiffness_total))
    noise = np.sqrt(np.diag(contact.stiffness_covariance))
    head = f"{label}: " if label else ""
    lines = [
        f"{head}contact: k' {k.real:.3f} +- {k_std[0]:.2g} N/m, k'' {k.imag:.3f} +- {k_std[1]:.2g} N/m "
        f"at {main.f0_hz:.2f} Hz (from noise alone +- {noise[0]:.2g}, {noise[1]:.2g})",
        f"mode: f0 {main.f0_hz:.4f} +- {main.std[0]:.2g} Hz, damping ratio {main.damping_ratio:.6f} "
        f"+- {main.std[1]:.2g}; {contact.poles.method}",
    ]
    if np.isfinite(moduli.storage_pa):
        lines.append(
            f"moduli: storage {moduli.storage_pa / 1e3:.4g} +- {moduli.storage_std_pa / 1e3:.2g} kPa, loss "
            f"{moduli.loss_pa / 1e3:.4g} +- {moduli.loss_std_pa / 1e3:.2g} kPa; contact radius "
            f"{1e3 * moduli.contact_radius_m:.3g} mm, {moduli.radius_ratio:.2f} of the ball's"
        )
    if contact.status.value != "ok":
        lines.append(f"status: {contact.status.value}")
    lines += [f"note: {warning}" for warning in analysis.warnings]
    if analysis.black_box is not None:
        lines.append("without the calibration:")
        lines += [f"  {line}" for line in as_text(analysis.black_box).splitlines()]
    return "\n".join(lines)
