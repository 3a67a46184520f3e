# SPDX-License-Identifier: Apache-2.0
"""`tactile_resonance analyze`: FRF and poles of a recorded measurement, or contacts through a known sensor."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_resonance._typing import IntArray
from tactile_resonance.analysis import (
    POLES_METHODS,
    Analysis,
    analyse,
    analysis_content,
)
from tactile_resonance.calibration.model import read_calibration
from tactile_resonance.calibration.validity import as_of_today
from tactile_resonance.commands.options import add_band, add_figure, add_option, add_output
from tactile_resonance.contact_analysis import ContactAnalysis, contact_content, estimate_contact
from tactile_resonance.fields import band, require
from tactile_resonance.files import write_whole
from tactile_resonance.frf.spectra import METHODS
from tactile_resonance.front import FIELDS, read_record, read_run
from tactile_resonance.poles.estimator import CANDIDATES
from tactile_resonance.poles.structure import DEFAULT_RESIDUAL_TERMS, ModelStructure
from tactile_resonance.recording.recording import Recording
from tactile_resonance.tones import check_undriven, silent_record

if TYPE_CHECKING:
    from tactile_resonance.scan.run_content import RunContent

MOST_HARMONICS = 10**7


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Options of the command, named inside as the fields of the library that they give."""
    parser = commands.add_parser(
        "analyze",
        help="FRF and poles of a recorded measurement",
        description="Estimate the frequency response of a periodic record and the poles of one band of it.",
    )
    text = ".npz, .mat or .csv file, or a folder: records of the nodes, a scan's run"
    add_option(parser, "record", Path, text)
    for option, field, kind, text in _OF_RECORDS:
        add_option(parser, option, kind, text, dest=field)
    add_band(parser, "of a run that of its scene, else around the strongest resonance")
    add_option(
        parser, "--order N", parse_order,
        "of the denominator, two per mode (default: a run's own, else 2); auto or 0: the data choose one "
        "to three modes and six to ten residual terms, by description length",
    )
    text = "default: six real residual terms beside the modes, order + 5; 2 is the bare second-order model"
    add_option(parser, "--numerator-order", int, text)
    text = "of the model; z for an input held between samples"
    add_option(parser, "--domain", "s", text, choices=("s", "z"))
    add_option(
        parser, "--method", str,
        "poles from all bins together with the transients (joint) or from the FRF (default: "
        "joint, with --channel-delay frf)",
        dest="poles_method", choices=POLES_METHODS, default="auto",
    )
    text = "how transients are dealt with"
    add_option(parser, "--frf", METHODS[0], text, dest="frf_method", choices=METHODS)
    add_option(
        parser, "--channel-delay S", float,
        "of the sensor channel behind the actuator channel, from a loop-back; taken out",
        dest="channel_delay_s", default=0.0,
    )
    text = "even and odd distortion at the lines left out; --plot then draws FILE_distortion too"
    add_option(parser, "--distortion", False, text)
    text = "the record was taken without drive and needs no period: name its tones (hum) and its noise level"
    add_option(parser, "--silent", False, text)
    add_option(
        parser, "--calibration FILE", Path,
        "of `tactile_resonance calibrate`: stiffness of the contact, moduli and pole through this sensor; "
        "of a run without --measurement, of all its points",
    )
    text = "of the contact, with --calibration (default: a run's own; else unknown)"
    add_option(parser, "--force N", float, text, dest="force_n")
    text = "with --calibration: the sensor was at rest at the first sample; one period is then enough"
    add_option(parser, "--from-rest", False, text)
    text = "with --calibration: modulus at the mode over that under the held force (default: 1)"
    add_option(parser, "--relaxed-ratio X", float, text)
    add_output(parser, "--json FILE", "write the result here", ".json")
    add_figure(parser, "--plot", "draw it here")
    option_of = {each.dest: each.option_strings[0] for each in parser._actions if each.option_strings}
    default_of = {name: parser.get_default(name) for name in option_of}
    parser.set_defaults(run=run, option_of=option_of, default_of=default_of)


def parse_order(text: str) -> int:
    """'4' as 4, 'auto' as the 0 of scenes."""
    if text == "auto":
        return 0
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}, expected a whole number or auto") from None


def parse_segments(text: str) -> list[tuple[int, int]]:
    """'0:10,20:30' as [(0, 10), (20, 30)]."""
    try:
        pairs = [part.split(":") for part in text.split(",")]
        return [(int(start), int(stop)) for start, stop in pairs]
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r}, expected START:STOP,START:STOP,... in samples"
        ) from None


def parse_harmonics(text: str) -> IntArray:
    """'3,10:20:5' as [3, 10, 15, 20]."""
    found: set[int] = set()
    try:
        for part in text.split(","):
            first, *rest = (int(number) for number in part.split(":"))
            last, step = (rest + [first, 1][len(rest) :])[:2]
            if len(rest) > 2 or not (1 <= first <= last <= MOST_HARMONICS and step >= 1):
                raise ValueError
            found.update(range(first, last + 1, step))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r}, expected H or FIRST:LAST or FIRST:LAST:STEP, several with commas between, "
            f"1 <= FIRST <= LAST <= {MOST_HARMONICS} and STEP >= 1"
        ) from None
    return np.array(sorted(found), np.int64)


