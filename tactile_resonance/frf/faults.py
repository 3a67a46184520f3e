# SPDX-License-Identifier: Apache-2.0
"""Acquisition faults that a record shows by itself."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tactile_resonance.frf import record_checks as checks
from tactile_resonance.frf.fault_types import Fault, FaultReport, worst_of


def find_faults(
    u: npt.NDArray[np.floating],
    y: npt.NDArray[np.floating],
    *,
    sample_rate_hz: float,
    harmonics: npt.NDArray[np.integer],
    u_range_v: tuple[float, float] | None = None,
    y_range_v: tuple[float, float] | None = None,
    transient_removed: bool = False,
) -> FaultReport:
    """Look for acquisition faults in records.

    Parameters
    ----------
    u, y : (..., P, N) float
        Actuator and sensor [V].
    sample_rate_hz : float
    harmonics : (F,) int
        Excited lines.
    u_range_v, y_range_v : (low, high), optional
        Ends of the range of each channel [V]. Without them, saturation shows only as a flat top.
    transient_removed : bool
        The FRF comes from a method that removes transients (local polynomial), or the first period
        is dropped: one that has not settled, or a slow drift, then does no harm.

    Returns
    -------
    FaultReport

    Raises
    ------
    ValueError
        If shapes differ.

    Notes
    -----
    What is looked for, per record: `record_checks`. A channel skew needs a loop-back measurement
    (`skew.skew_from_loopback`); from an FRF it can only be suspected (`skew.suspected_skew`).
    """
    u, y = np.asarray(u), np.asarray(y)
    if u.ndim < 2 or u.shape != y.shape:
        raise ValueError(f"u, y: shapes {u.shape}, {y.shape}, expected the same (..., P, N)")
    shape = u.shape[-2:]
    reports = []
    for record_u, record_y in zip(u.reshape(-1, *shape), y.reshape(-1, *shape), strict=True):
        faults: list[Fault] = []
        for x, channel, range_v in (
            (record_u, "actuator", u_range_v),
            (record_y, "sensor", y_range_v),
        ):
            faults += checks.missing_samples(x, channel, harmonics)
            if not np.all(np.isfinite(x)):
                continue  # nothing else can be told
            faults += checks.saturation(x, channel, range_v)
            faults += checks.offset(x, channel)
            faults += checks.drift(x, channel, spoils=not transient_removed)
            faults += checks.hum(x, channel, sample_rate_hz, harmonics)
            faults += checks.lost_samples(x, channel, harmonics)
            faults += checks.unsettled(x, channel, harmonics, spoils=not transient_removed)
        reports.append(faults)
    return worst_of(reports)
