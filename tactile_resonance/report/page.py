# SPDX-License-Identifier: Apache-2.0
"""A page in one file that needs nothing else (styles, plotly.js, script, data, sections); its data as JSON.

The page may load nothing: its Content-Security-Policy allows the two scripts that it holds, by their hashes,
and no connection but that of a live page to the server it came from. Texts of runs reach it as JSON, which
the script shows as text, and in sections that are escaped. Of the data, of a run that ended or of one going
on, lengths are in mm, forces in mN, frequencies in Hz, poles in rad/s; numbers that are unknown are null.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy import special

from tactile_resonance._typing import ComplexArray, FloatArray, IntArray
from tactile_resonance.fields import known
from tactile_resonance.poles.result import Poles
from tactile_resonance.recording.messages import array_of, complex_of
from tactile_resonance.scan.level_set import Boundary, Lines
from tactile_resonance.scan.point_result import PointOutcome, PointResult
from tactile_resonance.scan.pole_map import HIGH_RGB, LOW_RGB, MapSurface

if TYPE_CHECKING:
    from tactile_resonance.scan.tissue_tests import TissueTest

MM, MN = 1e3, 1e3
LOW, HIGH = ("#{:02x}{:02x}{:02x}".format(*rgb) for rgb in (LOW_RGB, HIGH_RGB))
"""Colours of the lowest and the highest value, those of rviz and `pole_map.png`."""
_DIGITS = 6  # of arrays; results of points keep all
_MODEL_POINTS = 120
_MOST_MEANS = 160  # of a mechanical test
_ACROSS_HALF_WIDTHS = 6.0  # about a pole, in which half of the model's points lie


def _asset(name: str) -> str:
    return (resources.files(__package__) / "assets" / name).read_text(encoding="utf-8")


@cache
def _scripts() -> tuple[str, str]:
    """Both scripts as elements of HTML, and their hashes as a Content-Security-Policy takes them."""
    try:
        plotly = resources.files("plotly") / "package_data" / "plotly.min.js"
        library = plotly.read_text(encoding="utf-8")
    except (ModuleNotFoundError, FileNotFoundError) as error:
        raise ValueError(
            f"report: plotly.js was not found ({error}); the page needs 'pip install plotly'"
        ) from error
    texts = (library, _asset("page.js"))
    digests = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in texts)
    return (
        "".join(f"<script>{text}</script>" for text in texts),
        " ".join(f"'sha256-{digest}'" for digest in digests),
    )


def content_security_policy(live: bool) -> str:
    """What a page may load: nothing, or, live, events of its own server."""
    return (
        f"default-src 'none'; script-src {_scripts()[1]}; style-src 'unsafe-inline'; img-src data: blob:; "
        f"connect-src {chr(39)}{'self' if live else 'none'}{chr(39)}; base-uri 'none'; form-action 'none'"
    )


def page(
    title: str, head: str, data: Mapping[str, Any], sections: str = "", live: bool = False
) -> str:
    """HTML of a page.

    Parameters
    ----------
    title : str
        Text.
    head, sections : str
        HTML above and below the interactive part; texts of runs in it are escaped.
    data : mapping
        What `page.js` shows.
    live : bool
        Whether it goes on to listen to the server it came from.
    """
    policy = html.escape(content_security_policy(live), quote=True)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{_asset('page.css')}</style>"
        "<noscript><style>.paper { display: block }</style></noscript></head><body>"
        f'{head}<div id="interactive"></div>{sections}'
        f'<script type="application/json" id="data">{as_json({**data, "live": live})}</script>'
        f"{_scripts()[0]}</body></html>\n"
    )


def as_json(value: object) -> str:
    """JSON that may stand within a script element of HTML: ASCII without ``<``, with which its end would begin.

    Raises
    ------
    ValueError
        If a number is not finite: those that are unknown are None.
    """
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def listed(values: npt.ArrayLike, digits: int = _DIGITS) -> list[Any]:
    """Numbers of an array (...) with so many significant digits, None where one is not finite."""
    array = np.asarray(values, float)
    if array.ndim > 1:
        return [listed(row, digits) for row in array]
    return [known(float(f"{x:.{digits}g}")) for x in array.tolist()]


def point_entry(result: PointResult) -> dict[str, Any]:
    """One point, its latest attempt, as the map shows it."""
    pole = pole_entry(result.f0_hz, result.damping_ratio, result.covariance)
    return {
        "index": result.index,
        "attempt": result.attempt,
        "label": result.label,
        "outcome": result.outcome.name.lower(),
        "reason": "; ".join(t for t in (result.reason, result.tissue_reason, result.notes) if t),
        "x_mm": known(MM * result.x_m),
        "y_mm": known(MM * result.y_m),
        "z_mm": known(MM * result.z_m),
        "frame": result.frame_id,
        "force_mn": known(MN * result.force_n),
        "force_std_mn": known(MN * result.force_std_n),
        "force_rms_mn": known(MN * result.force_rms_n),
        "age_s": known(result.contact_age_s),
        **pole,
        "nominal_f0_hz": known(result.nominal_f0_hz),
        "nominal_f0_std_hz": known(result.nominal_f0_std_hz),
        "nominal_damping": known(result.nominal_damping_ratio),
        "nominal_damping_std": known(result.nominal_damping_ratio_std),
        "tissue": result.tissue_class,
        "probability": known(result.tissue_probability),
        "status": result.poles_status,
        "blocks": result.blocks,
        "repeats": result.repeats,
        "simulated": result.simulated,
        "done": result.outcome is PointOutcome.DONE,
    }


def pole_entry(f0_hz: float, damping_ratio: float, covariance: npt.ArrayLike) -> dict[str, Any]:
    """A pole with its standard deviations, and in the s-plane with its covariance there.

    Parameters
    ----------
    covariance : (2, 2) float
        Of f0 [Hz] and damping ratio.
    """
    s = complex(np.nan, np.nan)
    plane = np.full((2, 2), np.nan)
    if math.isfinite(f0_hz) and abs(damping_ratio) < 1:
        s, slope = s_plane(f0_hz, damping_ratio)
        plane = slope @ np.asarray(covariance) @ slope.T
    f0_std, damping_std = np.sqrt(np.diag(covariance))
    return {
        "f0_hz": known(f0_hz),
        "f0_std_hz": known(f0_std),
        "damping": known(damping_ratio),
        "damping_std": known(damping_std),
        "re": known(s.real),
        "im": known(s.imag),
        "plane": [known(plane[0, 0]), known(plane[0, 1]), known(plane[1, 1])],
    }


def s_plane(f0_hz: float, damping_ratio: float) -> tuple[complex, FloatArray]:
    """Pole [rad/s] of a natural frequency and a damping ratio below 1.

    Returns
    -------
    pole : complex
        With positive imaginary part.
    slope : (2, 2) float
        Derivatives of its real and imaginary part by f0 [Hz] and damping ratio.
    """
    w, z = 2 * np.pi * f0_hz, damping_ratio
    root = math.sqrt(1 - z**2)
    slope = np.array([[-2 * np.pi * z, -w], [2 * np.pi * root, -w * z / root]])
    return complex(-z * w, w * root), slope


def poles_entries(poles: Poles) -> list[dict[str, Any]]:
    """Every mode of every band, with status and message of its band."""
    return [
        {
            **pole_entry(f0_hz, damping_ratio, covariance),
            "band_hz": [known(end) for end in band.band_hz],
            "status": band.status.value,
            "message": band.message,
        }
        for band in poles.bands
        for f0_hz, damping_ratio, covariance in zip(
            band.f0_hz, band.damping_ratio, band.best_covariance, strict=True
        )
    ]


def frf_entry(message: Any, poles: Poles | None, most_lines: int) -> dict[str, Any]:
    """FRF of a point with its standard deviation and the model of each band over it.

    Parameters
    ----------
    message : FRF
        Of rosbags or of ROS.
    poles : Poles or None
        Of the same measurement.
    most_lines : int
        Beyond that lines outside of the bands, then within, are left out evenly.
    """
    frequency_hz, g = array_of(message.frequency_hz), complex_of(message, "")
    of = "total" if len(message.variance_total) else "noise"
    variance, dof = array_of(getattr(message, f"variance_{of}")), getattr(message, f"{of}_dof")
    std = np.sqrt(variance) if variance.size else np.full(g.shape, np.nan)
    bands = () if poles is None else poles.bands
    shown = shown_lines(frequency_hz, [band.band_hz for band in bands], most_lines)
    return {
        "frequency_hz": listed(frequency_hz[shown], 9),
        "re": listed(g.real[shown]),
        "im": listed(g.imag[shown]),
        "std": listed(std[shown]),
        "std_of": of,
        "bar_stds": _half_bar(dof),
        "lines": int(frequency_hz.size),
        "models": [entry for band in bands if (entry := _model_entry(frequency_hz, g, std, band))],
    }


def _half_bar(dof: int) -> float:
    """Half of a 95 % bar of ``|G|``, in roots of ``E|dG|^2``, of which half is along G.

    The variance rests on ``dof`` complex residuals (0: unknown), which are twice as many real ones.
    """
    quantile = special.stdtrit(2 * dof, 0.975) if dof else special.ndtri(0.975)
    return float(quantile) / math.sqrt(2)


def shown_lines(
    frequency_hz: FloatArray, bands_hz: Iterable[Sequence[float]], most: int
) -> IntArray:
    """Indices of at most so many of the lines (F,), those of the bands first."""
    inside = np.zeros(frequency_hz.size, bool)
    for low, high in bands_hz:
        inside |= (frequency_hz >= low) & (frequency_hz <= high)
    within, beside = np.flatnonzero(inside), np.flatnonzero(~inside)
    within = within[evenly(within.size, most)]
    beside = beside[evenly(beside.size, most - within.size)]
    return np.sort(np.concatenate([within, beside]))


def evenly(count: int, most: int) -> IntArray:
    """Indices of so many of `count`, evenly over all."""
    return np.unique(np.linspace(0, count - 1, min(count, max(most, 0))).round().astype(int))


def _model_entry(
    frequency_hz: FloatArray, g: ComplexArray, std: FloatArray, poles: Poles
) -> dict[str, Any] | None:
    """Response of the model in a band; None where there are no poles, or nothing to take the rest of it from.

    That are too few lines, and an FRF without a variance: it is of one period, with its transient.
    """
    inside = (frequency_hz >= poles.band_hz[0]) & (frequency_hz <= poles.band_hz[1])
    terms = poles.structure.numerator_order - poles.structure.order + 1
    unknown = not np.any(np.isfinite(std[inside]))
    if not poles.f0_hz.size or unknown or 2 * np.count_nonzero(inside) < terms:
        return None
    low, high = poles.band_hz
    half = _ACROSS_HALF_WIDTHS * poles.damping_ratio * poles.f0_hz
    near = [
        np.linspace(f0 - wide, f0 + wide, _MODEL_POINTS // 2)
        for f0, wide in zip(poles.f0_hz, half, strict=True)
    ]
    fine = np.unique(np.concatenate([np.linspace(low, high, _MODEL_POINTS // 2), *near]))
    fine = fine[(fine >= low) & (fine <= high)]
    response = model_response(frequency_hz[inside], g[inside], std[inside], poles, fine)
    return {
        "frequency_hz": listed(fine),
        "re": listed(response.real),
        "im": listed(response.imag),
        "cost": known(poles.cost),
        "expected_cost": known(poles.expected_cost),
    }


def model_response(
    frequency_hz: FloatArray, g: ComplexArray, std: FloatArray, poles: Poles, at_hz: FloatArray
) -> ComplexArray:
    """(K,) the identified model at frequencies (K,) within the band.

    Its modes are those of the poles, with their residues. Messages do not hold the real polynomial
    ``c_0 + c_1 s + ...`` beside them: it is fitted to the FRF, which is linear in it.

    Parameters
    ----------
    frequency_hz, g, std : (F,)
        Lines of the band with the standard deviation of the response; not finite: all alike.
    at_hz : (K,) float
    """
    terms = poles.structure.numerator_order - poles.structure.order + 1

    def modes(f_hz: FloatArray) -> ComplexArray:
        s = 2j * np.pi * f_hz[:, None]
        p, r = poles.poles_rad_s, poles.residues
        return np.asarray(np.sum(r / (s - p) + r.conj() / (s - p.conj()), axis=1))

    def rest(f_hz: FloatArray) -> FloatArray:
        """(2 K, terms) of powers of j w, 1 at the end of the band: real parts, then imaginary ones."""
        powers = (1j * f_hz[:, None] / poles.band_hz[1]) ** np.arange(terms)
        return np.concatenate([powers.real, powers.imag])

    left = g - modes(frequency_hz)
    weight = 1 / std if np.all(np.isfinite(std) & (std > 0)) else np.ones(g.size)
    twice = np.concatenate([weight, weight])
    if terms <= 0:
        return modes(at_hz)
    design, wanted = rest(frequency_hz) * twice[:, None], np.concatenate([left.real, left.imag])
    coefficients = np.linalg.lstsq(design, wanted * twice, rcond=None)[0]
    real, imaginary = np.split(rest(at_hz) @ coefficients, 2)
    return modes(at_hz) + real + 1j * imaginary


def mechanics_entry(one: TissueTest) -> dict[str, Any]:
    """A mechanical test as `mechanics --json` writes it, with its curve: means of the force, model, depth."""
    entry, fit = one.as_json(), one.fit
    if fit is None:
        return {**entry, "curve": None}
    kept = evenly(fit.time_s.size, _MOST_MEANS)
    curve = {
        "t_s": listed(fit.time_s[kept]),
        "measured_mn": listed(MN * fit.measured_n[kept]),
        "model_mn": listed(MN * fit.force_n[kept]),
        "depth_mm": listed(MM * fit.indentation_m[kept]),
    }
    return {**entry, "curve": curve}


def map_entry(
    surface: MapSurface | None, boundary: Boundary | None = None, true_outline_m: Lines = ()
) -> dict[str, Any]:
    """What lies between the points: kriged natural frequency, and a boundary with its simulated truth."""
    entry: dict[str, Any] = {"surface": None, "boundary": None}
    if surface is not None:
        entry["surface"] = {
            "x_mm": listed(MM * surface.position_m[0, :, 0]),
            "y_mm": listed(MM * surface.position_m[:, 0, 1]),
            "f0_hz": listed(surface.f0_hz),
            "std_hz": listed(surface.f0_std_hz, 3),
        }
    if boundary is not None:
        entry["boundary"] = {
            "outline_mm": _lines(boundary.outline_m),
            "band_mm": _lines((*boundary.inner_m, *boundary.outer_m)),
            "truth_mm": _lines(true_outline_m),
        }
    return entry


def _lines(lines: Lines) -> list[Any]:
    return [listed(MM * line, 5) for line in lines]


def page_data(
    runs: Sequence[dict[str, Any]], figures: Sequence[dict[str, Any]], heading: str
) -> dict[str, Any]:
    """All that `page.js` reads.

    Parameters
    ----------
    runs : sequence of dict
        Of `run_report.run_entry`.
    figures : sequence of dict
        Of `paper_figures`.
    heading : str
        Of the figures.
    """
    detailed = sum(len(run["details"]) for run in runs)
    measured = sum(
        sum(p["done"] for p in run["bands"][0]["points"]) for run in runs if run["bands"]
    )
    lines = [
        f"{len(each['frequency_hz'])} of {each['lines']}"
        for run in runs
        for detail in run["details"].values()
        if (each := detail["frf"]) and len(each["frequency_hz"]) < each["lines"]
    ]
    notes = ["Hover or click a point of a map, or a row of a table."]
    if detailed < measured:
        notes.append(f"FRFs and forces of {detailed} of {measured} points are in this page.")
    tested = sum(run["tested"] for run in runs)
    tests_shown = sum(bool(each["tests"]) for run in runs for each in run["details"].values())
    if tests_shown < tested:
        notes.append(f"Mechanical tests of {tests_shown} of {tested} points are in this page.")
    if lines:
        notes.append(
            f"Of the lines of an FRF those of the bands and some others are shown: {lines[0]}."
        )
    return {
        "runs": list(runs),
        "figures": list(figures),
        "heading": heading,
        "colours": [LOW, HIGH],
        "note": " ".join(notes),
    }
