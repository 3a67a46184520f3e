# SPDX-License-Identifier: Apache-2.0
"""A whole recording to FRF and poles, through the functions the nodes use, and the content of its JSON."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import band, known, number, require, require_kind
from tactile_resonance.frf.distortion import Distortion, estimate_distortion
from tactile_resonance.frf.estimate import frf_of_record, with_narrow_modes_judged
from tactile_resonance.frf.excited import find_excited_harmonics
from tactile_resonance.frf.faults import FaultReport, find_faults
from tactile_resonance.frf.result import FRF, band_bins
from tactile_resonance.frf.skew import correct_skew, suspected_skew
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.poles.estimator import POLES_METHODS, choose_among, poles_of_frf
from tactile_resonance.poles.result import Poles, PolesStatus
from tactile_resonance.poles.structure import ModelStructure, checked_structure
from tactile_resonance.recording.recording import Recording


@dataclass(frozen=True)
class Analysis:
    """FRF and poles of a recording.

    Attributes
    ----------
    frf : FRF
        At all excited lines.
    poles : Poles
    distortion : Distortion or None
        Where it was asked for.
    faults : FaultReport
        Of the record.
    warnings : tuple of str
        What a reader should know before relying on the figures.
    timing_s : dict
        Seconds per stage.
    """

    frf: FRF
    poles: Poles
    distortion: Distortion | None
    faults: FaultReport
    warnings: tuple[str, ...]
    timing_s: dict[str, float]


def analyse(
    recording: Recording,
    *,
    band_hz: tuple[float, float] | None = None,
    structure: ModelStructure | None = None,
    candidates: Sequence[ModelStructure] = (),
    frf_method: str = "local polynomial",
    poles_method: str = "auto",
    with_distortion: bool = False,
    channel_delay_s: float = 0.0,
) -> Analysis:
    """FRF at all excited lines, poles in a band.

    Parameters
    ----------
    recording : Recording
    band_hz : (low, high), optional
        Around the strongest resonance when absent, with a warning that says which.
    structure : ModelStructure, optional
    candidates : sequence of ModelStructure, optional
        Of which the data choose one in place of `structure`, by minimum description length.
    frf_method : str
        See `frf.estimate.frf_of_record`.
    poles_method : {"auto", "joint", "frf"}
        Poles from all bins of the band together with the transients (`poles.joint`, of
        several realisations `PoleEstimator` there), or from the FRF. ``auto`` takes the
        first unless there is a channel delay to be taken out.
    with_distortion : bool
        Estimate even and odd distortion too; needs an odd or odd random grid.
    channel_delay_s : float
        Delay of the sensor channel behind the actuator channel, from a loop-back
        (`frf.skew.skew_from_loopback`); taken out of the FRF. Where it is 0, a skew is only suspected.

    Raises
    ------
    ValueError
        If an argument is not accepted, the band holds too few lines for the model, or the method does
        not fit the record.

    Examples
    --------
    Two periods of a resonance at 250 Hz, damping ratio 2 %, and the lines between that an odd grid leaves out:

    >>> import numpy as np
    >>> multisine = tr.design_multisine(
    ...     sample_rate_hz=5e3, samples_per_period=4000, band_hz=(200.0, 300.0), grid=tr.Grid.ODD
    ... )
    >>> u = np.tile(multisine.period(), (2, 1))
    >>> s, w0 = 2j * np.pi * np.fft.rfftfreq(4000, 1 / 5e3), 2 * np.pi * 250
    >>> y = np.fft.irfft(0.04 * w0**2 / (s**2 + 0.04 * w0 * s + w0**2) * np.fft.rfft(u))
    >>> y += 1e-3 * np.random.default_rng(0).standard_normal(y.shape)
    >>> recording = tr.make_recording(u, y, sample_rate_hz=5e3)
    >>> analysis = tr.analyse(recording, band_hz=(200, 300), with_distortion=True)
    >>> analysis.poles.status.value, analysis.frf.g.shape
    ('ok', (40,))
    >>> bool(analysis.distortion.even.rms_level_db < -40)
    True
    """
    require_kind(recording, "recording", Recording)
    structure = checked_structure(structure)
    require_kind(candidates, "candidates", Sequence)
    for candidate in candidates:
        require_kind(candidate, "candidates", ModelStructure)
    channel_delay_s = number(channel_delay_s, "channel_delay_s")
    most_s = recording.u.shape[-1] / recording.sample_rate_hz / 2
    accepted = f"up to half a period, {most_s:g} s, either way"
    require(abs(channel_delay_s) <= most_s, "channel_delay_s", channel_delay_s, accepted)
    if band_hz is not None:
        band_hz = band(band_hz, most_hz=recording.sample_rate_hz / 2)
    accepted = f"one of {', '.join(POLES_METHODS)}"
    require(poles_method in POLES_METHODS, "poles_method", poles_method, accepted)
    recording.require_driven()
    if poles_method == "joint" and channel_delay_s:
        raise ValueError("poles_method: joint takes no channel delay, use frf")
    warnings = list(recording.notes)
    if recording.copied:
        warnings.append(
            "y: all periods are copies of the first, without noise between them: deviations say nothing"
        )
    record = Spectrum.of(recording.u, recording.y)
    rate_hz, harmonics = recording.sample_rate_hz, recording.excited_harmonics
    start = time.perf_counter()
    if harmonics is None:
        harmonics = find_excited_harmonics(record)
        warnings.append(f"excited lines found from the input spectrum: {harmonics.size}")
    found = time.perf_counter()
    frf = frf_of_record(record, harmonics, sample_rate_hz=rate_hz, method=frf_method)
    faults = find_faults(record, sample_rate_hz=rate_hz, harmonics=harmonics)
    estimated = time.perf_counter()
    if channel_delay_s:
        frf = correct_skew(frf, channel_delay_s)
    else:
        suspicion = suspected_skew(frf)
        if suspicion is not None:
            warnings.append(f"frf: {suspicion.message}")
    if band_hz is None:
        band_hz = _strongest_resonance_band(frf)
        warnings.append(
            f"band: chosen around the strongest resonance, {band_hz[0]:g}-{band_hz[1]:g} Hz"
        )
    bins = None
    if poles_method != "frf" and not channel_delay_s:
        bins = band_bins(record, harmonics, sample_rate_hz=rate_hz, band_hz=band_hz)
    # faults of the FRF are reported once, below
    silent = replace(faults.marked(frf), message="", bins=bins)
    method = "auto" if bins is None else poles_method

    def fit(structure: ModelStructure) -> Poles:
        return poles_of_frf(silent, band_hz, structure, method)

    poles = choose_among(fit, candidates) if candidates else fit(structure)
    identified = time.perf_counter()
    distortion = None
    if with_distortion:
        distortion = estimate_distortion(
            record, sample_rate_hz=rate_hz, harmonics=harmonics, method=frf_method
        )
    if poles.status is PolesStatus.TOO_FEW_LINES:
        first_hz, last_hz = frf.frequency_hz[[0, -1]]
        excited = f"excited are lines from {first_hz:g} to {last_hz:g} Hz"
        raise ValueError(f"band_hz: {poles.message}; {excited}")
    frf = with_narrow_modes_judged(faults.marked(frf))
    warnings += [
        f"{name}: {of.message}" for name, of in (("frf", frf), ("poles", poles)) if of.message
    ]
    return Analysis(
        frf,
        poles,
        distortion,
        faults,
        tuple(warnings),
        {
            "excited_lines": found - start,
            "frf": estimated - found,
            "poles": identified - estimated,
        },
    )


def analysis_content(analysis: Analysis) -> dict[str, Any]:
    """Plain values of an analysis, as docs/analysis.md describes its JSON; NaN becomes null."""
    frf, poles = analysis.frf, analysis.poles
    return {
        "frf": {
            "frequency_hz": frf.frequency_hz.tolist(),
            "real": [known(value) for value in frf.g.real],
            "imag": [known(value) for value in frf.g.imag],
            "variance": None if frf.variance is None else [known(value) for value in frf.variance],
        },
        "poles": [
            {
                "real_rad_s": float(pole.real),
                "imag_rad_s": float(pole.imag),
                "f0_hz": float(poles.f0_hz[k]),
                "damping_ratio": float(poles.damping_ratio[k]),
                "covariance": _entry(poles.covariance, k),
                "total_covariance": _entry(poles.total_covariance, k),
                "f0_drift_hz_per_s": _entry(poles.f0_drift_hz_per_s, k),
                "damping_drift_per_s": _entry(poles.damping_drift_per_s, k),
                "drift_covariance": _entry(poles.drift_covariance, k),
            }
            for k, pole in enumerate(poles.poles_rad_s)
        ],
        "instant_s": poles.instant_s,
        "band_hz": list(poles.band_hz),
        "lines": poles.lines,
        "order": poles.structure.order,
        "numerator_order": poles.structure.numerator_order,
        "cost": known(poles.cost),
        "expected_cost": known(poles.expected_cost),
        "condition_number": known(poles.condition_number),
        "method": poles.method,
        "variance_model": poles.variance_model,
        "distortion": _distortion(analysis.distortion),
        "status": poles.status.value,
        "warnings": list(analysis.warnings),
        "timing_s": analysis.timing_s,
    }


def _distortion(distortion: Distortion | None) -> dict | None:
    """Levels against the linear output around, of all realisations together; null where unknown."""
    if distortion is None:
        return None
    return {
        name: {
            "frequency_hz": lines.frequency_hz.tolist(),
            "level_db": [known(level) for level in lines.level_db],
            "rms_level_db": known(float(lines.rms_level_db)),
            "rms_output_level_db": known(float(lines.rms_output_level_db)),
            "rms_input_level_db": known(float(lines.rms_input_level_db)),
            "rms_noise_level_db": known(float(lines.rms_noise_level_db)),
        }
        for name, lines in (("even", distortion.even), ("odd", distortion.odd))
    }


def _entry(values: FloatArray | None, k: int) -> Any:
    """Number or lists of the k-th mode; None where something of it is not known."""
    return None if values is None or not np.all(np.isfinite(values[k])) else values[k].tolist()


# Half width of the band in units of the resonance's own half width: wide enough to see the mode die
# out.
HALF_WIDTHS = 5.0
FEWEST_LINES_EACH_SIDE = 20
# Lines that are so many times as far apart as those beside them belong to two stretches, between which nothing
# was excited.
GAP = 10.0


def _strongest_resonance_band(frf: FRF) -> tuple[float, float]:
    """Band around the line where the response moves fastest along its arc, within one stretch of lines.

    Kennedy & Pancu (J. Aeronaut. Sci. 14 (1947) 603-625): near a resonance G runs through a circle,
    and ``|dG/df|``, proportional to ``1 / ((f - f0)^2 + (damping f0)^2)``, is largest at the
    resonance whatever the other modes add. It is averaged over five lines against noise.
    """
    f = frf.frequency_hz
    require(f.size >= 10, "band", f"{f.size} excited lines", "10 or more, to find a resonance")
    speed = np.abs(np.diff(frf.g) / np.diff(f))
    speed = np.convolve(speed, np.ones(5) / 5, mode="same")
    speed[:2] = speed[-2:] = 0.0  # fewer than five lines were averaged there
    centre = int(np.argmax(speed))
    above = speed > speed[centre] / 2
    left = centre - int(np.argmin(above[centre::-1])) if not above[: centre + 1].all() else 0
    right = centre + int(np.argmin(above[centre:])) if not above[centre:].all() else f.size - 2
    half = max(int(HALF_WIDTHS * (right - left) / 2), FEWEST_LINES_EACH_SIDE)
    spacing = np.diff(f)
    gaps = 1 + np.flatnonzero(spacing[1:-1] > GAP * np.maximum(spacing[:-2], spacing[2:]))
    first = max((int(gap) + 1 for gap in gaps if gap < centre), default=0)
    last = min((int(gap) for gap in gaps if gap >= centre), default=f.size - 1)
    return float(f[max(centre - half, first)]), float(f[min(centre + half + 1, last)])
