# SPDX-License-Identifier: Apache-2.0
"""Figures 5, 6, 8 and 9 of arXiv 1805.00682 from the estimates of a run, as traces of plotly.

What a run cannot give is left out, and its note says why. Nothing here is taken from the truth of a simulation.
"""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import FloatArray
from tactile_resonance.frf.distortion import DetectionLines, decibel, estimate_distortion
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.poles.result import ellipse
from tactile_resonance.recording.messages import array_of, complex_of
from tactile_resonance.recording.recording import Recording
from tactile_resonance.recording.store import recording_of
from tactile_resonance.report.drawing import PROBABILITY
from tactile_resonance.report.page import evenly, listed, s_plane
from tactile_resonance.report.point_details import FRF_TYPE, PointDetails
from tactile_resonance.scan.point_file import read_messages
from tactile_resonance.scan.point_outcome import BEFORE, read_reference
from tactile_resonance.scan.point_result import PointResult
from tactile_resonance.scan.recorded import measurements_of_file
from tactile_resonance.scan.run_content import RunContent, file_of

Figure = dict[str, Any]
Trace = dict[str, Any]  # of plotly
_COLOURS = ("#1f77b4", "#d95f02", "#1b9e77", "#7b3fa0", "#b8860b", "#c2185b", "#555555")
_PARITIES = {"even": "#1f77b4", "odd": "#d62728"}
_FREQUENCY, _DECADE = "frequency [Hz]", 10
_MOST_CASES = 5  # classes of tissue of which an FRF is drawn
_MOST_LINES = 800  # of a trace
_MOST_ELLIPSES = 300
_LEAST_OF_A_CLASS = 4  # points for the scatter of a class


def paper_figures(run: RunContent, details: Mapping[int, PointDetails]) -> list[Figure]:
    """All four, each with a title, a note for people, and traces and layout of plotly; no traces: left out.

    Parameters
    ----------
    run : RunContent
    details : mapping of int to PointDetails
        By point; figures of FRFs are of these points.
    """
    classes = _by_class([r for r in run.latest if not r.failed])
    return [
        _responses(run, classes, details),
        *_distortion(run, details),
        _poles(run, classes),
        _variance(classes, details),
    ]


def _figure(
    title: str, note: str, traces: Sequence[Trace] = (), x: str = "", y: str = ""
) -> Figure:
    layout: dict[str, Any] = {
        name: {
            "title": {"text": text},
            "gridcolor": "#e8e8e8",
            "zeroline": False,
            "automargin": True,
        }
        for name, text in (("xaxis", x), ("yaxis", y))
    }
    if x == _FREQUENCY and max(t["x"][-1] for t in traces) > _DECADE * min(
        t["x"][0] for t in traces
    ):
        layout["xaxis"]["type"] = "log"
    layout["legend"] = {"orientation": "v", "font": {"size": 10}}
    return {"title": title, "note": note, "traces": list(traces), "layout": layout}


