# SPDX-License-Identifier: Apache-2.0
"""Which estimator of the poles the data at hand allow, and how many poles the lines speak for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tactile_resonance.frf.result import FRF, FrfStatus
from tactile_resonance.poles.identify import identify_frf
from tactile_resonance.poles.joint_records import identify_poles_from_bins
from tactile_resonance.poles.result import Poles, PolesStatus
from tactile_resonance.poles.structure import ModelStructure, PoleBand

POLES_METHODS = ("auto", "joint", "frf")


def poles_of_frf(
    frf: FRF,
    band_hz: tuple[float, float],
    structure: ModelStructure | None = None,
    method: str = "auto",
) -> Poles:
    """Poles from the bins that come with an FRF, else from the FRF itself.

    Parameters
    ----------
    frf : FRF
        With (F,) arrays.
    band_hz : (low, high)
    structure : ModelStructure, optional
        One mode and six residual terms when absent.
    method : {"auto", "joint", "frf"}
        ``auto`` is ``joint`` where the FRF brings bins that cover the band and hold lines enough.

    Returns
    -------
    Poles
        Always with a status; its ``method`` says which was taken.

    Raises
    ------
    ValueError
        If the method is unknown, or ``joint`` is not possible.
    """
    if method not in POLES_METHODS:
        raise ValueError(f"method: {method!r}, accepted are {', '.join(POLES_METHODS)}")
    structure = structure or ModelStructure()
    if frf.status is FrfStatus.FAILED or frf.frequency_hz.size == 0:
        return Poles(status=PolesStatus.FAILED, message=frf.message)
    reason = _joint_impossible(frf, band_hz, structure)
    if method == "joint" and reason:
        raise ValueError(f"method: joint, but {reason}")
    if method == "frf" or frf.bins is None or reason:
        poles = identify_frf(frf, band_hz, structure)
        if method == "auto" and frf.bins is not None:
            poles = poles.noting(f"from the FRF: {reason}")
        return poles
    notes = [frf.message] if frf.status is not FrfStatus.OK else []
    poles = identify_poles_from_bins(frf.bins, band_hz, structure, notes=notes)
    return second_attempt(poles, frf, band_hz, structure)


def poles_of_bands(frf: FRF, bands: Sequence[PoleBand], method: str = "auto") -> Poles:
    """Poles in several bands of one FRF, each fitted alone; those of the second and so on as `further`.

    Parameters
    ----------
    frf : FRF
        Its bins are those of the bands, in their order, where it brings any.
    bands : sequence of PoleBand
        One or more.
    method : str
        See `poles_of_frf`.
    """
    bins = [frf.bins, *frf.further_bins, *[None] * len(bands)]

    def of_band(k: int, band: PoleBand) -> Poles:
        alone = replace(frf, bins=bins[k], further_bins=())

        def fit(structure: ModelStructure) -> Poles:
            return poles_of_frf(alone, band.ends_hz, structure, method)

        if band.order == 0 and frf.status is not FrfStatus.FAILED:
            return choose_among(fit).best
        return fit(ModelStructure.with_residual(band.order or 2, band.residual_terms))

    first, *further = (of_band(k, band) for k, band in enumerate(bands))
    return replace(first, further=tuple(further))


def second_attempt(
    poles: Poles, frf: FRF, band_hz: tuple[float, float], structure: ModelStructure
) -> Poles:
    """Poles from the FRF where the joint fit of the same record did not converge, and says so.

    Parameters
    ----------
    poles : Poles
        From a joint fit; returned as they are unless it did not converge.
    frf : FRF
        With (F,) arrays.
    band_hz : (low, high)
    structure : ModelStructure
    """
    if poles.status is not PolesStatus.NOT_CONVERGED:
        return poles
    again = identify_frf(frf, band_hz, structure)
    if again.status not in (PolesStatus.OK, PolesStatus.MODEL_ERROR, PolesStatus.NO_COVARIANCE):
        return poles.noting(f"from the FRF: {again.status.value}")
    return again.noting("from the FRF: the joint fit did not converge")


def _joint_impossible(frf: FRF, band_hz: tuple[float, float], structure: ModelStructure) -> str:
    """Why there can be no joint estimate; empty where there can."""
    bins = frf.bins
    if bins is None:
        return (
            "the FRF brings no bins: they were not asked for, or its realisations differ in periods"
        )
    low_hz, high_hz = bins.band_hz
    margin = bins.resolution_hz * (1 + 1e-9)  # the band's ends need not lie on bins
    if band_hz[0] <= low_hz - margin or band_hz[1] >= high_hz + margin:
        return f"the bins cover {low_hz:g} to {high_hz:g} Hz of {band_hz[0]:g} to {band_hz[1]:g} Hz"
    line_hz = bins.sample_rate_hz / bins.samples_per_period
    lines = bins.harmonics * line_hz
    count = int(((lines >= band_hz[0]) & (lines <= band_hz[1])).sum())
    if count <= structure.fewest_lines:
        return (
            f"the band holds {count} excited lines, more than {structure.fewest_lines} are needed"
        )
    if structure.delay:
        return "it estimates no delay"
    return ""


CANDIDATES = tuple(ModelStructure.with_residual(n, r) for n in (2, 4, 6) for r in (6, 8, 10))
"""One to three modes, with six to ten residual terms."""


@dataclass(frozen=True)
class OrderChoice:
    """Candidates and the one to take.

    Attributes
    ----------
    poles : tuple of Poles
        Of each candidate, in the order given.
    mdl : tuple of float
        ``(cost / F) exp(n log(2 F) / (2 F - n - 2))`` of each: minimum description length, with the
        correction for few lines. Infinite where there is no result.
    chosen : int
        Index of the smallest.
    """

    poles: tuple[Poles, ...]
    mdl: tuple[float, ...]
    chosen: int

    @property
    def best(self) -> Poles:
        """Of the chosen structure; the message says that it was chosen."""
        poles = self.poles[self.chosen]
        orders = f"{poles.structure.order} and {poles.structure.numerator_order}"
        return poles.noting(f"orders {orders} chosen by description length from {len(self.mdl)}")

    @property
    def structure(self) -> ModelStructure:
        """The chosen one."""
        return self.poles[self.chosen].structure


def choose_among(
    fit: Callable[[ModelStructure], Poles], candidates: Sequence[ModelStructure] = CANDIDATES
) -> OrderChoice:
    """Fit several structures to the same data and choose by minimum description length.

    Parameters
    ----------
    fit : callable
        May raise a `ValueError` where the data are too few for a structure, which is then left out.
    candidates : sequence of ModelStructure

    Raises
    ------
    ValueError
        If there is no candidate, or none has a result whose noise is known: the cost then says nothing.

    References
    ----------
    De Ridder, Pintelon, Schoukens & Gillikin, *Modified AIC and MDL model selection criteria for
    short data records*, IEEE Trans. Instrum. Meas. 54 (2005) 144-150.
    """
    if not candidates:
        raise ValueError("candidates: none given, expected one structure at least")
    fits, refused = [], None
    for structure in candidates:
        try:
            fits.append(fit(structure))
        except ValueError as error:
            refused = error
    if not fits:
        assert refused is not None
        raise refused
    poles = tuple(fits)
    mdl = tuple(_description_length(p) for p in poles)
    chosen = int(np.argmin(mdl))
    if not np.isfinite(mdl[chosen]):
        raise ValueError(
            "candidates: none has a result with a known level of noise, more lines or smaller orders "
            "are needed"
        )
    return OrderChoice(poles, mdl, chosen)


def _description_length(poles: Poles) -> float:
    usable = (PolesStatus.OK, PolesStatus.MODEL_ERROR, PolesStatus.NO_RESONANCE)
    data, n = 2 * poles.lines, poles.structure.parameters
    if poles.status not in usable or data <= n + 2 or not np.isfinite(poles.cost):
        return float("inf")
    return poles.cost / poles.lines * float(np.exp(n * np.log(data) / (data - n - 2)))
