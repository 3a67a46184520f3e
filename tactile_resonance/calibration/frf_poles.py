# SPDX-License-Identifier: Apache-2.0
"""Poles of an FRF through a calibrated sensor where its bins allow it and the data do not contradict it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tactile_resonance.calibration.contact_record import ContactRecord, Start
from tactile_resonance.calibration.estimator import CalibratedEstimator
from tactile_resonance.frf.result import FRF, FrfStatus
from tactile_resonance.poles.estimator import poles_of_bands
from tactile_resonance.poles.result import Poles, PolesStatus
from tactile_resonance.poles.structure import PoleBand

FEWEST_LINES = 3
IN_AIR_N_PER_M = 1.0
"""Stiffness below which the tip is in air; tissue at 1 cN has tens."""


def calibrated_poles(
    frf: FRF,
    bands: Sequence[PoleBand],
    estimator: CalibratedEstimator,
    force_n: float = float("nan"),
    force_std_n: float = 0.0,
    method: str = "auto",
) -> Poles:
    """Poles in all bands, those of the first one through the calibrated sensor.

    The records begin at rest. Where something stands against it the poles are those of `poles_of_bands`, and
    the message says what.

    Parameters
    ----------
    frf : FRF
        With the bins of the bands.
    bands : sequence of PoleBand
        One or more.
    estimator : CalibratedEstimator
    force_n, force_std_n : float
        Of the contact; NaN: unknown.
    method : str
        Of the black-box fit.
    """
    reason = _impossible(frf)
    if not reason:
        assert frf.bins is not None  # see `_impossible`
        record = ContactRecord.of_bins(frf.bins, Start.REST)
        try:
            found = estimator(record, force_n, force_std_n)
        except np.linalg.LinAlgError:  # its parameters ran away: no contact explains such a record
            found = None
        if found is None:
            reason = "the fit through it does not converge: the data contradict the calibration"
        elif abs(found.stiffness_n_per_m) < IN_AIR_N_PER_M:
            # a pole in air is to show whether the sensor is as calibrated, so that it must not be taken from it
            reason = "nothing is touched"
        elif found.poles.status is PolesStatus.OK:
            further = poles_of_bands(frf, bands, method).further if len(bands) > 1 else ()
            return replace(found.poles, further=further)
        else:
            reason = found.poles.message
    poles = poles_of_bands(frf, bands, method)
    note = f"without the calibrated sensor: {reason}"
    return replace(poles, message="; ".join(filter(None, [poles.message, note])))


def _impossible(frf: FRF) -> str:
    """Why there can be no calibrated estimate; empty where there can."""
    bins = frf.bins
    if frf.status is FrfStatus.FAILED or bins is None:
        return "the FRF brings no bins"
    if bins.u.shape[0] > 1:
        return f"{bins.u.shape[0]} realisations, of which one alone begins at rest"
    if bins.harmonics.size < FEWEST_LINES:
        return f"the band holds {bins.harmonics.size} excited lines, {FEWEST_LINES} are needed"
    lines = frf.frequency_hz.size
    held = sum(each.harmonics.size for each in (bins, *frf.further_bins))
    if held < lines:
        return f"{lines - held} excited lines lie outside of the bands"
    if frf.further_bins:
        return "lines of further bands are excited"
    known = np.isfinite(bins.u).all() and np.isfinite(bins.y).all()
    return "" if known else "bins are missing"
