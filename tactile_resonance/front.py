# SPDX-License-Identifier: Apache-2.0
"""One call per stage, for users of the library: a recording, its frequency response, its poles.

The names are those of the package itself (``import tactile_resonance as tr``).
"""

from __future__ import annotations

import errno
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_resonance.analysis import analyse
from tactile_resonance.fields import require, require_kind, whole
from tactile_resonance.frf.estimate import frf_of_record, with_narrow_modes_judged
from tactile_resonance.frf.excited import find_excited_harmonics
from tactile_resonance.frf.result import FRF, FrfStatus
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.poles.identify import identify_frf
from tactile_resonance.poles.result import Poles, PolesStatus
from tactile_resonance.poles.structure import ModelStructure
from tactile_resonance.recording.recording import Recording, read_recording
from tactile_resonance.recording.store import read_measurement, recording_of

if TYPE_CHECKING:
    from tactile_resonance.scan.run_content import RunContent

FIELDS = {"u", "y", "sample_rate_hz", "samples_per_period", "segments", "excited_harmonics"}
"""What `read_record` passes on to the reader of a file."""

WITHOUT_ROSBAGS = "rosbags not found, which reads runs: pip install 'rosbags>=0.11.1,<0.12'"


def read_record(
    path: str | PathLike[str],
    measurement_id: int | None = None,
    *,
    periods: int | None = None,
    **fields: Any,
) -> Recording:
    """Read whole periods of both channels.

    Parameters
    ----------
    path : path
        A file (``.npz``, ``.mat``, ``.csv``), a folder of records that the nodes stored, or the run of a
        scan.
    measurement_id : int, optional
        Which one of a folder or run that holds several.
    periods : int, optional
        Use the first so many.
    **fields
        Of a file: names of its fields, `u` and `y`, and what overrides its content, ``sample_rate_hz``,
        ``samples_per_period``, ``segments``, ``excited_harmonics``. See `recording.recording.read_recording`.

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted.
    OSError
        If it cannot be opened.

    Examples
    --------
    >>> recording = tr.read_record("runs/demo", measurement_id=3)  # doctest: +SKIP
    """
    require_kind(path, "path", str, PathLike)
    path = Path(path)
    if measurement_id is not None:
        measurement_id = whole(measurement_id, "measurement_id")
    if periods is not None:
        periods = whole(periods, "periods", 1)
    fields = {name: value for name, value in fields.items() if value is not None}
    unknown = sorted(set(fields) - FIELDS)
    if unknown:
        accepted = ", ".join(sorted(FIELDS))
        raise ValueError(f"{', '.join(unknown)}: unknown; accepted are {accepted}")
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, "no such file or folder", str(path))
    if not path.is_dir():
        accepted = "none with a file, only with a folder of records"
        require(measurement_id is None, "measurement_id", measurement_id, accepted)
        return read_recording(path, periods=periods, **fields)
    for name in fields:
        raise ValueError(f"{name}: only for a file; {path} is a folder, whose records say it")
    if not (path / "run.json").is_file():
        return recording_of(read_measurement(path, measurement_id), periods)
    try:
        from tactile_resonance.scan.recorded import read_recorded
    except ImportError as error:
        raise ValueError(f"{path}: {WITHOUT_ROSBAGS}") from error
    return recording_of(read_recorded(path, measurement_id), periods)


def read_run(path: str | PathLike[str]) -> RunContent:
    """Read the run of a scan: its plan, and the result of each point, also while it is recorded.

    Parameters
    ----------
    path : path
        Folder of the run.

    Returns
    -------
    RunContent
        ``facts``, ``points`` of the plan, and ``results``, a `scan.point_result.PointResult` for each attempt.

    Raises
    ------
    ValueError
        If it is not a run, or rosbags is not installed.

    Examples
    --------
    >>> run = tr.read_run("runs/demo")  # doctest: +SKIP
    >>> [result.f0_hz for result in run.results]  # doctest: +SKIP
    """
    require_kind(path, "path", str, PathLike)
    path = Path(path)
    if not (path / "run.json").is_file():
        what = "a folder without run.json" if path.is_dir() else "a file"
        what = what if path.exists() else "not there"
        raise ValueError(f"path: {path} is {what}; accepted is the folder of a scan's run")
    try:
        from tactile_resonance.scan import run_content
    except ImportError as error:
        raise ValueError(f"{path}: {WITHOUT_ROSBAGS}") from error
    return run_content.read_run(path)