def _trace(
    name: str, x: npt.ArrayLike, y: npt.ArrayLike, colour: str, symbol: str = "circle", **more: Any
) -> Trace:
    """Dots; names come from the scene, and plotly reads tags."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    shown = evenly(x.size, _MOST_LINES)
    x, y = x[shown], y[shown]
    trace = {"type": "scatter", "mode": "markers", "name": html.escape(name, quote=False)}
    marker = {"color": colour, "size": 4, "symbol": symbol}
    return {**trace, "marker": marker, "x": listed(x, 8), "y": listed(y), **more}


def _by_class(results: Sequence[PointResult]) -> dict[str, list[PointResult]]:
    """Points with a pole by the tissue that was called, most points first; one class where none was."""
    classes: dict[str, list[PointResult]] = {}
    for result in results:
        classes.setdefault(result.tissue_class or "points", []).append(result)
    return dict(sorted(classes.items(), key=lambda item: -len(item[1])))


def _responses(
    run: RunContent,
    classes: Mapping[str, Sequence[PointResult]],
    details: Mapping[int, PointDetails],
) -> Figure:
    """Figure 5: response and levels of noise and, over realisations, of all that scatters."""
    title = "FRF with its noise, by tissue (figure 5)"
    cases: dict[str, Any] = {}
    for path in run.paths(FRF_TYPE, reference=BEFORE)[:1]:
        for _, _, message in read_messages(path, FRF_TYPE):
            if len(message.frequency_hz):  # else it failed
                cases["free air"] = message
    for name, results in list(classes.items())[:_MOST_CASES]:
        frfs = [(r, details[r.index].frf) for r in results if r.index in details]
        there = ((r, frf) for r, frf in frfs if frf is not None and len(frf.frequency_hz))
        first = next(there, None)
        if first is not None:
            cases[f"{name}, point {first[0].index + 1}"] = first[1]
    traces, several = [], False
    for (name, frf), colour in zip(cases.items(), _COLOURS, strict=False):
        frequency_hz, group = array_of(frf.frequency_hz), {"legendgroup": name}
        traces.append(
            _trace(name, frequency_hz, decibel(np.abs(complex_of(frf, "")) ** 2), colour, **group)
        )
        for of, symbol in (("noise", "circle-open"), ("total", "x-thin-open")):
            variance = array_of(getattr(frf, f"variance_{of}"))
            if variance.size:
                several |= of == "total"
                level = decibel(variance)
                traces.append(_trace(f"{of}, {name}", frequency_hz, level, colour, symbol, **group))
    if not traces:
        return _figure(title, "Left out: the recording holds no FRF of a point of this page.")
    note = "|G| of one point of each tissue; open circles: standard deviation of the estimate from noise"
    note += ", crosses: noise and distortion." if several else "; one realisation each."
    return _figure(title, note, traces, _FREQUENCY, "|G|, standard deviation [dB]")


def _distortion(run: RunContent, details: Mapping[int, PointDetails]) -> list[Figure]:
    """Figures 5 and 6: even and odd distortion at the lines left out, at one point and over all."""
    title = "Nonlinear distortion (figures 5 and 6)"
    told = [r for r in run.latest if r.distortion]
    if not told:
        why = "distortion is not among the outputs of the scene, so that no lines were left out for it"
        return [_figure(title, f"Left out: {why}.")]
    figures = []
    chosen = next((r for r in told if r.index in details), told[0])
    try:
        measurements = measurements_of_file(file_of(run.path, chosen))
        stored = next((m for m in measurements if m.measurement_id == chosen.measurement_id), None)
        if stored is not None and stored.records:
            figures.append(_output(recording_of(stored), f"point {chosen.index + 1}"))
    except ValueError as error:  # blocks that are missing, or a file of an earlier version
        figures.append(_figure("Output and its distortion (figure 5)", f"Left out: {error}."))
    points, traces = [r.index + 1 for r in told], []
    first = [r.distortion[0] for r in told]
    for name, colour in _PARITIES.items():
        level, noise = ([getattr(d, f"{name}_{of}db") for d in first] for of in ("", "noise_"))
        traces.append(_trace(f"{name} lines", points, level, colour))
        traces.append(_trace(f"noise at {name} lines", points, noise, colour, "circle-open"))
    above = ", ".join(f"{n} {sum(getattr(d, f'{n}_above_noise') for d in first)}" for n in _PARITIES)
    note = "Against the linear output in the first band, at the one level of the drive of a run. "
    note += f"Points with more than noise, of {len(first)}: {above}."
    if unknown := sum(np.isnan([d.even_noise_db, d.odd_noise_db]).all() for d in first):
        note += f" Noise is unknown at {unknown}."
    figures.append(_figure("Levels of distortion (figure 6)", note, traces, "point", "[dB]"))
    return figures


def _output(recording: Recording, name: str) -> Figure:
    """Output at the lines that are excited and at those left out."""
    assert recording.excited_harmonics is not None  # the store's recordings know them
    found = estimate_distortion(
        Spectrum.of(recording.u, recording.y),
        sample_rate_hz=recording.sample_rate_hz,
        harmonics=recording.excited_harmonics,
    )
    linear = decibel(np.mean(np.abs(found.output) ** 2, axis=-2))
    traces = [_trace("linear output", found.frequency_hz, linear, "black")]
    for parity, colour in _PARITIES.items():
        lines: DetectionLines = getattr(found, parity)
        if lines.harmonics.size:
            at_hz = lines.frequency_hz
            traces.append(_trace(f"{parity} lines", at_hz, decibel(lines.power), colour))
            if not np.all(np.isnan(noise := lines.noise_power)):
                of_noise = f"noise at {parity} lines"
                traces.append(_trace(of_noise, at_hz, decibel(noise), colour, "circle-open"))
    title, note = f"Output and its distortion, {name} (figure 5)", found.summary()
    return _figure(title, note, traces, _FREQUENCY, "output per line [dB, 1 V]")


def _poles(run: RunContent, classes: Mapping[str, Sequence[PointResult]]) -> Figure:
    """Figure 8: poles of the tissues in the s-plane."""
    title = "Poles of the tissues in the s-plane (figure 8)"
    traces: list[Trace] = []
    air = read_reference(run, BEFORE)
    if air is not None:
        traces += _plane("free air", [air.estimate], [air.covariance], "black")
    many = sum(map(len, classes.values())) > _MOST_ELLIPSES
    for k, (name, results) in enumerate(classes.items()):
        colour = _COLOURS[k % len(_COLOURS)]
        estimates = [r.estimate for r in results]
        traces += _plane(name, estimates, [] if many else [r.covariance for r in results], colour)
        if len(results) >= _LEAST_OF_A_CLASS:
            middle, spread = np.mean(estimates, axis=0), np.cov(np.transpose(estimates))
            traces += _loops(
                f"{name}, scatter of its points", [middle], [spread], colour, dash="dot"
            )
    if not traces:
        return _figure(title, "Left out: no point has a pole.")
    note = f"Measured poles with {100 * PROBABILITY:g} % ellipses; dotted: scatter over a class."
    if many:
        note += f" Ellipses of more than {_MOST_ELLIPSES} points are left out."
    return _figure(title, note, traces, "real part [rad/s]", "imaginary part [rad/s]")


def _plane(
    name: str, estimates: Sequence[FloatArray], covariances: Sequence[FloatArray], colour: str
) -> list[Trace]:
    poles = np.array([s_plane(*estimate)[0] for estimate in estimates])
    dots = _trace(name, poles.real, poles.imag, colour)
    return [dots, *_loops(name, estimates, covariances, colour, showlegend=False)]


def _loops(
    name: str,
    estimates: Sequence[FloatArray],
    covariances: Sequence[FloatArray],
    colour: str,
    dash: str = "solid",
    **more: Any,
) -> list[Trace]:
    """Ellipses of (f0, damping ratio) in the s-plane, as one trace."""
    loops = []
    for estimate, covariance in zip(estimates, covariances, strict=False):
        if not np.all(np.isfinite(covariance)):
            continue
        pole, slope = s_plane(*estimate)
        loop = ellipse(slope @ covariance @ slope.T, 37, PROBABILITY)
        loops += [loop + [[pole.real], [pole.imag]], np.full((2, 1), np.nan)]
    if not loops:
        return []
    x, y = np.concatenate(loops, axis=1)
    line = {"color": colour, "width": 1.2, "dash": dash}
    trace = {
        "type": "scatter",
        "mode": "lines",
        "name": html.escape(name, quote=False),
        "line": line,
    }
    return [{**trace, "x": listed(x), "y": listed(y), "hoverinfo": "skip", **more}]


def _variance(
    classes: Mapping[str, Sequence[PointResult]], details: Mapping[int, PointDetails]
) -> Figure:
    """Figure 9: variance of the FRF over periods, realisations and the positions of one tissue."""
    title = "Variance of the FRF by source (figure 9)"
    for name, results in classes.items():
        frfs = [details[r.index].frf for r in results if r.index in details]
        frfs = [f for f in frfs if f is not None and len(f.frequency_hz)]
        if len(frfs) < 2:
            continue
        # grids may leave out others at each point; lines are at multiples of one spacing
        at = [np.round(array_of(f.frequency_hz), 6) for f in frfs]
        frequency_hz = reduce(np.intersect1d, at)
        common = [np.isin(each, frequency_hz) for each in at]
        if not frequency_hz.size:
            continue
        g = np.array([complex_of(f, "")[c] for f, c in zip(frfs, common, strict=True)])  # (n, F)
        mean = g.mean(axis=0)
        traces = [
            _trace(f"mean of {len(frfs)} points", frequency_hz, decibel(np.abs(mean) ** 2), "black")
        ]
        missing = []
        scatter = np.var(g, axis=0, ddof=1)  # |.|^2 of complex deviations
        sources = {f"positions ({len(frfs)})": scatter}
        for source, field, count in (
            ("realisations", "variance_total", "realisations"),
            ("periods", "variance_noise", "periods"),
        ):
            # of one period or realisation: that of the mean estimate times how many are behind it
            known = [
                (f.periods if count == "periods" else 1) * f.realisations * array_of(v)[c]
                for f, c in zip(frfs, common, strict=True)
                if len(v := getattr(f, field))
            ]
            if known:
                counts = ", ".join(map(str, sorted({getattr(f, count) for f in frfs})))
                sources[f"{source} ({counts})"] = np.mean(known, axis=0)
            else:
                missing.append(f"{source}: one at each point")
        power = np.mean(np.abs(mean) ** 2)
        levels = []
        for (source, variance), colour in zip(sources.items(), _COLOURS, strict=False):
            traces.append(_trace(source, frequency_hz, decibel(variance), colour))
            levels.append(f"{source} {float(decibel(np.mean(variance) / power)):.1f} dB")
        missing.append("preparations: a run does not say which points share one")
        note = (
            f"{name}; against the rms of the mean over the lines: {', '.join(levels)}. That of positions holds "
            f"the noise of each point. Left out: {'; '.join(missing)}."
        )
        return _figure(title, note, traces, _FREQUENCY, "|G|^2, variance [dB]")
    return _figure(
        title, "Left out: no tissue has two points with FRFs at the same lines in this page."
    )
