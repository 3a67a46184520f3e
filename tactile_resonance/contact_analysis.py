# SPDX-License-Identifier: Apache-2.0
"""A whole recording to the contact that a calibrated sensor touched, and its JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tactile_resonance.analysis import Analysis, analyse, analysis_content
from tactile_resonance.calibration.contact import ContactStatus, Law, Moduli, TissueContact, moduli
from tactile_resonance.calibration.estimator import CalibratedEstimator, ContactRecord
from tactile_resonance.calibration.model import CalibratedSensor, read_calibration
from tactile_resonance.fields import band, known, number, read, require, require_kind
from tactile_resonance.frf.excited import find_excited_harmonics
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.poles.result import Poles
from tactile_resonance.recording.recording import Recording

BAND = (0.8, 1.6)
"""Of the mode in air: the band where none is asked for."""


@dataclass(frozen=True, eq=False)
class ContactAnalysis:
    """A contact, and what was made of the record without the calibration where they contradict each other.

    Attributes
    ----------
    contact : TissueContact
    moduli : Moduli
    black_box : Analysis or None
        Where the record contradicts the calibration, nothing is touched or the fit does not converge, and the
        record allows it.
    warnings : tuple of str
    """

    contact: TissueContact
    moduli: Moduli
    black_box: Analysis | None
    warnings: tuple[str, ...]

    @property
    def poles(self) -> Poles:
        """Those that count: of the calibrated sensor, else of the black box where there is one."""
        return self.contact.poles if self.black_box is None else self.black_box.poles


def estimate_contact(
    recording: Recording,
    sensor: CalibratedSensor | str | Path,
    *,
    band_hz: tuple[float, float] | None = None,
    force_n: float = float("nan"),
    force_std_n: float = 0.0,
    from_rest: bool = False,
    law: Law | str = Law.STANDARD_LINEAR_SOLID,
    relaxed_ratio: float = 1.0,
) -> ContactAnalysis:
    """Complex stiffness of a contact, moduli and pole, through a sensor that was calibrated.

    Parameters
    ----------
    recording : Recording
        Its first realisation is used. One period is enough where it begins at rest.
    sensor : CalibratedSensor or path
        As `tactile_resonance calibrate` writes it.
    band_hz : (low, high), optional
        From .8 to 1.6 times the mode of 100 to 500 Hz in air when absent.
    force_n : float
        Of the contact; NaN: unknown. The moduli need it, the stiffness hardly.
    force_std_n : float
        Its standard deviation, 0 or above.
    from_rest : bool
        The sensor was at rest at the first sample, and the record is the first of its excitation. Otherwise two
        periods or more are needed.
    law : Law or str
        How the modulus goes over the band.
    relaxed_ratio : float
        See `calibration.contact.moduli`.

    Raises
    ------
    ValueError
        If an argument is not accepted, or the record is too short.

    Examples
    --------
    A sensor of two modes, on a spring of 60 N/m with a dashpot, in the steady state:

    >>> import numpy as np
    >>> import tactile_resonance as tr
    >>> from tactile_resonance.calibration.model import CalibratedSensor, Calibration, SensorModel
    >>> model = SensorModel.of_values(
    ...     [236, 1540, 0.012, 0.012, 48.9, 170.7, 60.9, 46.4, 0.02, 3.5, 1.0, 0.0]
    ... )
    >>> known = Calibration(model, np.zeros((12, 12)), np.ones(12, bool), (10, 1e3), 1e-5, 1.0)
    >>> sensor = CalibratedSensor(known, 0.0025, np.nan, np.nan, {})
    >>> multisine = tr.design_multisine(
    ...     sample_rate_hz=5e3, samples_per_period=2000, band_hz=(200.0, 300.0), seed=1
    ... )
    >>> s = 2j * np.pi * multisine.frequency_hz
    >>> y = np.zeros(1001, complex)
    >>> y[multisine.harmonics] = model.response(s, 60 + 0.02 * s)
    >>> u = np.tile(multisine.period(), (4, 1))
    >>> y = np.fft.irfft(y * np.fft.rfft(u), 2000)
    >>> y += 5e-4 * np.random.default_rng(0).standard_normal(y.shape)
    >>> recording = tr.make_recording(u, y, sample_rate_hz=5e3, excited_harmonics=multisine.harmonics)
    >>> found = tr.estimate_contact(recording, sensor, band_hz=(200, 300), force_n=0.01)
    >>> k = found.contact.stiffness_n_per_m
    >>> print(f"{k.real:.0f} + {k.imag:.0f}j N/m, {found.contact.status.value}")
    60 + 32j N/m, ok
    """
    require_kind(recording, "recording", Recording)
    require_kind(sensor, "sensor", CalibratedSensor, str, Path)
    calibrated = sensor if isinstance(sensor, CalibratedSensor) else read_calibration(Path(sensor))
    realisations, periods, samples = recording.u.shape
    accepted = "two periods or more, or from_rest"
    require(from_rest or periods > 1, "periods", periods, accepted)
    if np.isfinite(force_n):
        require(number(force_n, "force_n") > 0, "force_n", force_n, "above 0")
        require(number(force_std_n, "force_std_n") >= 0, "force_std_n", force_std_n, "0 or above")
    ratio = number(relaxed_ratio, "relaxed_ratio")
    require(ratio > 0, "relaxed_ratio", ratio, "above 0")
    rate_hz = recording.sample_rate_hz
    if band_hz is None:
        f = calibrated.calibration.model.natural_rad_s / (2 * np.pi)
        middle = f[(f > 100) & (f < 500)]
        require(middle.size > 0, "band_hz", None, "a band: no mode in air is from 100 to 500 Hz")
        band_hz = (BAND[0] * float(middle[0]), BAND[1] * float(middle[0]))
    band_hz = band(band_hz, most_hz=rate_hz / 2)
    warnings = list(recording.notes)
    harmonics = recording.excited_harmonics
    if harmonics is None:
        harmonics = find_excited_harmonics(Spectrum.of(recording.u, recording.y))
        warnings.append(f"excited lines found from the input spectrum: {harmonics.size}")
    if realisations > 1:
        warnings.append(f"the first of {realisations} realisations is used")
    record = ContactRecord.of_samples(
        recording.u[0],
        recording.y[0],
        sample_rate_hz=rate_hz,
        harmonics=harmonics,
        band_hz=band_hz,
        from_rest=from_rest,
    )
    lines = int(np.count_nonzero(record.excited))
    require(lines > 2, "band_hz", band_hz, f"a band of three excited lines or more ({lines} found)")
    of_kind = law if isinstance(law, Law) else read(Law, law, "law")
    contact = CalibratedEstimator(calibrated.calibration, calibrated.tip_radius_m, of_kind)(
        record, force_n, force_std_n
    )
    black_box = None
    if contact.poles.message:
        warnings.append(f"contact: {contact.poles.message}")
    if contact.status is not ContactStatus.OK:
        why = "which the record contradicts"
        if contact.status is ContactStatus.NOT_CONVERGED:
            why = "through which the fit does not converge"
        elif contact.status is ContactStatus.NO_CONTACT:
            why = "since nothing is touched"
        try:
            black_box = analyse(recording, band_hz=band_hz)
            warnings.append(f"poles without the calibration, {why}")
        except ValueError as error:
            warnings.append(f"no poles without the calibration either: {error}")
    found = moduli(contact, ratio)
    if found.message:
        warnings.append(f"moduli: {found.message}")
    return ContactAnalysis(contact, found, black_box, tuple(warnings))


def contact_content(analysis: ContactAnalysis) -> dict[str, Any]:
    """Plain values of an analysis, as docs/calibration.md describes its JSON; null where unknown."""
    contact, found = analysis.contact, analysis.moduli
    main, black_box = contact.poles.main, analysis.black_box
    return {
        "stiffness_n_per_m": [contact.stiffness_n_per_m.real, contact.stiffness_n_per_m.imag],
        "stiffness_covariance": contact.stiffness_covariance.tolist(),
        "stiffness_total_covariance": contact.stiffness_total.tolist(),
        "at_hz": main.f0_hz,
        "law": contact.prior.law.value,
        "pole_rad_s": [main.pole_rad_s.real, main.pole_rad_s.imag],
        "f0_hz": main.f0_hz,
        "damping_ratio": main.damping_ratio,
        "covariance": main.noise.tolist(),
        "total_covariance": main.covariance.tolist(),
        "band_hz": list(contact.poles.band_hz),
        "chi_square": contact.poles.cost,
        "degrees_of_freedom": int(contact.poles.expected_cost),
        "status": contact.status.value,
        "moduli": {
            **{name: known(value) for name, value in asdict(found).items() if isinstance(value, float)},
            "status": found.status.value,
        },
        "black_box": None if black_box is None else analysis_content(black_box),
        "warnings": list(analysis.warnings),
    }