def estimate_frf(recording: Recording, *, method: str = "local polynomial") -> FRF:
    """Frequency response at the excited lines, with the covariances that the recording allows.

    Parameters
    ----------
    recording : Recording
        Its excited lines are found from the input spectrum where it does not name them.
    method : {"local polynomial", "average"}
        See `frf.estimate.frf_of_record`.

    Raises
    ------
    ValueError
        For another method, or a channel that does not move.

    Examples
    --------
    Four periods of a resonance at 250 Hz with a damping ratio of 2 %, in the steady state:

    >>> import numpy as np
    >>> import tactile_resonance as tr
    >>> multisine = tr.design_multisine(
    ...     sample_rate_hz=5e3, samples_per_period=2000, band_hz=(200.0, 300.0), seed=1
    ... )
    >>> period = multisine.period()
    >>> s, w0 = 2j * np.pi * np.fft.rfftfreq(2000, 1 / 5e3), 2 * np.pi * 250
    >>> g = 0.04 * w0**2 / (s**2 + 2 * 0.02 * w0 * s + w0**2)
    >>> u = np.tile(period, (4, 1))
    >>> y = np.tile(np.fft.irfft(g * np.fft.rfft(period)), (4, 1))
    >>> y = y + 1e-3 * np.random.default_rng(0).standard_normal(y.shape)
    >>> recording = tr.make_recording(u, y, sample_rate_hz=5e3, excited_harmonics=multisine.harmonics)
    >>> frf = tr.estimate_frf(recording)
    >>> frf.g.shape, frf.status.value
    ((41,), 'ok')
    >>> poles = tr.identify_poles(recording, band_hz=(200, 300))
    >>> print(f"{poles.main.f0_hz:.2f} Hz, {poles.main.damping_ratio:.4f}, {poles.status.value}")
    250.00 Hz, 0.0200, ok
    >>> bool(np.all(np.abs(poles.main.estimate - [250, 0.02]) < 4 * poles.main.std))
    True
    """
    require_kind(recording, "recording", Recording)
    recording.require_driven()
    record = Spectrum.of(recording.u, recording.y)
    harmonics = recording.excited_harmonics
    if harmonics is None:
        harmonics = find_excited_harmonics(record)
    rate_hz = recording.sample_rate_hz
    return with_narrow_modes_judged(
        frf_of_record(record, harmonics, sample_rate_hz=rate_hz, method=method)
    )


def identify_poles(
    data: Recording | FRF,
    band_hz: tuple[float, float] | None = None,
    structure: ModelStructure | None = None,
) -> Poles:
    """Poles of the model of one band, with their covariance.

    Parameters
    ----------
    data : Recording or FRF
        From a recording: all bins of the band, the transient of each realisation estimated along; from a
        frequency response: its lines, weighted with their variance. Spectra with a noise covariance:
        `identify_spectra`; many points of one kind: `PoleEstimator`, `identify_batch`.
    band_hz : (low, high), optional
        When absent, around the strongest resonance of a recording, or all lines of a response.
    structure : ModelStructure, optional
        One mode and six residual terms when absent.

    Returns
    -------
    Poles
        Its `status` says what it is worth; ``main`` is the mode with the highest peak and
        ``best_covariance`` the covariance that counts.

    Raises
    ------
    ValueError
        If an argument is not accepted, or the band holds too few lines with finite values for the model.

    Examples
    --------
    From a response of your own, with the variance of its errors, a mean over eight periods:

    >>> import numpy as np
    >>> import tactile_resonance as tr
    >>> frequency_hz = np.arange(200.0, 300.1, 2.5)
    >>> s, w0 = 2j * np.pi * frequency_hz, 2 * np.pi * 250
    >>> g = 0.04 * w0**2 / (s**2 + 2 * 0.02 * w0 * s + w0**2)
    >>> noise = np.random.default_rng(0).standard_normal((2, g.size))
    >>> g = g + 1e-3 * (noise[0] + 1j * noise[1]) / np.sqrt(2)
    >>> frf = tr.FRF(frequency_hz, g, variance_noise=np.full(g.size, 1e-6), noise_dof=7)
    >>> poles = tr.identify_poles(frf)
    >>> print(f"{poles.main.f0_hz:.3f} Hz +- {poles.main.std[0]:.3f}, {poles.status.value}")
    249.999 Hz +- 0.004, ok
    """
    require_kind(data, "data", Recording, FRF)
    if isinstance(data, FRF):
        poles = identify_frf(data, band_hz, structure)
        if poles.status is PolesStatus.TOO_FEW_LINES:
            raise ValueError(f"band_hz: {poles.message}")
        return poles
    analysis = analyse(data, band_hz=band_hz, structure=structure)
    of_record = analysis.faults.message if analysis.faults.suspect else ""
    if analysis.poles.status is not PolesStatus.OK and analysis.frf.status is FrfStatus.SUSPECT:
        of_record = analysis.frf.message  # these faults, and whether lines were driven at all
    message = "; ".join(filter(None, [of_record, analysis.poles.message]))
    return replace(analysis.poles, message=message)
