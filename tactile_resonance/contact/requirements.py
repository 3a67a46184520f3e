# SPDX-License-Identifier: Apache-2.0
"""Whether a force source is good enough for the force asked of it."""

from __future__ import annotations

from tactile_resonance.contact.interfaces import ForceInfo

REFERENCE_RATE_HZ = 500.0
"""The control loop's. White noise of another rate is compared by its density."""
NOISE_SHARE = 0.10
"""Noise of one sample at the reference rate, per force asked for: 1 mN rms at 1 cN."""
RESOLUTION_SHARE = 0.03
"""Smallest step, per force asked for: 0.3 mN at 1 cN."""
SLOWEST_HZ = 200.0
"""Two samples within the 10 ms after which force data are too old."""
RANGE_FACTOR = 5.0
"""Range, per force asked for: the hard stop of contact control must be measurable."""


def unfit(info: ForceInfo, force_n: float) -> list[str]:
    """What keeps a source from serving a force, one sentence each with its figures.

    The limits are those with which the contact controller was simulated: with three times the noise the
    95 % quantile of its overshoot goes from 10 to 33 % (docs/force_sensors.md).

    Parameters
    ----------
    info : ForceInfo
    force_n : float
        Contact force asked for [N].
    """
    if not 0 < force_n < float("inf"):
        raise ValueError(f"force_n: {force_n!r}, expected a force above 0")
    noise_n = info.noise_rms_n * (REFERENCE_RATE_HZ / info.rate_hz) ** 0.5
    most_noise_n, most_step_n = NOISE_SHARE * force_n, RESOLUTION_SHARE * force_n
    slack = 1 + 1e-9
    reasons = []
    if not noise_n <= most_noise_n * slack:
        reasons.append(
            f"its noise is {noise_n * 1e3:.3g} mN rms (at {REFERENCE_RATE_HZ:g} Hz), at most "
            f"{most_noise_n * 1e3:.3g} mN serve"
        )
    if not info.resolution_n <= most_step_n * slack:
        reasons.append(
            f"its smallest step is {info.resolution_n * 1e3:.3g} mN, at most "
            f"{most_step_n * 1e3:.3g} mN serve"
        )
    if not info.rate_hz >= SLOWEST_HZ:
        reasons.append(f"it gives {info.rate_hz:g} Hz, at least {SLOWEST_HZ:g} Hz serve")
    if not info.range_n >= RANGE_FACTOR * force_n:
        reasons.append(
            f"its range is {info.range_n * 1e3:.4g} mN, at least {RANGE_FACTOR * force_n * 1e3:.3g} mN serve"
        )
    return reasons


def require_fit(info: ForceInfo, force_n: float) -> None:
    """Refuse a source that cannot serve a force.

    Raises
    ------
    ValueError
        With every reason and its figures.
    """
    reasons = unfit(info, force_n)
    if reasons:
        raise ValueError(
            f"force source {info.name} cannot control {force_n * 1e3:.3g} mN: {'; '.join(reasons)}"
        )