_OF_RECORDS: tuple[tuple[str, str, Callable[[str], Any], str], ...] = (
    ("--measurement ID", "measurement_id", int, "which one of a folder with several"),
    ("--point N", "point", int, "of a run in place of --measurement: its point N, from 1"),
    ("--u FIELD", "u", str, "actuator field (default: u)"),
    ("--y FIELD", "y", str, "sensor field (default: y)"),
    ("--sample-rate HZ", "sample_rate_hz", float, "wins over the file's"),
    ("--samples-per-period N", "samples_per_period", int, "wins over the file's"),
    (
        *("--periods P", "periods", int),
        "use the first P periods; where the period is not known, the record has P of them",
    ),
    (
        *("--segments START:STOP,...", "segments", parse_segments),
        "cut realisations out of a longer recording (samples, stop excluded); each is one period "
        "unless --samples-per-period or --periods says otherwise",
    ),
    (
        *("--harmonics H,FIRST:LAST:STEP,...", "excited_harmonics", parse_harmonics),
        "excited multiples of the sample rate over the samples per period, LAST included; "
        "default: the file's, else found from the spectrum of u",
    ),
)
"""Options that say what is read: each with its field of `read_record`, kind and help."""

_OF_POLES = (
    *("order", "numerator_order", "domain", "poles_method", "frf_method", "channel_delay_s"),
    *("distortion", "plot"),
)
_OF_CONTACTS = ("force_n", "from_rest", "relaxed_ratio")
"""Options, by their fields, that only the analysis of poles, or only that of contacts, knows."""


def run(options: argparse.Namespace) -> int:
    """Read, analyse, then write; a message that begins with a field also names the option for it."""
    try:
        return _run(options)
    except ValueError as error:
        field, colon, rest = str(error).partition(":")
        if not colon or field not in options.option_of:
            raise
        raise ValueError(f"{field} ({options.option_of[field]}):{rest}") from error


def _run(options: argparse.Namespace) -> int:
    """Nothing is written unless all went well."""
    _check_together(options)
    if options.point is not None:
        if options.measurement_id is not None:
            raise ValueError("point: given beside --measurement, expected one of them")
        if not options.record.is_dir():
            raise ValueError(f"point: {options.point}, only for a run; {options.record} is no folder")
        from tactile_resonance.scan.recorded import measurement_at

        options.measurement_id = measurement_at(options.record, options.point)
    if options.calibration is not None:
        return _analyze_contacts(options)
    recording = _recording(options, options.measurement_id)
    rate_hz = recording.sample_rate_hz
    band_hz = None if options.band_hz is None else band(options.band_hz, most_hz=rate_hz / 2)
    if options.silent:
        check_undriven(recording.u, recording.excited_harmonics, rate_hz)
        found = silent_record(recording.u, recording.y, sample_rate_hz=rate_hz, band_hz=band_hz)
        print(found.text())
        return 0
    order, residual_terms = options.order, DEFAULT_RESIDUAL_TERMS
    if (band_hz is None or order is None) and (options.record / "run.json").is_file():
        from tactile_resonance.scan.reidentify import scene_band

        of_scene = scene_band(options.record)
        band_hz = of_scene.ends_hz if band_hz is None else band_hz
        if order is None:
            order, residual_terms = of_scene.order, of_scene.residual_terms
    structures = [ModelStructure.with_residual(2 if order is None else order or 2, residual_terms)]
    if order == 0:
        if options.numerator_order is not None:
            raise ValueError("numerator_order: got a number; with --order auto it is chosen")
        structures = list(CANDIDATES)
    elif options.numerator_order is not None:
        structures = [replace(structures[0], numerator_order=options.numerator_order)]
    if options.domain == "z":
        structures = [replace(s, domain="z", sample_rate_hz=rate_hz) for s in structures]
    analysis = analyse(
        recording,
        band_hz=band_hz,
        structure=structures[0],
        candidates=structures[1:] and structures,
        frf_method=options.frf_method,
        poles_method=options.poles_method,
        with_distortion=options.distortion,
        channel_delay_s=options.channel_delay_s,
    )
    outputs: dict[Path, bytes] = {}
    if options.json:
        outputs[options.json] = _json(analysis_content(analysis))
    if options.plot:
        # drawing libraries take half a second to load: only who wants a figure waits for it
        from tactile_resonance.report.drawing import draw_analysis, draw_distortion, figure_bytes

        figure = draw_analysis(analysis, options.record.name)
        outputs[options.plot] = figure_bytes(figure, options.plot.suffix)
        if analysis.distortion is not None:
            figure = draw_distortion({options.record.name: analysis.distortion}, "Distortion")
            path = options.plot.with_stem(f"{options.plot.stem}_distortion")
            outputs[path] = figure_bytes(figure, path.suffix)
    # all is made before anything is written
    for path, content in outputs.items():
        write_whole(path, content)
    print(as_text(analysis))
    return 0


def _recording(options: argparse.Namespace, measurement_id: int | None) -> Recording:
    fields = {name: getattr(options, name) for name in (*FIELDS, "periods")}
    return read_record(options.record, measurement_id, **fields)


def as_text(analysis: Analysis) -> str:
    """What a person reads first."""
    frf, poles = analysis.frf, analysis.poles
    cost = f"cost {poles.cost:.4g} (expected {poles.expected_cost:.4g})"
    if not np.isfinite(poles.cost):
        cost = "no cost (noise known from the residuals alone)"
    lines = [
        f"FRF: {frf.frequency_hz.size} lines, {frf.frequency_hz[0]:g}-{frf.frequency_hz[-1]:g} Hz, "
        f"{frf.realisations} x {frf.periods} periods, {frf.method}",
        f"fit: {poles.method}, {poles.lines} lines, {poles.band_hz[0]:g}-{poles.band_hz[1]:g} Hz, "
        f"orders {poles.structure.numerator_order}/{poles.structure.order}, {cost}, "
        f"variance {poles.variance_model}",
    ]
    for k, pole in enumerate(poles.poles_rad_s):
        f0_std, damping_std = np.sqrt(np.diag(poles.best_covariance[k]))
        lines.append(
            f"mode: f0 {poles.f0_hz[k]:.4f} +- {_std(f0_std)} Hz, damping ratio "
            f"{poles.damping_ratio[k]:.6f} +- {_std(damping_std)}, poles at "
            f"{pole.real:.3f} + {pole.imag:.3f}j rad/s and its conjugate"
        )
    if analysis.distortion is not None:
        lines.append(f"distortion: {analysis.distortion.summary()}")
    lines.append(f"status: {poles.status.value}")
    lines += [f"note: {warning}" for warning in analysis.warnings]
    return "\n".join(lines)


def _std(value: float) -> str:
    return f"{value:.2g}" if np.isfinite(value) else "unknown"


def _check_together(options: argparse.Namespace) -> None:
    """Refuse options that would be passed over."""
    unused: tuple[str, ...] = _OF_CONTACTS
    accepted = "one beside --calibration"
    if options.calibration is not None:
        unused, accepted = (*_OF_POLES, "silent"), "one without --calibration"
    elif options.silent:
        unused, accepted = (*_OF_POLES, *_OF_CONTACTS, "json"), "one without --silent, which prints"
    for name in unused:
        value = getattr(options, name)
        text = str(value) if isinstance(value, Path) else value
        require(value == options.default_of[name], options.option_of[name], text, accepted)


def _analyze_contacts(options: argparse.Namespace) -> int:
    """Contact of one record, or of each point of a run."""
    sensor = read_calibration(options.calibration)
    run = read_run(options.record) if (options.record / "run.json").is_file() else None
    if run is not None:
        from tactile_resonance.scan.point_outcome import calibration_in_air

        in_air = calibration_in_air(run, sensor.calibration)
        print(f"sensor in air: {in_air.message}")
        sensor = replace(sensor, calibration=as_of_today(sensor.calibration, in_air))
    contents = {}
    for key, label, force_n, force_std_n in _pressed(options, run):
        found = estimate_contact(
            _recording(options, key),
            sensor,
            band_hz=options.band_hz,
            force_n=force_n,
            force_std_n=force_std_n,
            from_rest=options.from_rest,
            relaxed_ratio=1.0 if options.relaxed_ratio is None else options.relaxed_ratio,
        )
        print(contact_as_text(found, label))
        contents[key] = contact_content(found)
    if options.json:
        one = len(contents) == 1
        content = next(iter(contents.values())) if one else contents
        write_whole(options.json, _json(content))
    return 0


def _json(content: dict) -> bytes:
    return json.dumps(content, indent=1, allow_nan=False).encode()


def _pressed(
    options: argparse.Namespace, run: RunContent | None
) -> Iterator[tuple[int | None, str, float, float]]:
    """Measurement, name, force and its deviation [N] of each record: that asked for, or all that count."""
    wanted = options.measurement_id
    given = (float("nan") if options.force_n is None else options.force_n), 0.0
    attempts = () if run is None else run.latest if wanted is None else run.results
    points = [of for of in attempts if of.blocks and wanted in (None, of.measurement_id)]
    for of in points:
        own = options.force_n is None and np.isfinite([of.force_n, of.force_std_n]).all()
        force = (of.force_n, of.force_std_n) if own else given
        yield of.measurement_id, f"point {of.index + 1} {of.label}".strip(), *force
    if not points:  # no run, or a reference of one
        if run is not None and wanted is None:
            raise ValueError(f"{options.record}: no point with a record")
        yield wanted, "", *given


def contact_as_text(analysis: ContactAnalysis, label: str = "") -> str:
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
